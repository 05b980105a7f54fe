"""Registration against made-up poses, numpy's SVD, and touches in a sequence of PLUS."""

from __future__ import annotations

import math
import re
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given
from hypothesis import strategies as st

from igtl_gateway.base.errors import ConfigError
from igtl_gateway_lab.simulate.registration import (
    Rigid,
    distances,
    eigen,
    expected_fle,
    expected_tre,
    register,
    register_in_order,
    rms,
    stops,
)
from tests.plus_sequences import LANDMARKS, TIP_MM, phantom, touches
from tests.tables import table

Array = npt.NDArray[Any]

FLAT = np.array([[0.0, 82, 20], [56, 50, 20], [66, -70, 20], [0, -118, 20], [-62, -72, 20], [-58, 46, 20]])
SOLID = np.array([[0.0, 0, 0], [100, 0, 0], [0, 80, 0], [0, 0, 60], [70, 70, 10]])


def pose(axis: tuple[float, float, float], degrees: float, shift: tuple[float, float, float]) -> Rigid:
    """By Rodrigues' formula."""
    x, y, z = np.array(axis) / math.sqrt(sum(value * value for value in axis))
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    angle = math.radians(degrees)
    rotation = np.eye(3) + math.sin(angle) * cross + (1 - math.cos(angle)) * (cross @ cross)
    return Rigid(rotation, np.array(shift, float))


def by_svd(moving: Array, fixed: Array) -> Array:
    """Rotation after Arun, Huang and Blostein."""
    u, _, vt = np.linalg.svd((moving - moving.mean(0)).T @ (fixed - fixed.mean(0)))
    return np.asarray(vt.T @ np.diag([1, 1, np.sign(np.linalg.det(vt.T @ u.T))]) @ u.T)


@table("landmarks", [FLAT, SOLID], ids=["flat", "solid"])
@table(("axis", "degrees"), [((1, 0, 0), 0), ((1, 2, 3), 20), ((0, 0, 1), 180), ((1, -1, 0), 179.99)])
def test_a_known_pose_is_found(landmarks: Array, axis: tuple[float, float, float], degrees: float) -> None:
    truth = pose(axis, degrees, (215.0, -3.0, 12.0))
    found = register(landmarks, truth.apply(landmarks))
    assert found.fre < 1e-12
    assert np.abs(found.transform.rotation - truth.rotation).max() < 1e-13
    assert found.transform.translation == pytest.approx(truth.translation, abs=1e-11)
    back = found.transform.inverse()
    assert np.abs(back.apply(found.transform.apply(landmarks)) - landmarks).max() < 1e-11
    assert found.transform.rows[1] == [*found.transform.rotation[1], found.transform.translation[1]]


@given(seed=st.integers(0, 2**32 - 1), noise=st.sampled_from([0.01, 1.0, 30.0]), flat=st.booleans())
def test_noise_is_shared_out_as_by_the_svd(seed: int, noise: float, flat: bool) -> None:
    random = np.random.default_rng(seed)
    landmarks = FLAT if flat else random.uniform(-100, 100, (6, 3))
    touched = pose((3, 1, 2), 70, (1, 2, 3)).apply(landmarks) + random.normal(0, noise, landmarks.shape)
    found = register(landmarks, touched)
    rotation = found.transform.rotation
    assert np.abs(rotation @ rotation.T - np.eye(3)).max() < 1e-12 and np.linalg.det(rotation) > 0
    assert np.abs(rotation - by_svd(landmarks, touched)).max() < 1e-9
    assert found.fre == pytest.approx(math.sqrt(np.mean(np.sum((found.transform.apply(landmarks) - touched) ** 2, 1))))


def test_a_mirrored_set_gives_the_nearest_rotation_not_a_reflection() -> None:
    found = register(SOLID, SOLID * (1, 1, -1))
    assert np.linalg.det(found.transform.rotation) == pytest.approx(1)
    assert found.fre > 10


@pytest.mark.parametrize(
    ("moving", "fixed", "told"),
    [
        (FLAT[:2], FLAT[:2], r"found points of shape \(2, 3\) and \(2, 3\), expected 3 or more pairs"),
        (FLAT[:3], FLAT[:4], "expected 3 or more pairs"),
        (FLAT[:, :2], FLAT[:, :2], "expected 3 or more pairs"),
        (FLAT, FLAT * np.nan, "fixed points: found numbers that are not finite"),
        (np.outer(np.arange(4.0), (1, 2, 3)), FLAT[:4], "moving points: found all on a line"),
        (FLAT[:4], np.zeros((4, 3)), "fixed points: found all on a line"),
    ],
)
def test_what_has_no_single_answer_is_refused(moving: Array, fixed: Array, told: str) -> None:
    with pytest.raises(ConfigError, match=told):
        register(moving, fixed)


def test_eigenvectors_are_those_of_lapack() -> None:
    random = np.random.default_rng(3)
    for size in (3, 4):
        matrix = random.normal(size=(size, size))
        matrix = matrix + matrix.T
        values, vectors = eigen(matrix.tolist())
        assert values == pytest.approx(np.linalg.eigvalsh(matrix)[::-1])
        for value, vector in zip(values, np.array(vectors), strict=True):
            assert matrix @ vector == pytest.approx(value * vector, abs=1e-12)
    assert eigen([[0.0, 0.0], [0.0, 0.0]])[0] == [0.0, 0.0]


def test_expected_errors_are_those_of_many_trials() -> None:
    random = np.random.default_rng(5)
    target, fle = np.array([36.0, 8.0, 20.0]), 1.0
    fres, tres = [], []
    for _ in range(800):
        found = register(FLAT + random.normal(0, fle / math.sqrt(3), FLAT.shape), FLAT)
        fres.append(found.fre)
        tres.append(float(distances(found.transform.apply(target[None]), target[None])[0]))
    assert expected_fle(len(FLAT), rms(np.array(fres))) == pytest.approx(fle, rel=0.05)
    assert rms(np.array(tres)) == pytest.approx(expected_tre(FLAT, rms(np.array(fres)), target), rel=0.07)
    with pytest.raises(ConfigError, match="found 2 landmarks"):
        expected_tre(FLAT[:2], 1.0, target)


def wander(*parts: tuple[float, Array, Array]) -> tuple[Array, Array]:
    """A tip at 50 Hz: (seconds, from, to) each, with a tracker's noise of 0.1 mm."""
    path = np.concatenate([a + np.linspace(0, 1, round(50 * s))[:, None] * (b - a) for s, a, b in parts])
    return np.arange(len(path)) / 50, path + np.random.default_rng(1).normal(0, 0.1, path.shape)


def test_stops_are_where_the_tool_stands_long_enough() -> None:
    a, b, c = SOLID[:3]
    times, path = wander((1.0, a, a), (0.5, a, b), (0.4, b, b), (0.5, b, c), (2.0, c, c))
    first, last = stops(times, path, slowest=10, shortest_s=0.5)
    assert first.position == pytest.approx(a, abs=0.5) and last.position == pytest.approx(c, abs=0.5)
    assert abs(first.end - 50) < 6 and last.end == len(path) and last.spread < 0.5
    assert len(stops(times, path, slowest=10, shortest_s=0.1)) == 3
    assert stops(times[:1], path[:1], slowest=10, shortest_s=0) == []


def test_rests_before_and_after_are_told_from_landmarks() -> None:
    touched = pose((0, 0, 1), 30, (9, 9, 9)).apply(SOLID)
    rest = np.array([[300.0, 0, 0]])
    found, first = register_in_order(SOLID, np.concatenate([rest, touched, rest]))
    assert first == 1 and found.fre < 1e-9
    with pytest.raises(ConfigError, match="found 4 stops of the tool, expected 5"):
        register_in_order(SOLID, touched[:4])
    with pytest.raises(ConfigError, match="on a line"):
        register_in_order(SOLID, np.outer(np.arange(6.0), (1, 1, 1)))


# -- touches in a sequence of PLUS -------------------------------------------------------------------------------------


def matrix(text: str) -> Array:
    return np.array(text.split(), float).reshape(4, 4)


def recorded_touches(path: Path) -> tuple[Array, Array]:
    """Times in s, tip of the stylus in the frame of the reference; mm."""
    text = path.read_bytes().decode("latin-1")

    def values(name: str) -> list[str]:
        return re.findall(rf"^Seq_Frame\d+_{name} = ([-+.e\d ]+?) *\r?$", text, re.M)

    reference, stylus = values("ReferenceToTrackerTransform"), values("StylusToTrackerTransform")
    pairs = zip(reference, stylus, strict=True)
    tips = np.array([(np.linalg.inv(matrix(a)) @ matrix(b) @ (*TIP_MM, 1))[:3] for a, b in pairs])
    return np.array(values("Timestamp"), float), tips


def test_eight_recorded_landmarks_give_the_registration(tmp_path: Path) -> None:
    times, tips = recorded_touches(touches(tmp_path / "some.igs.mha"))
    assert len(tips) == 1000 and len(LANDMARKS) == 8
    pauses = stops(times, tips, slowest=20, shortest_s=1.5)
    assert len(pauses) == 10, "the stylus pauses before the first landmark and after the last"
    found, first = register_in_order(LANDMARKS, np.array([pause.position for pause in pauses]))
    assert first == 1
    rows = phantom()
    ours = found.transform.inverse()  # phantom → reference, the direction that PLUS sends
    assert float(found.residuals.mean()) == pytest.approx(0.2, abs=0.1)
    assert found.fre < 0.3 and found.residuals.max() < 0.4
    planned = Rigid(rows[:3, :3], rows[:3, 3])
    assert distances(ours.apply(LANDMARKS), planned.apply(LANDMARKS)).max() < 0.5
    assert ours.translation == pytest.approx([22.71, -39.75, 25.65], abs=0.25)
    cosine = (np.trace(ours.rotation @ planned.rotation.T) - 1) / 2
    assert math.degrees(math.acos(min(cosine, 1))) < 0.2
