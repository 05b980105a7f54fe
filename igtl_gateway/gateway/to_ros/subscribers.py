"""Subscribers of topics: outputs without a subscriber are not built, in sessions without a recording."""

from __future__ import annotations

from collections.abc import Callable

from igtl_gateway.convert.common_msgs import TFMessage
from igtl_gateway.convert.context import ToRosContext
from igtl_gateway.convert.table import ConversionToRos
from igtl_gateway.gateway.log.entry import Entry

#: Topic and ROS type → whether the topic has a subscriber.
HasSubscriber = Callable[[str, str], bool]


class Subscribers:
    """Which topics have a subscriber, if the ROS edge reports it.

    This is not an input of the gateway.  A recorded session leaves ``ask`` unset: then all outputs are built, so that a
    verification depends on the inputs only.

    Args:
        needs_tf: whether ``tf_out`` has rows, which need the /tf messages.

    Attributes:
        ask: returns whether a topic has a subscriber; None: build all outputs.
        waiting: latched topic → its last message, which is built for the first subscriber; at most one per topic.
            Entry, row, content (None: still to be decoded) and context.
    """

    def __init__(self, *, needs_tf: bool) -> None:
        self.ask: HasSubscriber | None = None
        self.waiting: dict[str, tuple[Entry, ConversionToRos, object, ToRosContext]] = {}
        self._needs_tf = needs_tf

    def has(self, topic: str, ros_type: str) -> bool:
        """Return whether a message must be built: for a subscriber, or for ``tf_out``."""
        return self.ask is None or self.ask(topic, ros_type) or (self._needs_tf and ros_type == TFMessage.TYPE)
