"""Goal ids of actions, which are random, and clients in events of services, which are addresses.

They are numbered by their first appearance, so that two runs can be compared.  The time in an event is that of a clock
of its own, and left out.  Kilted fills the last 4 bytes of a message, Jazzy does not.
"""

from __future__ import annotations

import struct
from collections.abc import Callable

#: Between the name of an action and those of its topics and services; names of this kind are reserved for them.
IN_ACTION = "/_action/"
_FEEDBACK, _STATUS, _EVENT = f"{IN_ACTION}feedback", f"{IN_ACTION}status", "/_service_event"
_OPTIONS, _ENCAPSULATION, _ID = 2, 4, 16
#: Of an event: behind its kind, where its time begins, and its client; where its number ends.
_KIND, _CLIENT, _NUMBER, _CONTENT = 5, 16, 36, 44


def numbering(topic: str) -> Callable[[bytes], bytes]:
    """Return what replaces the ids in the messages of a topic, in their order, by 1, 2, …

    Messages (CDR) of other topics, and those that are cut off, stay as they are.
    """
    if topic.endswith(_EVENT):
        return _numbering_of_events(ids_of_goals=IN_ACTION in topic)
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


def _numbering_of_events(*, ids_of_goals: bool) -> Callable[[bytes], bytes]:
    """Of an event, client and number of a call become one number; in services of actions, the id of a goal does."""
    calls: dict[bytes, int] = {}
    goals: dict[bytes, int] = {}

    def numbered(data: bytes) -> bytes:
        if len(data) < _CONTENT + 4:
            return data
        call = data[_CLIENT : _CLIENT + _ID] + data[_NUMBER:_CONTENT]
        number = calls.setdefault(call, len(calls) + 1)
        changed = bytearray(data + bytes(-len(data) % 4))
        changed[_OPTIONS:_ENCAPSULATION] = bytes(_ENCAPSULATION - _OPTIONS)
        changed[_KIND:_CONTENT] = number.to_bytes(_CONTENT - _KIND, "big")
        at = _CONTENT + 4
        if ids_of_goals and data[_CONTENT:at].strip(b"\0") and len(data) >= at + _ID:
            changed[at : at + _ID] = goals.setdefault(data[at : at + _ID], len(goals) + 1).to_bytes(_ID, "big")
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
