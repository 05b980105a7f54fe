"""Tracking data of single poses: one message for each moment, with what does not move in each."""

from __future__ import annotations

from typing import Any

from hypothesis import given
from hypothesis import strategies as st

from igtl_gateway.gateway.to_igtl.sender import OutboundMessage
from igtl_gateway.gateway.to_igtl.tf_out import MOMENT_NS
from igtl_gateway.gateway.to_igtl.trackdata import (
    NAME_BYTES,
    TRACKING_DEVICE,
    TrackedMoment,
    name_field,
    tracking_moments,
)
from igtl_gateway.wire.tracking import TOOL_6D
from igtl_gateway.wire.transform import Position, Transform
from tests.tables import table

T0 = 10**18


def pose(device: str, stamp_ns: int, x: float = 0.0, **more: Any) -> OutboundMessage:
    matrix = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0, x, 2.0, 3.0)
    return OutboundMessage("TRANSFORM", device, Transform(matrix), stamp_ns, **more)


def moments(*poses: OutboundMessage, device: str = "", all_at_once: bool = False) -> list[TrackedMoment]:
    def latest(igtl_type: str, wanted: str) -> list[OutboundMessage]:
        assert (igtl_type, wanted) == ("TRANSFORM", "")
        return list(poses)

    return tracking_moments("TDATA", device, latest, moments=not all_at_once)


def tools(moment: TrackedMoment) -> list[str]:
    return [name.decode() for name in moment.message.content.elements["name"].tolist()]  # type: ignore[attr-defined]


def test_poses_of_one_moment_are_one_message_with_the_newest_stamp() -> None:
    (found,) = moments(
        pose("A", T0, 1.0, ros_stamp_ns=5, frame_id="base"), pose("B", T0 + 7, 2.0, ros_stamp_ns=9, frame_id="base")
    )
    message = found.message
    assert (message.igtl_type, message.device, message.stamp_ns) == ("TDATA", TRACKING_DEVICE, T0 + 7)
    assert (message.ros_stamp_ns, message.frame_id) == (9, "base")
    assert tools(found) == ["A", "B"] and found.stamps == {"A": T0, "B": T0 + 7}
    elements = message.content.elements  # type: ignore[attr-defined]
    assert elements["matrix"][:, 9].tolist() == [1.0, 2.0] and set(elements["type"]) == {TOOL_6D}


def test_the_device_is_that_of_the_request() -> None:
    assert moments(pose("A", T0), device="Tracker")[0].message.device == "Tracker"


def test_poses_of_several_moments_are_several_messages_the_oldest_first() -> None:
    found = moments(pose("A", T0 + 9 * MOMENT_NS), pose("B", T0), pose("C", T0 + 1))
    assert [tools(each) for each in found] == [["B", "C"], ["A"]]
    assert [each.message.stamp_ns for each in found] == [T0 + 1, T0 + 9 * MOMENT_NS]


def test_what_does_not_move_is_in_each_message_and_has_no_stamp_beside_what_moves() -> None:
    static = pose("Base", 7, is_static=True)
    found = moments(static, pose("A", T0), pose("B", T0 + S))
    assert [tools(each) for each in found] == [["Base", "A"], ["Base", "B"]]
    assert [list(each.stamps) for each in found] == [["A"], ["B"]]
    (alone,) = moments(static, pose("Table", 9, is_static=True))
    assert tools(alone) == ["Base", "Table"] and alone.stamps == {"Base": 7, "Table": 9}
    assert alone.message.stamp_ns == 9


S = 10**9


def test_old_recordings_have_all_poses_in_one_message() -> None:
    (found,) = moments(pose("A", T0), pose("B", T0 + 9 * S), pose("C", 5, is_static=True), all_at_once=True)
    assert tools(found) == ["A", "B", "C"] and found.message.stamp_ns == T0 + 9 * S and found.stamps == {}


def test_without_poses_there_is_nothing_to_send() -> None:
    assert moments() == []


def test_poses_in_several_frames_have_no_common_one() -> None:
    (found,) = moments(pose("A", T0, frame_id="a"), pose("B", T0, frame_id="b"))
    assert found.message.frame_id == ""


@given(st.lists(st.integers(0, 40), min_size=1, max_size=8))
def test_each_pose_is_in_a_message_near_its_stamp(steps: list[int]) -> None:
    poses = [pose(f"T{number}", T0 + step * MOMENT_NS // 4) for number, step in enumerate(steps)]
    found = moments(*poses)
    assert {name for each in found for name in each.stamps} == {each.device for each in poses}
    for each in found:
        assert all(0 <= each.message.stamp_ns - stamp < MOMENT_NS for stamp in each.stamps.values())
    stamps = [each.message.stamp_ns for each in found]
    assert stamps == sorted(set(stamps))


def test_positions_and_quaternions() -> None:
    one = OutboundMessage("POSITION", "A", Position((1.0, 2.0, 3.0), (0.0, 0.0, 1.0, 0.0)), T0)

    def latest(igtl_type: str, _device: str) -> list[OutboundMessage]:
        assert igtl_type == "POSITION"
        return [one]

    (found,) = tracking_moments("QTDATA", "", latest)
    (element,) = found.message.content.elements  # type: ignore[attr-defined]
    assert found.message.igtl_type == "QTDATA"
    assert (element["position"].tolist(), element["quaternion"].tolist()) == ([1, 2, 3], [0, 0, 1, 0])


@table(
    ("full_name", "field"),
    [
        ("ProbeToTracker", b"ProbeToTracker"),
        ("a" * 25, b"a" * NAME_BYTES),  # the C++ reader drops a name that fills its field
        ("é" * 12, "é".encode() * 9),  # never inside a character
        ("", b"short"),
    ],
)
def test_names_of_tools(full_name: str, field: bytes) -> None:
    (found,) = moments(pose("short", T0, full_name=full_name))
    assert found.message.content.elements["name"].tolist() == [field]  # type: ignore[attr-defined]
    assert list(found.stamps) == [full_name or "short"], "by its whole name"


def test_fields_are_filled_up() -> None:
    assert name_field("ab", 4) == b"ab\0\0" and name_field("abcdef", 4) == b"abcd"
