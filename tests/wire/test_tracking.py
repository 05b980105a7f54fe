"""TDATA and QTDATA: the bytes of a tool, and its description."""

from __future__ import annotations

from igtl_gateway.wire.tracking import (
    TOOL_3D,
    TOOL_5D,
    TOOL_6D,
    TRACKER,
    QuaternionTrackingData,
    TrackingData,
)
from tests.wire.contents import check_golden, check_list, element, f32, text


def test_lists_hold_whole_elements() -> None:
    check_list(TrackingData, 70)
    check_list(QuaternionTrackingData, 50)


def test_golden_bytes_of_matrices() -> None:
    described = check_golden(
        element(TrackingData, "probe", TOOL_6D, 0, [0, 1, 0, -1, 0, 0, 0, 0, 1, 10, 20, 30]),
        text("probe", 20) + b"\2\0" + f32(0, 1, 0, -1, 0, 0, 0, 0, 1, 10, 20, 30),
        lambda size: size == 0,
    )
    assert described["elements"] == [
        {"name": "probe", "type": 2, "matrix": [[0, -1, 0, 10], [1, 0, 0, 20], [0, 0, 1, 30], [0, 0, 0, 1]]}
    ]


def test_golden_bytes_of_quaternions() -> None:
    """The scalar is the last number."""
    described = check_golden(
        element(QuaternionTrackingData, "é".encode(), TOOL_5D, 7, [1, 2, 3], [0, 0, 1, 0]),
        text("é", 20) + b"\4\7" + f32(1, 2, 3, 0, 0, 1, 0),
        lambda size: size == 0,
    )
    assert described["elements"] == [{"name": "é", "type": 4, "position": [1, 2, 3], "quaternion": [0, 0, 1, 0]}]


def test_kinds_of_tools_are_those_of_the_document() -> None:
    assert (TRACKER, TOOL_6D, TOOL_3D, TOOL_5D) == (1, 2, 3, 4)
