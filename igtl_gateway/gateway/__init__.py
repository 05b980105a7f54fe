"""The gateway: a pure function from each input entry to the entries that it causes.

``Gateway.handle`` reads no clock, no file and no socket.  Its state (links, names, counters) depends on the inputs
only.  The same inputs with the same configuration therefore give the same outputs: live, in a replay and in a
verification.  All three use it through ``Session``, which adds the numbering.
"""

from igtl_gateway.gateway.core import LISTENED, TICK, Gateway
from igtl_gateway.gateway.dialogue.links import LINK_DOWN, LINK_UP, LINKS_TOPIC
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
