"""Stamps with the corrections that a session states: which messages move, by how much, and which stay."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from types import SimpleNamespace
from typing import Any

import pytest

from igtl_gateway.base.errors import DamagedRecording
from igtl_gateway.convert.common_msgs import FrameTransform, PoseStamped, TFMessage
from igtl_gateway.convert.rosmsg import Header
from igtl_gateway.gateway.log.corrections import CORRECTIONS, StampCorrection
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.record.sessionfile.bulk import block_of
from igtl_gateway.replay.recorded_stamps import RecordedStamps
from tests.tables import table

S = 1_000_000_000
T0, LAG_NS = 1_700_000_000 * S, 120_000_000
POSE = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)
DEFINITIONS = {
    PoseStamped.TYPE: "std_msgs/Header header\nfloat64[7] pose\n" + "=" * 80 + "\nMSG: std_msgs/Header\n"
    "builtin_interfaces/Time stamp\nstring frame_id\n" + "=" * 80 + "\nMSG: builtin_interfaces/Time\n"
    "int32 sec\nuint32 nanosec\n"
}  # fmt: skip


@dataclass
class File:
    """What is needed of a session file."""

    session: Mapping[str, str]
    notes: list[Entry] = field(default_factory=list)
    definitions: Mapping[str, str] = field(default_factory=lambda: DEFINITIONS)

    def entries(self) -> Iterator[Entry]:
        yield from self.notes


def correction(channel: str, ros_type: str, **more: Any) -> StampCorrection:
    given = StampCorrection("late", "early", LAG_NS, LAG_NS, LAG_NS, 0.0, T0, channel=channel, type=ros_type)
    return replace(given, **more)


def stamps_of(*corrections: StampCorrection) -> RecordedStamps:
    return RecordedStamps(File({CORRECTIONS: json.dumps([each.facts() for each in corrections])}))


def frames(*stamps: int) -> Entry:
    """A TFMessage with the frames a, b, c …, received half a second later."""
    transforms = tuple(
        FrameTransform(Header(stamp, "base"), name, POSE) for name, stamp in zip("abc", stamps, strict=False)
    )
    data = TFMessage(transforms).pack()
    return Entry(1, T0 + S // 2, Kind.ROS_IN, "/tf", TFMessage.TYPE, (data,), (), T0 + S // 4)


def shown(found: Entry) -> list[tuple[str, int]]:
    return [(each.child_frame_id, each.header.stamp_ns - T0) for each in TFMessage.unpack(found.data()).transforms]


@table(
    ("more", "expected"),
    [
        ({"frame": "b"}, [("a", 0), ("b", S - LAG_NS), ("c", 2 * S)]),  # each frame stays once, in its place
        ({}, [("a", -LAG_NS), ("b", S - LAG_NS), ("c", 2 * S - LAG_NS)]),
        ({"frame": "z"}, [("a", 0), ("b", S), ("c", 2 * S)]),
        ({"is_stamped": False}, [("a", S // 4), ("b", S // 4), ("c", S // 4)]),  # a lag of gateway times
        (
            {"skew_ppm": 1_000.0},
            [("a", -LAG_NS + 120_000), ("b", S - LAG_NS - 880_000), ("c", 2 * S - LAG_NS - 1_880_000)],
        ),
    ],
)
def test_frames_of_a_tree(more: dict[str, Any], expected: list[tuple[str, int]]) -> None:
    found = stamps_of(correction("/tf", TFMessage.TYPE, **more))
    assert shown(found.entry(frames(T0, T0 + S, T0 + 2 * S))) == expected


def test_stamps_that_are_unset_stay_so() -> None:
    found = stamps_of(correction("/tf", TFMessage.TYPE))
    assert shown(found.entry(frames(0, T0)))[0] == ("a", -T0)
    damaged = replace(frames(T0), payload=(b"\0\1\0\0\xff\xff",))
    assert found.entry(damaged).data() == damaged.data()


#: Entry that is asked for → whether it moves.
@table(
    ("kind", "channel", "ros_type", "moves"),
    [
        (Kind.ROS_IN, "/pose", PoseStamped.TYPE, True),
        (Kind.ROS_OUT, "/pose", PoseStamped.TYPE, False),  # what the gateway made of it is as it was
        (Kind.ROS_IN, "/other", PoseStamped.TYPE, False),
        (Kind.IGTL_IN, "/pose", PoseStamped.TYPE, False),
        (Kind.ROS_IN, "/pose", "std_msgs/msg/Empty", False),  # has no stamp
    ],
)
def test_which_messages_move(kind: Kind, channel: str, ros_type: str, moves: bool) -> None:
    found = stamps_of(correction("/pose", ros_type))
    data = PoseStamped(Header(T0, "base"), POSE).pack()
    entry = Entry(1, T0 + 1, kind, channel, ros_type, (data,), (), T0)
    new = found.entry(entry)
    assert replace(new, payload=entry.payload) == entry, "its bytes alone"
    assert PoseStamped.unpack(new.data()).header.stamp_ns == T0 - LAG_NS * moves


@pytest.mark.parametrize("kind", [Kind.ROS_IN, Kind.ROS_OUT, Kind.IGTL_IN])
def test_a_block_of_messages_moves_as_each_of_them(kind: Kind) -> None:
    found = stamps_of(correction("/pose", PoseStamped.TYPE))
    entries = [
        Entry(seq, T0 + seq, kind, "/pose", PoseStamped.TYPE, (PoseStamped(Header(T0 + seq, "base"), POSE).pack(),))
        for seq in range(1, 5)
    ]
    channel: Any = SimpleNamespace(kind=kind, stream="/pose", type=PoseStamped.TYPE)
    block = found.block(channel, block_of(entries))
    assert [bytes(block.payload(row)) for row in range(4)] == [found.entry(entry).data() for entry in entries]
    moved = PoseStamped.unpack(block.payload(0)).header.stamp_ns != T0 + 1
    assert moved is (kind is Kind.ROS_IN)
    none = RecordedStamps(File({}))
    assert none.block(channel, block) is block


def test_without_corrections_nothing_is_looked_at() -> None:
    none = RecordedStamps(File({}))
    assert not none and none.notes == () and none.of("/tf", TFMessage.TYPE) is None
    entry = frames(T0)
    assert none.entry(entry) is entry


def test_corrections_of_an_earlier_version_are_in_notes() -> None:
    note = correction("/tf", TFMessage.TYPE).note()
    entries = [Entry(7, T0, Kind.EDGE_NOTE, payload=(note.pack(),)), replace(frames(T0), seq=8)]
    assert not RecordedStamps(File({}, entries)), "only where the session states that there are some"
    found = RecordedStamps(File({"corrected_by": "x"}, entries))
    assert found and found.of("/tf", TFMessage.TYPE) == correction("/tf", TFMessage.TYPE)
    assert found.notes == (f"sync: {correction('/tf', TFMessage.TYPE).text()}",)


@pytest.mark.parametrize("text", ["{}", "[1]", '[{"stream": "a"}]', "[", '"x"'])
def test_corrections_that_cannot_be_read(text: str) -> None:
    with pytest.raises(DamagedRecording, match=r"session: stamps_corrected"):
        RecordedStamps(File({CORRECTIONS: text}))
