"""Paths of frames, compared with poses composed by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from igtl_gateway.addons.review.frames import FramePoses, Placed
from igtl_gateway.base.errors import ConversionError
from igtl_gateway.convert.structs import Pose
from igtl_gateway.gateway.log.one_clock import StreamTimes
from igtl_gateway.gateway.log.timing import GAP_NS

_MS = 1_000_000
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


def _at(frames: FramePoses, points: list[list[float]], frame: str, base: str, stamp_ns: int) -> Placed:
    stamps = np.array([stamp_ns])
    return frames.transformed(np.array(points), frame, base, StreamTimes("/plan", stamps + 100, stamps), 0)


def test_a_path_in_another_branch_of_the_tree_has_gateway_times() -> None:
    path = _frames().path("tool", "camera")
    assert path.stamps_ns.tolist() == [110, 120]
    np.testing.assert_allclose(path.positions, [[0, 1, 0], [0, -1, 0]], atol=1e-12)
    assert path.joined.tolist() == [True]
    assert not path.notes


def test_transforms_to_a_parent_and_to_a_child_are_inverse() -> None:
    frames = _frames()
    there = _at(frames, [[1, 2, 3]], "camera", "base", 10).points
    np.testing.assert_allclose(there, [[-1, 1, 3]], atol=1e-12)
    np.testing.assert_allclose(_at(frames, there.tolist(), "/base", "camera", 10).points, [[1, 2, 3]], atol=1e-12)


@pytest.mark.parametrize(("stamp", "x"), [(10, 0.0), (15, 1.0), (20, 2.0)])
def test_poses_are_interpolated(stamp: int, x: float) -> None:
    found = _at(_frames(), [[0, 0, 0]], "tool", "base", stamp)
    np.testing.assert_allclose(found.points, [[x, 0, 0]], atol=1e-12)
    assert not found.notes


def test_a_quaternion_and_its_negative_are_one_rotation() -> None:
    frames = FramePoses()
    frames.add("base", "camera", _pose(0, 0, 0, q=_QUARTER), 10, 110, "/c")
    frames.add("base", "camera", _pose(0, 1, 0, q=(0.0, 0.0, -2 * _QUARTER[2], -2 * _QUARTER[3])), 20, 120, "/c")
    np.testing.assert_allclose(_at(frames, [[1, 0, 0]], "camera", "base", 15).points, [[0, 1.5, 0]], atol=1e-12)


@given(
    offset_s=st.sampled_from([0, 3, -3]),
    delay_ms=st.integers(0, 30),
    jitter_ms=st.integers(0, 200),
    gap_s=st.sampled_from([0.0, 0.1, 0.14, 0.3, 2.0]),
    seed=st.integers(0, 99),
)
def test_a_path_is_the_truth_or_unknown(offset_s: int, delay_ms: int, jitter_ms: int, gap_s: float, seed: int) -> None:
    """Tool and camera move along x, each at 100 mm/s; the camera's stamps are late, ahead, and have a gap.

    The tool's y states its moment.  A corrected clock leaves the least latency.
    """
    noise = np.random.default_rng(seed)
    events = []
    for at in range(1000, 7000, 10):
        events.append((at + 1, at, "tool", 1))
        if at % 25 == 0 and not 4000 < at < 4000 + gap_s * 1000:
            late = delay_ms + int(noise.integers(0, jitter_ms + 1))
            events.append((at + late, at + 1000 * offset_s, "camera", -1))
    frames = FramePoses()
    for arrival, stamp, child, sign in sorted(events):
        at = stamp - (1000 * offset_s if child == "camera" else 0)
        y = at * 1e-4 if child == "tool" else 0.0
        frames.add("base", child, _pose(sign * at * 1e-4, y, 0), (stamp + 10**6) * _MS, (arrival + 10**6) * _MS, child)
    path = frames.path("tool", "camera")
    off_mm = 1000 * np.abs(path.positions[:, 0] - 2 * path.positions[:, 1])
    moments = np.round(path.positions[:, 1] * 1e4)
    inside = (moments > 4000) & (moments < 4000 + gap_s * 1000)
    if offset_s:
        assert any("corrected by" in note for note in path.notes)
        assert off_mm.max() <= 0.1 * (delay_ms + jitter_ms) + 1e-6
    else:
        assert off_mm.max() <= 1e-6
        assert bool(inside.any()) == (0.0 < gap_s <= GAP_NS / 1e9)
        assert int((~path.joined).sum()) == int(gap_s > GAP_NS / 1e9)
    assert any("'camera' in 'base' (camera): unknown at" in note for note in path.notes)
    assert len(path.positions) > 550 - gap_s * 100


def test_a_gap_of_the_tool_divides_its_path_unless_it_stood_still() -> None:
    frames = FramePoses()
    for at, x in ((0, 0.0), (100, 0.01), (900, 0.01), (1000, 0.02), (1600, 0.08), (1700, 0.09)):
        frames.add("base", "tool", _pose(x, 0, 0), (at + 1000) * _MS, (at + 1000) * _MS, "/tool")
    path = frames.path("tool", "base")
    assert path.joined.tolist() == [True, True, True, False, True]
    (note,) = path.notes
    assert note.startswith("'tool' in 'base' (/tool): unknown in 1 gap above 0.15 s, the longest of 600 ms")


def test_before_and_after_its_samples_a_pose_is_unknown() -> None:
    frames = FramePoses()
    for at in range(1000, 2000, 100):
        frames.add("base", "camera", _pose(at, 0, 0), at * _MS, at * _MS, "/camera")
        frames.add("base", "mount", _pose(3, 0, 0), 5 * _MS, 5 * _MS, "/mount")
    for at in (500, 2400):
        found = _at(frames, [[0, 0, 0]], "camera", "base", at * _MS)
        assert not found.known.any()
        assert np.isnan(found.points).all()
        assert "'camera' in 'base' (/camera): unknown at 1 of 1 moment" in found.notes[0]
        assert _at(frames, [[0, 0, 0]], "mount", "base", at * _MS).points.tolist() == [[3, 0, 0]]


def test_without_a_stamp_all_have_times_of_receipt() -> None:
    frames = FramePoses()
    for at in range(1000, 2000, 100):
        frames.add("base", "camera", _pose(at, 0, 0), 0, at * _MS, "/camera")
    stamps = np.array([9_000 * _MS])
    found = frames.transformed(np.zeros((1, 3)), "camera", "base", StreamTimes("/plan", stamps // 6, stamps), 0)
    np.testing.assert_allclose(found.points, [[1500, 0, 0]])
    assert "so all streams have their times of receipt" in found.notes[0]


def test_unconnected_frames_are_an_error() -> None:
    frames = _frames()
    frames.add("other", "probe", _pose(0, 0, 0), 1, 1, "/p")
    assert not frames.connected("probe", "tool")
    assert frames.connected("tool", "camera")
    with pytest.raises(ConversionError, match="'probe' and 'camera' unconnected"):
        _at(frames, [[0, 0, 0]], "probe", "camera", 1)


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
