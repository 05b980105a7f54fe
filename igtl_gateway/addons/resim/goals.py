"""Goal ids of actions, which are random: numbered by their first appearance, so that two runs can be compared."""

from __future__ import annotations

import struct
from collections.abc import Callable

#: Between the name of an action and those of its topics and services; names of this kind are reserved for them.
IN_ACTION = "/_action/"
_FEEDBACK, _STATUS = f"{IN_ACTION}feedback", f"{IN_ACTION}status"
_ENCAPSULATION, _ID = 4, 16


def numbering(topic: str) -> Callable[[bytes], bytes]:
    """Return what replaces the goal ids in the messages of a topic, in their order, by 1, 2, …

    Messages (CDR) of other topics, and those that are cut off, stay as they are.
    """
    if not topic.endswith((_FEEDBACK, _STATUS)):
        return lambda data: data
    places_in = _places_in_status if topic.endswith(_STATUS) else _place_in_feedback
    numbers: dict[bytes, int] = {}

    def numbered(data: bytes) -> bytes:
        changed = bytearray(data)
        for at in places_in(data):
            goal = data[at : at + _ID]
            changed[at : at + _ID] = numbers.setdefault(goal, len(numbers) + 1).to_bytes(_ID, "big")
        return bytes(changed)

    return numbered


def _place_in_feedback(data: bytes) -> list[int]:
    """It begins with the id."""
    return [_ENCAPSULATION] if len(data) >= _ENCAPSULATION + _ID else []


def _places_in_status(data: bytes) -> list[int]:
    """action_msgs/msg/GoalStatusArray: a sequence of the id, a time (8 bytes, aligned to 4), and a byte."""
    if len(data) < _ENCAPSULATION + 4:
        return []
    (count,) = struct.unpack_from("<I" if data[1] & 1 else ">I", data, _ENCAPSULATION)
    found: list[int] = []
    at = _ENCAPSULATION + 4
    while len(found) < count and at + _ID <= len(data):
        found.append(at)
        at = (at + _ID + 3) // 4 * 4 + 8 + 1
    return found
