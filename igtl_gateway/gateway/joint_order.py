"""The order of the joints of each arm, by their names: numbers without names are in it.

Strategy: a command of OpenIGTLink has numbers, and ROS passes them on without names, so a robot takes them by position.
The first joint state of an arm that names its joints fixes which position is which joint, for the whole session.  What
comes with names later is put into this order; other joints cannot be compared with a command.
"""

from __future__ import annotations

from collections.abc import Sequence

from igtl_gateway.base.errors import ConversionError
from igtl_gateway.convert.common_msgs import JointState
from igtl_gateway.gateway.log.entry import Entry, Kind

_STATE = "/measured_js"
#: Maximum number of arms whose order is kept.
_MAX_ARMS = 1_000


def is_state(topic: str) -> bool:
    """Return whether a topic has the measured joints of an arm, whose names may fix an order."""
    return topic.endswith(_STATE)


def names_of_state(entry: Entry) -> tuple[str, ...]:
    """Return the names of a valid measured state from ROS whose joints have a name each; () for all else."""
    if entry.kind is not Kind.ROS_IN or entry.type != JointState.TYPE or not is_state(entry.channel):
        return ()
    try:
        joints = JointState.unpack(entry.payload[0])
    except ConversionError:
        return ()
    names = joints.name
    tells = len(names) == len(joints.position) == len(set(names)) and all(names) and joints.header.stamp_ns > 0
    return names if tells else ()


class JointOrders:
    """The names of the joints by topic, in the order of the first state that has them."""

    def __init__(self) -> None:
        self._of: dict[str, tuple[str, ...]] = {}

    def see(self, entry: Entry) -> None:
        """Take notice of an input."""
        if entry.channel in self._of or len(self._of) >= _MAX_ARMS:
            return
        if names := names_of_state(entry):
            self._of[entry.channel] = names

    def of(self, topic: str) -> tuple[str, ...]:
        """Return the names of the joints of an arm in their order; () if no state has named them."""
        return self._of.get(topic, ())


def places(names: Sequence[str], order: Sequence[str]) -> list[int] | None:
    """Return where each joint of ``order`` stands in ``names``; None if they are not the same joints."""
    at = {name: index for index, name in enumerate(names)}
    same = len(names) == len(at) == len(order) and at.keys() == set(order)
    return [at[name] for name in order] if same else None
