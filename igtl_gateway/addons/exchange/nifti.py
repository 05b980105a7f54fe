"""Reads NIfTI headers, ``.nii`` and ``.nii.gz``, versions 1 and 2, with nibabel (the extra ``nifti``).

The position is that of sform if ``sform_code`` is set, otherwise that of qform, in RAS.  Without both, the axes are
left, posterior, superior with the origin 0, as in ITK.  The fourth axis is time with the step ``pixdim[4]``; the fifth
axis is the values of a voxel.  ``scl_slope`` and ``scl_inter`` are reported in a note and not applied.  Document:
nifti1.h of the NIfTI working group.
"""

from __future__ import annotations

import math
import zlib
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from igtl_gateway.addon import DamagedRecording, Unavailable, UnsupportedRecording
from igtl_gateway.addon.messages import millimetres
from igtl_gateway.addon.processes import missing
from igtl_gateway.addon.streams import ImagePlacement
from igtl_gateway.addon.terminal import counted
from igtl_gateway.addon.untrusted import limits
from igtl_gateway.addons.exchange.header import ImageFile
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
)

_GZIP = b"\x1f\x8b"
#: sizeof_hdr, in bytes → version.
_SIZES = {348: 1, 540: 2}
#: Bytes of a header of version 2, the longer one.
_HEADER = 540
_ROLES = (SPACE, SPACE, SPACE, FRAME, COMPONENT)
#: Units in xyzt_units: the low three bits → unit of lengths, the next three bits → seconds.
_LENGTHS = {0: "mm", 1: "m", 2: "mm", 3: "um"}
_SECONDS = {0: 1.0, 8: 1.0, 16: 1e-3, 24: 1e-6}
#: Data types of several numbers → their count, and the type of each.
_COMPOUND = {"complex64": (2, "f4"), "complex128": (2, "f8"), "rgb": (3, "u1"), "rgba": (4, "u1")}
_PLAIN = ("i1", "u1", "i2", "u2", "i4", "u4", "i8", "u8", "f4", "f8")


def looks_like_nifti(start: bytes) -> bool:
    """Return whether the first 512 bytes of a file are NIfTI, compressed or not."""
    data = start
    if start.startswith(_GZIP):
        try:
            data = zlib.decompressobj(zlib.MAX_WBITS | 16).decompress(start, _HEADER)
        except zlib.error:
            return False
    return data[344:348] in {b"n+1\0", b"ni1\0"} or data[4:8] in {b"n+2\0", b"ni2\0"}


def read_nifti(path: Path, stream: BinaryIO) -> ImageFile:
    """Read the header.

    Raises DamagedRecording, UnsupportedRecording, LimitExceeded, or Unavailable without nibabel.
    """
    where = str(path)
    start = stream.read(1 << 16)
    packed = start.startswith(_GZIP)
    if packed:
        start = zlib.decompressobj(zlib.MAX_WBITS | 16).decompress(start, _HEADER)
    header, order = _header(start, where)
    notes: list[str] = []
    shape = [int(size) for size in header["dim"][1 : 1 + int(header["dim"][0])]]
    while len(shape) > 3 and shape[-1] == 1:
        shape.pop()
    if len(shape) > len(_ROLES):
        raise UnsupportedRecording(
            f"{where}: dim: found {counted(len(shape), 'axis', 'axes')}, expected at most {len(_ROLES)}"
        )
    roles = list(_ROLES[: len(shape)])
    components, dtype = _dtype(header, where)
    if components > 1:
        roles, shape = [COMPONENT, *roles], [components, *shape]
    magic = bytes(header["magic"].tobytes())
    if magic.startswith(b"ni"):
        raise UnsupportedRecording(f"{where}: found the header of a pair (.hdr and .img), expected one .nii file")
    offset = float(header["vox_offset"])
    if not (math.isfinite(offset) and offset == int(offset) and 0 <= offset < 1 << 40):
        raise DamagedRecording(f"{where}: vox_offset: found {offset:g}, expected a number of bytes")
    raster = Raster(
        where,
        check_axes(roles, shape, where),
        dtype if math.prod(shape) else "",
        order == ">",
        ZLIB if packed else RAW,
        path,
        0 if packed else int(offset),
        _placement(header, roles.count(SPACE), where, notes),
        int(offset) if packed else 0,
        _times(header, roles, shape),
    )
    slope, shift = (float(header[name]) for name in ("scl_slope", "scl_inter"))
    if slope and math.isfinite(slope) and math.isfinite(shift) and (slope, shift) != (1.0, 0.0):
        notes.append(f"voxels stay as stored: scl_slope {slope:g} and scl_inter {shift:g} are not applied")
    fields = {
        name: " ".join(str(value) for value in np.atleast_1d(header[name]))
        for name in ("dim", "pixdim", "datatype", "qform_code", "sform_code", "scl_slope", "scl_inter", "xyzt_units")
    }
    return ImageFile(fields, {}, raster, notes)


def _header(start: bytes, where: str) -> tuple[Any, str]:
    """Return the header, decoded by nibabel, and the byte order of the file, ``<`` or ``>``."""
    try:
        from nibabel.nifti1 import Nifti1Header
        from nibabel.nifti2 import Nifti2Header
    except ImportError as error:
        raise Unavailable(f"{where}: NIfTI: {missing('nibabel', error)}") from None
    for order, name in (("<", "little"), (">", "big")):
        size = int.from_bytes(start[:4], "little" if order == "<" else "big")
        if (version := _SIZES.get(size)) and len(start) >= size:
            kind = Nifti1Header if version == 1 else Nifti2Header
            header = kind(start[:size], endianness=name, check=False)
            if not 2 <= int(header["dim"][0]) <= 7:
                raise DamagedRecording(
                    f"{where}: dim: found {counted(int(header['dim'][0]), 'axis', 'axes')}, expected 2 … 7"
                )
            return header, order
    raise DamagedRecording(f"{where}: found a header of {counted(len(start), 'byte')}, expected sizeof_hdr 348 or 540")


def _dtype(header: Any, where: str) -> tuple[int, str]:
    """Return the number of values of a voxel, and their type."""
    try:
        dtype = header.get_data_dtype()
    except Exception:
        dtype = None
    code = int(header["datatype"])
    if dtype is not None:
        names = dtype.names
        key = {3: "rgb", 4: "rgba"}.get(len(names), "") if names else dtype.name
        if key in _COMPOUND:
            return _COMPOUND[key]
        if not names and dtype.str[1:] in _PLAIN:
            return 1, dtype.str[1:]
    raise UnsupportedRecording(f"{where}: datatype: found {code}, expected integers, float32, float64, RGB or RGBA")


@np.errstate(all="ignore")  # of_file rejects NaN and infinity; numpy would also print a warning
def _placement(header: Any, axes: int, where: str, notes: list[str]) -> ImagePlacement:
    lengths = millimetres(_LENGTHS.get(int(header["xyzt_units"]) & 7, "mm"))
    codes = {name: int(header[f"{name}_code"]) for name in ("sform", "qform")}
    if codes["sform"] > 0:
        affine = header.get_sform()
        if codes["qform"] > 0 and not np.allclose(affine, _qform(header, where), atol=1e-3):
            notes.append("sform and qform differ: the position is that of sform; ITK may take that of qform")
    elif codes["qform"] > 0:
        affine = _qform(header, where)
    else:
        notes.append("neither sform nor qform is set: axes are treated as left, posterior, superior, as in ITK")
        steps = [lengths.to_ros(abs(float(step))) for step in header["pixdim"][1 : 1 + axes]]
        return ImagePlacement.of_file(np.diag(steps).tolist(), [0.0] * axes, "LPS", where)
    columns = lengths.to_ros(affine[:3, :axes]).T.tolist()
    return ImagePlacement.of_file(columns, lengths.to_ros(affine[:3, 3]).tolist(), "RAS", where)


def _qform(header: Any, where: str) -> Any:
    if not float(header["pixdim"][0]):
        # nifti1.h: a qfac of 0 means 1; nibabel takes only 1 and -1
        header = header.copy()
        header["pixdim"][0] = 1.0
    try:
        return header.get_qform()
    except Exception:  # of several types
        values = " ".join(f"{float(header[name]):g}" for name in ("quatern_b", "quatern_c", "quatern_d"))
        found = f"quatern {values} and pixdim[0] {float(header['pixdim'][0]):g}"
        raise DamagedRecording(f"{where}: qform: found {found}, expected a rotation, and 1, -1 or 0") from None


def _times(header: Any, roles: list[str], shape: list[int]) -> tuple[float, ...]:
    if FRAME not in roles:
        return ()
    count = shape[roles.index(FRAME)]
    scale = _SECONDS.get(int(header["xyzt_units"]) & 56, 0.0)
    step = float(header["pixdim"][4]) * scale
    begin = float(header["toffset"]) * scale
    if not 0 <= begin < MAX_STEP_S:
        begin = 0.0
    if not MIN_STEP_S <= step < MAX_STEP_S or not 1 < count <= limits.current_limits().count:
        return ()
    return tuple(begin + index * step for index in range(count))
