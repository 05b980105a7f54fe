"""The gateway: a pure function from each input entry to the entries that it causes.

``Gateway.handle`` reads no clock, no file and no socket.  Its state (links, names, counters) depends on the inputs
only.  The same inputs with the same configuration therefore give the same outputs: live, in a replay and in a
verification.  All three use it through ``Session``, which adds the numbering.

The names load at their first use: the recorder's process needs the session log of this package, and none of them.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from igtl_gateway.gateway.core import LISTENED, TICK, Gateway
    from igtl_gateway.gateway.dialogue.links import LINKS_TOPIC
    from igtl_gateway.gateway.log.note import LINK_DOWN, LINK_UP
    from igtl_gateway.gateway.relay import CUT, FAULT, PARTNER, RelayGateway
    from igtl_gateway.gateway.session import Core, Session, header_names, make_core

__all__ = [
    "CUT",
    "FAULT",
    "LINKS_TOPIC",
    "LINK_DOWN",
    "LINK_UP",
    "LISTENED",
    "PARTNER",
    "TICK",
    "Core",
    "Gateway",
    "RelayGateway",
    "Session",
    "header_names",
    "make_core",
]


def __getattr__(name: str) -> Any:
    """Import the names of the package when one of them is first used."""
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from igtl_gateway.gateway import core, relay, session
    from igtl_gateway.gateway.dialogue import links
    from igtl_gateway.gateway.log import note

    for module in (core, links, note, relay, session):
        globals().update({each: getattr(module, each) for each in __all__ if hasattr(module, each)})
    return globals()[name]
