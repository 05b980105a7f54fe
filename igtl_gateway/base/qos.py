"""Quality of service of a ROS stream as plain values; the ROS edge converts them to rclpy profiles."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Qos:
    """Quality of service of a stream: history KEEP_LAST with depth, reliability and durability.

    Attributes:
        depth: number of messages stored for a subscriber that lags.
        reliable: true for RELIABLE, false for BEST_EFFORT.
        latched: true for TRANSIENT_LOCAL (late joiners receive the last messages), false for VOLATILE.
    """

    depth: int = 10
    reliable: bool = True
    latched: bool = False


@dataclass(frozen=True, slots=True)
class Endpoint:
    """A publisher or a subscription in the ROS graph.

    Attributes:
        topic: full name of the topic.
        type: ROS type, ``"pkg/msg/Name"``.
        node: full name of the node.
        publishes: true for a publisher, false for a subscription.
        qos: offered (publisher) or requested (subscription) quality of service.
    """

    topic: str
    type: str
    node: str
    publishes: bool
    qos: Qos


def incompatible(offered: Qos, requested: Qos) -> str:
    """Return why DDS does not connect a publisher with a subscription, or ``""``: it offers less than requested."""
    found = []
    if requested.reliable and not offered.reliable:
        found.append("reliability (best effort offered, reliable requested)")
    if requested.latched and not offered.latched:
        found.append("durability (volatile offered, transient local requested)")
    return " and ".join(found)
