"""Outputs to ROS that nobody subscribes to are not built, in sessions that nobody records."""

from __future__ import annotations

from collections.abc import Callable

from igtl_gateway.convert.common_msgs import TFMessage
from igtl_gateway.convert.context import ToRosContext
from igtl_gateway.convert.table import ConversionToRos
from igtl_gateway.session.entry import Entry

#: Topic and ROS type → whether there is a subscriber.
Ask = Callable[[str, str], bool]


class Subscribers:
    """Which topics have subscribers, where the ROS edge tells.

    It is no input of the gateway.  A session that is recorded leaves ``ask`` unset: then everything is built, so that
    what is verified depends on the inputs alone.

    Args:
        needs_tf: whether frames go out (``tf_out``), which are taken from /tf messages.

    Attributes:
        ask: whether a topic has a subscriber; None: build everything.
        waiting: latched topic → its last message, which is built for the first subscriber; as many as there are topics.
    """

    def __init__(self, *, needs_tf: bool) -> None:
        self.ask: Ask | None = None
        self.waiting: dict[str, tuple[Entry, ConversionToRos, object, ToRosContext]] = {}
        self._needs_tf = needs_tf

    def has(self, topic: str, ros_type: str) -> bool:
        """Whether a message has to be built: for a subscriber, or for the frames that go out."""
        return self.ask is None or self.ask(topic, ros_type) or (self._needs_tf and ros_type == TFMessage.TYPE)
