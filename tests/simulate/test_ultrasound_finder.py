"""What is found in pictures whose truth is known."""

from __future__ import annotations

import numpy as np
import pytest

from igtl_gateway.simulate.ultrasound_finder import bone, lumen
from igtl_gateway.simulate.ultrasound_phantom import (
    HEIGHT,
    PIXEL_MM,
    WIDTH,
    Grey,
    bone_depth,
    phantom,
    vessel,
)

V = 20.0


@pytest.fixture(scope="module")
def picture() -> Grey:
    return phantom().image(np.array([-20.0, V, 0.0]), np.array([PIXEL_MM, 0, 0]), np.array([0, 0, PIXEL_MM]))


def test_the_vessel_is_found(picture: Grey) -> None:
    found = lumen(picture)
    assert found is not None
    u, w, _ = vessel(np.array(V))
    assert found[0] * PIXEL_MM == pytest.approx(float(w), abs=0.15)
    assert found[1] * PIXEL_MM - 20 == pytest.approx(float(u), abs=0.15)


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
        assert lumen(blank) is None


def test_a_bright_line_without_a_shadow_is_no_bone() -> None:
    fascia = np.full((HEIGHT, WIDTH), 80, np.uint8)
    fascia[150:153] = 255
    assert len(bone(fascia)) == 0
    fascia[153:] = 0
    assert len(bone(fascia)) == WIDTH // 5
