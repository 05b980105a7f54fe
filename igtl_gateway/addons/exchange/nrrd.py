"""Reads NRRD headers: ``.nrrd`` with the pixels after them, ``.nhdr`` with the pixels in another file.

``kinds`` name the axes: ``domain`` and ``space`` are spatial, ``list`` and ``time`` are frames, all others are the
values of a pixel.  Without ``kinds``, an axis with the direction ``none`` is frames if it is the last one, otherwise
the values of a pixel.  The geometry is that of ``space``.  As in ITK, a space without a name, or one that is not
anatomical, is LPS.
"""

from __future__ import annotations

import math
import re
from pathlib import Path
from typing import BinaryIO

from igtl_gateway.addon import DamagedRecording, UnsupportedRecording
from igtl_gateway.addon.streams import ImagePlacement, Vector
from igtl_gateway.addon.terminal import counted
from igtl_gateway.addon.untrusted import files, limits
from igtl_gateway.addons.exchange.header import Frames, ImageFile, ImageFileHeader, header_lines
from igtl_gateway.addons.exchange.raster import (
    BZIP2,
    COMPONENT,
    FRAME,
    MAX_STEP_S,
    MIN_STEP_S,
    RAW,
    SPACE,
    ZLIB,
    Raster,
    check_axes,
    check_steps,
    fourth_axis_as_time,
    parse_finite,
    parse_number,
    parse_whole,
)

_VERSIONS = frozenset(("NRRD00.01", *(f"NRRD000{number}" for number in range(1, 7))))
_TYPES = {
    **dict.fromkeys(("signed char", "int8", "int8_t"), "i1"),
    **dict.fromkeys(("uchar", "unsigned char", "uint8", "uint8_t"), "u1"),
    **dict.fromkeys(("short", "short int", "signed short", "signed short int", "int16", "int16_t"), "i2"),
    **dict.fromkeys(("ushort", "unsigned short", "unsigned short int", "uint16", "uint16_t"), "u2"),
    **dict.fromkeys(("int", "signed int", "int32", "int32_t"), "i4"),
    **dict.fromkeys(("uint", "unsigned int", "uint32", "uint32_t"), "u4"),
    **dict.fromkeys(
        ("longlong", "long long", "long long int", "signed long long", "signed long long int", "int64", "int64_t"), "i8"
    ),
    **dict.fromkeys(
        ("ulonglong", "unsigned long long", "unsigned long long int", "uint64", "uint64_t"),
        "u8",
    ),
    "float": "f4",
    "double": "f8",
}
_PACKINGS = {"raw": RAW, "gzip": ZLIB, "gz": ZLIB, "bzip2": BZIP2, "bz2": BZIP2}
#: Anatomical spaces → their orientation; a trailing ``-time`` or ``T`` adds a fourth coordinate.
_SPACES = {
    "right-anterior-superior": "RAS",
    "ras": "RAS",
    "left-anterior-superior": "LAS",
    "las": "LAS",
    "left-posterior-superior": "LPS",
    "lps": "LPS",
}
#: Spaces that are not anatomical.
_OTHER_SPACES = ("scanner-xyz", "3d-right-handed", "3d-left-handed")
_FRAME_KINDS, _SPACE_KINDS = ("list", "time"), ("domain", "space")
#: Fields that give the ends of axes without a direction; coordinates of a space with time.
_ENDS, _WITH_TIME = ("spacings", "axis mins", "axis maxs"), 4
_UNKNOWN_KINDS = ("???", "none", "")
_VECTOR = re.compile(r"none|\(([^()]*)\)")
#: Units that programs use for a time axis → seconds.
_SECONDS = {"s": 1.0, "sec": 1.0, "seconds": 1.0, "ms": 1e-3, "msec": 1e-3, "us": 1e-6}


def read_nrrd(path: Path, stream: BinaryIO) -> ImageFile:
    """Read the header.  Raises DamagedRecording, UnsupportedRecording or LimitExceeded."""
    header, where = _read(path, stream), str(path)
    fields, notes = header.fields, list[str]()
    sizes = [parse_whole(word, "sizes", where) for word in fields.get("sizes", "").split()[:17]]
    if not 2 <= len(sizes) <= 16 or fields.get("dimension", str(len(sizes))) != str(len(sizes)):
        raise DamagedRecording(
            f"{where}: found {counted(len(sizes), 'size')} and dimension {fields.get('dimension', '')[:20]!r}, "
            "expected one size for each of 2 or more"
        )
    vectors = _vectors(fields, len(sizes), where)
    roles = fourth_axis_as_time(_roles(fields, vectors, len(sizes), header.frames, where), notes)
    data, offset, skip = _data(path, fields, header.end, where)
    raster = Raster(
        where,
        check_axes(roles, sizes, where),
        _dtype(fields, math.prod(sizes), where),
        fields.get("endian", "little").lower() == "big",
        _packing(fields, where),
        data,
        offset,
        _placement(fields, roles, sizes, vectors, where, notes),
        skip,
        _times(fields, roles, sizes, vectors, where, notes),
        is_beside=data != path,
    )
    return ImageFile(fields, header.frames, raster, notes)


def _read(path: Path, stream: BinaryIO) -> ImageFileHeader:
    """Read ``field: value`` and ``key:=value`` lines up to an empty line, or to the end of a detached header."""
    header = ImageFileHeader()
    for number, line in enumerate(header_lines(stream, str(path)), 1):
        if not line:
            break
        if number == 1 and line.strip() not in _VERSIONS:
            raise UnsupportedRecording(f"{path}: line 1: found {line[:20]!r}, expected NRRD0001 to NRRD0006")
        if line.startswith(("#", "NRRD")):
            continue
        key, separator, value = line.partition(":=")
        if not separator:
            key, separator, value = line.partition(":")
            key = {"datafile": "data file", "byteskip": "byte skip", "lineskip": "line skip"}.get(
                key.strip().lower(), key.strip()
            )
        if separator:
            header.add(key.strip(), value.strip())
    header.end = stream.tell()
    return header


def _vectors(fields: dict[str, str], count: int, where: str) -> list[list[float] | None]:
    """Return ``space directions`` of each axis; None for ``none``, (nan,nan,nan) and a header without the field."""
    text = fields.get("space directions", "")
    if not text:
        return [None] * count
    found = list(_VECTOR.finditer(text))
    if len(found) != count:
        raise DamagedRecording(f"{where}: space directions: found {counted(len(found), 'vector')}, expected {count}")
    vectors: list[list[float] | None] = []
    for match in found:
        values = [parse_number(word, "space directions", where) for word in (match[1] or "").split(",") if word.strip()]
        vectors.append(None if not values or all(map(math.isnan, values)) else values)
    return vectors


def _roles(
    fields: dict[str, str], vectors: list[list[float] | None], count: int, frames: Frames, where: str
) -> list[str]:
    kinds = fields.get("kinds", "").lower().split() or ["???"] * count
    if len(kinds) != count:
        raise DamagedRecording(f"{where}: kinds: found {counted(len(kinds), 'word')}, expected {count}")
    directed = any(vector is not None for vector in vectors)
    roles = []
    for axis, (kind, vector) in enumerate(zip(kinds, vectors, strict=True)):
        if kind in _SPACE_KINDS:
            role = SPACE
        elif kind in _FRAME_KINDS:
            role = FRAME
        elif kind not in _UNKNOWN_KINDS:
            role = COMPONENT
        elif directed:
            role = SPACE if vector is not None else FRAME if axis == count - 1 and axis else COMPONENT
        else:
            role = FRAME if frames and axis == count - 1 > 1 else SPACE
        roles.append(role)
    return roles


def _dtype(fields: dict[str, str], pixels: int, where: str) -> str:
    element = fields.get("type", "").lower()
    if not pixels:
        return ""
    if element not in _TYPES:
        raise UnsupportedRecording(f"{where}: type: found {element[:40]!r}, expected an integer type, float or double")
    return _TYPES[element]


def _packing(fields: dict[str, str], where: str) -> str:
    encoding = fields.get("encoding", "raw").lower()
    if encoding not in _PACKINGS:
        raise UnsupportedRecording(
            f"{where}: encoding: found {encoding[:40]!r}, expected one of {', '.join(_PACKINGS)}"
        )
    return _PACKINGS[encoding]


def _data(path: Path, fields: dict[str, str], end: int, where: str) -> tuple[Path, int, int]:
    """Return the file with the pixels, their offset in it, and the number of decompressed bytes before them."""
    name = fields.get("data file", "")
    skip = parse_whole(fields.get("byte skip", "0"), "byte skip", where)
    packed = _packing(fields, where) != RAW
    if parse_whole(fields.get("line skip", "0"), "line skip", where):
        raise UnsupportedRecording(f"{where}: line skip: found {fields['line skip'][:20]}, expected 0")
    if skip < 0 and (packed or skip != -1):
        raise UnsupportedRecording(f"{where}: byte skip: found {skip}, expected 0 or more, or -1 for raw pixels")
    if name.upper().startswith("LIST") or "%" in name:
        raise UnsupportedRecording(f"{where}: data file: found {name[:60]!r}, expected one file for all pixels")
    data, start = (files.sibling_file(path, name.removeprefix("./")), 0) if name else (path, end)
    if packed:
        return data, start, skip
    return data, -1 if skip < 0 else start + skip, 0


def _placement(
    fields: dict[str, str],
    roles: list[str],
    sizes: list[int],
    vectors: list[list[float] | None],
    where: str,
    notes: list[str],
) -> ImagePlacement | None:
    spaces = [axis for axis, role in enumerate(roles) if role == SPACE]
    directions = [vector for axis in spaces if (vector := vectors[axis]) is not None]
    space = _space(fields, where, notes)
    if not directions:
        return _undirected_placement(fields, spaces, sizes, where, notes)
    if len(directions) != len(spaces):
        raise DamagedRecording(f"{where}: space directions: found none for a spatial axis, expected a vector")
    dims = {len(vector) for vector in directions}
    text = fields.get("space origin", "")
    origin = [parse_number(word, "space origin", where) for word in text.strip(" ()").split(",") if word.strip()]
    count = dims.pop()
    if dims or not 2 <= count <= 4 or (origin and len(origin) != count):
        raise DamagedRecording(
            f"{where}: found an origin of {counted(len(origin), 'number')} and directions of {count}, expected 2 … "
            "4 for all"
        )
    if count == 4 and any(abs(vector[3]) > 1e-9 for vector in directions):
        raise UnsupportedRecording(
            f"{where}: space directions: found spatial axes with a time component, expected none"
        )
    if not origin or any(map(math.isnan, origin)):
        origin = [0.0] * count
        notes.append("the header has no space origin: the first voxel is at 0")
    units = set(re.findall(r'"([^"]*)"', fields.get("space units", ""))) - {"mm", "", "s", "ms", "???"}
    if units:
        notes.append(f"space units {', '.join(sorted(units))[:40]}: numbers are treated as millimetres, as in ITK")
    return ImagePlacement.of_file([vector[:3] for vector in directions], origin[:3], space, where)


def _space(fields: dict[str, str], where: str, notes: list[str]) -> str:
    name = fields.get("space", "")
    known = re.sub(r"(-time|(?<=^ras|^las|^lps)t)$", "", name.lower())
    if known in _SPACES:
        if known != name.lower() and _SPACES[known] != "LPS":
            notes.append(f"space {name}: read as {_SPACES[known]}, as NRRD defines it; ITK reads it as LPS")
        return _SPACES[known]
    if name and known not in _OTHER_SPACES:
        raise DamagedRecording(f"{where}: space: found {name[:40]!r}, expected one of {', '.join(_SPACES)}")
    if "space directions" in fields:
        notes.append(f"space {name or 'without a name'}: treated as left-posterior-superior, as in ITK")
    return "LPS"


def _undirected_placement(
    fields: dict[str, str], spaces: list[int], sizes: list[int], where: str, notes: list[str]
) -> ImagePlacement | None:
    """Return the position from ``spacings``, ``axis mins`` and ``axis maxs``, which have no directions; None without.

    Without a spacing, it is that of the samples between the ends of the axis (Definition of NRRD, section 5).
    """
    steps, first, last = (_of_axes(fields, name, spaces, len(sizes), where) for name in _ENDS)
    centred = "node" not in (fields.get("centers", "") or fields.get("centerings", "")).lower()
    if not steps and first and last:
        numbers = [sizes[axis] if centred else sizes[axis] - 1 for axis in spaces]
        steps = [
            (high - low) / number if number else math.nan
            for low, high, number in zip(first, last, numbers, strict=True)
        ]
        notes.append("the voxels lie between axis mins and axis maxs, as NRRD defines them; ITK reads voxels of 1 mm")
    if not steps:
        if first or last:
            alone = "mins" if first else "maxs"
            raise UnsupportedRecording(f"{where}: found axis {alone} alone, expected spacings, or axis mins and maxs")
        notes.append("the header has no position: the image is centred, with voxels of 1 mm")
        return None
    check_steps(steps, "spacings", where, notes)
    # the minimum of cell-centred samples is half a step before the first centre
    origin = [low + (step / 2 if centred else 0.0) for low, step in zip(first, steps, strict=True)] if first else []
    axes: list[Vector] = [(steps[0], 0.0, 0.0), (0.0, steps[1], 0.0)]
    if len(steps) == 3:
        axes.append((0.0, 0.0, steps[2]))
    notes.append("the header has spacings without directions: axes are treated as left, posterior, superior, as in ITK")
    return ImagePlacement.of_file(axes, origin or [0.0] * len(axes), "LPS", where)


def _of_axes(fields: dict[str, str], name: str, spaces: list[int], count: int, where: str) -> list[float]:
    """Return the numbers of a field for the spatial axes; none if the field is absent, or NaN for one of them."""
    words = fields.get(name, "").split()
    if not words:
        return []
    if len(words) != count:
        raise DamagedRecording(f"{where}: {name}: found {counted(len(words), 'number')}, expected {count}")
    values = [parse_number(words[axis], name, where) for axis in spaces]
    return [] if any(map(math.isnan, values)) else values


def _times(
    fields: dict[str, str],
    roles: list[str],
    sizes: list[int],
    vectors: list[list[float] | None],
    where: str,
    notes: list[str],
) -> tuple[float, ...]:
    """Return the times of the frames in seconds, from Slicer's ``axis 3 index values`` or from a constant step."""
    if FRAME not in roles or sizes[roles.index(FRAME)] > limits.current_limits().count:
        return ()
    axis = roles.index(FRAME)
    # 3D Slicer counts the axes of a picture without that of its colours: the frames have axis 3, or 0 in newer versions
    key = next((each for each in (axis, 3, 0) if f"axis {each} index values" in fields), axis)
    values = fields.get(f"axis {key} index values", "").split()
    if values and fields.get(f"axis {key} index type", "numeric") == "numeric":
        name = f"axis {key} index values"
        if len(values) != sizes[axis]:
            raise DamagedRecording(f"{where}: {name}: found {counted(len(values), 'number')}, expected {sizes[axis]}")
        unit = fields.get(f"axis {axis} index unit", "") or _word(fields.get("units", ""), axis)
        label = _word(fields.get("labels", ""), axis)
        scale = _SECONDS.get(unit.lower(), 1.0 if "time" in label.lower() else 0.0)
        if scale:
            return tuple(parse_finite(value, name, where) * scale for value in values)
        notes.append(f"index values of the frames ({label[:40] or 'no label'}, {unit[:20] or 'no unit'}) are not times")
        return ()
    vector = vectors[axis]
    words = fields.get("spacings", "").split()
    step = vector[-1] if vector else parse_number(words[axis], "spacings", where) if len(words) == len(sizes) else 0.0
    if not MIN_STEP_S <= step < MAX_STEP_S:
        return ()
    begin = _first_time(fields, vector, where)
    return tuple(begin + index * step for index in range(sizes[axis]))


def _first_time(fields: dict[str, str], vector: list[float] | None, where: str) -> float:
    """Return the time of the first frame, the fourth number of ``space origin``, in seconds; 0 if it has none."""
    words = fields.get("space origin", "").strip(" ()").split(",")
    if vector is None or len(words) != len(vector) or len(words) != _WITH_TIME:
        return 0.0
    begin = parse_number(words[-1], "space origin", where)
    return begin if 0 <= begin < MAX_STEP_S else 0.0


def _word(text: str, axis: int) -> str:
    """Return the quoted word of an axis; ``""`` if there is none."""
    words = re.findall(r'"([^"]*)"', text)
    return words[axis] if axis < len(words) else ""
