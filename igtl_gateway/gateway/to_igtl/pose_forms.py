"""Poses as the other type of the protocol: matrices (TRANSFORM, TDATA) and quaternions (POSITION, QTDATA)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from igtl_gateway.convert.context import ToRosContext
from igtl_gateway.convert.poses import pose_of_matrix, rotation_matrix
from igtl_gateway.convert.units import LengthUnits
from igtl_gateway.gateway.to_igtl.sender import OutboundMessage
from igtl_gateway.wire.body import Body
from igtl_gateway.wire.tracking import QTRACKING_DTYPE, TRACKING_DTYPE, QuaternionTrackingData, TrackingData
from igtl_gateway.wire.transform import Position, Transform


def as_type(out: OutboundMessage, igtl_type: str) -> OutboundMessage | None:
    """Return a message as another type; None if there is no such form.  Raises ConversionError for no rotation."""
    if out.igtl_type == igtl_type:
        return out
    convert = _FORMS.get((out.igtl_type, igtl_type))
    return replace(out, igtl_type=igtl_type, content=convert(out.content)) if convert else None


def _pose(wire_matrix: Any, place: str) -> tuple[float, ...]:
    """Return position and quaternion, in the units of the matrix."""
    return pose_of_matrix(wire_matrix, ToRosContext("", 0, "", "", LengthUnits("mm", "mm")), place)


def _columns(place: Any, quaternion: Any) -> tuple[float, ...]:
    """Return the twelve numbers of TRANSFORM: the columns of the matrix."""
    rows = rotation_matrix(quaternion)
    return (*(rows[row][column] for column in range(3) for row in range(3)), *place)


def _as_position(content: Any) -> Body:
    pose = _pose(content.wire_matrix, "TRANSFORM")
    return Position((pose[0], pose[1], pose[2]), (pose[3], pose[4], pose[5], pose[6]))


def _as_transform(content: Any) -> Body:
    return Transform(_columns(content.position, content.quaternion))


def _as_quaternions(content: Any) -> Body:
    elements = np.zeros(len(content.elements), QTRACKING_DTYPE)
    for name in ("name", "type"):
        elements[name] = content.elements[name]
    for element, matrix in zip(elements, content.elements["matrix"].tolist(), strict=True):
        pose = _pose(matrix, "TDATA")
        element["position"], element["quaternion"] = pose[:3], pose[3:]
    return QuaternionTrackingData(elements)


def _as_matrices(content: Any) -> Body:
    elements = np.zeros(len(content.elements), TRACKING_DTYPE)
    for name in ("name", "type"):
        elements[name] = content.elements[name]
    rows = zip(content.elements["position"].tolist(), content.elements["quaternion"].tolist(), strict=True)
    for element, (place, quaternion) in zip(elements, rows, strict=True):
        element["matrix"] = _columns(place, quaternion)
    return TrackingData(elements)


_FORMS: dict[tuple[str, str], Callable[[Any], Body]] = {
    ("TRANSFORM", "POSITION"): _as_position,
    ("POSITION", "TRANSFORM"): _as_transform,
    ("TDATA", "QTDATA"): _as_quaternions,
    ("QTDATA", "TDATA"): _as_matrices,
}
