"""igtl-gateway: bridge between ROS 2 and OpenIGTLink, with recording, replay and verification.

The names of the Python API load at their first use: ``import igtl_gateway`` alone imports nothing else, so that the
command line starts fast.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from igtl_gateway.api import aio
    from igtl_gateway.api.peer import Peer, Server, connect, serve
    from igtl_gateway.api.poses import Poses
    from igtl_gateway.api.recording import Recording, open
    from igtl_gateway.api.stream import Stream

__version__ = "0.1.0"

__all__ = ["Peer", "Poses", "Recording", "Server", "Stream", "__version__", "aio", "connect", "open", "serve"]

#: Public name → its module in ``igtl_gateway.api``; a name that is its module is that module.
_HOMES: dict[str, str] = {
    "Peer": "peer",
    "Poses": "poses",
    "Recording": "recording",
    "Server": "peer",
    "Stream": "stream",
    "aio": "aio",
    "connect": "peer",
    "open": "recording",
    "serve": "peer",
}


def __getattr__(name: str) -> Any:
    home = _HOMES.get(name)
    if home is None:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from importlib import import_module

    module = import_module(f"{__name__}.api.{home}")
    found = module if name == home else getattr(module, name)
    globals()[name] = found
    return found


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
