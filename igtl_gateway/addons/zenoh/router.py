"""A router of Zenoh: what ``rmw_zenohd`` is, where it is not installed.

A router is a session in the mode of a router.  ``ZENOH_ROUTER_CONFIG_URI`` names a file with its configuration, which
may have certificates, access control and limits.
"""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from typing import Any

from igtl_gateway.addon import ConfigError, Unavailable
from igtl_gateway.addons.zenoh.config import made, value_of
from igtl_gateway.addons.zenoh.library import first_line, import_zenoh
from igtl_gateway.addons.zenoh.notation import ZENOH_LISTEN

ROUTER_FILE = "ZENOH_ROUTER_CONFIG_URI"

_ROUTER: dict[str, Any] = {
    "mode": "router",
    "listen/endpoints": [ZENOH_LISTEN],
    "scouting/multicast/enabled": False,
    "timestamping/enabled": True,
}
_CHANGES = 1000


class Router:
    """A running router.

    Args:
        listen: endpoints; (): those of the file, or the usual one.
        connect: endpoints of other routers.
        environ: the environment.
        wake: called, from a thread of Zenoh, when there is something for `changes`.

    Attributes:
        zid: its id.
        endpoints: where it listens.

    Raises:
        RosError: Zenoh is not installed.
        ConfigError: a wrong configuration.
        Unavailable: a port is in use.
    """

    def __init__(
        self,
        listen: Sequence[str],
        connect: Sequence[str],
        wake: Callable[[], None],
        environ: Mapping[str, str] = os.environ,
    ) -> None:
        self._zenoh = import_zenoh()
        self._wake = wake
        self._changes: deque[str] = deque(maxlen=_CHANGES)
        given = {"listen/endpoints": list(listen), "connect/endpoints": list(connect)}
        config = made(_ROUTER, ROUTER_FILE, {name: found for name, found in given.items() if found}, environ)
        if value_of(config, "mode") != "router":
            raise ConfigError(f"{ROUTER_FILE}: found mode {value_of(config, 'mode')!r}, expected 'router'")
        self.endpoints = _endpoints(config)
        try:
            self._session = self._zenoh.open(config)
        except Exception as error:  # zenoh's class is one for all causes
            raise Unavailable(f"no router on {', '.join(self.endpoints)}: {first_line(error)}") from None
        self.zid = str(self._session.info.zid())
        self._listener = self._session.info.declare_transport_events_listener(self._on_transport, history=True)

    def changes(self) -> list[str]:
        """Return what has happened since the last call: one line for each session that came or left."""
        return [self._changes.popleft() for _ in range(len(self._changes))]

    def close(self) -> None:
        """End the router; a session that does not close in the time that Zenoh gives it ends with the process."""
        with suppress(Exception):  # zenoh's class is one for all causes
            self._session.close()

    def _on_transport(self, event: Any) -> None:
        came = event.kind == self._zenoh.SampleKind.PUT
        self._changes.append(f"{event.transport.whatami} {event.transport.zid} {'connected' if came else 'left'}")
        self._wake()


def _endpoints(config: Any) -> tuple[str, ...]:
    found = value_of(config, "listen/endpoints")
    if isinstance(found, dict):  # by mode
        found = found.get("router")
    return tuple(str(each) for each in found or ())
