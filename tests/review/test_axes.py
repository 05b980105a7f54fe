"""Which way a camera looks: by the points, and by the name of the frame."""

from __future__ import annotations

import numpy as np
import pytest

from igtl_gateway.review.axes import BODY, OPTICAL, axes_of
from igtl_gateway.review.model import Array
from tests.review.sessions import dome_clouds, rays

_CLOUD = dome_clouds(1)[0].points


def _list(points: Array) -> Array:
    return np.asarray(points.reshape(1, -1, 3))


def test_there_and_back() -> None:
    for axes in (OPTICAL, BODY):
        np.testing.assert_array_equal(axes.to_optical(axes.from_optical(_CLOUD)), _CLOUD)
    np.testing.assert_array_equal(BODY.from_optical(np.array([[1.0, 2.0, 3.0]])), [[3.0, -1.0, -2.0]])


@pytest.mark.parametrize("frame", ["camera", "camera_optical_frame", "base_link", ""])
@pytest.mark.parametrize("shape", [np.asarray, _list])
def test_an_optical_cloud_is_no_matter_for_a_note(frame: str, shape: object) -> None:
    assert callable(shape)
    assert axes_of(shape(_CLOUD), frame) == (OPTICAL, "")


@pytest.mark.parametrize("frame", ["camera_link", "camera_optical_frame"])
@pytest.mark.parametrize("shape", [np.asarray, _list])
def test_an_x_forward_cloud_is_found_and_named(frame: str, shape: object) -> None:
    assert callable(shape)
    axes, note = axes_of(shape(BODY.from_optical(_CLOUD)), frame)
    assert axes is BODY
    assert "x forward" in note
    assert "optical frame" in note
    assert frame in note


def test_a_picture_that_was_moved_to_another_frame_is_doubted() -> None:
    """Of what a camera sees with 60°; of a few degrees the rows and columns stay nearly even."""
    wide = rays(focal_px=70.0) * (0.4 + 0.05 * np.random.default_rng(1).random((60, 80, 1)))
    turned = wide @ np.array([[0.8, 0, -0.6], [0, 1, 0], [0.6, 0, 0.8]]) + np.array([0.1, -0.3, 0.4])
    axes, note = axes_of(turned, "base_link")
    assert axes is OPTICAL
    assert "rows and columns" in note


def test_a_list_that_fits_both_is_doubted_unless_its_name_tells() -> None:
    beside = _list(_CLOUD + np.array([0.25, 0, 0]))
    assert axes_of(beside, "camera_optical_frame") == (OPTICAL, "")
    axes, note = axes_of(beside, "camera_link")
    assert axes is OPTICAL
    assert "reviewed as z forward" in note


def test_points_around_the_origin_are_no_cameras() -> None:
    around = np.random.default_rng(1).standard_normal((1, 500, 3))
    assert "around the origin" in axes_of(around, "map")[1]


def test_nothing_seen_is_nothing_to_note() -> None:
    assert axes_of(np.full((4, 5, 3), np.nan), "camera") == (OPTICAL, "")
