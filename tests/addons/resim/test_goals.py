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
    ],
)
def test_other_messages_stay_as_they_are(topic: str, data: bytes) -> None:
    assert numbering(topic)(data) == data
