"""What the application needs of a ROS side, and what a side of any middleware is made with.

``side`` is the interface.  ``publishers`` and ``subscriptions`` are the halves that the sides over DDS (`edges.ros`)
and over Zenoh (an add-on) have in common: topics by name, refusals, discovery, losses; ``halves`` joins them.
``reports`` has notes and counts.
"""

from igtl_gateway.config.settings import DEFAULT_LATCHED_MIB
from igtl_gateway.edges.interface.halves import Halves
from igtl_gateway.edges.interface.publishers import DISCOVERY_NS, Publishers
from igtl_gateway.edges.interface.reports import OnNote, Reports, TopicCounts
from igtl_gateway.edges.interface.side import Change, OnMessage, PlainSide, Publication, RosSide, Wants
from igtl_gateway.edges.interface.subscriptions import Deliver, Subscriptions, describe, guarded
from igtl_gateway.gateway.orders import Heard

__all__ = [
    "DEFAULT_LATCHED_MIB",
    "DISCOVERY_NS",
    "Change",
    "Deliver",
    "Halves",
    "Heard",
    "OnMessage",
    "OnNote",
    "PlainSide",
    "Publication",
    "Publishers",
    "Reports",
    "RosSide",
    "Subscriptions",
    "TopicCounts",
    "Wants",
    "describe",
    "guarded",
]
