"""The pictures of the phantom show what is in it."""

from __future__ import annotations

import zlib

import numpy as np
import pytest

from igtl_gateway_lab.simulate.ultrasound_phantom import (
    FORK_MM,
    GREYS,
    HEIGHT,
    PIXEL_MM,
    WIDTH,
    Grey,
    Phantom,
    bone_depth,
    vessels,
)

LEFT_MM = -20.0


@pytest.fixture(scope="module")
def phantom() -> Phantom:
    return Phantom()


def across(phantom: Phantom, v: float, turn: float = 0.0) -> Grey:
    """The arm cut across at ``v``, turned a little about the beam."""
    row = PIXEL_MM * np.array([1.0, turn, 0.0]) / np.sqrt(1 + turn * turn)
    return phantom.image(np.array([LEFT_MM, v, 0.0]), row, np.array([0.0, 0.0, PIXEL_MM]))


def around(picture: Grey, u: float, w: float, half_mm: float = 0.6) -> float:
    """Mean grey around a place of the cut."""
    column, row, half = (round(mm / PIXEL_MM) for mm in (u - LEFT_MM, w, half_mm))
    return float(picture[row - half : row + half + 1, column - half : column + half + 1].mean())


def test_a_picture_has_its_size_and_its_greys(phantom: Phantom) -> None:
    picture = across(phantom, 20.0)
    assert picture.shape == (HEIGHT, WIDTH) and picture.dtype == np.uint8
    assert 20 < len(np.unique(picture)) <= GREYS


def test_pictures_are_the_same_bytes_on_every_machine(phantom: Phantom) -> None:
    assert zlib.crc32(across(phantom, 20.0, 0.05).tobytes()) == 0x968693CA


@pytest.mark.parametrize("v", [3.0, 20.0, 33.0])
def test_the_vessel_is_dark_where_it_is_and_bright_around(phantom: Phantom, v: float) -> None:
    picture = across(phantom, v)
    u, w, radius = (float(value) for value in vessels(np.array(v))[0])
    assert around(picture, u, w) < 25
    assert around(picture, u - radius - 1.5, w) > 40 and around(picture, u + radius + 1.5, w) > 40


def test_the_vessel_forks(phantom: Phantom) -> None:
    def lumens(v: float) -> int:
        _, w, _ = vessels(np.array(v))[0]
        dark = across(phantom, v)[round(float(w) / PIXEL_MM) - 8] < 20
        runs = np.diff(np.flatnonzero(np.diff(dark.astype(int), prepend=0, append=0)))[::2]
        return int((runs > 10).sum())

    assert lumens(FORK_MM - 5) == 1
    assert lumens(FORK_MM + 20) == 2


@pytest.mark.parametrize("v", [5.0, 44.0])
def test_the_bone_is_bright_and_casts_a_shadow(phantom: Phantom, v: float) -> None:
    picture = across(phantom, v)
    surface = float(bone_depth(np.array(4.0), np.array(v)))
    assert around(picture, 4.0, surface, 0.15) > 200
    assert around(picture, 4.0, surface + 3.0) < 30
    assert around(picture, -18.0, surface + 3.0) > 50, "beside the bone there is none"


def test_speckle_stays_where_it_is(phantom: Phantom) -> None:
    """Two cuts at the same place show the same dots, two a few millimetres apart do not."""
    picture = across(phantom, 20.0)[110:140, :60].astype(float)
    moved = phantom.image(
        np.array([LEFT_MM + 8 * PIXEL_MM, 20.0, 0.0]), np.array([PIXEL_MM, 0, 0]), np.array([0, 0, PIXEL_MM])
    )[110:140, :60].astype(float)
    far = across(phantom, 24.0)[110:140, :60].astype(float)
    assert np.corrcoef(picture[:, 12:].reshape(-1), moved[:, 4:-8].reshape(-1))[0, 1] > 0.95
    assert abs(np.corrcoef(picture.reshape(-1), far.reshape(-1))[0, 1]) < 0.6
