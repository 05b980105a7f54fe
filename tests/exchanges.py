"""A recording with a service, an action and their like, packed by hand: what a real graph sends in two seconds.

``/arm/enable``: four calls, of which the last one has no answer.  ``/fib``: four goals, of which one succeeds, one is
aborted, one is canceled, and one has no result.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator
from pathlib import Path

from igtl_gateway.base.qos import Qos
from igtl_gateway.base.untrusted.dialects import RULE
from igtl_gateway.convert.exchanges import REQUEST_RECEIVED, REQUEST_SENT, RESPONSE_RECEIVED, RESPONSE_SENT
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.record.sessionfile.definition import Definition
from igtl_gateway.record.sessionfile.writer import SessionWriter

START_NS, MS = 1_700_000_000_000_000_000, 1_000_000
HEAD = b"\0\1\0\0"
SERVICE, SERVICE_TYPE = "/arm/enable", "std_srvs/srv/SetBool"
ACTION, ACTION_TYPE = "/fib", "test_msgs/action/Fibonacci"
SRV = "bool data\n---\nbool success\nstring message\n"
CANCEL_TYPE = "action_msgs/srv/CancelGoal"
CANCEL = (
    f"GoalInfo goal_info\n---\nint8 return_code\nGoalInfo[] goals_canceling\n{RULE}\nMSG: action_msgs/GoalInfo\n"
    "unique_identifier_msgs/UUID goal_id\nbuiltin_interfaces/Time stamp\n"
)
ACTION_TEXT = "int32 order\n---\nint32[] sequence\n---\nint32[] sequence\n"
SUCCEEDED, CANCELED, ABORTED, EXECUTING = 4, 5, 6, 2
#: Order → how the goal ends; EXECUTING: the recording ends before.
GOALS = {3: SUCCEEDED, 9: ABORTED, 5: CANCELED, 7: EXECUTING}

#: Time in ns from the start, topic, type, bytes.
Row = tuple[int, str, str, bytes]


def event(kind: int, ns: int, number: int, request: bytes = b"", response: bytes = b"", client: bytes = b"me") -> bytes:
    """An event; the content of a request begins at 4 modulo 8, that of a response at 0, and between are no zeros."""
    time_ns = START_NS + ns
    data = struct.pack("<B3siI16s4xq", kind, b"\x7f\1\2", time_ns // 10**9, time_ns % 10**9, client, number)
    data += struct.pack("<I", bool(request)) + request
    data += bytes(-len(data) % 4) + struct.pack("<I", bool(response)) + response
    return HEAD + data


def states(goals: dict[int, int]) -> bytes:
    """A GoalStatusArray: order → status."""
    data = struct.pack("<I", len(goals))
    for order, status in goals.items():
        data += goal_id(order)
        data += bytes(-len(data) % 4) + struct.pack("<iIb", 7, 8, status)
    return HEAD + data


def goal_id(order: int) -> bytes:
    return bytes([order] * 16)


def both(
    topic: str, ros_type: str, ns: int, number: int, request: bytes, response: bytes | None, took_ns: int = 2 * MS
) -> Iterator[Row]:
    """The four events of a call, of client and server; two without a response."""
    place = f"{topic}/_service_event", f"{ros_type}_Event"
    yield ns, *place, event(REQUEST_SENT, ns, number, request)
    yield ns + MS // 2, *place, event(REQUEST_RECEIVED, ns + MS // 2, number, request)
    if response is not None:
        yield ns + took_ns, *place, event(RESPONSE_SENT, ns + took_ns, number, response=response)
        yield ns + took_ns + 1, *place, event(RESPONSE_RECEIVED, ns + took_ns + 1, number, response=response)


def calls() -> Iterator[Row]:
    """Those of the service."""
    for number in range(1, 5):
        text = b"on\0" if number % 2 else b"off\0"
        response = struct.pack("<?3xI", number % 2, len(text)) + text
        request = struct.pack("<?", number % 2)
        yield from both(SERVICE, SERVICE_TYPE, 10 * number * MS, number, request, response if number < 4 else None)


def goals() -> Iterator[Row]:
    """All topics of the action."""
    for number, (order, end) in enumerate(GOALS.items(), 1):
        at, whole = 100 * number * MS, {order: end}
        ask = goal_id(order)
        sent = f"{ACTION_TYPE}_SendGoal", ask + struct.pack("<i", order), struct.pack("<?3xiI", 1, 7, 8)
        yield from both(f"{ACTION}/_action/send_goal", sent[0], at, number, *sent[1:])
        topic, array = f"{ACTION}/_action/status", "action_msgs/msg/GoalStatusArray"
        yield at + 5 * MS, topic, array, states({order: EXECUTING})
        result = struct.pack("<b3xI2i", end, 2, 0, 1)
        yield from both(
            f"{ACTION}/_action/get_result", f"{ACTION_TYPE}_GetResult", at + 6 * MS, number, ask,
            None if end is EXECUTING else result, 80 * MS,
        )  # fmt: skip
        for length in (3, 4):
            feedback = HEAD + ask + struct.pack(f"<I{length}i", length, *range(length))
            yield at + (10 + length) * MS, f"{ACTION}/_action/feedback", f"{ACTION_TYPE}_FeedbackMessage", feedback
        if end is CANCELED:
            request = ask + struct.pack("<iI", 0, 0)
            response = struct.pack("<b3xI", 0, 1) + ask + struct.pack("<iI", 7, 8)
            yield from both(f"{ACTION}/_action/cancel_goal", CANCEL_TYPE, at + 40 * MS, number, request, response)
        if end is not EXECUTING:
            yield at + 70 * MS, topic, array, states(whole)


def definition_of(ros_type: str) -> Definition | None:
    """Of the types of the recording whose packages might not be installed."""
    known = {SERVICE_TYPE: SRV, ACTION_TYPE: ACTION_TEXT, CANCEL_TYPE: CANCEL}
    text = known.get(ros_type.partition("_Event")[0]) or known.get(f"{ros_type.partition('Fibonacci_')[0]}Fibonacci")
    return Definition(Definition(text.encode()).text(ros_type).encode()) if text else None


def write(
    path: Path,
    rows: Iterator[Row] | list[Row] | None = None,
    definitions: Callable[[str], Definition | None] = definition_of,
) -> Path:
    """Write a recording; its rows are those of the service and the action, in their order, without any other."""
    facts = {"config": "{}", "igtl_gateway_version": "1"}
    latched = Qos(latched=True)

    def qos_of(topic: str, _type: str) -> Qos | None:
        return latched if topic.endswith("/status") else None

    with path.open("wb"):
        pass
    writer = SessionWriter(path, facts, qos_of=qos_of, definition_of=definitions, overwrite=True)
    found = sorted([*calls(), *goals()] if rows is None else rows, key=lambda row: row[0])
    for number, (ns, topic, ros_type, data) in enumerate(found, 1):
        writer.write(Entry(number, START_NS + ns, Kind.ROS_IN, topic, ros_type, (data,)))
    writer.close({})
    return path
