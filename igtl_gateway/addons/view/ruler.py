"""Rulers in millimetres: a bar of a round length at the bottom of each 3-D view.

The lengths of ROS are metres, and those of image-guided therapy are millimetres.  A ruler shows the size of what is in
the view without a change of its unit.  It is at the distance of the point that the eye looks at.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import rerun as rr

from igtl_gateway.addons.view.contents import RULERS
from igtl_gateway.addons.view.eye import HALF_HEIGHT, HALF_WIDTH, Eye, Xyz
from igtl_gateway.addons.view.pen import Pen

#: Fractions of half of the view: from the middle to the ruler, and longest ruler.
_LEFT, _DOWN, _SHARE = 0.9, 0.88, 0.6
_ROUND = (1.0, 2.0, 5.0)
_COLOUR = 0xCFD8DCFF
#: Smallest and largest half of a view that has a ruler, mm.
_LEAST_MM, _MOST_MM = 0.001, 1e9


@dataclass(frozen=True, slots=True)
class Ruler:
    """A ruler of a view.

    Attributes:
        path: its entity.
        length_mm: its length.
        begin, end: its ends, metres in the frame of the view.
    """

    path: str
    length_mm: float
    begin: Xyz
    end: Xyz


def ruler_of(eye: Eye, number: int) -> Ruler | None:
    """Return the ruler of a view, horizontal, at the lower left; None for a view without a plausible size.

    Args:
        eye: of the view.
        number: of the view.
    """
    place, target = np.array(eye.place), np.array(eye.target)
    distance = math.dist(eye.place, eye.target)
    half_mm = 1000.0 * distance * math.tan(HALF_WIDTH)
    if not _LEAST_MM < half_mm < _MOST_MM:
        return None
    way = (place - target) / distance
    right = np.cross(np.array(eye.up), way)
    right /= np.linalg.norm(right)
    length_mm = round_length(_SHARE * half_mm)
    down = distance * math.tan(HALF_HEIGHT) * _DOWN * np.cross(way, right)
    begin = target - _LEFT * half_mm / 1000.0 * right - down
    ends = (begin, begin + length_mm / 1000.0 * right)
    return Ruler(f"{RULERS}/{number}", length_mm, *((float(x), float(y), float(z)) for x, y, z in ends))


def round_length(most: float) -> float:
    """Return the largest 1, 2 or 5 times a power of ten that is not above ``most``."""
    power = 10.0 ** math.floor(math.log10(most))
    return max((step * power for step in _ROUND if step * power <= most * (1 + 1e-9)), default=power)


def draw_ruler(ruler: Ruler, frame: str, pen: Pen) -> None:
    """Draw a ruler at all times, with its length as the label."""
    bar = rr.LineStrips3D(
        np.array([[ruler.begin, ruler.end]], np.float32),
        colors=[_COLOUR],
        radii=[rr.Radius.ui_points(2.0)],
        labels=[f"{ruler.length_mm:g} mm"],
        show_labels=True,
    )
    pen.static(ruler.path, rr.CoordinateFrame(frame), bar)
