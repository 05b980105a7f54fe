"""Tracking data: names, types and poses by hand, every rotation there and back, tools without a valid pose, /tf."""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from igtl_gateway.base.buffers import join
from igtl_gateway.base.errors import ConversionError
from igtl_gateway.convert import tracking
from igtl_gateway.convert.common_msgs import FrameTransform, PoseArray, TFMessage
from igtl_gateway.convert.context import ConvertedMessage, ToIgtlContext, ToRosContext
from igtl_gateway.convert.igtl_msgs import MetadataItem, TrackedTool
from igtl_gateway.convert.igtl_msgs import TrackingData as RosTracking
from igtl_gateway.convert.poses import position_to_igtl, position_to_ros, transform_to_igtl, transform_to_ros
from igtl_gateway.convert.rosmsg import Header, TransformStamped
from igtl_gateway.convert.units import LengthUnits
from igtl_gateway.wire.tracking import TOOL_3D, TOOL_5D, TOOL_6D, TRACKER, QuaternionTrackingData, TrackingData
from igtl_gateway.wire.transform import Position, Transform
from tests import strategies
from tests.tables import table

H = math.sqrt(0.5)
ITEMS = (MetadataItem("Status", 3, "OK"),)
Content = TrackingData | QuaternionTrackingData
Quat = tuple[float, float, float, float]

#: A quarter turn about z, column by column, and as quaternion.
TURN = (0, 1, 0, -1, 0, 0, 0, 0, 1)
IDENTITY = (1, 0, 0, 0, 1, 0, 0, 0, 1)
TURN_Q = (0, 0, H, H)

#: The most that float32 may change an element of a rotation, from the table of conversions.
ROUNDED = 2e-7


def to_ros(device_name: str = "Tracker", **further: Any) -> ToRosContext:
    return ToRosContext(device_name, 5, "base", "child", **further)


def tdata(*tools: tuple[bytes, int, tuple[float, ...]]) -> TrackingData:
    """Tools of name, type and the twelve numbers."""
    return TrackingData(np.array([(name, kind, 0, matrix) for name, kind, matrix in tools], TrackingData.DTYPE))


def qtdata(*tools: tuple[bytes, int, tuple[float, ...], tuple[float, ...]]) -> QuaternionTrackingData:
    rows = [(name, kind, 0, position, quaternion) for name, kind, position, quaternion in tools]
    return QuaternionTrackingData(np.array(rows, QuaternionTrackingData.DTYPE))


TWO = tdata((b"Needle", TOOL_5D, (*TURN, 1, -2, 3)), (b"", TRACKER, (*IDENTITY, 1000, 0, 0.5)))
TWO_Q = qtdata((b"Needle", TOOL_5D, (1, -2, 3), TURN_Q), (b"", TRACKER, (1000, 0, 0.5), (0, 0, 0, -2)))
POSES = [(0.001, -0.002, 0.003, *TURN_Q), (1, 0, 0.0005, 0, 0, 0, 1)]
BOTH = pytest.mark.parametrize("content", [TWO, TWO_Q], ids=["TDATA", "QTDATA"])


@BOTH
def test_tools_keep_name_type_and_pose(content: Content) -> None:
    message = tracking.tracking_to_ros(content, to_ros(metadata=ITEMS))
    message = RosTracking.unpack(message.pack())
    assert message.header == Header(5, "base")
    assert message.metadata == ITEMS
    assert [(tool.name, tool.type) for tool in message.tools] == [("Needle", TOOL_5D), ("", TRACKER)]
    for tool, pose in zip(message.tools, POSES, strict=True):
        assert tool.pose == pytest.approx(pose, abs=1e-15)


@BOTH
def test_a_pose_array_has_the_order_of_the_tools(content: Content) -> None:
    message = PoseArray.unpack(tracking.tracking_to_poses(content, to_ros()).pack())
    assert message.header == Header(5, "base")
    assert message.poses == pytest.approx(np.array(POSES), abs=1e-15)


@pytest.mark.parametrize("content", [tdata(), qtdata()], ids=["TDATA", "QTDATA"])
def test_no_tools(content: Content) -> None:
    message = tracking.tracking_to_ros(content, to_ros())
    poses = tracking.tracking_to_poses(content, to_ros())
    assert (message.tools, poses.poses.shape) == ((), (0, 7))
    assert tracking.tracking_to_tf(content, to_ros()) == TFMessage(())
    for outgoing in (
        tracking.tracking_to_tdata(message, ToIgtlContext()),
        tracking.tracking_to_qtdata(message, ToIgtlContext()),
        tracking.poses_to_tdata(PoseArray.unpack(poses.pack()), ToIgtlContext()),
    ):
        assert outgoing.content.pack() == []


# -- out ----------------------------------------------------------------------------------------------------------


def message_of(*tools: TrackedTool) -> RosTracking:
    return RosTracking(Header(7, "camera"), tools, ITEMS)


MESSAGE = message_of(
    TrackedTool("Needle", TOOL_5D, (0.001, -0.002, 0.003, *TURN_Q)),
    TrackedTool("", TRACKER, (1, 0, 0.0005, 0, 0, 0, -2)),
)


def sent(outgoing: ConvertedMessage, to: ToIgtlContext | None = None) -> Any:
    """The elements as a peer reads them."""
    assert to is None or to.warnings == []
    content = outgoing.content
    assert isinstance(content, TrackingData | QuaternionTrackingData)
    return type(content).unpack(memoryview(join(content.pack()))).elements


def test_sent_as_tdata() -> None:
    outgoing = tracking.tracking_to_tdata(MESSAGE, ToIgtlContext())
    assert (outgoing.stamp_ns, outgoing.frame_id, outgoing.metadata) == (7, "camera", ITEMS)
    elements = sent(outgoing)
    assert elements["name"].tolist() == [b"Needle", b""]
    assert elements["type"].tolist() == [TOOL_5D, TRACKER]
    assert elements["reserved"].tolist() == [0, 0]
    assert elements["matrix"] == pytest.approx(np.array([[*TURN, 1, -2, 3], [*IDENTITY, 1000, 0, 0.5]]), abs=1e-15)


def test_sent_as_qtdata() -> None:
    outgoing = tracking.tracking_to_qtdata(MESSAGE, ToIgtlContext())
    assert (outgoing.stamp_ns, outgoing.frame_id, outgoing.metadata) == (7, "camera", ITEMS)
    elements = sent(outgoing)
    assert elements["name"].tolist() == [b"Needle", b""]
    assert elements["type"].tolist() == [TOOL_5D, TRACKER]
    assert elements["position"].tolist() == [[1, -2, 3], [1000, 0, 0.5]]
    assert elements["quaternion"].tolist() == [[0, 0, np.float32(H), np.float32(H)], [0, 0, 0, -1]]


def test_a_pose_array_is_sent_as_numbered_tools() -> None:
    message = PoseArray(Header(7, "camera"), np.array(POSES))
    to = ToIgtlContext()
    outgoing = tracking.poses_to_tdata(message, to)
    assert (outgoing.stamp_ns, outgoing.frame_id) == (7, "camera")
    elements = sent(outgoing, to)
    assert elements["name"].tolist() == [b"Tool1", b"Tool2"]
    assert elements["type"].tolist() == [TOOL_6D, TOOL_6D]
    assert elements["matrix"] == pytest.approx(np.array([[*TURN, 1, -2, 3], [*IDENTITY, 1000, 0, 0.5]]), abs=1e-15)


def test_a_long_name_is_cut_with_a_warning() -> None:
    to = ToIgtlContext()
    tool = TrackedTool("a name of 20 bytes, ", TOOL_3D, (0, 0, 0, 0, 0, 0, 1))
    assert sent(tracking.tracking_to_tdata(message_of(tool), to))["name"].tolist() == [b"a name of 20 bytes,"]
    assert [code for code, _ in to.warnings] == ["text_cut"]


@table(
    "pose",
    [
        (math.nan, 0, 0, 0, 0, 0, 1),
        (0, math.inf, 0, 0, 0, 0, 1),
        (1e36, 0, 0, 0, 0, 0, 1),  # 1e39 mm: none of float32
        (0, 0, 0, 0, 0, 0, 0),
        (0, 0, 0, math.nan, 0, 0, 1),
        (0, 0, 0, 0, 0, math.inf, 1),
        (0, 0, 0, 1e200, 0, 0, 0),
        (0, 0, 0, 1e-200, 0, 0, 0),
    ],
)
def test_what_is_no_pose_is_not_sent(pose: tuple[float, ...]) -> None:
    good = (1, 2, 3, 0, 0, 0, 1)
    array = PoseArray(Header(), np.array([good, pose]))
    message = message_of(TrackedTool("a", 2, good), TrackedTool("b", 2, pose))  # type: ignore[arg-type]
    for convert in (tracking.tracking_to_tdata, tracking.tracking_to_qtdata):
        with pytest.raises(ConversionError, match=r"pose 1: found .* expected finite"):
            convert(message, ToIgtlContext())
    with pytest.raises(ConversionError, match=r"pose 1: found .* expected finite"):
        tracking.poses_to_tdata(array, ToIgtlContext())


# -- what is no rotation ------------------------------------------------------------------------------------------

TO_ROS: list[Callable[[Any, ToRosContext], Any]] = [
    tracking.tracking_to_ros,
    tracking.tracking_to_poses,
    tracking.tracking_to_tf,
]


@pytest.mark.parametrize("convert", TO_ROS)
def test_scale_is_taken_off_with_a_warning_that_names_the_tool(convert: Callable[[Any, ToRosContext], Any]) -> None:
    content = tdata((b"Good", 2, (*TURN, 0, 0, 0)), (b"Big", 2, (2, 0, 0, 0, 2, 0, 0, 0, 2, 0, 0, 0)))
    to = to_ros()
    convert(content, to)
    ((code, text),) = to.warnings
    assert code == "not_a_rotation"
    assert "TDATA 'Tracker', tool 'Big'" in text


@table("convert", TO_ROS)
@table(
    "content",
    [
        tdata((b"Good", 2, (*TURN, 0, 0, 0)), (b"Bad", 2, (-1, 0, 0, 0, 1, 0, 0, 0, 1, 0, 0, 0))),
        tdata((b"Good", 2, (*TURN, 0, 0, 0)), (b"Bad", 2, (0,) * 12)),
        tdata((b"Good", 2, (*TURN, 0, 0, 0)), (b"Bad", 2, (*IDENTITY, 0, math.nan, 0))),
        qtdata((b"Good", 2, (0, 0, 0), TURN_Q), (b"Bad", 2, (0, 0, 0), (0, 0, 0, 0))),
        qtdata((b"Good", 2, (0, 0, 0), TURN_Q), (b"Bad", 2, (0, math.inf, 0), TURN_Q)),
    ],
)
def test_a_tool_that_is_no_pose_costs_itself(convert: Callable[[Any, ToRosContext], Any], content: Content) -> None:
    to = to_ros()
    message = convert(content, to)
    code, text = to.warnings[-1]
    assert code == "not_a_pose" and re.search(r"TDATA 'Tracker', tool 'Bad': found .*expected", text)
    match message:
        case RosTracking():
            assert [tool.name for tool in message.tools] == ["Good"]
        case TFMessage():
            assert [transform.child_frame_id for transform in message.transforms] == ["Good"]
        case PoseArray():
            assert np.isfinite(message.poses[0]).all() and np.isnan(message.poses[1]).all()


@pytest.mark.parametrize("convert", TO_ROS)
@pytest.mark.parametrize("kind", [TrackingData, QuaternionTrackingData])
def test_more_tools_than_any_tracker_has_are_refused(
    kind: type[Content], convert: Callable[[Any, ToRosContext], Any]
) -> None:
    """16 MB of matrices that are not orthonormal would be a minute of work."""
    with pytest.raises(ConversionError, match="elements, expected at most 512"):
        convert(kind(np.zeros(tracking.MAX_TOOLS + 1, kind.DTYPE)), to_ros())


def test_as_many_tools_as_are_taken() -> None:
    one = TWO.elements[:1]
    message = tracking.tracking_to_poses(TrackingData(np.repeat(one, tracking.MAX_TOOLS)), to_ros())
    assert (message.poses == message.poses[0]).all() and len(message.poses) == tracking.MAX_TOOLS


# -- there and back -----------------------------------------------------------------------------------------------

quaternions = st.tuples(*[st.floats(-1, 1)] * 4).filter(lambda q: sum(v * v for v in q) > 1e-6)
names = strategies.ros_text.map(lambda text: text.encode()[:18].decode(errors="ignore"))
tools = st.builds(
    TrackedTool,
    names,
    st.integers(0, 255),
    st.tuples(*[strategies.metres] * 3, quaternions).map(lambda parts: (*parts[:3], *parts[3])),
)
ros_tracking = st.builds(RosTracking, strategies.headers, st.lists(tools, max_size=4).map(tuple))


def off_by(a: Any, b: Any) -> float:
    return float(np.max(np.abs(np.asarray(a, float) - np.asarray(b, float)), initial=0.0))


@given(ros_tracking, st.sampled_from([tracking.tracking_to_tdata, tracking.tracking_to_qtdata]))
def test_ros_to_igtl_and_back(
    message: RosTracking, convert: Callable[[RosTracking, ToIgtlContext], ConvertedMessage]
) -> None:
    """Names and types are exact, positions rounded to float32 millimetres, rotations within the table's tolerance."""
    content: Any = convert(message, ToIgtlContext()).content
    back = tracking.tracking_to_ros(content, to_ros())
    assert [(tool.name, tool.type) for tool in back.tools] == [(tool.name, tool.type) for tool in message.tools]
    for before, after in zip(message.tools, back.tools, strict=True):
        assert after.pose[:3] == tuple(float(np.float32(value * 1000)) / 1000 for value in before.pose[:3])
        unit = np.array(before.pose[3:]) / math.sqrt(sum(v * v for v in before.pose[3:]))
        assert min(off_by(after.pose[3:], unit), off_by(after.pose[3:], -unit)) < ROUNDED


@given(ros_tracking)
def test_igtl_to_ros_and_back(message: RosTracking) -> None:
    """Values that are float32 already keep positions exactly, and rotations within the table's tolerance."""
    there: Any = tracking.tracking_to_tdata(message, ToIgtlContext()).content
    to = to_ros()
    back: Any = tracking.tracking_to_tdata(tracking.tracking_to_ros(there, to), ToIgtlContext()).content
    assert to.warnings == []
    for name in ("name", "type", "reserved"):
        assert there.elements[name].tolist() == back.elements[name].tolist()
    assert there.elements["matrix"][:, 9:].tobytes() == back.elements["matrix"][:, 9:].tobytes()
    assert off_by(there.elements["matrix"], back.elements["matrix"]) < ROUNDED

    there = tracking.tracking_to_qtdata(message, ToIgtlContext()).content
    back = tracking.tracking_to_qtdata(tracking.tracking_to_ros(there, to), ToIgtlContext()).content
    assert there.elements["position"].tobytes() == back.elements["position"].tobytes()
    for a, b in zip(there.elements["quaternion"], back.elements["quaternion"], strict=True):
        assert min(off_by(a, b), off_by(a, -b)) < ROUNDED


@given(ros_tracking)
def test_columns_have_the_bits_of_single_poses(message: RosTracking) -> None:
    matrices = sent(tracking.tracking_to_tdata(message, ToIgtlContext()))["matrix"].tolist()
    quaternions = sent(tracking.tracking_to_qtdata(message, ToIgtlContext()))
    for index, tool in enumerate(message.tools):
        single = TransformStamped(Header(), "", tool.pose[:3], tool.pose[3:])
        one: Any = Transform.unpack(memoryview(join(transform_to_igtl(single, ToIgtlContext()).content.pack())))
        assert tuple(matrices[index]) == one.wire_matrix
        other: Any = Position.unpack(memoryview(join(position_to_igtl(single, ToIgtlContext()).content.pack())))
        assert tuple(quaternions["position"][index].tolist()) == other.position
        assert tuple(quaternions["quaternion"][index].tolist()) == other.quaternion


@given(strategies.bodies()["TDATA"] | strategies.bodies()["QTDATA"])
def test_any_bytes_are_converted_or_refused(content: Content) -> None:
    for convert in TO_ROS:
        try:
            convert(content, to_ros()).pack()
        except ConversionError as error:
            assert "expected" in str(error)


def test_configured_units() -> None:
    content = tdata((b"", 2, (*IDENTITY, 10, 20, 30)))
    message = tracking.tracking_to_ros(content, to_ros(lengths=LengthUnits("cm", "mm")))
    assert message.tools[0].pose[:3] == (1, 2, 3)
    assert sent(tracking.tracking_to_tdata(message, ToIgtlContext(LengthUnits("cm", "mm"))))["matrix"].tolist() == [
        [*IDENTITY, 10, 20, 30]
    ]


# -- /tf ----------------------------------------------------------------------------------------------------------


def frames(message: TFMessage) -> list[tuple[int, str, str]]:
    """Stamp, parent and child of each, as a subscriber reads them."""
    return [
        (one.header.stamp_ns, one.header.frame_id, one.child_frame_id)
        for one in TFMessage.unpack(message.pack()).transforms
    ]


def test_names_of_tools_give_frames() -> None:
    names = [b"ProbeToTracker", b"Needle", b"", b"7 iron", b"a\x00junk"]
    content = tdata(*((name, 2, (*TURN, 1, -2, 3)) for name in names))
    message = tracking.tracking_to_tf(content, to_ros(device_name="My Device"))
    assert frames(message) == [
        (5, "Tracker", "Probe"),
        (5, "base", "Needle"),
        (5, "base", "My_Device_2"),
        (5, "base", "_7_iron"),
        (5, "base", "a"),
    ]
    assert all(one.pose == pytest.approx(POSES[0], abs=1e-15) for one in message.transforms)


def test_the_name_of_a_device_gives_its_nameless_tools_no_other_parent() -> None:
    message = tracking.tracking_to_tf(tdata((b"", 2, (*TURN, 0, 0, 0))), to_ros(device_name="ProbeToTracker"))
    assert frames(message) == [(5, "base", "ProbeToTracker_0")]


def test_quaternions_give_the_same_frames() -> None:
    assert frames(tracking.tracking_to_tf(TWO_Q, to_ros())) == frames(tracking.tracking_to_tf(TWO, to_ros()))
    assert frames(tracking.tracking_to_tf(TWO_Q, to_ros())) == [(5, "base", "Needle"), (5, "base", "Tracker_1")]


def test_a_frame_is_never_its_own_parent() -> None:
    content = tdata(*((name, 2, (*TURN, 0, 0, 0)) for name in (b"base", b"AToA", b"A")))
    to = to_ros()
    assert frames(tracking.tracking_to_tf(content, to)) == [(5, "base", "A")]
    assert [code for code, _ in to.warnings] == ["own_parent"] * 2


def test_transforms_and_positions_go_by_the_frames_of_their_stream() -> None:
    transform = Transform((*TURN, 1, -2, 3))
    position = Position((1, -2, 3), (0, 0, -0.6, -0.8))
    for message, single in (
        (tracking.transform_to_tf(transform, to_ros()), transform_to_ros(transform, to_ros())),
        (tracking.position_to_tf(position, to_ros()), position_to_ros(position, to_ros())),
    ):
        pose = (*single.translation, *single.rotation)
        assert message == TFMessage((FrameTransform(Header(5, "base"), "child", pose),))
        # a transform in a TFMessage is the one that is published alone
        assert TFMessage.unpack(message.pack()).transforms[0].pack() == single.pack()


def test_what_is_no_transform_is_none_on_tf() -> None:
    with pytest.raises(ConversionError):
        tracking.transform_to_tf(Transform((0.0,) * 12), to_ros())
    with pytest.raises(ConversionError):
        tracking.position_to_tf(Position((0, 0, 0), (0, 0, 0, 0)), to_ros())
