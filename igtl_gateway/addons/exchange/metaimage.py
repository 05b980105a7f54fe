"""Reads MetaImage headers: ``.mha`` with the pixels after them, ``.mhd`` with the pixels in another file.

The geometry is that of ITK: row *i* of TransformMatrix is the direction of axis *i*, Offset the centre of the first
voxel, ElementSpacing the distance of voxels, all in LPS millimetres, independent of AnatomicalOrientation.  The axes
are those of PLUS: ``Kinds`` names them (``domain``, ``list`` or ``time``, ``vector``).  Without ``Kinds`` the last
axis is time if frames have fields; otherwise a fourth axis is time.
"""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import BinaryIO

from igtl_gateway.addon import DamagedRecording, UnsupportedRecording
from igtl_gateway.addon.streams import ImagePlacement
from igtl_gateway.addon.terminal import counted
from igtl_gateway.addon.untrusted import files, limits
from igtl_gateway.addons.exchange.header import Frames, ImageFile, ImageFileHeader, header_lines
from igtl_gateway.addons.exchange.raster import (
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

_TYPES = {
    "MET_CHAR": "i1",
    "MET_UCHAR": "u1",
    "MET_SHORT": "i2",
    "MET_USHORT": "u2",
    "MET_INT": "i4",
    "MET_UINT": "u4",
    "MET_LONG": "i4",  # four bytes in MetaIO on every machine
    "MET_ULONG": "u4",
    "MET_LONG_LONG": "i8",
    "MET_ULONG_LONG": "u8",
    "MET_FLOAT": "f4",
    "MET_DOUBLE": "f8",
}
#: numpy's name of a type, without byte order → name in MetaIO.
MET_NAMES = {dtype: name for name, dtype in _TYPES.items() if name not in {"MET_LONG", "MET_ULONG"}}
_KINDS = {"domain": SPACE, "space": SPACE, "list": FRAME, "time": FRAME, "vector": COMPONENT}
#: Names of the same field in MetaIO; the first name that the header contains is used.
_OFFSET = ("Offset", "Position", "Origin")
_DIRECTIONS = ("TransformMatrix", "Rotation", "Orientation")
_SPACING = ("ElementSpacing", "ElementSize")


def read_metaimage(path: Path, stream: BinaryIO) -> ImageFile:
    """Read the header.  Raises DamagedRecording, UnsupportedRecording or LimitExceeded."""
    header = _read(path, stream)
    where = str(path)
    fields, notes = header.fields, list[str]()
    sizes = [parse_whole(word, "DimSize", where) for word in _words(fields, "DimSize", where)]
    roles = _roles(fields, header.frames, sizes, where, notes)
    if COMPONENT not in roles:
        channels = parse_whole(fields.get("ElementNumberOfChannels", "1"), "ElementNumberOfChannels", where)
        roles, sizes = [COMPONENT, *roles], [channels, *sizes]
    if _dims(fields, where) == len(roles) and FRAME not in roles:  # PLUS: one frame, but with a time axis
        roles, sizes = [*roles, FRAME], [*sizes, 1]
    axes = check_axes(roles, sizes, where)
    spatial = [role for role in roles if role != COMPONENT]
    data, offset = _data(path, fields, header.end, where)
    placed = _with_spacing_of_frames(header, len(spatial), where, notes)
    raster = Raster(
        where,
        axes,
        _dtype(fields, math.prod(sizes), where),
        _flag(fields, "BinaryDataByteOrderMSB", "ElementByteOrderMSB"),
        ZLIB if _flag(fields, "CompressedData") else RAW,
        data,
        offset,
        _placement(placed, spatial, where, notes),
        is_beside=data != path,
    )
    if len(spatial) == 4 and not header.frames:
        raster = replace(raster, times_s=_times(fields, spatial, raster.frames, where))
    return ImageFile(fields, header.frames, raster, notes)


def _read(path: Path, stream: BinaryIO) -> ImageFileHeader:
    """Read ``Key = value`` lines up to ElementDataFile, which is the last."""
    header = ImageFileHeader()
    for line in header_lines(stream, str(path)):
        key, equals, value = (part.strip() for part in line.partition("="))
        if equals:
            header.add(key, value)
        if key == "ElementDataFile":
            header.end = stream.tell()
            return header
    raise DamagedRecording(f"{path}: found a header without ElementDataFile, expected one at its end")


def _words(fields: dict[str, str], key: str, where: str) -> list[str]:
    words = fields.get(key, "").split()
    if not 2 <= len(words) <= 6:
        raise DamagedRecording(f"{where}: {key}: found {fields.get(key, '')[:60]!r}, expected 2 … 5 sizes")
    return words


def _roles(fields: dict[str, str], frames: Frames, sizes: list[int], where: str, notes: list[str]) -> list[str]:
    kinds = fields.get("Kinds", "").split()
    if kinds:
        if len(kinds) != len(sizes) or not {kind.lower() for kind in kinds} <= _KINDS.keys():
            raise DamagedRecording(
                f"{where}: Kinds: found {' '.join(kinds)[:60]!r}, expected one of {', '.join(_KINDS)} "
                f"for each of {counted(len(sizes), 'axis', 'axes')}"
            )
        roles = [_KINDS[kind.lower()] for kind in kinds]
        if not frames and roles == [SPACE, SPACE, FRAME] and sizes[2] > 1:
            # older versions of PLUS wrote reconstructed volumes in this way
            notes.append("Kinds declares the third axis as list, but no frame has fields: imported as one volume")
            return [SPACE, SPACE, SPACE]
        return fourth_axis_as_time(roles, notes)
    if frames and len(sizes) > 2:
        return [*([SPACE] * (len(sizes) - 1)), FRAME]
    return fourth_axis_as_time([SPACE] * len(sizes), notes)


def _with_spacing_of_frames(header: ImageFileHeader, dims: int, where: str, notes: list[str]) -> dict[str, str]:
    """Return the fields with the spacing that the frames have, if they have one.

    Raises UnsupportedRecording if it differs between frames: all images of a sequence have one size of pixels.
    """
    spacings = {number: frame[_SPACING[0]].split() for number, frame in header.frames.items() if _SPACING[0] in frame}
    if not spacings:
        return header.fields
    first = min(spacings)
    for number, words in sorted(spacings.items()):
        if words != spacings[first]:
            raise UnsupportedRecording(
                f"{where}: ElementSpacing: found {' '.join(spacings[first])[:60]} in frame {first} and "
                f"{' '.join(words)[:60]} in frame {number}, expected the same in all frames"
            )
    words = [*spacings[first], "1", "1"][: max(dims, len(spacings[first]))]
    notes.append(f"the spacing is that of the frames: {' '.join(spacings[first])[:60]}")
    return header.fields | {_SPACING[0]: " ".join(words)}


def _dims(fields: dict[str, str], where: str) -> int:
    return parse_whole(fields.get("NDims", "0"), "NDims", where)


def _dtype(fields: dict[str, str], pixels: int, where: str) -> str:
    element = fields.get("ElementType", "")
    if not pixels:
        return ""
    if element not in _TYPES:
        raise UnsupportedRecording(f"{where}: ElementType: found {element[:40]!r}, expected one of {', '.join(_TYPES)}")
    if fields.get("BinaryData", "True").lower() != "true":
        raise UnsupportedRecording(f"{where}: BinaryData: found {fields['BinaryData'][:20]!r}, expected True")
    return _TYPES[element]


def _flag(fields: dict[str, str], *keys: str) -> bool:
    return next((fields[key] for key in keys if key in fields), "False").lower() in {"true", "t", "1", "yes"}


def _data(path: Path, fields: dict[str, str], end: int, where: str) -> tuple[Path, int]:
    """Return the file with the pixels, and the offset of the first one."""
    name = fields["ElementDataFile"]
    skip = parse_whole(fields.get("HeaderSize", "0"), "HeaderSize", where)
    if name.upper() == "LOCAL":
        return path, end
    if name.upper().startswith("LIST") or "%" in name:
        raise UnsupportedRecording(f"{where}: ElementDataFile: found {name[:60]!r}, expected one file for all slices")
    if skip < -1:
        raise DamagedRecording(f"{where}: HeaderSize: found {skip}, expected -1 or more")
    return files.sibling_file(path, name), skip


def _floats(fields: dict[str, str], keys: tuple[str, ...], count: int, where: str) -> list[float]:
    """Return the numbers of the first of these fields that the header contains; empty for none."""
    key = next((key for key in keys if key in fields), "")
    values = [parse_number(word, key, where) for word in fields.get(key, "").split()]
    if values and len(values) < count:
        raise DamagedRecording(f"{where}: {key}: found {counted(len(values), 'number')}, expected {count}")
    return values


def _placement(fields: dict[str, str], roles: list[str], where: str, notes: list[str]) -> ImagePlacement | None:
    """Return position and orientation of the image; None if no field contains them.

    If the third of three axes is time, the three numbers of a row are spatial coordinates: slices can be oblique.
    """
    dims = len(roles)
    offset = _floats(fields, _OFFSET, dims, where)
    spacing = _floats(fields, _SPACING, dims, where)
    matrix = _floats(fields, _DIRECTIONS, dims * dims, where)
    if not (offset or spacing or matrix):
        notes.append("the header has no position: the image is centred, with voxels of 1 mm")
        return None
    offset, spacing = offset or [0.0] * dims, spacing or [1.0] * dims
    matrix = matrix or [float(i == j) for i in range(dims) for j in range(dims)]
    spaces = [axis for axis, role in enumerate(roles) if role == SPACE]
    check_steps([spacing[axis] for axis in spaces], "ElementSpacing", where, notes)
    coordinates = spaces
    if dims == 3 and len(spaces) == 2 and roles[-1] == FRAME:
        coordinates = [0, 1, 2]
        if spacing[2] > 0 and math.isfinite(spacing[2]):
            spaces = coordinates
    elif any(
        abs(matrix[axis * dims + other]) > 1e-9 for axis in spaces for other in range(dims) if other not in spaces
    ):
        raise UnsupportedRecording(f"{where}: TransformMatrix: found spatial axes with a time component, expected none")
    axes = [[matrix[axis * dims + other] * spacing[axis] for other in coordinates] for axis in spaces]
    return ImagePlacement.of_file(axes, [offset[axis] for axis in coordinates], "LPS", where)


def _times(fields: dict[str, str], roles: list[str], count: int, where: str) -> tuple[float, ...]:
    """Return the times of the frames of a plain image with four axes, in seconds: those of 3D Slicer, or by a step."""
    values = fields.get("axis 3 index values", "").split()
    unit, label = fields.get("NRRD_units[3]", ""), fields.get("NRRD_labels[3]", "")
    if values and (unit == "s" or (not unit and label == "time")):
        if len(values) != count:
            raise DamagedRecording(
                f"{where}: axis 3 index values: found {counted(len(values), 'number')}, expected {count}"
            )
        return tuple(parse_finite(value, "axis 3 index values", where) for value in values)
    step = (_floats(fields, _SPACING, len(roles), where) or [0.0] * len(roles))[roles.index(FRAME)]
    if not MIN_STEP_S <= step < MAX_STEP_S or count > limits.current_limits().count:
        return ()
    return tuple(index * step for index in range(count))
