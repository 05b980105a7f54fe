"""Methods that are written by hand for speed: their bytes are those of rosbags, field by field."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st
from rosbags.typesys import Stores, get_typestore

from igtl_gateway.base.errors import ConversionError
from igtl_gateway.convert.cdr import CdrReader, CdrWriter
from igtl_gateway.convert.common_msgs import FrameTransform, TFMessage
from igtl_gateway.convert.igtl_msgs import LabeledPoint
from igtl_gateway.convert.rosmsg import Header
from igtl_gateway.convert.structs import Struct
from tests import strategies

STORE = get_typestore(Stores.ROS2_JAZZY)

_poses = st.tuples(*[strategies.any64] * 7)
_stamps = st.integers(0, 2**31 * 10**9 - 1)
_names = st.text(st.characters(codec="utf-8", exclude_characters="\0"), max_size=40)


@st.composite
def transforms(draw: st.DrawFn) -> FrameTransform:
    return FrameTransform(Header(draw(_stamps), draw(_names)), draw(_names), draw(_poses))


def same(found: float, expected: float) -> bool:
    return (math.isnan(found) and math.isnan(expected)) or (found, math.copysign(1, found)) == (
        expected,
        math.copysign(1, expected),
    )


@given(st.lists(transforms(), max_size=3).map(tuple))
def test_a_list_of_transforms_is_what_rosbags_reads_and_writes(given_: tuple[FrameTransform, ...]) -> None:
    """One transform is built in one step, other numbers of them are not."""
    data = TFMessage(given_).pack()
    message = STORE.deserialize_cdr(data, "tf2_msgs/msg/TFMessage")
    assert len(message.transforms) == len(given_)  # type: ignore[attr-defined]
    for found, one in zip(message.transforms, given_, strict=True):  # type: ignore[attr-defined]
        assert found.header.stamp.sec * 10**9 + found.header.stamp.nanosec == one.header.stamp_ns
        assert (found.header.frame_id, found.child_frame_id) == (one.header.frame_id, one.child_frame_id)
        place, turn = found.transform.translation, found.transform.rotation
        numbers = (place.x, place.y, place.z, turn.x, turn.y, turn.z, turn.w)
        assert all(map(same, numbers, one.pose))
    assert bytes(STORE.serialize_cdr(message, "tf2_msgs/msg/TFMessage")) == data
    again = TFMessage.unpack(data)
    assert [each.header for each in again.transforms] == [each.header for each in given_]


@given(transforms())
def test_one_transform_is_packed_as_by_its_fields(one: FrameTransform) -> None:
    message = TFMessage((one,))
    assert message.pack() == Struct.pack(message)


@given(
    st.builds(
        LabeledPoint, _names, _names, st.tuples(*[st.integers(0, 255)] * 4), st.tuples(*[strategies.any64] * 3),
        strategies.any64, _names,
    )
)  # fmt: skip
def test_points_are_packed_and_read_as_by_their_fields(point: LabeledPoint) -> None:
    """At every offset: strings of any length come before the numbers, which are aligned to 8 bytes."""
    for before in range(3):
        quick_out, out = CdrWriter(), CdrWriter()
        for writer in (quick_out, out):
            writer.string("x" * before)
        point.write(quick_out)
        Struct.write(point, out)
        data = out.finish()
        assert quick_out.finish() == data
        read = CdrReader(data, LabeledPoint.TYPE)
        read.string()
        found = LabeledPoint.read(read)
        assert (found.name, found.group, found.rgba, found.owner) == (
            point.name, point.group, point.rgba, point.owner,
        )  # fmt: skip
        assert all(map(same, (*found.position, found.diameter), (*point.position, point.diameter)))


def test_a_colour_that_a_byte_does_not_hold_is_refused() -> None:
    with pytest.raises(ConversionError):
        LabeledPoint("a", "", (256, 0, 0, 0), (0.0, 0.0, 0.0), 0.0, "").write(CdrWriter())
