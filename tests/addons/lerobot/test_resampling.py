"""Each rule of sampling, at odd rates, against pandas and numpy: which message a moment has, and its value.

Rotations are computed another way than in the product: with axes and angles of matrices, by the formula of Rodrigues.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import numpy.typing as npt
import pandas as pd

from igtl_gateway.addons.lerobot.recipe import Feature
from igtl_gateway.addons.lerobot.resampling import Picks, coverage, frame_count, moments, pick
from igtl_gateway.addons.lerobot.samples import Samples
from igtl_gateway.addons.lerobot.values import orientation
from tests.addons.lerobot.sessions import BEGIN_NS
from tests.tables import table

Array = npt.NDArray[Any]

#: Messages per second, frames per second, tolerance in ms: odd ones, and those whose messages and frames coincide.
RATES = [(997.0, 30, 100.0), (100.0, 7, 9.0), (29.97, 30, 50.0), (25.0, 50, 25.0), (7.3, 30, 160.0), (1.1, 60, 950.0)]


def turned(vectors: Array) -> Array:
    """Rotation vectors (N, 3) as matrices (N, 3, 3)."""
    angles = np.linalg.norm(vectors, axis=1)[:, None, None]
    x, y, z = (vectors / np.maximum(angles[:, :, 0], 1e-300)).T
    none = np.zeros(len(vectors))
    cross = np.array([[none, -z, y], [z, none, -x], [-y, x, none]]).transpose(2, 0, 1)
    return np.asarray(np.eye(3) + np.sin(angles) * cross + (1 - np.cos(angles)) * (cross @ cross))


def vector_of(matrices: Array) -> Array:
    """The rotation vectors (N, 3) of matrices (N, 3, 3), of less than half a turn."""
    odd = np.stack([matrices[:, i, j] - matrices[:, j, i] for i, j in ((2, 1), (0, 2), (1, 0))], axis=1) / 2
    angles = np.arctan2(np.linalg.norm(odd, axis=1), (np.trace(matrices, axis1=1, axis2=2) - 1) / 2)
    return odd / np.maximum(np.linalg.norm(odd, axis=1), 1e-300)[:, None] * angles[:, None]


def samples_of(rule: str, kind: str, times: Array, values: Any, tolerance_ms: float | None = None) -> Samples:
    row = Feature("observation.more", "S", rule=rule, tolerance_ms=tolerance_ms)
    names = tuple(f"n{number}" for number in range(np.shape(values)[1])) if kind == "numbers" else ()
    numbers = np.arange(len(times)) + 1
    return Samples(row, "T", kind, times, times, numbers, values, names, names, (), len(times), 0, 0, 0)


def times_at(rate_hz: float, seconds: float = 8.0) -> Array:
    """Times with jitter of a fifth of an interval; some messages are missing, and some are at the moments of frames."""
    random = np.random.default_rng(round(rate_hz))
    steps = np.arange(round(seconds * rate_hz)) + random.uniform(-0.2, 0.2, round(seconds * rate_hz))
    times = BEGIN_NS + np.round(steps / rate_hz * 1e9).astype(np.int64)
    kept = random.random(len(times)) > 0.1
    kept[[0, -1]] = True
    times = times[kept]
    times[len(times) // 2] = BEGIN_NS + 4_000_000_000
    return np.unique(times)


def wanted_of(samples: Samples, fps: int) -> Iterator[Array]:
    """The moments of each time without a gap, on the grid that begins with the first message."""
    for start, end in coverage(samples):
        count = frame_count(start, min(end, int(samples.times[-1])), fps)
        if count > 0:
            yield moments(start, count, fps)


def asof(samples: Samples, wanted: Array, direction: Any, tolerance_ms: float) -> Array:
    """The row of each moment by pandas; −1 for none."""
    right = pd.DataFrame({"at": samples.times, "row": np.arange(len(samples.times))})
    found = pd.merge_asof(
        pd.DataFrame({"at": wanted}), right, on="at", direction=direction, tolerance=round(tolerance_ms * 1e6)
    )
    return found["row"].fillna(-1).to_numpy(np.int64)


@table(("rate_hz", "fps", "tolerance_ms"), RATES)
def test_hold_and_nearest_are_those_of_merge_asof(rate_hz: float, fps: int, tolerance_ms: float) -> None:
    times = times_at(rate_hz)
    values = np.random.default_rng(2).normal(size=(len(times), 3))
    for rule, direction in (("hold", "backward"), ("nearest", "nearest")):
        samples = samples_of(rule, "numbers", times, values, tolerance_ms)
        wanted = np.concatenate(list(wanted_of(samples, fps)))
        picks, expected = pick(samples, wanted, fps), asof(samples, wanted, direction, tolerance_ms)
        assert len(wanted) > 1 and (expected >= 0).all() and not picks.held.any()
        assert np.array_equal(samples.at(picks.before, picks.after, picks.share), values[expected]), rule
    held = samples_of("hold", "numbers", times, values, tolerance_ms)
    grid = moments(int(times[0]), frame_count(int(times[0]), int(times[-1]), fps), fps)
    inside = np.zeros(len(grid), np.bool_)
    for start, end in coverage(held):  # nothing that has a value is left out
        inside |= (grid >= start) & (grid <= end)
    assert np.array_equal(inside, asof(held, grid, "backward", tolerance_ms) >= 0)


@table(("rate_hz", "fps", "tolerance_ms"), RATES)
def test_interpolation_is_linear_and_turns_about_one_axis(rate_hz: float, fps: int, tolerance_ms: float) -> None:
    times, random = times_at(rate_hz), np.random.default_rng(3)
    numbers = random.normal(size=(len(times), 2))
    poses = np.tile(np.eye(4), (len(times), 1, 1))
    poses[:, :3, :3], poses[:, :3, 3] = turned(random.normal(size=(len(times), 3))), random.normal(size=(len(times), 3))
    at = (times - BEGIN_NS).astype(np.float64)
    for kind, values in (("numbers", numbers), ("pose", poses)):
        samples = samples_of("interpolate", kind, times, values, tolerance_ms)
        wanted = np.concatenate(list(wanted_of(samples, fps)))
        picks = pick(samples, wanted, fps)
        found = samples.at(picks.before, picks.after, picks.share)
        when = (wanted - BEGIN_NS).astype(np.float64)
        straight = numbers if kind == "numbers" else poses[:, :3, 3]
        expected = np.stack([np.interp(when, at, each) for each in straight.T], axis=1)
        assert np.allclose(found[:, : expected.shape[1]], expected, rtol=0, atol=1e-6)
        if kind == "pose":
            after = np.minimum(np.searchsorted(times, wanted), len(times) - 1)
            one, two = poses[np.maximum(after - 1, 0), :3, :3], poses[after, :3, :3]
            span = np.maximum(times[after] - times[np.maximum(after - 1, 0)], 1)
            share = 1 - (times[after] - wanted) / span
            between = one @ turned(share[:, None] * vector_of(one.transpose(0, 2, 1) @ two))
            assert np.allclose(matrices_of_quaternions(found[:, 3:]), between, rtol=0, atol=1e-7)
        assert (times[picks.after] - times[picks.before] <= tolerance_ms * 1e6).all()
        exact = np.isin(wanted, times)
        assert (picks.share[exact] == 0).all()


def matrices_of_quaternions(quaternions: Array) -> Array:
    """Quaternions x, y, z, w (N, 4) as matrices (N, 3, 3)."""
    x, y, z, w = quaternions.T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    return np.array(rows).transpose(2, 0, 1)


def test_the_forms_of_a_rotation_are_those_of_the_vector() -> None:
    vectors = np.random.default_rng(4).normal(size=(50, 3))
    poses = np.tile(np.eye(4), (50, 1, 1))
    poses[:, :3, :3] = turned(vectors)
    assert np.allclose(turned(vector_of(poses[:, :3, :3])), poses[:, :3, :3], atol=1e-9)
    assert np.allclose(orientation(poses, "rotation_vector"), vector_of(poses[:, :3, :3]), atol=1e-7)
    assert np.allclose(matrices_of_quaternions(orientation(poses, "quaternion")), poses[:, :3, :3], atol=1e-9)
    assert np.array_equal(orientation(poses, "rotation_6d"), poses[:, :3, :2].transpose(0, 2, 1).reshape(50, 6))


@table(("rate_hz", "fps"), [(rate_hz, fps) for rate_hz, fps, _ in RATES])
def test_a_string_by_the_rule_none_is_in_the_nearest_frame_alone(rate_hz: float, fps: int) -> None:
    grid = moments(BEGIN_NS, 6 * fps, fps)
    half = 10**9 // (2 * fps)
    times = np.unique(np.concatenate([times_at(rate_hz), grid[:3] + half, [grid[0] - half, grid[-1] + half - 1]]))
    texts = np.array([f"{each}" for each in range(len(times))], object)
    samples = samples_of("none", "text", times, texts)
    picks = pick(samples, grid, fps)
    found = samples.at(picks.before, picks.after, picks.share)
    # the other way round: the nearest frame of each string, the earlier one of two, and none that is further away
    frames = pd.DataFrame({"at": grid, "frame": np.arange(len(grid))})
    owners = pd.merge_asof(pd.DataFrame({"at": times}), frames, on="at", direction="nearest", tolerance=half)["frame"]
    expected = [""] * len(grid)
    for text, owner in zip(texts, owners, strict=True):
        if not np.isnan(owner):
            place = int(owner)
            expected[place] += ("\n" if expected[place] else "") + text
    assert found.tolist() == expected
    assert np.array_equal(picks.empty, np.array([not each for each in expected]))


def test_no_number_between_two_angles_that_are_a_turn_apart_is_invented() -> None:
    times = BEGIN_NS + np.arange(3, dtype=np.int64) * 100
    row = Feature("observation.state", "/joint_states", rule="interpolate", tolerance_ms=None)
    names = ("yaw.position", "yaw.velocity")
    values = np.array([[3.1, 3.1], [-3.1, -3.1], [-3.0, -3.0]])
    samples = Samples(
        row, "sensor_msgs/msg/JointState", "numbers", times, times, times, values, names, names, (), 3, 0, 0, 0
    )
    picks: Picks = pick(samples, times[0] + np.array([0, 25, 50, 75, 100, 150]), 30)
    found = samples.at(picks.before, picks.after, picks.share)
    assert np.allclose(found[:, 0], [3.1, 3.1, 3.1, -3.1, -3.1, -3.05])
    assert np.allclose(found[:, 1], [3.1, 1.55, 0, -1.55, -3.1, -3.05])
