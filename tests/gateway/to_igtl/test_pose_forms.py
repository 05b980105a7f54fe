"""Poses as matrices and as quaternions, there and back."""

from __future__ import annotations

import math

import numpy as np
import pytest

from igtl_gateway.gateway.to_igtl.pose_forms import as_type
from igtl_gateway.gateway.to_igtl.sender import OutboundMessage
from igtl_gateway.wire.body import Body
from igtl_gateway.wire.text import Status
from igtl_gateway.wire.tracking import TRACKING_DTYPE, QuaternionTrackingData, TrackingData
from igtl_gateway.wire.transform import Position, Transform

S = math.sqrt(0.5)
TURNED = (0.0, 1.0, 0.0, -1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 10.0, 20.0, 30.0)  # 90 degrees around z


def out(igtl_type: str, content: Body) -> OutboundMessage:
    return OutboundMessage(igtl_type, "Tool", content, 7)


def test_a_matrix_as_a_quaternion_and_back() -> None:
    form = as_type(out("TRANSFORM", Transform(TURNED)), "POSITION")
    assert form and isinstance(form.content, Position)
    assert (form.igtl_type, form.device, form.stamp_ns) == ("POSITION", "Tool", 7)
    assert form.content.position == (10.0, 20.0, 30.0)
    assert form.content.quaternion == pytest.approx((0.0, 0.0, S, S))
    back = as_type(form, "TRANSFORM")
    assert back and isinstance(back.content, Transform) and back.content.wire_matrix == pytest.approx(TURNED, abs=1e-6)


def test_tracking_data_as_quaternions_and_back() -> None:
    elements = np.zeros(2, TRACKING_DTYPE)
    elements["name"], elements["type"], elements["matrix"] = [b"Probe", b"Stylus"], [2, 3], [TURNED, TURNED]
    form = as_type(out("TDATA", TrackingData(elements)), "QTDATA")
    assert form and isinstance(form.content, QuaternionTrackingData)
    assert form.content.elements["name"].tolist() == [b"Probe", b"Stylus"]
    assert form.content.elements["quaternion"][1].tolist() == pytest.approx((0.0, 0.0, S, S))
    back = as_type(form, "TDATA")
    assert back and isinstance(back.content, TrackingData)
    assert back.content.elements["type"].tolist() == [2, 3]
    assert back.content.elements["matrix"][1].tolist() == pytest.approx(TURNED, abs=1e-6)


def test_other_types_have_no_other_form() -> None:
    status = out("STATUS", Status(1))
    assert as_type(status, "STATUS") is status
    assert as_type(status, "POSITION") is None
