"""The viewing direction of a camera: from the points, and from the name of the frame."""

from __future__ import annotations

import numpy as np
import pytest

from igtl_gateway.addons.review.axes import BODY, OPTICAL, axes_of
from igtl_gateway.addons.review.model import Array
from tests.addons.review.sessions import dome_clouds, rays
from tests.tables import table

_CLOUD = dome_clouds(1)[0].points


def _list(points: Array) -> Array:
    return np.asarray(points.reshape(1, -1, 3))


def test_to_optical_and_from_optical_are_inverse() -> None:
    for axes in (OPTICAL, BODY):
        np.testing.assert_array_equal(axes.to_optical(axes.from_optical(_CLOUD)), _CLOUD)
    np.testing.assert_array_equal(BODY.from_optical(np.array([[1.0, 2.0, 3.0]])), [[3.0, -1.0, -2.0]])


@table("frame", ["camera", "camera_optical_frame", "base_link", ""])
@table("shape", [np.asarray, _list])
def test_an_optical_cloud_has_no_note(frame: str, shape: object) -> None:
    assert callable(shape)
    assert axes_of(shape(_CLOUD), frame) == (OPTICAL, "")


@pytest.mark.parametrize("frame", ["camera_link", "camera_optical_frame"])
@pytest.mark.parametrize("shape", [np.asarray, _list])
def test_an_x_forward_cloud_is_detected_and_noted(frame: str, shape: object) -> None:
    assert callable(shape)
    axes, note = axes_of(shape(BODY.from_optical(_CLOUD)), frame)
    assert axes is BODY
    assert "x forward" in note
    assert "optical frame" in note
    assert frame in note


def test_an_organised_cloud_in_another_frame_is_noted() -> None:
    """With a field of view of 60°; with a few degrees the steps of rows and columns stay nearly equal."""
    wide = rays(focal_px=70.0) * (0.4 + 0.05 * np.random.default_rng(1).random((60, 80, 1)))
    turned = wide @ np.array([[0.8, 0, -0.6], [0, 1, 0], [0.6, 0, 0.8]]) + np.array([0.1, -0.3, 0.4])
    axes, note = axes_of(turned, "base_link")
    assert axes is OPTICAL
    assert "rows and columns" in note


def test_an_ambiguous_unorganised_cloud_is_noted_unless_its_frame_is_optical() -> None:
    beside = _list(_CLOUD + np.array([0.25, 0, 0]))
    assert axes_of(beside, "camera_optical_frame") == (OPTICAL, "")
    axes, note = axes_of(beside, "camera_link")
    assert axes is OPTICAL
    assert "reviewed as z forward" in note


def test_points_around_the_origin_are_noted() -> None:
    around = np.random.default_rng(1).standard_normal((1, 500, 3))
    assert "around the origin" in axes_of(around, "map")[1]


def test_a_cloud_without_depth_has_no_note() -> None:
    assert axes_of(np.full((4, 5, 3), np.nan), "camera") == (OPTICAL, "")
