"""Stamps in ROS messages: where they are in each type, read from blocks in both byte orders, and written."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from igtl_gateway.record.sessionfile.bulk import MessageBlock
from igtl_gateway.record.sessionfile.header_stamps import StampPlace, stamp_place
from tests.tables import table

STORE = get_typestore(Stores.ROS2_JAZZY)
S = 1_000_000_000
PLAIN, IN_LIST = StampPlace(4, in_list=False), StampPlace(8, in_list=True)


@table(
    ("ros_type", "place"),
    [
        ("sensor_msgs/msg/Image", PLAIN),
        ("geometry_msgs/msg/PoseStamped", PLAIN),
        ("geometry_msgs/msg/PoseWithCovarianceStamped", PLAIN),
        ("std_msgs/msg/Header", None),  # is one, and does not begin with one
        ("nav_msgs/msg/Odometry", PLAIN),
        ("tf2_msgs/msg/TFMessage", IN_LIST),
        ("geometry_msgs/msg/Pose", None),
        ("std_msgs/msg/String", None),
        ("builtin_interfaces/msg/Time", None),
        ("std_msgs/msg/Empty", None),
        ("std_msgs/msg/Float64MultiArray", None),
        ("unheard_of/msg/Thing", None),
    ],
)
def test_where_types_of_ros_have_their_stamp(ros_type: str, place: StampPlace | None) -> None:
    assert stamp_place(STORE.fielddefs, ros_type) == place


def types_of(text: str, **others: str) -> dict[str, Any]:
    found: dict[str, Any] = dict(STORE.fielddefs) | get_types_from_msg(text, "p/msg/A")
    for name, fields in others.items():
        found |= get_types_from_msg(fields, f"p/msg/{name}")
    return found


@table(
    ("types", "place"),
    [
        (types_of("std_msgs/Header header\nint8 x"), PLAIN),
        (types_of("int8 x\nstd_msgs/Header header"), None),
        (types_of("p/B b", B="std_msgs/Header h"), PLAIN),  # nested, as TransformStamped in others
        (types_of("p/B b", B="p/C c", C="std_msgs/Header h"), PLAIN),
        (types_of("p/B[] b", B="std_msgs/Header h"), IN_LIST),
        (types_of("p/B[] b", B="p/C c", C="std_msgs/Header h"), IN_LIST),
        (types_of("p/B[] b", B="p/C[] c", C="std_msgs/Header h"), None),
        (types_of("p/B b", B="p/C[] c", C="std_msgs/Header h"), None),
        (types_of("std_msgs/Header[] headers"), None),
        (types_of("p/B[2] b", B="std_msgs/Header h"), None),
        (types_of("string s"), None),
        (types_of("std_msgs/Header h") | get_types_from_msg("int32 seq", "std_msgs/msg/Header"), None),  # of ROS 1
        ({"p/msg/A": get_types_from_msg("std_msgs/Header h", "p/msg/A")["p/msg/A"]}, None),  # not defined
    ],
)
def test_where_other_types_have_it(types: dict[str, Any], place: StampPlace | None) -> None:
    assert stamp_place(types, "p/msg/A") == place


def test_a_definition_without_end_has_none() -> None:
    assert stamp_place(types_of("p/A a"), "p/msg/A") is None
    deep = {f"T{number}": f"p/T{number + 1} x" for number in range(20)} | {"T20": "std_msgs/Header h"}
    assert stamp_place(types_of("p/T0 x", **deep), "p/msg/A") is None


def block(*payloads: bytes) -> MessageBlock:
    """Messages with three bytes between them, which belong to none."""
    data = np.frombuffer(b"".join(b"\xff" * 3 + payload for payload in payloads) + b"\xff", np.uint8)
    ends = np.cumsum([3 + len(payload) for payload in payloads])
    begins = ends - [len(payload) for payload in payloads]
    rows = np.arange(len(payloads))
    return MessageBlock(data, begins, ends, rows, rows + 10, rows + 20)


def pose(stamp_ns: int, *, big: bool = False) -> bytes:
    kind = STORE.types["std_msgs/msg/Header"]
    stamp = STORE.types["builtin_interfaces/msg/Time"](*divmod(stamp_ns, S))
    header = kind(stamp=stamp, frame_id="base")
    return bytes(STORE.serialize_cdr(header, "std_msgs/msg/Header", little_endian=not big))


def listed(count: int, stamp_ns: int, *, big: bool = False) -> bytes:
    """A list whose elements begin with a header; what follows does not count."""
    whole = pose(stamp_ns, big=big)
    return whole[:4] + count.to_bytes(4, "big" if big else "little") + whole[4:]


_stamps = st.integers(0, 2**31 * S - 1)
_rows = st.lists(st.tuples(_stamps, st.booleans()), min_size=1, max_size=6)


@given(_rows)
def test_stamps_are_read_in_both_byte_orders(rows: list[tuple[int, bool]]) -> None:
    expected = [stamp for stamp, _ in rows]
    assert PLAIN.of(block(*(pose(stamp, big=big) for stamp, big in rows))).tolist() == expected
    assert IN_LIST.of(block(*(listed(2, stamp, big=big) for stamp, big in rows))).tolist() == expected


def test_short_messages_and_empty_lists_have_none() -> None:
    assert PLAIN.of(block(pose(5)[:11], b"", pose(7)[:12], b"\0\1")).tolist() == [0, 0, 7, 0]
    empty = listed(0, 9)
    assert IN_LIST.of(block(empty, listed(1, 9)[:15], listed(1, 9)[:16])).tolist() == [0, 0, 9]
    assert PLAIN.of(block()).tolist() == []


@given(_rows, st.lists(_stamps, min_size=6, max_size=6))
def test_other_stamps_are_written_where_there_are_any(rows: list[tuple[int, bool]], given_: list[int]) -> None:
    before = block(*(pose(stamp, big=big) for stamp, big in rows))
    stamps = np.array(given_[: len(rows)])
    after = PLAIN.with_stamps(before, stamps)
    expected = [new if new > 0 else old for new, (old, _) in zip(stamps.tolist(), rows, strict=True)]
    assert PLAIN.of(after).tolist() == expected
    assert PLAIN.of(before).tolist() == [stamp for stamp, _ in rows], "the block itself stays"
    for index, (stamp, (_, big)) in enumerate(zip(expected, rows, strict=True)):
        assert bytes(after.payload(index)) == pose(stamp, big=big)
    assert (after.data[after.ends[-1] :] == 255).all() and (after.data[:3] == 255).all()
    assert after.times is before.times and after.source_times is before.source_times


@pytest.mark.parametrize("place", [PLAIN, IN_LIST])
def test_messages_that_are_too_short_stay(place: StampPlace) -> None:
    before = block(b"\0\1\0\0abc", b"")
    assert (place.with_stamps(before, np.array([5, 6])).data == before.data).all()
