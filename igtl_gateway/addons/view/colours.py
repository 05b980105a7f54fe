"""Colours of numbers, of packed ROS words and of markers, all as 0xRRGGBBAA words for rerun."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[Any]

#: Colours for devices without a colour, in turn: distinct, and unlike tissue.
SERIES = (0x4FC3F7FF, 0xFFB74DFF, 0x81C784FF, 0xE57373FF, 0xBA68C8FF, 0xFFF176FF, 0x4DD0E1FF, 0xA1887FFF)
#: Colours of lines in a plot, in turn: each two differ for the eye.
_LINES = (
    0x4FC3F7FF, 0xFFB74DFF, 0x66BB6AFF, 0xE57373FF, 0xBA68C8FF, 0xFFF176FF, 0x3F6CFFFF, 0xA1887FFF,
    0xF8BBD0FF, 0x00897BFF, 0xC6FF00FF, 0xFF4081FF, 0x8D6E00FF, 0xFFFFFFFF, 0x78909CFF, 0xB388FFFF,
)  # fmt: skip
GREY, BONE = 0xC8C8C8FF, 0xDDD0C0FF  # points and surfaces without a colour
INFO, WARN, ERROR = 0xB0BEC5FF, 0xFFB300FF, 0xFF5252FF

#: Turbo (A. Mikhailov, Google, 2019) as polynomials of degree 5 in 0 … 1, red, green, blue.
_TURBO = (
    (0.13572138, 4.61539260, -42.66032258, 132.13108234, -152.94239396, 59.28637943),
    (0.09140261, 2.19418839, 4.84296658, -14.18503333, 4.27729857, 2.82956604),
    (0.10667330, 12.64194608, -60.58204836, 110.36276771, -89.90310912, 27.34824973),
)


def scale_colours(values: Array, low: float, high: float) -> Array:
    """Return numbers as colours: blue = ``low`` … red = ``high``; grey for NaN."""
    spread = high - low
    unit = (values.astype(np.float64) - low) / spread if spread > 0 else np.full(len(values), 0.5)
    known = np.isfinite(unit)
    unit = np.clip(np.where(known, unit, 0.0), 0.0, 1.0)
    index = (unit * (len(_TABLE) - 1)).astype(np.intp)
    return np.where(known, _TABLE[index], np.uint32(GREY)).astype(np.uint32)


def span(values: Array) -> tuple[float, float]:
    """Return the 1st and 99th percentile of the finite numbers: the range of a colour scale."""
    finite = values[np.isfinite(values)]
    if not len(finite):
        return 0.0, 1.0
    low, high = np.percentile(finite.astype(np.float64), (1, 99))
    return float(low), float(high)


def rgba(colours: Array) -> Array:
    """Pack (n, 3 or 4) numbers as words; the range is 0 … 1, or 0 … 255 if any number is above 1."""
    values = np.nan_to_num(np.asarray(colours, np.float64))
    if values.size and values.max() <= 1.0:
        values = values * 255.0
    out = np.full((len(values), 4), 255, np.uint32)
    out[:, : values.shape[1]] = np.clip(np.rint(values), 0, 255).astype(np.uint32)
    return colour_words(out)


def colour_words(octets: Array) -> Array:
    """Pack (n, 4) bytes red, green, blue, alpha as words."""
    wide = octets.astype(np.uint32)
    joined: Array = wide[:, 0] << 24 | wide[:, 1] << 16 | wide[:, 2] << 8 | wide[:, 3]
    return joined


def unpack_pcl_colours(words: Array, *, alpha: bool) -> Array:
    """Convert PCL's packed 0xAARRGGBB words to 0xRRGGBBAA; opaque if the words have no alpha."""
    turned: Array = (words << np.uint32(8)) | (words >> np.uint32(24) if alpha else np.uint32(255))
    return turned


def marker_colour(colour: tuple[float, ...]) -> int:
    """Convert the colour 0 … 1 of a marker; grey if it is unset (all zero, or transparent)."""
    red, green, blue, alpha = (round(min(max(part, 0.0), 1.0) * 255) for part in colour)
    return red << 24 | green << 16 | blue << 8 | alpha if alpha else GREY


def line_colour(number: int) -> int:
    """Return the colour of a line of a plot, from 0: those after the 16th are darker, then darker again."""
    word, turns = _LINES[number % len(_LINES)], number // len(_LINES) % 3
    red, green, blue = ((word >> shift & 0xFF) * (10 - 3 * turns) // 10 for shift in (24, 16, 8))
    return red << 24 | green << 16 | blue << 8 | 0xFF


def octet_colour(rgba: tuple[int, int, int, int], unset: int) -> int:
    """Convert four bytes of OpenIGTLink; all zero is unset, and alpha is never 0."""
    red, green, blue, alpha = rgba
    return red << 24 | green << 16 | blue << 8 | (alpha or 255) if any(rgba) else unset


def _table() -> Array:
    unit = np.linspace(0.0, 1.0, 256)
    columns = [sum(factor * unit**power for power, factor in enumerate(row)) for row in _TURBO]
    return rgba(np.clip(np.stack(columns, axis=1), 0.0, 1.0))


_TABLE = _table()
