"""Goal ids of actions, which are random, are numbered before runs are compared."""

from __future__ import annotations

import struct
import uuid

from igtl_gateway.addons.resim.goals import numbering
from tests.tables import table


def status(*goals: bytes) -> bytes:
    """CDR of a GoalStatusArray."""
    data = struct.pack("<I", len(goals))
    for number, goal in enumerate(goals):
        data += goal
        data += bytes(-len(data) % 4) + struct.pack("<iIb", 7, 8, number)
    return b"\0\1\0\0" + data


def of_call(kind: int, number: int, seen: tuple[bytes, int, int], content: bytes) -> bytes:
    """CDR of an event of a service, with a client, a time and a filling of its own."""
    client, time_s, filled = seen
    head = struct.pack("<B3xiI16s4xq", kind, time_s, 5, client, number)
    return b"\0\1\0" + bytes((filled,)) + head + content + bytes(filled)


def test_events_of_two_runs_are_equal_but_for_their_contents() -> None:
    on, off = b"\1\0\0\0\1" + bytes(7), b"\1\0\0\0\0" + bytes(7)
    runs = []
    for seen, first, content in (((b"c" * 16, 7, 0), 1, on), ((b"d" * 16, 9, 0), 31, on), ((b"d" * 16, 9, 0), 1, off)):
        numbered = numbering("/arm/enable/_service_event")
        runs.append([numbered(of_call(kind, first + step, seen, content)) for step in (0, 1) for kind in (1, 2)])
    assert runs[0] == runs[1] != runs[2] and len(set(runs[0])) == 4
    filled = [numbering("/a/_service_event")(of_call(2, 1, (b"c" * 16, 7, n), b"abcdef")) for n in (0, 2)]
    assert filled[0] == filled[1]
    sent = [
        numbering("/fib/_action/send_goal/_service_event")(
            of_call(1, 1, (b"c" * 16, 7, 0), b"\1\0\0\0" + goal + b"\5\0\0\0" + bytes(4))
        )
        for goal in (b"g" * 16, b"h" * 16)
    ]
    assert sent[0] == sent[1]


def test_ids_are_numbered_by_their_first_appearance() -> None:
    goals = [uuid.uuid4().bytes for _ in range(3)]
    numbers = [bytes(15) + bytes((number,)) for number in (1, 2, 3)]
    numbered = numbering("/arm/drive/_action/status")
    assert numbered(status(goals[2])) == status(numbers[0])
    assert numbered(status(goals[2], goals[0], goals[1])) == status(*numbers)
    assert numbered(status(goals[1])) == status(numbers[2])
    feedback = numbering("/arm/drive/_action/feedback")
    assert feedback(b"\0\1\0\0" + goals[0] + b"rest") == b"\0\1\0\0" + numbers[0] + b"rest"


@table(
    ("topic", "data"),
    [
        ("/drive/status", status(bytes(range(16)))),
        ("/drive/_action/status", b"\0\1\0\0\1"),
        ("/drive/_action/status", status(bytes(16))[:20]),
        ("/drive/_action/feedback", b"\0\1\0\0\1\2"),
        ("/drive/_service_event", bytes(47)),
    ],
)
def test_other_messages_stay_as_they_are(topic: str, data: bytes) -> None:
    assert numbering(topic)(data) == data
