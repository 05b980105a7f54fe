"""What the columns of a data set of others are as messages: a table of kinds, for all frames of an episode at once.

Messages of one stream differ in their numbers and stamps only, so one is packed, and the others are copies of its bytes
with their own numbers.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from math import prod
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from igtl_gateway.addon import NS_PER_S, DamagedRecording
from igtl_gateway.addon.messages import MULTI_ARRAYS
from igtl_gateway.addon.reading import Buffer
from igtl_gateway.addon.ros import (
    CompressedImage,
    Header,
    JointState,
    MultiArrayDimension,
    MultiArrayLayout,
    PoseStamped,
)
from igtl_gateway.addon.terminal import count_text
from igtl_gateway.addons.lerobot.recipe import ACTION, STATE

if TYPE_CHECKING:
    import pyarrow as pa

Array = npt.NDArray[Any]
Times = npt.NDArray[np.int64]

#: dtype of a feature → numbers of the message that has its values; of int64 those that a float64 has exactly.
NUMBERS = {
    "float16": "f4", "float32": "f4", "float64": "f8", "int8": "i1", "int16": "i2", "int32": "i4", "int64": "f8",
    "uint8": "u1", "uint16": "u2", "uint32": "u4", "uint64": "f8", "bool": "i1",
}  # fmt: skip
_EXACT = 1 << 53
#: Names of the seven numbers of a pose, behind what they have in common.
_POSE = ("x", "y", "z", "qx", "qy", "qz", "qw")
_POSE_NAME = re.compile(r"(|.*[._/ -])(x|y|z|qx|qy|qz|qw)", re.DOTALL)
#: Largest difference of the length of a quaternion from 1.
_UNIT = 1e-2
#: Bytes of messages that are made at once.
_BLOCK = 1 << 24
#: First bytes of an encoded picture → the format of CompressedImage.
_STILLS = {b"\x89PNG": "png", b"\xff\xd8\xff": "jpeg", b"II*\0": "tiff", b"MM\0*": "tiff"}


def names_of(feature: Mapping[str, Any], count: int) -> tuple[str, ...]:
    """Return the names of the ``count`` numbers of a feature; nothing if it does not have one for each, once."""
    names = feature.get("names")
    if isinstance(names, dict) and len(names) == 1:
        names = next(iter(names.values()))
    if not isinstance(names, list) or len(names) != count or not all(isinstance(each, str) for each in names):
        return ()
    return tuple(names) if len(set(names)) == count and all(names) else ()


def is_joints(name: str, feature: Mapping[str, Any]) -> bool:
    """Return whether a feature is state or action with named numbers, which JointState has by name."""
    is_main = name.startswith((STATE, ACTION)) and feature["dtype"].startswith("float")
    return is_main and len(feature["shape"]) == 1 and bool(names_of(feature, prod(feature["shape"])))


@dataclass(frozen=True, slots=True)
class PoseColumns:
    """Numbers of a feature that are a pose: what their names have in common, and their places as in ``_POSE``."""

    name: str
    columns: tuple[int, ...]


def poses_of(names: Sequence[str]) -> list[PoseColumns]:
    """Return the poses among named numbers: those that have all seven names of one, and no other rotation."""
    found: dict[str, dict[str, int]] = {}
    for place, name in enumerate(names):
        if match := _POSE_NAME.fullmatch(name):
            found.setdefault(match[1], {})[match[2]] = place
    return [
        PoseColumns(common.rstrip("._/ -"), tuple(places[each] for each in _POSE))
        for common, places in found.items()
        if len(places) == len(_POSE)
    ]


def values_of(table: pa.Table, name: str, width: int, place: str) -> Array:
    """Return a column of numbers, or of lists of them, as (N, width).  Raises DamagedRecording."""
    import pyarrow as pa  # here: tables in HDF5 do not need it
    from pyarrow import compute

    column = table[name]
    array = pa.concat_arrays(column.chunks) if column.num_chunks else pa.array([], column.type)
    if isinstance(array, pa.ExtensionArray):
        array = array.storage
    missing = array.null_count
    while pa.types.is_list(array.type) or pa.types.is_large_list(array.type) or pa.types.is_fixed_size_list(array.type):
        if not pa.types.is_fixed_size_list(array.type):
            least, most = compute.min_max(compute.list_value_length(array)).as_py().values()
            if least != most:
                raise DamagedRecording(
                    f"{place}: {name}: found lists of {least} up to {count_text(most, 'value')}, expected one length"
                )
        array = array.flatten()
        missing += array.null_count
    if not (pa.types.is_floating(array.type) or pa.types.is_integer(array.type) or pa.types.is_boolean(array.type)):
        raise DamagedRecording(f"{place}: {name}: found {array.type}, expected numbers")
    if missing or len(array) != table.num_rows * width:
        found = f"{count_text(len(array) - missing, 'number')} in {count_text(table.num_rows, 'row')}"
        raise DamagedRecording(f"{place}: {name}: found {found}, expected {width} in each")
    return np.asarray(array.to_numpy(zero_copy_only=False)).reshape(table.num_rows, width)


def joint_messages(
    names: tuple[str, ...], position: Array, times: Times, velocity: Array | None = None, effort: Array | None = None
) -> Iterator[Buffer]:
    """Yield the JointState of each row at its time: positions (N, K), and velocities and efforts (N, K) or (N, 0)."""
    parts = [np.empty((len(position), 0)) if each is None else each for each in (position, velocity, effort)]
    first = JointState(Header(0, ""), names, *(np.zeros(each.shape[1]) for each in parts)).pack()
    # CDR: the length of a sequence, and its numbers at a multiple of 8 bytes behind the head
    pieces, at = list[tuple[int, Array]](), len(JointState(Header(0, ""), names).pack()) - 12
    for each in parts:
        at += 4
        if each.shape[1]:
            at = 4 + -(-(at - 4) // 8) * 8
            pieces.append((at, np.ascontiguousarray(each, "<f8")))
            at += 8 * each.shape[1]
    return _copies(first, pieces, times)


def are_poses(values: Array) -> Array:
    """Return which rows (N, 7), m and quaternion, have a position and a rotation (N,)."""
    with np.errstate(invalid="ignore", over="ignore"):
        unit = np.abs(np.linalg.norm(values[:, 3:], axis=1) - 1) <= _UNIT
    return np.asarray(np.isfinite(values).all(axis=1) & unit)


def pose_messages(values: Array, times: Times, frame: str) -> Iterator[Buffer | None]:
    """Yield the PoseStamped of each row (N, 7), m and quaternion, at its time; None without a rotation."""
    good = are_poses(values)
    first = PoseStamped(Header(0, frame), (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)).pack()
    packed = _copies(first, [(len(first) - 56, np.ascontiguousarray(values, "<f8"))], times)
    return (each if is_good else None for each, is_good in zip(packed, good.tolist(), strict=True))


def array_messages(shape: Sequence[int], labels: Sequence[str], dtype: str, values: Array) -> Iterator[Buffer | None]:
    """Yield the array of std_msgs of each row (N, K); None for one with an integer that a float64 does not have."""
    number = NUMBERS[dtype]
    good: Array = np.ones(len(values), bool)
    if number == "f8" and values.dtype.kind in "iu":
        least = -_EXACT if values.dtype.kind == "i" else 0
        good = np.all((values >= least) & (values <= _EXACT), axis=1)
    dims = tuple(
        MultiArrayDimension(label, size, prod(shape[axis:]))
        for axis, (label, size) in enumerate(zip(labels, shape, strict=True))
    )
    data = np.ascontiguousarray(values, f"<{number}")
    first = MULTI_ARRAYS[number](MultiArrayLayout(dims), np.zeros(prod(shape), number)).pack()
    packed = _copies(first, [(len(first) - data.itemsize * prod(shape), data)], None)
    return (each if is_good else None for each, is_good in zip(packed, good.tolist(), strict=True))


def still_messages(column: pa.ChunkedArray, times: Times, frame: str, place: str) -> Iterator[Buffer]:
    """Yield the CompressedImage of each encoded picture of a column.  Raises DamagedRecording."""
    import pyarrow as pa

    if not pa.types.is_struct(column.type) or column.type.get_field_index("bytes") < 0:
        raise DamagedRecording(f"{place}: found {column.type}, expected encoded pictures")
    cells = (cell for chunk in column.chunks for cell in chunk.field("bytes"))
    for row, (cell, time_ns) in enumerate(zip(cells, times.tolist(), strict=True)):
        data = cell.as_py() or b""
        form = next((name for start, name in _STILLS.items() if data.startswith(start)), "")
        if not form:
            found = f"{data[:4]!r}" if data else "no bytes"
            raise DamagedRecording(f"{place}: row {row}: found {found}, expected PNG, JPEG or TIFF in the table")
        yield CompressedImage(Header(time_ns, frame), form, data).pack()


def _copies(first: bytes, pieces: Sequence[tuple[int, Array]], times: Times | None) -> Iterator[Buffer]:
    """Yield the bytes of a message with the numbers (N, K) of each piece from its place on, and with its stamp."""
    many, count = max(_BLOCK // len(first), 1), len(pieces[0][1])
    for begin in range(0, count, many):
        rows = np.tile(np.frombuffer(first, np.uint8), (min(many, count - begin), 1))
        for at, values in pieces:
            raw = values[begin : begin + many].view(np.uint8).reshape(len(rows), -1)
            rows[:, at : at + raw.shape[1]] = raw
        if times is not None:
            own = times[begin : begin + many]
            stamps = np.stack([own // NS_PER_S, own % NS_PER_S], axis=1).astype("<u4")
            rows[:, 4:12] = stamps.view(np.uint8)
        yield from (row.data for row in rows)
