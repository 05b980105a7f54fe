"""igtl-gateway: bridge between ROS 2 and OpenIGTLink, with recording, replay and verification.

The names of the Python API load at their first use: ``import igtl_gateway`` alone imports nothing else, so that the
command line starts fast.
"""

from __future__ import annotations

from igtl_gateway.base.version import __version__

TYPE_CHECKING = False  # as typing has it, whose import takes longer than all else here

if TYPE_CHECKING:
    from typing import Any

    from igtl_gateway.addons.resim.api import resim
    from igtl_gateway.addons.review.api import review
    from igtl_gateway.addons.sync.lags import lag
    from igtl_gateway.api import aio
    from igtl_gateway.api.alignment import align
    from igtl_gateway.api.bridge import Bridge
    from igtl_gateway.api.peer import Peer, Server, connect, serve
    from igtl_gateway.api.poses import Poses
    from igtl_gateway.api.recording import Recording, open
    from igtl_gateway.api.stream import Stream
    from igtl_gateway.api.verbs import diff, replay_recording, verify

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
    "replay_recording",
    "resim",
    "review",
    "serve",
    "verify",
]

#: Public name → its module; a name that is its module is that module.
_HOMES: dict[str, str] = {
    "Bridge": "api.bridge",
    "Peer": "api.peer",
    "Poses": "api.poses",
    "Recording": "api.recording",
    "Server": "api.peer",
    "Stream": "api.stream",
    "aio": "api.aio",
    "align": "api.alignment",
    "connect": "api.peer",
    "diff": "api.verbs",
    "lag": "addons.sync.lags",
    "open": "api.recording",
    "replay_recording": "api.verbs",
    "resim": "addons.resim.api",
    "review": "addons.review.api",
    "serve": "api.peer",
    "verify": "api.verbs",
}


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from importlib import import_module

    home = _HOMES[name]
    if home.startswith("addons."):
        from igtl_gateway.base.addons import check_present

        check_present(home.split(".")[1])
    module = import_module(f"{__name__}.{home}")
    found = module if home.endswith(f".{name}") else getattr(module, name)
    globals()[name] = found
    return found


def __dir__() -> list[str]:
    return sorted({*__all__, *(name for name in globals() if name.startswith("__"))})
