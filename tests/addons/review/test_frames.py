"""Paths of frames, compared with poses composed by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest

from igtl_gateway.addons.review.frames import FramePoses
from igtl_gateway.base.errors import ConversionError
from igtl_gateway.convert.structs import Pose

_QUARTER = (0.0, 0.0, math.sqrt(0.5), math.sqrt(0.5))  # about z
_NONE = (0.0, 0.0, 0.0, 1.0)


def _pose(*position: float, q: tuple[float, float, float, float] = _NONE) -> Pose:
    x, y, z = position
    return (x, y, z, *q)


def _frames() -> FramePoses:
    """Return a camera rotated by 90° about z, and a tool that moves along x of the base; 10 and 11 are stamps."""
    frames = FramePoses()
    frames.add("base", "camera", _pose(1, 0, 0, q=_QUARTER), 10, 110, "/camera")
    frames.add("base", "tool", _pose(0, 0, 0), 10, 110, "/tool")
    frames.add("base", "tool", _pose(2, 0, 0), 20, 120, "/tool")
    return frames


def test_a_path_in_another_branch_of_the_tree_has_gateway_times() -> None:
    path = _frames().path("tool", "camera")
    assert path.stamps_ns.tolist() == [110, 120]
    np.testing.assert_allclose(path.positions, [[0, 1, 0], [0, -1, 0]], atol=1e-12)


def test_transforms_to_a_parent_and_to_a_child_are_inverse() -> None:
    frames, points, stamps = _frames(), np.array([[1.0, 2.0, 3.0]]), np.array([10])
    there = frames.transformed(points, "camera", "base", stamps)
    np.testing.assert_allclose(there, [[-1, 1, 3]], atol=1e-12)
    np.testing.assert_allclose(frames.transformed(there, "/base", "camera", stamps), points, atol=1e-12)
    assert frames.transformed(points, "unknown", "unknown", stamps) is points


@pytest.mark.parametrize(("stamp", "x"), [(5, 0.0), (10, 0.0), (15, 1.0), (20, 2.0), (99, 2.0)])
def test_poses_are_interpolated_and_constant_beyond_the_samples(stamp: int, x: float) -> None:
    found = _frames().transformed(np.zeros((1, 3)), "tool", "base", np.array([stamp]))
    np.testing.assert_allclose(found, [[x, 0, 0]], atol=1e-12)


def test_a_quaternion_and_its_negative_are_one_rotation() -> None:
    frames = FramePoses()
    frames.add("base", "camera", _pose(0, 0, 0, q=_QUARTER), 10, 10, "/c")
    frames.add("base", "camera", _pose(0, 0, 0, q=(0.0, 0.0, -2 * _QUARTER[2], -2 * _QUARTER[3])), 20, 20, "/c")
    found = frames.transformed(np.array([[1.0, 0, 0]]), "camera", "base", np.array([15]))
    np.testing.assert_allclose(found, [[0, 1, 0]], atol=1e-12)


def test_unconnected_frames_are_an_error() -> None:
    frames = _frames()
    frames.add("other", "probe", _pose(0, 0, 0), 1, 1, "/p")
    assert not frames.connected("probe", "tool")
    assert frames.connected("tool", "camera")
    with pytest.raises(ConversionError, match="'probe' and 'camera' unconnected"):
        frames.transformed(np.zeros((1, 3)), "probe", "camera", np.array([1]))


def test_moving_frames_are_listed_and_invalid_poses_are_skipped() -> None:
    frames = _frames()
    for bad in (_pose(math.nan, 0, 0), _pose(0, 0, 0, q=(0.0, 0.0, 0.0, 0.0))):
        frames.add("base", "broken", bad, 1, 1, "/b")
    frames.add("", "nameless", _pose(0, 0, 0), 1, 1, "/b")
    assert frames.moving() == {"tool": "/tool"}
    assert frames.above("/camera") == {"camera", "base"}
    assert frames.above("broken") == {"broken"}


def test_a_cycle_of_frames_terminates() -> None:
    frames = FramePoses()
    frames.add("a", "b", _pose(0, 0, 0), 1, 1, "/r")
    frames.add("b", "a", _pose(0, 0, 0), 1, 1, "/r")
    assert frames.above("a") == {"a", "b"}
