"""Subscribers of topics: outputs without a subscriber are not built, in sessions without a recording."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

from igtl_gateway.convert.common_msgs import TFMessage
from igtl_gateway.convert.context import ToRosContext
from igtl_gateway.convert.table import ConversionToRos
from igtl_gateway.gateway.kept import beyond, largest_first
from igtl_gateway.gateway.log.entry import Entry

#: Topic and ROS type → whether the topic has a subscriber.
HasSubscriber = Callable[[str, str], bool]


class Waiting(NamedTuple):
    """The last message of a latched topic without a subscriber.

    Attributes:
        entry: without its payload if ``content`` is there.
        content: None: still to be decoded.
        size: bytes that are kept.
    """

    entry: Entry
    row: ConversionToRos
    content: object
    to: ToRosContext
    size: int


class Subscribers:
    """Which topics have a subscriber, if the ROS edge reports it.

    This is not an input of the gateway.  A recorded session leaves ``ask`` unset: then all outputs are built, so that a
    verification depends on the inputs only.

    Args:
        needs_tf: whether ``tf_out`` has rows, which need the /tf messages.
        room: bytes of waiting messages that ``forget`` leaves; None: any number.

    Attributes:
        ask: returns whether a topic has a subscriber; None: build all outputs.
        waiting: latched topic → its last message, which is built for the first subscriber; at most one per topic.
    """

    def __init__(self, *, needs_tf: bool, room: int | None = None) -> None:
        self.ask: HasSubscriber | None = None
        self.waiting: dict[str, Waiting] = {}
        self._needs_tf = needs_tf
        self._room = room

    def has(self, topic: str, ros_type: str) -> bool:
        """Return whether a message must be built: for a subscriber, or for ``tf_out``."""
        return self.ask is None or self.ask(topic, ros_type) or (self._needs_tf and ros_type == TFMessage.TYPE)

    def exceed(self) -> bool:
        """Return whether ``forget`` has anything to do."""
        return bool(self._beyond())

    def forget(self) -> dict[str, int]:
        """Forget the largest messages, until the others are within the room; return topic → forgotten bytes."""
        return {topic: self.waiting.pop(topic).size for topic in self._beyond()}

    def _beyond(self) -> list[str]:
        return beyond(self._room, largest_first(self.waiting, self._size), self._size)

    def _size(self, topic: str) -> int:
        return self.waiting[topic].size
