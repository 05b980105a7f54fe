"""igtl-gateway: bridge between ROS 2 and OpenIGTLink, with recording, replay and verification.

The names of the Python API load at their first use: ``import igtl_gateway`` alone imports nothing else, so that the
command line starts fast.
"""

from __future__ import annotations

import sys

from igtl_gateway.base.version import __version__

TYPE_CHECKING = False  # as typing has it, whose import takes longer than all else here

if TYPE_CHECKING:
    from typing import Any

    from igtl_gateway.api import aio
    from igtl_gateway.api.alignment import align
    from igtl_gateway.api.bridge import Bridge
    from igtl_gateway.api.lags import lag
    from igtl_gateway.api.peer import Peer, Server, connect, serve
    from igtl_gateway.api.poses import Poses
    from igtl_gateway.api.recording import Recording, open
    from igtl_gateway.api.stream import Stream
    from igtl_gateway.api.verbs import diff, replay, review, verify

__all__ = [
    "Bridge",
    "Peer",
    "Poses",
    "Recording",
    "Server",
    "Stream",
    "__version__",
    "aio",
    "align",
    "connect",
    "diff",
    "lag",
    "open",
    "replay",
    "review",
    "serve",
    "verify",
]

#: Public name → its module in ``igtl_gateway.api``; a name that is its module is that module.
_HOMES: dict[str, str] = {
    "Bridge": "bridge",
    "Peer": "peer",
    "Poses": "poses",
    "Recording": "recording",
    "Server": "peer",
    "Stream": "stream",
    "aio": "aio",
    "align": "alignment",
    "connect": "peer",
    "diff": "verbs",
    "lag": "lags",
    "open": "recording",
    "replay": "verbs",
    "review": "verbs",
    "serve": "peer",
    "verify": "verbs",
}
#: Public functions whose names packages have, too: the package is called, see `CallablePackage`.
_PACKAGES = frozenset({"replay", "review"})


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    if name in _PACKAGES:
        from importlib import import_module

        found = import_module(f"{__name__}.{name}")
    else:
        found = _load(name)
    globals()[name] = found
    return found


def _load(name: str) -> Any:
    """Return a public name from its module in ``igtl_gateway.api``."""
    from importlib import import_module

    home = _HOMES[name]
    module = import_module(f"{__name__}.api.{home}")
    return module if name == home else getattr(module, name)


class CallablePackage(type(sys)):  # type: ignore[misc]
    """A package that is called as the public function of its name: ``igtl_gateway.replay("out.mcap")``."""

    def __call__(self, *arguments: Any, **options: Any) -> Any:
        return _load(self.__name__.rpartition(".")[2])(*arguments, **options)


def __dir__() -> list[str]:
    return sorted({*__all__, *(name for name in globals() if name.startswith("__"))})
