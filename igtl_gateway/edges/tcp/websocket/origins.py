"""Whose pages may connect: every page of every site that a user's browser shows can open a WebSocket to any address."""

from __future__ import annotations

import ipaddress
from collections.abc import Sequence
from urllib.parse import urlsplit

#: Stands for every origin.
ANY = "*"
#: Ports that browsers leave out.
_USUAL = {"http": ":80", "https": ":443"}


class Origins:
    """The origins whose pages may connect (RFC 6454: scheme, host and port), beside those of this machine.

    Without being named, pages of ``localhost`` and of loopback addresses may, and pages of the numeric address at
    which they connect.  A name as such is no proof: any name can be made to point here (DNS rebinding).  A program
    that is not a browser gives no origin.

    Args:
        named: such as ``https://viewer.clinic:8443``; ``null``: files and sandboxed pages; ``*``: all.
    """

    def __init__(self, named: Sequence[str] = ()) -> None:
        self._named = frozenset(map(_plain, named))

    def allow(self, origin: str | None, host: str) -> bool:
        """Return whether a page may connect.

        Args:
            origin: as the browser gives it; None: no browser.
            host: where it connects to, as the header Host has it.
        """
        if origin is None or ANY in self._named or _plain(origin) in self._named:
            return True
        theirs = _hostname(origin)
        return (
            theirs == "localhost" or _is_loopback(theirs) or (_is_numeric(theirs) and theirs == _hostname(f"//{host}"))
        )


def _plain(origin: str) -> str:
    """An origin as browsers write it: in lower case, without the usual port."""
    origin = origin.lower()
    return origin.removesuffix(_USUAL.get(origin.partition("://")[0], ""))


def _hostname(address: str) -> str:
    """The host of an address, in lower case; ``""`` for none."""
    try:
        return urlsplit(address).hostname or ""
    except ValueError:
        return ""


def _is_numeric(host: str) -> bool:
    try:
        ipaddress.ip_address(host)
    except ValueError:
        return False
    return True


def _is_loopback(host: str) -> bool:
    return _is_numeric(host) and ipaddress.ip_address(host).is_loopback
