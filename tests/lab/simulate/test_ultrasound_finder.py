"""What is found in pictures whose truth is known."""

from __future__ import annotations

import numpy as np
import pytest

from igtl_gateway_lab.simulate.ultrasound_finder import bone, dark, middle, walls
from igtl_gateway_lab.simulate.ultrasound_phantom import (
    HEIGHT,
    PIXEL_MM,
    WIDTH,
    Grey,
    bone_depth,
    phantom,
    vessels,
)

V = 20.0


@pytest.fixture(scope="module")
def picture() -> Grey:
    return phantom().image(np.array([-20.0, V, 0.0]), np.array([PIXEL_MM, 0, 0]), np.array([0, 0, PIXEL_MM]))


def test_the_vessel_is_found(picture: Grey) -> None:
    found = middle(dark(picture))
    assert found is not None
    u, w, _ = vessels(np.array(V))[0]
    assert found[0] * PIXEL_MM == pytest.approx(float(w), abs=0.15)
    assert found[1] * PIXEL_MM - 20 == pytest.approx(float(u), abs=0.15)


def test_its_wall_is_found_all_around(picture: Grey) -> None:
    row, column = (walls(dark(picture)) * PIXEL_MM).T
    u, w, radius = (float(value) for value in vessels(np.array(V))[0])
    across, down = column - 20 - u, row - w
    assert len(row) > 20
    assert np.abs(np.sqrt(across**2 + down**2) - radius).max() < 0.5
    assert np.abs(np.sqrt(across**2 + down**2) - radius).mean() < 0.15
    assert across.min() < -0.9 * radius and across.max() > 0.9 * radius


def test_the_surface_of_the_bone_is_found_where_the_beam_meets_it_squarely(picture: Grey) -> None:
    found = bone(picture) * PIXEL_MM
    assert len(found) > 10
    truth = bone_depth(found[:, 1] - 20, np.array(V))
    assert np.abs(found[:, 0] - truth).max() < 0.4
    assert np.ptp(found[:, 1]) > 8


@pytest.mark.parametrize("grey", [0, 90, 255])
def test_nothing_is_found_in_nothing(grey: int) -> None:
    blank = np.full((HEIGHT, WIDTH), grey, np.uint8)
    assert len(bone(blank)) == 0
    if grey:
        assert middle(dark(blank)) is None and len(walls(dark(blank))) == 0


def test_a_bright_line_without_a_shadow_is_no_bone() -> None:
    fascia = np.full((HEIGHT, WIDTH), 80, np.uint8)
    fascia[150:153] = 255
    assert len(bone(fascia)) == 0
    fascia[153:] = 0
    assert len(bone(fascia)) == WIDTH // 5
