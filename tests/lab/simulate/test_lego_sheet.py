"""The plan lies on the sheet, and lines are compared as a surgeon would."""

from __future__ import annotations

import math

import numpy as np
import pytest

from igtl_gateway_lab.simulate.lego_sheet import CHECKS, HEIGHT_MM, LANDMARKS, line_error, on_sheet, strokes
from igtl_gateway_lab.simulate.volume import LESION

STRAIGHT = np.array([[0.0, 0, 0], [100, 0, 0]])


def segments(*points: tuple[float, float]) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
    line = np.array([(x, y, 0.0) for x, y in points])
    return np.stack([line[:-1], line[1:]], 1)


def test_the_same_line_is_not_off() -> None:
    error = line_error([STRAIGHT], segments((0, 0), (30, 0), (100, 0)))
    assert (error.mean, error.largest, error.hausdorff) == pytest.approx((0, 0, 0), abs=1e-12)
    assert error.planned == error.drawn == 100


def test_a_line_beside_the_plan() -> None:
    error = line_error([STRAIGHT], segments((0, 2), (100, 2)))
    assert (error.mean, error.largest, error.hausdorff) == pytest.approx((2, 2, 2))


def test_a_spike_is_the_largest_error_and_hardly_the_mean() -> None:
    error = line_error([STRAIGHT], segments((0, 0), (50, 0), (50, 3), (50, 0), (100, 0)))
    assert error.largest == error.hausdorff == pytest.approx(3)
    assert error.mean == pytest.approx(2 * 3 * 1.5 / 106, rel=0.1)


def test_what_is_missing_shows_in_the_hausdorff_distance_alone() -> None:
    error = line_error([STRAIGHT], segments((0, 0), (60, 0)))
    assert error.largest == pytest.approx(0) and error.hausdorff == pytest.approx(40)


def test_strokes_are_compared_each_with_the_nearest() -> None:
    other = STRAIGHT + np.array([0, 50, 0])
    drawn = np.concatenate([segments((100, 50.5), (0, 50.5)), segments((0, 0), (100, 0))])
    error = line_error([STRAIGHT, other], drawn)
    assert error.largest == pytest.approx(0.5) and error.mean == pytest.approx(0.25)


def test_a_point_is_a_line_too() -> None:
    assert line_error([STRAIGHT], segments((0, 1), (0, 1))).hausdorff == pytest.approx(math.hypot(100, 1))


def test_the_plan_leads_to_the_lesion_and_around_it() -> None:
    plan = strokes()
    approach, margin = plan["approach"], plan["margin"]
    for line in (approach, margin):
        assert (line[:, 2] == HEIGHT_MM).all()
        assert np.linalg.norm(np.diff(line, axis=0), axis=1).max() < 2.5
    assert approach[-1] == pytest.approx(margin[0], abs=0.02), "it ends where the margin begins"
    assert margin[0] == pytest.approx(margin[-1], abs=0.02), "the margin is closed"
    from_lesion = np.linalg.norm(margin - LESION, axis=1)
    assert from_lesion.min() > 14 and from_lesion.max() < 23
    assert np.linalg.norm(approach[0] - LESION) > 30


def test_checks_are_within_the_landmarks_and_none_of_them() -> None:
    crosses = on_sheet(LANDMARKS | CHECKS)
    assert len(crosses) == 9 == len({tuple(cross) for cross in crosses.tolist()})
    assert np.ptp(on_sheet(CHECKS), axis=0)[:2].max() < np.ptp(on_sheet(LANDMARKS), axis=0)[:2].min()
