"""What a navigation program finds in a B-mode picture: the vessel's lumen and the surface of the bone.

Simple on purpose, and on whole numbers as far as it goes: the lumen is what is dark between the skin and the depth
where bone may begin, the bone is the brightest spot of a column with a shadow behind it.  Pixels are (row, column).
"""

from __future__ import annotations

import numpy as np

from igtl_gateway.simulate.star_numbers import Array
from igtl_gateway.simulate.ultrasound_phantom import PIXEL_MM, Grey

_LUMEN_ROWS = slice(round(5.0 / PIXEL_MM), round(16.0 / PIXEL_MM))
_BOX = 9  # pixels: a dot of speckle is smaller, a vessel is not
_DARK = 30
_LEAST_PIXELS = 150

_BONE_FROM = round(13.0 / PIXEL_MM)
_COLUMNS = 5  # that are taken together
_BRIGHT, _SHADOW = 165, 45
_AROUND = 6  # rows around the brightest one
_SHADOW_FROM, _SHADOW_ROWS = 8, 16
_STEP_ROWS = 10  # between neighbours on one surface


def lumen(picture: Grey) -> tuple[float, float] | None:
    """Middle of the dark (row, column); None where there is none of a vessel's size."""
    part = picture[_LUMEN_ROWS].astype(np.int64)
    sums = np.pad(part, ((1, 0), (1, 0))).cumsum(axis=0).cumsum(axis=1)
    boxes = sums[_BOX:, _BOX:] - sums[:-_BOX, _BOX:] - sums[_BOX:, :-_BOX] + sums[:-_BOX, :-_BOX]
    rows, columns = np.nonzero(boxes < _DARK * _BOX * _BOX)
    if len(rows) < _LEAST_PIXELS:
        return None
    middle = _BOX // 2
    return int(rows.sum()) / len(rows) + middle + _LUMEN_ROWS.start, int(columns.sum()) / len(columns) + middle


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
