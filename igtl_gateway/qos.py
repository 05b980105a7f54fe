"""Quality of service of a ROS stream, in plain values (the ROS edge turns them into rclpy profiles)."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Qos:
    """KEEP_LAST with the depth, reliability and durability that a stream needs.

    Attributes:
        depth: how many messages are kept for a reader that lags.
        reliable: RELIABLE, else BEST_EFFORT.
        latched: TRANSIENT_LOCAL (late subscribers get the last messages), else VOLATILE.
    """

    depth: int = 10
    reliable: bool = True
    latched: bool = False


@dataclass(frozen=True, slots=True)
class Endpoint:
    """A publisher or a subscription in the ROS graph.

    Attributes:
        topic: full name.
        type: ``"pkg/msg/Name"``.
        node: full name of its node.
        publishes: it is a publisher.
        qos: as offered or asked for.
    """

    topic: str
    type: str
    node: str
    publishes: bool
    qos: Qos


def incompatible(offered: Qos, asked: Qos) -> str:
    """Why nothing passes from a publisher to a subscription, or ``""``: DDS asks that no less is offered."""
    found = []
    if asked.reliable and not offered.reliable:
        found.append("reliability (best effort offered, reliable asked for)")
    if asked.latched and not offered.latched:
        found.append("durability (volatile offered, transient local asked for)")
    return " and ".join(found)
