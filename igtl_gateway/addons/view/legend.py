"""Legends in a 3-D view: colour scales with numbers and units, and the sides of the patient."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
import rerun as rr

from igtl_gateway.addons.view import colours
from igtl_gateway.addons.view.pen import Xyz

Array = npt.NDArray[Any]

_STEPS = 32
_TICKS = 3
_GAP, _THICK = 0.13, 0.012  #: fractions of the box diagonal: gap between box and bar, half the bar thickness
_LETTER = 0xFFFFFFFF
_DOT_M = 0.0005
#: Letters of the positive and negative side of each axis: right, anterior, superior.
_SIDES = ("RL", "AP", "SI")


def scale_text(name: str, low: float, high: float, unit: str) -> str:
    """``depth noise: blue 0 … red 0.8 mm``"""
    return f"{name}: blue {low:.4g} … red {high:.4g}{f' {unit}' if unit else ''}"


def scale_bar(name: str, low: float, high: float, unit: str, box: tuple[Xyz, Xyz]) -> tuple[rr.LineStrips3D, ...]:
    """Return a bar along x with the colours from ``low`` to ``high``, beside the coloured ``box``.

    The bar is at the largest y and the smallest z: in an optical camera frame that is below and in front.

    Returns the bar and its labels for two entities, because rerun puts labels into the middle of a bar.
    """
    near, far = np.asarray(box[0], np.float64), np.asarray(box[1], np.float64)
    size = float(np.linalg.norm(far - near)) or 0.01
    left = np.array([near[0], far[1] + _GAP * size, near[2] - _GAP * size])
    along = np.array([max(far[0] - near[0], 0.3 * size), 0.0, 0.0])
    ends = left + np.linspace(0.0, 1.0, _STEPS + 1)[:, None] * along
    middles = (np.arange(_STEPS) + 0.5) / _STEPS
    bar = rr.LineStrips3D(
        np.stack([ends[:-1], ends[1:]], axis=1).astype(np.float32),
        colors=colours.scale_colours(low + middles * (high - low), low, high),
        radii=[_THICK * size],
    )
    at = np.linspace(0.0, 1.0, _TICKS)
    values = [f"{low + share * (high - low):.4g}{f' {unit}' if unit else ''}" for share in at.tolist()]
    values[0] = f"{name} {values[0]}"
    down = np.array([0.0, 2 * _THICK * size, 0.0])
    ticks = rr.LineStrips3D(
        np.array([[left + share * along, left + share * along + down] for share in at], np.float32),
        colors=[_LETTER],
        radii=[rr.Radius.ui_points(1.0)],
        labels=values,
        show_labels=True,
    )
    return bar, ticks


def side(direction: Array) -> str:
    """Return the side of the patient that a direction (right, anterior, superior) points to: R, L, A, P, S or I."""
    axis = int(np.argmax(np.abs(direction)))
    return _SIDES[axis][0 if direction[axis] > 0 else 1]


def picture_sides(width: int, height: int, right: Array, down: Array) -> rr.Points2D:
    """Return letters at the four sides of an image whose axes have these directions in the patient frame."""
    margin = 0.03 * min(width, height)
    places = (
        ((width - margin, height / 2), side(right)),
        ((margin, height / 2), side(-right)),
        ((width / 2, height - 3 * margin), side(down)),
        ((width / 2, margin), side(-down)),
    )
    return rr.Points2D(
        [place for place, _ in places],
        labels=[letter for _, letter in places],
        colors=[_LETTER],
        radii=[rr.Radius.ui_points(0.5)],
        show_labels=True,
    )


def box_sides(corners: Array, directions: Array) -> rr.Points3D:
    """Return letters at the centres of the six faces of a volume.

    Args:
        corners: (8, 3) corners, metres.
        directions: (3, 3), one row for the direction of each of i, j, k.
    """
    middle = corners.mean(axis=0)
    places, letters = [], []
    lengths = np.linalg.norm(directions, axis=1, keepdims=True)
    for axis in directions / np.where(lengths > 0, lengths, 1.0):
        reach = float(np.abs((corners - middle) @ axis).max())
        for sign in (1.0, -1.0):
            places.append(middle + sign * 1.05 * reach * axis)
            letters.append(side(sign * axis))
    return rr.Points3D(np.array(places, np.float32), labels=letters, colors=[_LETTER], radii=[_DOT_M], show_labels=True)
