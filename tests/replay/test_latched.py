"""A part of a session, and the state that it begins with."""

from __future__ import annotations

from igtl_gateway.convert.common_msgs import FrameTransform, TFMessage
from igtl_gateway.convert.rosmsg import Header
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.replay.latched import part_of_session

LATCHED = {"/plan", "/tf_static"}


def log(*rows: tuple[Kind, str, str]) -> list[Entry]:
    """Entries at 10, 20, 30 …"""
    return [
        Entry(seq, 10 * seq, kind, channel, type_name, (f"{seq}".encode(),))
        for seq, (kind, channel, type_name) in enumerate(rows, start=1)
    ]


def numbers(entries: list[Entry], start: int | None, end: int | None = None) -> list[int]:
    return [entry.seq for entry in part_of_session(entries, start, end, lambda topic, _: topic in LATCHED)]


def test_without_limits_it_is_all() -> None:
    entries = log(*[(Kind.ROS_IN, "/plan", "P")] * 3)
    assert numbers(entries, None) == [1, 2, 3]


def test_both_ends_are_included() -> None:
    entries = log(*[(Kind.ROS_IN, "/a", "A")] * 5)
    assert numbers(entries, 20, 40) == [2, 3, 4]
    assert numbers(entries, 21, 39) == [3]
    assert numbers(entries, 51) == []


def test_the_last_of_each_latched_stream_comes_first_in_the_order_of_the_log() -> None:
    entries = log(
        (Kind.ROS_IN, "/plan", "P"),
        (Kind.IGTL_OUT, "POLYDATA/Liver", "POLYDATA"),
        (Kind.ROS_IN, "/pose", "X"),
        (Kind.ROS_IN, "/plan", "P"),
        (Kind.IGTL_OUT, "POLYDATA/Vessel", "POLYDATA"),
        (Kind.ROS_IN, "/pose", "X"),
        (Kind.IGTL_OUT, "TRANSFORM/Probe", "TRANSFORM"),
    )
    assert numbers(entries, 70) == [2, 4, 5, 7]
    assert numbers(entries, 45) == [2, 4, 5, 6, 7]
    assert numbers(entries, 1000) == [2, 4, 5], "also where nothing follows"


def test_what_a_latched_message_caused_is_latched() -> None:
    entries = log(
        (Kind.ROS_IN, "/plan", "P"),
        (Kind.IGTL_OUT, "STRING/Plan", "STRING"),
        (Kind.ROS_IN, "/text", "T"),
        (Kind.IGTL_OUT, "STRING/Text", "STRING"),
        (Kind.ROS_IN, "/pose", "X"),
    )
    assert numbers(entries, 50) == [1, 2, 5]


def test_what_a_state_of_openigtlink_caused_is_latched() -> None:
    entries = log(
        (Kind.IGTL_IN, "STATUS/Device", "STATUS"),
        (Kind.ROS_OUT, "/igtl/in/Device/status", "D"),
        (Kind.NOTE, "", ""),
        (Kind.IGTL_IN, "TRANSFORM/Tool", "TRANSFORM"),
        (Kind.ROS_OUT, "/igtl/in/Tool/transform", "T"),
        (Kind.LINK, "", ""),
        (Kind.ROS_OUT, "/igtl/links", "L"),
    )
    assert numbers(entries, 1000) == [1, 2]


def test_each_publisher_of_static_transforms_counts() -> None:
    def static(seq: int, *frames: str) -> Entry:
        transforms = tuple(FrameTransform(Header(0, "base"), frame, (0, 0, 0, 0, 0, 0, 1)) for frame in frames)
        return Entry(seq, 10 * seq, Kind.ROS_IN, "/tf_static", TFMessage.TYPE, (TFMessage(transforms).pack(),))

    entries = [static(1, "camera"), static(2, "tool", "tip"), static(3, "camera")]
    assert numbers(entries, 40) == [2, 3]
    damaged = Entry(4, 40, Kind.ROS_IN, "/tf_static", TFMessage.TYPE, (b"\0\1\0\0\xff",))
    assert numbers([*entries, damaged], 50) == [2, 3, 4]
