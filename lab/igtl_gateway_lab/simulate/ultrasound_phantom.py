"""A phantom of a forearm: layers of tissue, a vessel that forks, and a bone, as an ultrasound scanner sees them.

Everything is a function of the place (millimetres in the phantom's own frame: ``u`` across, ``v`` along the arm,
``w`` into the depth), speckle included, so that every slice cuts the same things, and slices beside each other
stack up to them.  What depends on the beam is worked out along it: nothing comes back from behind the bone, more
from behind the vessel.

Only +, −, ×, ÷ and √ of float32 and float64: the same bytes on every machine.
"""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from igtl_gateway_lab.simulate.star_numbers import Array, Noise

Grey = NDArray[np.uint8]
Single = NDArray[np.float32]
Real = NDArray[Any]  #: float32 in pictures, float64 elsewhere

WIDTH, HEIGHT = 320, 240  #: pixels
PIXEL_MM = 0.125  #: so 40 mm wide and 30 mm deep
LENGTH_MM = 60.0  #: of the arm, along v
FORK_MM = 36.0  #: v where the vessel gets its branch
GREYS = 32  #: that differ: enough for the eye, and half the bytes of a recording

_SEED = (2017, 41)
#: Patterns that repeat: their cells (powers of two), and the size of a cell.
_SCATTERERS = (256, 32, 256)
_SCATTERER_MM = (0.25, 0.6, 0.14)
_FIBRES = (32, 32, 128)
_FIBRE_MM = (2.2, 4.0, 0.45)
_RUN = 8  # pixels to either side over which fibres run together
_LOUD = 0.1  # brings the mean of the speckle to 1
_FAR_MM = 200.0  # added to every place, so that none is negative


def bone_depth(u: Real, v: Real) -> Real:
    """w of the bone's surface."""
    off = u - (4.0 - 0.06 * (v - 30.0))
    square, along = off * off, (v - 44.0) / 3.5
    ridge = 1.8 / (1 + along * along + square * square / 625.0)
    return np.asarray(20.5 + 0.022 * square + 0.0007 * square * square - ridge)


def vessels(v: Real) -> tuple[tuple[Real, Real, Real], tuple[Real, Real, Real]]:
    """Trunk and branch, each as (u, w, radius) of its middle line at ``v``.

    The branch leaves the trunk at FORK_MM, and before it has no width.
    """
    t = v - 30.0
    u, w = -6.0 + 0.05 * t + 0.004 * t * t, 11.5 + 0.03 * t
    past = np.clip(v - FORK_MM, 0, None)
    return (u, w, 2.7 - 0.035 * past), (u + 0.36 * past, w - 0.12 * past, np.clip(past, 0, 1.7))


@cache
def phantom() -> Phantom:
    """The one that there is: its patterns take a moment to make."""
    return Phantom()


class Phantom:
    """What the scanner looks at, seen from anywhere."""

    def __init__(self) -> None:
        noise = Noise(*_SEED)
        echoes = (noise.uniform(*_SCATTERERS, 2) - 0.5).astype(np.float32)
        self._echoes = (echoes[..., 0] + np.complex64(1j) * echoes[..., 1]).reshape(-1)
        self._fibres = noise.uniform(*_FIBRES).astype(np.float32).reshape(-1)

    def image(self, corner: Array, along_row: Array, along_column: Array) -> Grey:
        """The B-mode picture (HEIGHT, WIDTH): beams go down its columns.

        Args:
            corner: place of the first pixel's centre, mm.
            along_row: from a pixel to the next of its row, mm.
            along_column: to the next of its column.
        """
        i, j = np.arange(WIDTH), np.arange(HEIGHT)[:, None]
        u, v, w = ((corner[n] + i * along_row[n] + j * along_column[n]).astype(np.float32) for n in range(3))
        speckle = self._speckle(u, v, w)
        tissue, mirrors = self._tissue(u, v, w)
        tissue, mirrors = _vessels(u, v, w, tissue, mirrors)
        tissue, mirrors = _bone(u, v, w, tissue, mirrors)
        echo = speckle * tissue + mirrors * (np.float32(0.55) + np.float32(0.45) * speckle)
        # loudness to grey: a root does what the logarithm of a real scanner does
        shade = np.sqrt(echo) * np.float32(255 * 0.95)
        step = 256 // GREYS
        return np.asarray(np.minimum(shade, 255), np.uint8) // step * step

    def _speckle(self, u: Single, v: Single, w: Single) -> Single:
        """How loud scatterers are together, 1 on average: their waves add, blurred by pulse and beam."""
        waves = self._echoes[_cells(_SCATTERERS, _SCATTERER_MM, u, v, w)]
        waves = np.pad(waves, ((2, 2), (3, 3)), mode="edge")
        waves = waves[1:] + waves[:-1]
        waves = waves[1:] + waves[:-1]
        waves = waves[1:-1] + waves[2:] + waves[:-2]
        for step in (1, 2, 3):
            waves = waves[:, step:] + waves[:, :-step]
        return np.asarray(np.sqrt(waves.real * waves.real + waves.imag * waves.imag) * np.float32(_LOUD))

    def _tissue(self, u: Single, v: Single, w: Single) -> tuple[Single, Single]:
        """(scatter, mirrors): skin, fat and two muscles, with fasciae between them."""
        fibres = self._fibres[_cells(_FIBRES, _FIBRE_MM, u, v, w + np.float32(0.08) * u)]
        run = np.cumsum(np.pad(fibres, ((0, 0), (_RUN, _RUN)), mode="edge"), axis=1)
        fibres = (run[:, 2 * _RUN :] - run[:, : -2 * _RUN]) * np.float32(0.5 / _RUN)
        first = np.float32(4.6) + np.float32(0.0022) * u * u + np.float32(0.012) * (v - 25)
        second = np.float32(15.6) - np.float32(0.05) * u + np.float32(0.02) * (v - 30)
        muscle = np.float32(0.05) + np.float32(0.16) * fibres * fibres * fibres
        scatter = np.where(w < first, np.float32(0.11) + np.float32(0.05) * fibres, muscle)
        scatter = np.where(w < 1.3, np.float32(0.5), scatter)
        mirrors = np.float32(0.5) * _sheet(w - first, 0.16) + np.float32(0.3) * _sheet(w - second, 0.18)
        mirrors += np.float32(0.8) * _sheet(w - np.float32(0.35), 0.2)
        return scatter, mirrors.astype(np.float32)


def _cells(shape: tuple[int, int, int], size: tuple[float, float, float], *place: Single) -> NDArray[np.int32]:
    """Number of the cell that each place lies in; the pattern repeats."""
    index = np.zeros(place[0].shape, np.int32)
    for count, step, at in zip(shape, size, place, strict=True):
        index *= count
        index += ((at + np.float32(_FAR_MM)) * np.float32(1 / step)).astype(np.int32) & (count - 1)
    return index


def _sheet(off: Real, thickness: float) -> Real:
    """A mirroring surface, ``off`` millimetres away."""
    far = off * np.float32(1 / thickness)
    far *= far
    far *= far
    far += 1
    return np.asarray(1 / far)


def _vessels(u: Single, v: Single, w: Single, tissue: Single, mirrors: Single) -> tuple[Single, Single]:
    """Blood scatters next to nothing, the wall mirrors where the beam meets it squarely; behind it is louder."""
    inside = np.zeros(u.shape, bool)
    wall = np.zeros_like(u)
    for middle_u, middle_w, radius in vessels(v):
        across, down = u - middle_u, w - middle_w
        reach = np.sqrt(across * across + down * down) + np.float32(1e-6)
        square = np.abs(down) / reach
        wall = np.maximum(wall, np.where(radius > 0.2, square * square * _sheet(reach - radius - 0.15, 0.22), 0))
        inside |= reach < radius
    passed = np.cumsum(inside, axis=0, dtype=np.float32) * np.float32(0.02)
    tissue = np.where(inside, np.float32(0.002), tissue * (1 + passed))
    mirrors = np.where(inside, 0, mirrors)
    return tissue.astype(np.float32), (mirrors + np.float32(0.45) * wall * ~inside).astype(np.float32)


def _bone(u: Single, v: Single, w: Single, tissue: Single, mirrors: Single) -> tuple[Single, Single]:
    """A bright surface, brightest where it lies across the beam, and its shadow."""
    behind = w - bone_depth(u, v)
    slope = np.pad(np.diff(behind, axis=1), ((0, 0), (0, 1)), mode="edge") / np.float32(PIXEL_MM)
    surface = np.float32(1.15) * _sheet(behind, 0.26) / (1 + slope * slope)
    hidden = np.maximum.accumulate(behind > np.float32(0.3), axis=0)
    shadow = np.where(hidden, np.float32(0.03) / (1 + np.clip(behind, 0, None)), np.float32(1))
    return (tissue * shadow).astype(np.float32), (mirrors * shadow + surface).astype(np.float32)
