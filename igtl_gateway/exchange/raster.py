"""What a header says of pixels, whichever format it is in: which axis is what, number type, packing, place.

Axes stand in the order of the file, fastest first.  Each is one of three: *space* (columns, rows, slices in this
order), *component* (values of one pixel) or *frame* (images over time).  ``docs/formats.md`` says how the formats tell.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from igtl_gateway.errors import DamagedRecording, UnsupportedRecording
from igtl_gateway.exchange.placement import ImagePlacement
from igtl_gateway.untrusted import limits

SPACE, COMPONENT, FRAME = "space", "component", "frame"
RAW, ZLIB, BZIP2 = "raw", "zlib", "bzip2"

#: Fields of IMAGE: sizes are u16, the number of components is u8.
_MAX_SIZE, _MAX_COMPONENTS = 65_535, 255
#: A distance in time that is a distance in time.
MAX_STEP_S = 1e6
#: Types that IMAGE does not have → what holds their values; a value that does not fit is an error.
WIDER = {"i8": "f8", "u8": "f8"}


@dataclass(frozen=True, slots=True)
class Axis:
    """One axis: SPACE, COMPONENT or FRAME, and its number of samples."""

    role: str
    size: int


@dataclass(frozen=True, slots=True)
class Raster:
    """The pixels of a file.

    Attributes:
        where: the file with the header, for errors.
        axes: in the order of the file, fastest first; checked.
        dtype: numpy's name without byte order; ``""`` where the file has no pixels.
        big_endian: of the pixels.
        packing: RAW, ZLIB (gzip, too) or BZIP2.
        data: the file with the pixels.
        offset: of the first byte there; -1: the pixels are the end of the file.
        place: of the first frame, and so of all; None where the header says nothing.
        skip: unpacked bytes before the first pixel, where the pixels are packed.
        times_s: when each frame was taken, as far as the header (not the fields of frames) says; seconds.
    """

    where: str
    axes: tuple[Axis, ...]
    dtype: str
    big_endian: bool
    packing: str
    data: Path
    offset: int
    place: ImagePlacement | None
    skip: int = 0
    times_s: tuple[float, ...] = ()

    @property
    def size(self) -> tuple[int, int, int]:
        """Columns, rows, slices."""
        x, y, z = (*(axis.size for axis in self.axes if axis.role == SPACE), 1)[:3]
        return x, y, z

    @property
    def frames(self) -> int:
        return math.prod(axis.size for axis in self.axes if axis.role == FRAME)

    @property
    def components(self) -> int:
        return math.prod(axis.size for axis in self.axes if axis.role == COMPONENT)

    @property
    def frame_bytes(self) -> int:
        """Bytes of one frame in the file; 0 where there are no pixels."""
        return math.prod(self.size) * self.components * np.dtype(self.dtype).itemsize if self.dtype else 0


def check_axes(roles: list[str], sizes: list[int], where: str) -> tuple[Axis, ...]:
    """Axes, checked against what an IMAGE holds.  Raises DamagedRecording, UnsupportedRecording or LimitExceeded."""
    axes = tuple(Axis(role, size) for role, size in zip(roles, sizes, strict=True))
    spaces = [axis.size for axis in axes if axis.role == SPACE]
    if any(size < 0 for size in sizes):
        raise DamagedRecording(f"{where}: found sizes {_sizes_text(sizes)}, expected 0 or more")
    if not 2 <= len(spaces) <= 3 or roles.count(FRAME) > 1:
        raise UnsupportedRecording(
            f"{where}: found axes {', '.join(roles)}, expected 2 or 3 of space and at most one of time"
        )
    if max(spaces) > _MAX_SIZE:
        raise UnsupportedRecording(f"{where}: found sizes {_sizes_text(spaces)}, expected at most {_MAX_SIZE} (IMAGE)")
    components = math.prod(axis.size for axis in axes if axis.role == COMPONENT)
    if not 1 <= components <= _MAX_COMPONENTS:
        raise UnsupportedRecording(
            f"{where}: found {_sizes_text([components])} values per pixel, expected 1 … {_MAX_COMPONENTS} (IMAGE)"
        )
    return axes


def fourth_axis_as_time(roles: list[str], notes: list[str]) -> list[str]:
    """Roles in which a fourth axis of space is time: an IMAGE has three."""
    if roles.count(SPACE) != 4 or FRAME in roles:
        return roles
    notes.append("the fourth axis is taken as time")
    last = len(roles) - 1 - roles[::-1].index(SPACE)
    return [*roles[:last], FRAME, *roles[last + 1 :]]


def parse_number(word: str, what: str, where: str) -> float:
    """A number of a header.  Raises DamagedRecording."""
    try:
        return float(word)
    except ValueError:
        raise DamagedRecording(f"{where}: {what}: found {word[:40]!r}, expected a number") from None


def parse_whole(word: str, what: str, where: str) -> int:
    """A whole number of a header, of at most 18 digits.  Raises DamagedRecording."""
    digits = word.removeprefix("-").removeprefix("+")
    if not (digits.isascii() and digits.isdigit() and len(digits) <= 18):
        raise DamagedRecording(f"{where}: {what}: found {word[:40]!r}, expected an integer")
    return int(word)


def check_room(raster: Raster, packed: int) -> None:
    """Raise LimitExceeded where the pixels take more memory than they may, or unpack to too much."""
    limits.check_limit("memory", raster.frame_bytes, f"{raster.where}: bytes of a frame")
    if raster.packing != RAW:
        total = raster.skip + raster.frame_bytes * raster.frames
        allowed = max(limits.current_limits().free, limits.current_limits().ratio * packed)
        limits.check_limit("ratio", total, f"{raster.where}: {packed} packed bytes, unpacked", allowed)


def _sizes_text(sizes: list[int]) -> str:
    return " ".join(str(size)[:24] for size in sizes[:8])
