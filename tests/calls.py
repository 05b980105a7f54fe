"""Sessions of action servers with any goals, packed by hand; ``exchanges`` has a recording with all that there is."""

from __future__ import annotations

import struct
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

from igtl_gateway.convert.exchanges import REQUEST_SENT, RESPONSE_RECEIVED
from igtl_gateway.gateway.log.entry import Entry, Kind
from tests.exchanges import ACTION_TYPE, HEAD, START_NS, SUCCEEDED, event

NS = 1_000_000_000


def status(*goals: tuple[bytes, int]) -> bytes:
    """A GoalStatusArray."""
    data = struct.pack("<I", len(goals))
    for goal, state in goals:
        data += goal
        data += bytes(-len(data) % 4) + struct.pack("<iIb", 7, 8, state)
    return HEAD + data


def fibonacci(*numbers: int) -> bytes:
    """A result or feedback of Fibonacci."""
    return struct.pack(f"<I{len(numbers)}i", len(numbers), *numbers)


@dataclass(frozen=True)
class Goal:
    """A goal of Fibonacci as a recording has it; times are ns from the begin of the session.

    Attributes:
        id: 16 bytes.
        order: what is asked for.
        at_ns: when it is sent; it is accepted 1 ms later.
        ends_ns: when it ends; None: never.
        status: how.
        accepted: whether it is.
        cancel_ns: when the client cancels it; None: never.
        asked: whether the client asks for the result.
        feedback_ns: times of the feedback.
    """

    id: bytes
    order: int
    at_ns: int
    ends_ns: int | None = None
    status: int = SUCCEEDED
    accepted: bool = True
    cancel_ns: int | None = None
    asked: bool = True
    feedback_ns: tuple[int, ...] = field(default=())


_MS = 1_000_000


def rows_of(action: str, goals: Sequence[Goal], *, events: bool = True) -> Iterable[tuple[int, str, str, bytes]]:
    """Time, topic, type and CDR of what an action server and its client send, in their order.

    ``events``: whether service introspection is on.
    """
    rows: list[tuple[int, int, str, str, bytes]] = []

    def add(at_ns: int, part: str, type_: str, data: bytes) -> None:
        rows.append((at_ns, len(rows), f"{action}/_action/{part}", type_, data))

    def ask(at_ns: int, part: str, of: str, number: int, request: bytes, answer_ns: int | None, answer: bytes) -> None:
        if events:
            topic = f"{part}/_service_event"
            add(at_ns, topic, of, event(REQUEST_SENT, at_ns, number, request=request))
            if answer_ns is not None:
                add(answer_ns, topic, of, event(RESPONSE_RECEIVED, answer_ns, number, response=answer))

    changes: list[tuple[int, bytes, int]] = []
    for number, goal in enumerate(goals, 1):
        stamp = struct.pack("<iI", (START_NS + goal.at_ns) // NS, (START_NS + goal.at_ns) % NS)
        ask(
            goal.at_ns, "send_goal", f"{ACTION_TYPE}_SendGoal_Event", number, goal.id + struct.pack("<i", goal.order),
            goal.at_ns + _MS, struct.pack("<?3s", goal.accepted, b"\x55\1\2") + stamp,
        )  # fmt: skip
        if not goal.accepted:
            continue
        changes += [(goal.at_ns + _MS, goal.id, 1), (goal.at_ns + 2 * _MS, goal.id, 2)]
        for each, at_ns in enumerate(goal.feedback_ns, 1):
            data = HEAD + goal.id + fibonacci(*range(each))
            add(at_ns, "feedback", f"{ACTION_TYPE}_FeedbackMessage", data)
        if goal.cancel_ns is not None:
            info = goal.id + bytes(8)
            ask(
                goal.cancel_ns, "cancel_goal", "action_msgs/srv/CancelGoal_Event", number, info,
                goal.cancel_ns + _MS, struct.pack("<b3sI", 0, b"\1\2\3", 1) + info,
            )  # fmt: skip
            changes.append((goal.cancel_ns, goal.id, 3))
        if goal.ends_ns is not None:
            changes.append((goal.ends_ns, goal.id, goal.status))
        if goal.asked:
            answer_ns = None if goal.ends_ns is None else goal.ends_ns + _MS
            result = struct.pack("<b3s", goal.status, b"\x55\1\2") + fibonacci(goal.order, 8)
            ask(
                goal.at_ns + 2 * _MS, "get_result", f"{ACTION_TYPE}_GetResult_Event", number, goal.id, answer_ns, result
            )
    states: dict[bytes, int] = {}
    for at_ns, id_, state in sorted(changes, key=lambda row: row[0]):
        states[id_] = state
        add(at_ns, "status", "action_msgs/msg/GoalStatusArray", status(*states.items()))
        states = {key: each for key, each in states.items() if each < SUCCEEDED or len(states) < 5}
    return [row[:1] + row[2:] for row in sorted(rows)]


def entries_of(rows: Iterable[tuple[int, str, str, bytes]]) -> list[Entry]:
    """Entries of rows in the order of their times."""
    return [
        Entry(number, START_NS + at_ns + number, Kind.ROS_IN, topic, type_, (data,))
        for number, (at_ns, topic, type_, data) in enumerate(sorted(rows, key=lambda row: row[0]), 1)
    ]
