"""New stamps for old messages."""

from __future__ import annotations

import struct
from dataclasses import replace

import pytest

from igtl_gateway.base.stamp import ns_to_ticks, ticks_to_ns
from igtl_gateway.convert.common_msgs import FrameTransform, TFMessage
from igtl_gateway.convert.rosmsg import Header, PointStamped, String, TransformStamped
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.replay.restamp import Mode, Restamper
from igtl_gateway.replay.simclock import clock_entry
from igtl_gateway.wire import decode, encode
from igtl_gateway.wire.message import Item, Message
from igtl_gateway.wire.text import String as Text

S = 1_000_000_000
THEN, NOW = 1_700_000_000 * S + 5, 1_800_000_000 * S + 7


def restamped(mode: Mode, *entries: Entry) -> list[bytes]:
    """Payloads of entries that are sent from NOW on, a second after each other."""
    told: list[str] = []
    restamper = Restamper(mode, told.append)
    restamper.begin(None, 0)
    payloads = [restamper.payload(entry, NOW + index * S) for index, entry in enumerate(entries)]
    assert told == []
    return [b"".join(payload) for payload in payloads]


def ros(ros_type: str, data: bytes, stamp_ns: int = THEN) -> Entry:
    return Entry(1, stamp_ns, Kind.ROS_OUT, "/topic", ros_type, (data,))


def igtl(message: Message, stamp_ns: int = THEN) -> Entry:
    return Entry(1, stamp_ns, Kind.IGTL_OUT, "STRING/Text", "STRING", encode(message))


MESSAGE = Message("STRING", "Text", Text(b"hello", 3), ns_to_ticks(THEN - 2 * S))


def test_keep_keeps() -> None:
    entry = igtl(MESSAGE)
    assert restamped("keep", entry) == [entry.data()]


def test_now_is_the_time_of_sending_in_the_header_alone() -> None:
    (data,) = restamped("now", igtl(MESSAGE))
    assert decode(data) == replace(MESSAGE, ticks=ns_to_ticks(NOW))
    unset = replace(MESSAGE, ticks=0)
    assert ticks_to_ns(decode(restamped("now", igtl(unset))[0]).ticks) == NOW


def test_shift_moves_all_by_one_constant_and_leaves_what_is_unset() -> None:
    later = igtl(replace(MESSAGE, ticks=ns_to_ticks(THEN + 3 * S)), THEN + 5 * S)
    unset = igtl(replace(MESSAGE, ticks=0), THEN + 6 * S)
    first, second, third = (decode(data).ticks for data in restamped("shift", igtl(MESSAGE), later, unset))
    assert ticks_to_ns(first) == NOW - 2 * S
    assert ticks_to_ns(second) == NOW + 3 * S
    assert third == 0


def test_after_a_jump_the_target_is_now() -> None:
    restamper = Restamper("shift", lambda _: None)
    restamper.begin(THEN + 10 * S, NOW)
    state = igtl(MESSAGE, THEN)
    (data,) = restamper.payload(state, NOW)
    assert ticks_to_ns(decode(data).ticks) == NOW - 12 * S


@pytest.mark.parametrize(("mode", "expected"), [("now", NOW), ("shift", NOW - S)])
def test_the_ros_stamp_in_the_metadata_moves_with_it(mode: Mode, expected: int) -> None:
    items = (Item.of("a", "1"), Item.of("ros.stamp", str(THEN - S)), Item.of("z", "2"))
    (data,) = restamped(mode, igtl(replace(MESSAGE, header_version=2, metadata=items)))
    message = decode(data)  # its checksum is right again
    assert [item.text for item in message.metadata] == ["1", str(expected), "2"]
    assert message.content == MESSAGE.content


def test_of_a_damaged_message_only_the_header_changes() -> None:
    data = bytearray(igtl(MESSAGE).data())
    data[-1] ^= 1
    entry = Entry(1, THEN, Kind.IGTL_OUT, "STRING/Text", "STRING", (bytes(data),))
    (found,) = restamped("now", entry)
    assert (found[:34], found[42:]) == (bytes(data[:34]), bytes(data[42:]))
    short = Entry(1, THEN, Kind.IGTL_OUT, "", "", (b"short",))
    assert restamped("now", short) == [b"short"]


@pytest.mark.parametrize(("mode", "expected"), [("now", NOW), ("shift", NOW - S)])
def test_header_stamps_of_ros_in_place(mode: Mode, expected: int) -> None:
    pose = TransformStamped(Header(THEN - S, "base"), "tool", (1, 2, 3), (0, 0, 0, 1))
    (data,) = restamped(mode, ros(pose.TYPE, pose.pack()))
    assert data == replace(pose, header=Header(expected, "base")).pack()
    frames = ("a", "odd", "even", "frame with a long name")
    tf = TFMessage(
        tuple(FrameTransform(Header(THEN - S, "b" * i), name, (1, 2, 3, 0, 0, 0, 1)) for i, name in enumerate(frames))
    )
    moved = TFMessage(tuple(replace(one, header=Header(expected, one.header.frame_id)) for one in tf.transforms))
    assert restamped(mode, ros(tf.TYPE, tf.pack())) == [moved.pack()]


def test_big_endian_stays_big_endian() -> None:
    head = b"\0\0\0\0" + struct.pack(">iI", 1_700_000_000, 5) + b"rest"
    (data,) = restamped("now", ros(PointStamped.TYPE, head))
    assert data == b"\0\0\0\0" + struct.pack(">iI", 1_800_000_000, 7) + b"rest"


def test_the_clock_follows() -> None:
    assert restamped("shift", clock_entry(THEN)) == [clock_entry(NOW).data()]


@pytest.mark.parametrize(
    ("ros_type", "data"),
    [
        ("unheard_of/msg/Thing", String("x").pack()),
        (PointStamped.TYPE, b"\0\1\0\0\1"),
        (TFMessage.TYPE, b"\0\1\0\0\2\0\0\0\0\0\0\0"),
    ],
)
def test_what_is_not_known_stays_and_is_told_once(ros_type: str, data: bytes) -> None:
    told: list[str] = []
    restamper = Restamper("now", told.append)
    for _ in range(2):
        assert restamper.payload(ros(ros_type, data), NOW) == (data,)
    assert told == [ros_type]


def test_what_has_no_stamp_stays_and_nothing_is_told() -> None:
    data = String("x").pack()
    assert restamped("now", ros(String.TYPE, data)) == [data]


def test_the_recordings_own_definition_counts() -> None:
    """A type of an unknown program, and one that had other fields when it was recorded."""
    text = (
        "uint8 a\nbuiltin_interfaces/Time stamp\n"
        + "=" * 80
        + "\nMSG: builtin_interfaces/Time\nint32 sec\nuint32 nanosec"
    )
    restamper = Restamper("now", pytest.fail, {"lab/msg/Odd": text, PointStamped.TYPE: text})
    data = b"\0\1\0\0\7\0\0\0" + struct.pack("<iI", 5, 6)
    for ros_type in ("lab/msg/Odd", PointStamped.TYPE):
        (found,) = restamper.payload(ros(ros_type, data), NOW)
        assert found == data[:8] + struct.pack("<iI", NOW // S, NOW % S)
