"""Poses of OpenIGTLink as columns: the bodies of all messages of a stream at once, checked like single ones.

A message that the session rejects, for its CRC, size or version, is no pose; the others are not affected.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
import numpy.typing as npt

from igtl_gateway.api.cdr_columns import Column
from igtl_gateway.base.errors import ConversionError, WireError
from igtl_gateway.convert.context import ToRosContext
from igtl_gateway.convert.poses import ROUNDING, pose_of_matrix, rotation_matrix
from igtl_gateway.convert.units import LengthUnits, millimetres
from igtl_gateway.gateway.acceptance import DEFAULT_ACCEPTANCE, Acceptance
from igtl_gateway.record.sessionfile.bulk import Bytes, MessageBlock, gathered
from igtl_gateway.wire.header import BODY_SIZE_AT, CRC_AT, DEVICE_NAME_AT, HEADER_SIZE, TYPE_AT, crc64
from igtl_gateway.wire.transform import Position, Transform

Array = npt.NDArray[Any]

#: Types whose messages are one pose each.
POSE_TYPES = ("TRANSFORM", "POSITION", "QTRANS")
#: Bytes of the content of TRANSFORM and POSITION, in version 1.
_MATRIX_BYTES, _POSITION_BYTES = 48, 28
_HEAD = np.dtype(
    {
        "names": ["version", "type", "body_size", "crc"],
        "formats": [">u2", f"S{DEVICE_NAME_AT - TYPE_AT}", ">u8", ">u8"],
        "offsets": [0, TYPE_AT, BODY_SIZE_AT, CRC_AT],
        "itemsize": HEADER_SIZE,
    }
)
#: Bodies of this size and above have their CRC computed one by one.
_MAX_TABLE = 256


@dataclass(frozen=True, slots=True, eq=False)
class PoseRows:
    """The poses in a block of TRANSFORM or POSITION messages.

    Attributes:
        rows: (n,) index in the block of each message that is a pose; the other messages are damaged.
        matrices: (n, 4, 4) float64, translation in the unit of the message.
        quaternions: (n, 4) x, y, z, w as in POSITION; None for TRANSFORM.
        forms: of POSITION: what is on the wire, see ``wire.transform.Position``; empty for TRANSFORM.
    """

    rows: npt.NDArray[np.int64]
    matrices: Array
    quaternions: Array | None = None
    forms: tuple[str, ...] = ()


def pose_rows(block: MessageBlock, igtl_type: str, acceptance: Acceptance = DEFAULT_ACCEPTANCE) -> PoseRows:
    """The poses of messages of one of POSE_TYPES."""
    is_matrix = igtl_type == "TRANSFORM"
    size = _MATRIX_BYTES if is_matrix else _POSITION_BYTES
    plain, bodies = _plain(block, igtl_type, size, acceptance)
    matrices = np.zeros((len(block), 4, 4))
    matrices[:, 3, 3] = 1.0
    quaternions = np.zeros((len(block), 4))
    forms = ["all"] * len(block)
    good = plain.copy()
    with np.errstate(invalid="ignore"):  # a signalling NaN
        numbers = np.ascontiguousarray(bodies).view(">f4").astype(np.float64)
    if is_matrix:
        matrices[plain, :3, :] = numbers.reshape(-1, 4, 3).transpose(0, 2, 1)
    else:
        matrices[plain, :3, 3], quaternions[plain] = numbers[:, :3], numbers[:, 3:]
    for index in np.flatnonzero(~plain).tolist():  # version 2, short forms, damaged
        try:
            content = acceptance.message(block.payload(index)).content
        except WireError:
            continue
        if is_matrix and isinstance(content, Transform):
            matrices[index] = content.rows
        elif not is_matrix and isinstance(content, Position):
            matrices[index, :3, 3], quaternions[index], forms[index] = (
                content.position,
                content.quaternion,
                content.form,
            )
        else:
            continue
        good[index] = True
    rows = np.flatnonzero(good)
    if is_matrix:
        return PoseRows(rows, matrices[rows])
    quaternions = quaternions[rows]
    matrices = matrices[rows]
    matrices[:, :3, :3] = rotations(quaternions)
    return PoseRows(rows, matrices, quaternions, tuple(forms[index] for index in rows.tolist()))


def rotations(quaternions: Array) -> Array:
    """Rotation matrices (n, 3, 3) of quaternions (n, 4) x, y, z, w of any length above 0; NaN for others."""
    with np.errstate(all="ignore"):
        length = np.sqrt(np.sum(quaternions * quaternions, axis=-1, keepdims=True))
        unit = np.where((length > 0) & (length < np.inf), quaternions / length, np.nan)
    x, y, z, w = np.moveaxis(unit, -1, 0)
    rows: Any = rotation_matrix((x, y, z, w))
    return np.moveaxis(np.array(rows), (0, 1), (-2, -1))


def _plain(
    block: MessageBlock, igtl_type: str, size: int, acceptance: Acceptance
) -> tuple[npt.NDArray[np.bool_], Bytes]:
    """Which messages are of the type, of version 1, with a body of ``size`` bytes, and accepted; and these bodies."""
    found = np.zeros(len(block), np.bool_)
    fitting = np.flatnonzero(block.ends - block.begins == HEADER_SIZE + size)
    messages = gathered(block.data, block.begins[fitting], HEADER_SIZE + size)
    heads = messages[:, :HEADER_SIZE].copy().view(_HEAD).reshape(-1)
    bodies = messages[:, HEADER_SIZE:]
    right = (heads["version"] == 1) & (heads["body_size"] == size) & (heads["type"] == igtl_type.encode())
    if acceptance.check_crc:
        right &= heads["crc"] == crcs(bodies)
    found[fitting] = right
    return found, bodies[right]


def crcs(bodies: Bytes) -> npt.NDArray[np.uint64]:
    """CRC-64 of each row.

    The CRC is linear, without initial and final value: that of a body is the XOR of those of its bytes, each with zeros
    for all the others.
    """
    size = bodies.shape[1]
    if size >= _MAX_TABLE:
        return np.array([crc64(row.tobytes()) for row in bodies], np.uint64)
    table = _crc_table(size)
    found = np.zeros(len(bodies), np.uint64)
    columns = np.ascontiguousarray(bodies.T)  # each is read in one piece
    for place in range(size):
        found ^= table[place][columns[place]]
    return found


@lru_cache(maxsize=8)
def _crc_table(size: int) -> npt.NDArray[np.uint64]:
    """(size, 256): the CRC of a body with this byte at this place, and zeros."""
    last = np.array([crc64(bytes([value])) for value in range(256)], np.uint64)
    table = np.zeros((size, 256), np.uint64)
    row = last
    for place in reversed(range(size)):
        table[place] = row
        row = last[(row >> np.uint64(56)).astype(np.intp)] ^ (row << np.uint64(8))
    return table


def pose_columns(found: PoseRows, unit: str) -> list[Column]:
    """The columns of TRANSFORM or POSITION messages, as ``columns.name_igtl_fields`` has them of one."""
    matrices, lengths = found.matrices, millimetres(unit)
    xyz = [(f"{axis}_mm", "mm", lengths.to_ros(matrices[:, row, 3])) for row, axis in enumerate("xyz")]
    if found.quaternions is not None:
        kinds = [form.encode() for form in found.forms]
        offsets = np.concatenate(([0], np.cumsum([len(kind) for kind in kinds]))).astype(np.int64)
        pack = Column("pack", "", np.frombuffer(b"".join(kinds), np.uint8), offsets, is_text=True)
        position = [Column(f"position.{name}", unit, values) for name, unit, values in xyz]
        quaternion = [Column(f"quaternion.{axis}", "", found.quaternions[:, i]) for i, axis in enumerate("xyzw")]
        return [pack, *position, *quaternion]
    quaternions, valid = quaternions_of(matrices)
    columns = [Column(*each) for each in xyz]
    whole = None if valid.all() else valid
    columns += [Column(f"q{axis}", "", quaternions[:, i], valid=whole) for i, axis in enumerate("xyzw")]
    columns += [Column(f"r{row + 1}{col + 1}", "", matrices[:, row, col]) for row in range(3) for col in range(3)]
    return columns


def quaternions_of(matrices: Array) -> tuple[Array, npt.NDArray[np.bool_]]:
    """Unit quaternions (n, 4) x, y, z, w with w ≥ 0 of matrices (n, 4, 4), and which of them are rotations.

    The bits are those of ``convert.poses``, which the matrices that are not orthonormal go through one by one.
    """
    (a, b, c), (d, e, f), (g, h, i) = (tuple(matrices[:, row, col] for col in range(3)) for row in range(3))
    with np.errstate(all="ignore"):
        off = np.max(
            [
                np.abs(a * a + d * d + g * g - 1.0),
                np.abs(b * b + e * e + h * h - 1.0),
                np.abs(c * c + f * f + i * i - 1.0),
                np.abs(a * b + d * e + g * h),
                np.abs(a * c + d * f + g * i),
                np.abs(b * c + e * f + h * i),
            ],
            axis=0,
            initial=0.0,
        )
        determinant = a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g)
        trace = a + e + i
        cases = [trace >= np.max([a, e, i], axis=0), (a >= e) & (a >= i), e >= i]
        x = np.select(cases, [h - f, 1.0 + a - e - i, b + d], c + g)
        y = np.select(cases, [c - g, b + d, 1.0 - a + e - i], f + h)
        z = np.select(cases, [d - b, c + g, f + h], 1.0 - a - e + i)
        w = np.select(cases, [1.0 + trace, h - f, c - g], d - b)
        length = np.sqrt(x * x + y * y + z * z + w * w)
        found = np.stack([x, y, z, w], axis=-1) / length[:, None]
        last = np.select([found[:, 3] != 0, found[:, 2] != 0, found[:, 1] != 0], found[:, 3:0:-1].T, found[:, 0])
        found = np.where((last < 0)[:, None], -found, found)
    valid = (off <= ROUNDING) & (determinant > 0) & np.isfinite(matrices[:, :3, 3]).all(axis=1)
    units = LengthUnits("mm", "mm")
    for row in np.flatnonzero(~valid).tolist():
        wire = matrices[row, :3, :].T.reshape(-1).tolist()
        try:
            found[row] = pose_of_matrix(wire, ToRosContext("", 0, "", "", units), "TRANSFORM")[3:]
            valid[row] = True
        except ConversionError:
            found[row] = np.nan
    return found, valid
