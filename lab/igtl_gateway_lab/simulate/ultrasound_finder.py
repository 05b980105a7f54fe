"""What a navigation program finds in a B-mode picture: the vessel's lumen and the surface of the bone.

Deliberately simple, and with integers as far as possible: the lumen is what is dark between the skin and the depth
where bone may begin, the bone is the brightest spot of a column with a shadow behind it.  Pixels are (row, column).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from igtl_gateway_lab.simulate.star_numbers import Array
from igtl_gateway_lab.simulate.ultrasound_phantom import PIXEL_MM, Grey

_LUMEN_ROWS = slice(round(5.0 / PIXEL_MM), round(16.0 / PIXEL_MM))
_BOX = 9  # pixels: a dot of speckle is smaller, a vessel is not
_DARK = 30
_LIGHT = 1.5  # pixels of a box beyond the border, beside a dark one
_LEAST_PIXELS = 150

_BONE_FROM = round(13.0 / PIXEL_MM)
_COLUMNS = 5  # that are taken together
_BRIGHT, _SHADOW = 165, 45
_AROUND = 6  # rows around the brightest one
_SHADOW_FROM, _SHADOW_ROWS = 8, 16
_STEP_ROWS = 10  # between neighbours on one surface


def dark(picture: Grey) -> NDArray[np.bool_]:
    """Where a box of pixels, named by its first one, is dark; nowhere if that is less than a vessel."""
    part = picture[_LUMEN_ROWS].astype(np.int64)
    sums = np.pad(part, ((1, 0), (1, 0))).cumsum(axis=0).cumsum(axis=1)
    boxes = sums[_BOX:, _BOX:] - sums[:-_BOX, _BOX:] - sums[_BOX:, :-_BOX] + sums[:-_BOX, :-_BOX]
    found = boxes < _DARK * _BOX * _BOX
    return np.asarray(found if int(found.sum()) >= _LEAST_PIXELS else np.zeros_like(found))


def middle(found: NDArray[np.bool_]) -> tuple[float, float] | None:
    """Middle (row, column) of what is dark; None where nothing is."""
    rows, columns = np.nonzero(found)
    if not len(rows):
        return None
    half = (_BOX - 1) / 2
    return int(rows.sum()) / len(rows) + half + _LUMEN_ROWS.start, int(columns.sum()) / len(columns) + half


def walls(found: NDArray[np.bool_]) -> Array:
    """(n, 2) points around what is dark: where it begins and ends in every second row."""
    change = np.diff(np.pad(found[::2], ((0, 0), (1, 1))).astype(np.int8), axis=1)
    rows, columns = np.nonzero(change)
    # a box is dark where most of it is: the border is nearly half a box further out
    out = np.where(change[rows, columns] > 0, _LIGHT, _BOX - 1 - _LIGHT)
    half = (_BOX - 1) / 2
    return np.stack([2 * rows + half + _LUMEN_ROWS.start, columns + out - 0.5], axis=1).astype(float)


def bone(picture: Grey) -> Array:
    """(n, 2) points of the surface: row (between pixels) and column; none that stands alone."""
    height, width = picture.shape
    count = width // _COLUMNS
    columns = picture[:, : count * _COLUMNS].reshape(height, count, _COLUMNS).sum(axis=2, dtype=np.int64)
    found = []
    for number in range(count):
        profile = columns[:, number]
        top = _BONE_FROM + int(profile[_BONE_FROM:].argmax())
        behind = profile[top + _SHADOW_FROM : top + _SHADOW_FROM + _SHADOW_ROWS]
        if len(behind) < _SHADOW_ROWS or profile[top] < _BRIGHT * _COLUMNS:
            continue
        if int(behind.sum()) > _SHADOW * _COLUMNS * _SHADOW_ROWS:
            continue
        # of what is nearly as bright, the middle: the brightest pixels are all white
        near = np.arange(top - _AROUND, top + _AROUND + 1)
        bright = np.where(profile[near] * 10 >= profile[top] * 8, profile[near], 0)
        row = int((near * bright).sum()) / int(bright.sum())
        found.append((row, _COLUMNS * number + (_COLUMNS - 1) / 2))
    points = np.array(found, float).reshape(-1, 2)
    beside = np.abs(np.diff(points, axis=0)) <= (_STEP_ROWS, _COLUMNS)
    joined = np.pad(beside.all(axis=1), 1)
    return np.asarray(points[joined[1:] | joined[:-1]] if len(points) else points)
