"""A ROS side over another middleware: what the application asks of it, and the halves that all sides share."""

from __future__ import annotations

from typing import TYPE_CHECKING

from igtl_gateway.addon.loading import Homes, at_first_use

if TYPE_CHECKING:
    from igtl_gateway.edges.interface import DEFAULT_LATCHED_MIB as DEFAULT_LATCHED_MIB
    from igtl_gateway.edges.interface import Deliver as Deliver
    from igtl_gateway.edges.interface import Halves as Halves
    from igtl_gateway.edges.interface import Heard as Heard
    from igtl_gateway.edges.interface import OnMessage as OnMessage
    from igtl_gateway.edges.interface import OnNote as OnNote
    from igtl_gateway.edges.interface import PlainSide as PlainSide
    from igtl_gateway.edges.interface import Publication as Publication
    from igtl_gateway.edges.interface import Publishers as Publishers
    from igtl_gateway.edges.interface import Reports as Reports
    from igtl_gateway.edges.interface import Subscriptions as Subscriptions
    from igtl_gateway.edges.interface import TopicCounts as TopicCounts
    from igtl_gateway.edges.interface import Wants as Wants
    from igtl_gateway.edges.interface import guarded as guarded

HOMES: Homes = (
    # The interface
    ("edges.interface", "DEFAULT_LATCHED_MIB OnMessage OnNote PlainSide Publication Wants"),
    # The halves: publishers and subscriptions by topic, notes and counts
    ("edges.interface", "Deliver Halves Heard Publishers Reports Subscriptions TopicCounts guarded"),
)

__getattr__, __dir__ = at_first_use(__name__, HOMES)
