"""What gives way on the line between sites: a class for each stream, and a budget for what a gateway sends.

Each class has a priority and a rule for congestion in Zenoh, which every router on the way applies.  The budget is for
lines that queue what they cannot carry: there, only sending less keeps poses fast.
"""

from __future__ import annotations

import threading
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from igtl_gateway.addon import NS_PER_S, matches
from igtl_gateway.addons.zenoh.notation import site_class

#: Seconds of the budget that may be owed before data of other classes give way, too.
_DATA_DEBT_S = 0.5
#: Seconds of the budget that are saved up.
_SAVED_S = 0.1


@dataclass(frozen=True, slots=True)
class TrafficClass:
    """How the streams of a class are sent.

    Attributes:
        priority, congestion: names of Zenoh's ``Priority`` and ``CongestionControl``.
        express: without waiting for further messages to be sent together.
        debt_s: a message is sent if no more than this part of the budget, in seconds, is owed; None: always.
    """

    priority: str
    congestion: str
    express: bool
    debt_s: float | None

    @property
    def blocks(self) -> bool:
        """Whether Zenoh keeps the sender until the line takes the message."""
        return self.congestion == "BLOCK"


#: Name → class.
CLASSES = {
    "commands": TrafficClass("REAL_TIME", "BLOCK", True, None),
    "poses": TrafficClass("INTERACTIVE_HIGH", "DROP", True, None),
    "data": TrafficClass("DATA", "DROP", False, _DATA_DEBT_S),
    "pictures": TrafficClass("BACKGROUND", "DROP", False, 0.0),
}
#: Commands to robots: they do not wait for the line, and no budget counts them.
ROBOT = TrafficClass("REAL_TIME", "DROP", True, None)
#: ROS type → class; other types are data.
_TYPES = {
    **dict.fromkeys(("igtl_msgs/msg/Command", "igtl_msgs/msg/CommandReply", "std_msgs/msg/String"), "commands"),
    **dict.fromkeys(
        (
            "geometry_msgs/msg/PoseStamped",
            "geometry_msgs/msg/TransformStamped",
            "geometry_msgs/msg/TwistStamped",
            "geometry_msgs/msg/WrenchStamped",
            "sensor_msgs/msg/JointState",
            "tf2_msgs/msg/TFMessage",
        ),
        "poses",
    ),
    **dict.fromkeys(
        (
            "sensor_msgs/msg/CompressedImage",
            "sensor_msgs/msg/Image",
            "sensor_msgs/msg/PointCloud2",
            "igtl_msgs/msg/Volume",
            "igtl_msgs/msg/Video",
        ),
        "pictures",
    ),
}


class Traffic:
    """Classes of streams, and the budget of all of them.

    Args:
        rules: ``GLOB=CLASS`` for topics, before the table of types; the first that matches counts.
        bytes_per_s: budget; 0: none.
    """

    def __init__(self, rules: Sequence[str] = (), bytes_per_s: int = 0) -> None:
        self._rules = [site_class(rule) for rule in rules]
        self._rate = bytes_per_s
        self._lock = threading.Lock()
        self._left = _SAVED_S * bytes_per_s  # less than 0: owed
        self._at_ns = 0

    def class_of(self, topic: str, ros_type: str) -> TrafficClass:
        """The class of a stream."""
        for glob, name in self._rules:
            if matches(glob, topic):
                return CLASSES[name]
        return CLASSES[_TYPES.get(ros_type, "data")]

    def admits(self, of_class: TrafficClass, size: int, now_ns: int) -> bool:
        """Whether a message of ``size`` bytes is to be sent now (monotonic ns); then it counts."""
        if not self._rate:
            return True
        with self._lock:
            seconds = max(0, now_ns - self._at_ns) / NS_PER_S if self._at_ns else 0.0
            self._at_ns = now_ns
            self._left = min(_SAVED_S * self._rate, self._left + seconds * self._rate)
            if of_class.debt_s is not None and self._left < -of_class.debt_s * self._rate:
                return False
            self._left -= size
            return True


def how_to_send(zenoh: Any, of_class: TrafficClass) -> dict[str, Any]:
    """Arguments of ``declare_publisher``."""
    return {
        "priority": getattr(zenoh.Priority, of_class.priority),
        "congestion_control": getattr(zenoh.CongestionControl, of_class.congestion),
        "express": of_class.express,
    }
