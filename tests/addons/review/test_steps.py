"""Steps of quantised depth: their detection, and their effect on errors."""

from __future__ import annotations

import numpy as np
import pytest

from igtl_gateway.addons.review import noise, steps
from tests.addons.review.sensors import Camera, disparity, quantised, shots, surface, white
from tests.tables import table

_RANDOM = np.random.default_rng(3)


@table("kind", ["flat", "tilted", "curved"])
@table("distance", [0.06, 0.25, 1.0])
def test_integer_millimetres_are_detected(kind: str, distance: float) -> None:
    camera = Camera()
    points = shots(camera, surface(kind, distance).depth(camera.rays()), quantised, 2, _RANDOM)
    assert steps.steps_of(points[..., 2]).at(np.array(distance)) == pytest.approx(0.001, rel=1e-3)


@pytest.mark.parametrize("distance", [0.06, 0.25, 1.0])
def test_steps_of_disparity_grow_with_the_square_of_the_distance(distance: float) -> None:
    camera = Camera()
    points = shots(camera, surface("tilted", distance).depth(camera.rays()), disparity, 2, _RANDOM)
    found = steps.steps_of(points[..., 2])
    assert found.at(np.array(distance)) == pytest.approx(distance**2 / 16 / (0.045 * 600), rel=0.02)
    assert found.grow == pytest.approx(2.0, abs=0.2)


def test_continuous_depth_has_no_steps() -> None:
    camera = Camera()
    points = shots(camera, surface("tilted", 0.25).depth(camera.rays()), white, 4, _RANDOM)
    found = steps.steps_of(points[..., 2])
    assert (found.at(points[0, ..., 2]) == 0).all()
    assert found.grow == 0.0
    assert (steps.steps_of(np.full((3, 3), np.nan)).at(np.array([0.2, np.nan])) == 0).all()


def test_a_single_value_is_assumed_to_have_steps_of_a_millimetre() -> None:
    """A flat surface perpendicular to a sensor without noise: the file does not determine the step."""
    assert steps.steps_of(np.full((20, 20), np.float32(0.25))).at(np.array(0.25)) == pytest.approx(0.001)


@pytest.mark.parametrize("sigma", [0.05, 0.14, 0.25, 0.4, 0.8])
def test_noise_before_rounding_follows_from_the_observed_noise(sigma: float) -> None:
    """In steps, over all positions between two steps."""
    place = np.linspace(0, 10, 4001)
    readings = np.round(place + sigma * _RANDOM.standard_normal((40, 4001)))
    seen = np.diff(readings, axis=0).astype(float) ** 2 / 2
    found = steps.before_rounding(np.array(seen.mean()), np.array(1.0))
    assert np.sqrt(found) == pytest.approx(sigma, abs=0.02)
    true = np.sqrt(np.mean((readings - place) ** 2))
    assert noise.total_noise(np.sqrt(np.array(seen.mean())), np.array(1.0)) == pytest.approx(true, rel=0.03)
    assert steps.share_before_rounding(seen.mean(axis=0), readings.mean(axis=0)) == pytest.approx(sigma, abs=0.03)


def test_ambiguous_noise_before_rounding_is_the_smallest_possible() -> None:
    """Readings that alternate between two values fit any small noise; the smallest is the worst case."""
    flips = np.where(_RANDOM.random((40, 500)) < 0.2, 1.0, 0.0)
    assert steps.share_before_rounding(flips.var(axis=0, ddof=1), flips.mean(axis=0)) == 0.0
    readings = np.round(0.4 * _RANDOM.standard_normal((40, 4000)))
    assert steps.share_before_rounding(readings.var(axis=0), readings.mean(axis=0)) == pytest.approx(0.4, abs=0.04)


@table("sigma", [0.0, 0.1, 0.3])
@table("slope", [0.0, 0.02, 0.2])
def test_the_bias_is_that_of_the_mean_of_many_readings(sigma: float, slope: float) -> None:
    """Without noise it is a sawtooth, approximated by six harmonics."""
    place = slope * np.arange(30.0)
    turn = np.array([0.0, 0.2, 0.4])
    weights = np.full(30, 1 / 30)
    found = steps.bias(np.ones(30), np.full(30, sigma), place, weights, turn)
    for shift, bias in zip(turn, found, strict=True):
        readings = np.round(place + shift + sigma * _RANDOM.standard_normal((4000, 30)))
        assert bias == pytest.approx(
            np.mean(readings - place - shift), abs=0.1 if sigma == 0 else 0.01
        )  # a sawtooth of six harmonics
