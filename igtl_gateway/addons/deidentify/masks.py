"""Masks of pictures: which pixels are hidden."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
import numpy.typing as npt


@dataclass(frozen=True, slots=True)
class Rectangle:
    """A hidden rectangle, pixels: left column, upper row, columns, rows."""

    x: int
    y: int
    width: int
    height: int


@dataclass(frozen=True, slots=True)
class Fan:
    """The visible fan of a sector probe; all outside of it is hidden.

    Attributes:
        x, y: apex, pixels.
        near, far: distances from the apex, pixels.
        from_deg, to_deg: angles; 0 is to the right, 90 is down.
    """

    x: float
    y: float
    near: float
    far: float
    from_deg: float
    to_deg: float


@dataclass(frozen=True, slots=True)
class Mask:
    """The hidden pixels of the pictures of a stream.

    Attributes:
        stream: glob of the stream: topic or TYPE/device.
        rectangles: hidden rectangles.
        fan: if given, all outside of it is hidden, too.
        value: of the hidden pixels, in all components.
    """

    stream: str
    rectangles: tuple[Rectangle, ...] = ()
    fan: Fan | None = None
    value: int = 0


@lru_cache(maxsize=32)
def hidden(mask: Mask, rows: int, columns: int) -> npt.NDArray[np.bool_]:
    """Return which pixels are hidden: (rows, columns) bool; not to be changed, because it is cached."""
    found = np.zeros((rows, columns), np.bool_)
    if fan := mask.fan:
        y, x = np.mgrid[0:rows, 0:columns] - np.array([fan.y, fan.x])[:, None, None]
        distance = np.hypot(x, y)
        angle = (np.degrees(np.arctan2(y, x)) - fan.from_deg) % 360
        found |= (distance < fan.near) | (distance > fan.far) | (angle > fan.to_deg - fan.from_deg)
    for each in mask.rectangles:
        found[each.y : each.y + each.height, each.x : each.x + each.width] = True
    return found


def masked(mask: Mask, pixels: npt.NDArray[Any], size: tuple[int, int], at: tuple[int, int] = (0, 0)) -> Any:
    """Return a copy of pixels (…, rows, columns, components) with hidden values.

    Args:
        mask: the mask, on the complete picture.
        pixels: a part of it.
        size: rows and columns of the complete picture.
        at: first row and column of the part.
    """
    rows, columns = pixels.shape[-3:-1]
    part = hidden(mask, *size)[at[0] : at[0] + rows, at[1] : at[1] + columns]
    new = pixels.copy()
    most = np.iinfo(new.dtype).max if new.dtype.kind in "iu" else mask.value
    new[..., part, :] = min(mask.value, int(most))
    return new
