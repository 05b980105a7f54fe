"""Layout of the pixels of a file, independent of its format: roles of the axes, number type, compression, position.

Axes have the order of the file, fastest first.  Each has one of three roles: *space* (columns, rows, slices in this
order), *component* (values of one pixel) or *frame* (images over time).  ``docs/reference/formats.md`` has the rules by
which the formats declare the roles.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from igtl_gateway.addon import DamagedRecording, UnsupportedRecording
from igtl_gateway.addon.streams import ImagePlacement
from igtl_gateway.addon.terminal import counted
from igtl_gateway.addon.untrusted import limits

SPACE, COMPONENT, FRAME = "space", "component", "frame"
RAW, ZLIB, BZIP2 = "raw", "zlib", "bzip2"

#: Ranges of the fields of IMAGE: sizes are u16, the number of components is u8.
_MAX_SIZE, _MAX_COMPONENTS = 65_535, 255
#: Bounds of a plausible time step of frames, in seconds: stamps have nanoseconds.
MIN_STEP_S, MAX_STEP_S = 1e-9, 1e6
#: Types that IMAGE does not support → type for their values; a value that is not exact is an error.
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
        dtype: numpy's name without byte order; ``""`` if the file has no pixels.
        big_endian: whether the byte order of the pixels is big-endian.
        packing: compression: RAW, ZLIB (also for gzip) or BZIP2.
        data: the file with the pixels.
        offset: offset of the first byte in that file; -1: the pixels are the end of the file.
        place: position and orientation of all frames; None if the header contains none.
        skip: for compressed pixels the number of decompressed bytes before the first pixel.
        is_beside: whether the pixels have a file of their own.
        times_s: time of each frame in seconds, from the header but not from fields of frames; empty if unknown.
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
    is_beside: bool = False

    @property
    def size(self) -> tuple[int, int, int]:
        """Return the numbers of columns, rows and slices."""
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
        """Return the size of one frame in the file in bytes; 0 without pixels."""
        return math.prod(self.size) * self.components * np.dtype(self.dtype).itemsize if self.dtype else 0


def check_axes(roles: list[str], sizes: list[int], where: str) -> tuple[Axis, ...]:
    """Return the axes if IMAGE can represent them.  Raises DamagedRecording, UnsupportedRecording or LimitExceeded."""
    axes = tuple(Axis(role, size) for role, size in zip(roles, sizes, strict=True))
    spaces = [axis.size for axis in axes if axis.role == SPACE]
    if any(size < 0 for size in sizes):
        raise DamagedRecording(f"{where}: found sizes {_sizes_text(sizes)}, expected 0 or more")
    if not 2 <= len(spaces) <= 3 or roles.count(FRAME) > 1:
        raise UnsupportedRecording(
            f"{where}: found axes {', '.join(roles)}, expected 2 or 3 spatial axes and at most one time axis"
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
    """Return the roles with a fourth spatial axis as time, because IMAGE has three; adds a note."""
    if roles.count(SPACE) != 4 or FRAME in roles:
        return roles
    notes.append("the fourth axis is imported as time")
    last = len(roles) - 1 - roles[::-1].index(SPACE)
    return [*roles[:last], FRAME, *roles[last + 1 :]]


def check_steps(steps: Sequence[float], what: str, where: str, notes: list[str]) -> None:
    """Check the distances of voxels; add a note if an axis runs the other way.  Raises DamagedRecording."""
    if any(not step or not math.isfinite(step) for step in steps):
        found = " ".join(f"{step:g}" for step in steps)
        raise DamagedRecording(f"{where}: {what}: found {found}, expected numbers other than 0")
    if any(step < 0 for step in steps):
        notes.append(f"{what} has negative numbers: these axes run the other way, as in ITK")


def parse_number(word: str, what: str, where: str) -> float:
    """Parse a number of a header.  Raises DamagedRecording."""
    try:
        return float(word)
    except ValueError:
        raise DamagedRecording(f"{where}: {what}: found {word[:40]!r}, expected a number") from None


def parse_finite(word: str, what: str, where: str) -> float:
    """Parse a finite number of a header.  Raises DamagedRecording."""
    value = parse_number(word, what, where)
    if not math.isfinite(value):
        raise DamagedRecording(f"{where}: {what}: found {word[:40]!r}, expected a finite number")
    return value


def parse_whole(word: str, what: str, where: str) -> int:
    """Parse an integer of a header, of at most 18 digits.  Raises DamagedRecording."""
    digits = word.removeprefix("-").removeprefix("+")
    if not (digits.isascii() and digits.isdigit() and len(digits) <= 18):
        raise DamagedRecording(f"{where}: {what}: found {word[:40]!r}, expected an integer")
    return int(word)


def check_room(raster: Raster, packed: int) -> None:
    """Check memory and decompressed size of the pixels; ``packed`` is the file size in bytes.  Raises LimitExceeded."""
    limits.check_limit("memory", raster.frame_bytes, f"{raster.where}: bytes of a frame")
    if raster.packing != RAW:
        total = raster.skip + raster.frame_bytes * raster.frames
        allowed = max(limits.current_limits().free, limits.current_limits().ratio * packed)
        limits.check_limit("ratio", total, f"{raster.where}: decompressed from {counted(packed, 'byte')}", allowed)


def _sizes_text(sizes: list[int]) -> str:
    return " ".join(str(size)[:24] for size in sizes[:8])
