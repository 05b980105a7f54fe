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
