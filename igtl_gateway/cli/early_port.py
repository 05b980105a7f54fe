"""The ports of ``bridge``, found in the command line before its options are known, so that they are taken at once.

The options of a verb are known only after its modules are imported, which takes most of the time of a start.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence

from igtl_gateway.cli.options import DEFAULT_HOST, DEFAULT_PORT, address

_LISTEN = "--listen"
#: With one of these, a bridge without ``--listen`` may have other ports than the usual one.
_ELSEWHERE = ("--connect", "--config", "--ros-args")
#: With one of these there is no bridge, or not yet.
_NO_BRIDGE = ("--types", "--help", "-h", "--version", "--no-autostart")


def early_ports(words: Sequence[str]) -> list[tuple[str, int]]:
    """Return the addresses that the command line of a bridge names; none where that is not clear.

    Args:
        words: the command line, with the verb.
    """
    found, names = [], [word.partition("=")[0] for word in words if word.startswith("-")]
    full = (_LISTEN, *_ELSEWHERE, *_NO_BRIDGE)
    if any(name in _NO_BRIDGE or (name not in full and _is_abbreviation(name, full)) for name in names):
        return []
    for word, following in zip(words, [*words[1:], ""], strict=True):
        name, given, value = word.partition("=")
        if name == _LISTEN:
            try:
                found.append(address((value if given else following).rpartition("://")[2]))
            except argparse.ArgumentTypeError:  # the parser reports it
                return []
    if found or any(name in _ELSEWHERE for name in names):
        return found
    return [(DEFAULT_HOST, DEFAULT_PORT)]


def _is_abbreviation(name: str, names: Sequence[str]) -> bool:
    return name.startswith("--") and any(full.startswith(name) for full in names)
