"""The values of the messages of a stream, as a row of the recipe has them: numbers, poses, strings or pictures.

Lengths are in metres and angles of poses in radians.  A table is made of a stream once, because that takes longest.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from igtl_gateway.addon import ConfigError, one_of
from igtl_gateway.addon.reading import Stream
from igtl_gateway.addon.streams import NAME_FIELDS, by_name, completed, quaternions_of
from igtl_gateway.addon.terminal import count_text, counted
from igtl_gateway.addons.lerobot.pictures import Pictures, has_pictures
from igtl_gateway.addons.lerobot.recipe import Feature
from igtl_gateway.addons.sync.lags import POSES_BY_NAME

Array = npt.NDArray[Any]
Times = npt.NDArray[np.int64]

#: Units of columns → the unit in the data set, and the factor.
_UNITS = {"um": ("m", 1e-6), "mm": ("m", 1e-3), "cm": ("m", 1e-2), "dm": ("m", 1e-1), "deg": ("rad", np.pi / 180)}
JOINTS, POSITION = "sensor_msgs/msg/JointState", "position"
_TEXTS = {"STRING": "string", "std_msgs/msg/String": "data"}
_AXES = ("x", "y", "z")
_ORIENTATION_NAMES = {
    "quaternion": ("qx", "qy", "qz", "qw"),
    "rotation_vector": ("rx", "ry", "rz"),
    "rotation_6d": ("r11", "r21", "r31", "r12", "r22", "r32"),
    "none": (),
}
#: Numbers of a row of the recipe in a frame: an arm has ten, and a hundred sensors have a thousand.
MAX_NUMBERS = 4096
#: Columns of a table that are not numbers of the message.
_HEADS = ("entry", "time_ns", "source_ns")
#: End of the names of columns with ns since 1970.
_STAMP = "stamp_ns"


@dataclass(frozen=True, slots=True, eq=False)
class Recorded:
    """The numbers of all messages, without those of other messages.

    Attributes:
        rows: (M,) indices of the messages that can be read.
        numbers: (M, K) float64; NaN: the message does not have the number.
    """

    rows: Times
    numbers: Array


@dataclass(frozen=True, slots=True, eq=False)
class Values:
    """The values of the messages of a row.

    Attributes:
        kind: ``"pose"``, ``"numbers"``, ``"text"`` or ``"picture"``.
        rows: (N,) indices of the messages that have a value.
        values: (N, 4, 4) poses in m; (N, K) numbers; N strings; (N,) indices of pictures.
        names: names of the numbers.
        units: of the columns in the data set, and those in the messages of SENSOR, whose numbers keep them.
        pictures: the pictures.
        recorded: all messages, for rows with ``native``.
    """

    kind: str
    rows: Times
    values: Any
    names: tuple[str, ...] = ()
    units: tuple[str, ...] = ()
    pictures: Pictures | None = None
    recorded: Recorded | None = None


def read_values(stream: Stream, row: Feature) -> Values:
    """Return the values of the messages of a row.  Raises ConfigError for a row that does not fit the stream."""
    stream.check_sender()
    if row.is_picture:
        pictures = Pictures(stream, row.window, row.depth_mm)
        return Values("picture", pictures.usable, pictures.usable, pictures=pictures)
    if has_pictures(stream):
        raise ConfigError(f"found pictures in {stream.key}, expected the name {row.name!r} to be observation.images.…")
    if not row.fields and stream.type not in _TEXTS:
        return _poses(stream, row)
    return _columns(stream, row.fields or (_TEXTS[stream.type],), row)


def orientation(poses: Array, form: str) -> Array:
    """Return the rotations of poses (N, 4, 4) as (N, K): a quaternion x, y, z, w with w ≥ 0, or another form."""
    if form == "none":
        return np.zeros((len(poses), 0))
    if form == "rotation_6d":
        return np.concatenate([poses[:, :3, 0], poses[:, :3, 1]], axis=1)
    quaternions = np.asarray(quaternions_of(poses)[0])
    if form == "quaternion":
        return quaternions
    sines = np.linalg.norm(quaternions[:, :3], axis=1)
    angles = 2 * np.arctan2(sines, quaternions[:, 3])
    return np.asarray(quaternions[:, :3] * np.where(sines > 1e-12, angles / np.maximum(sines, 1e-12), 2.0)[:, None])


def _poses(stream: Stream, row: Feature) -> Values:
    try:
        poses = stream.poses(row.frame).in_unit("m")
    except ConfigError as error:
        if stream.type in POSES_BY_NAME:
            raise
        raise ConfigError(f"{error}; or fields = […] of {', '.join(columns_of(stream)) or 'no column'}") from None
    numbers = np.concatenate([poses.matrices.reshape(-1, 16), poses.quaternions], axis=1)
    good = _finite_float32(numbers)
    names = _AXES + _ORIENTATION_NAMES[row.orientation]
    recorded = Recorded(poses.rows, _pose_numbers(poses.matrices, row)) if row.native else None
    return Values("pose", poses.rows[good], poses.matrices[good], names, recorded=recorded)


def _pose_numbers(matrices: Array, row: Feature) -> Array:
    """The numbers (M, K) of poses (M, 4, 4); without a rotation that is finite, NaN in its place."""
    turns = np.full((len(matrices), len(_ORIENTATION_NAMES[row.orientation])), np.nan)
    good = np.isfinite(matrices).all(axis=(1, 2))
    turns[good] = orientation(matrices[good], row.orientation)
    return np.concatenate([matrices[:, :3, 3], turns], axis=1)


def columns_of(stream: Stream) -> list[str]:
    """Return the names of the columns with numbers or strings."""
    return _value_columns(stream.to_arrow())


def _value_columns(table: Any) -> list[str]:
    import pyarrow as pa

    def is_value(kind: Any) -> bool:
        if pa.types.is_list(kind) or pa.types.is_fixed_size_list(kind):
            kind = kind.value_type
            return bool(pa.types.is_integer(kind) or pa.types.is_floating(kind))
        return bool(
            pa.types.is_integer(kind) or pa.types.is_floating(kind) or pa.types.is_boolean(kind)
            or pa.types.is_string(kind)
        )  # fmt: skip

    names = [each.name for each in table.schema if each.name not in _HEADS and is_value(each.type)]
    return [each for each in names if not each.endswith(_STAMP)]


def _check_lengths(table: Any, fields: Sequence[str]) -> None:
    """Raise ConfigError for lists with more numbers than a frame may have, before they are read."""
    import pyarrow as pa
    from pyarrow import compute

    for name in fields:
        if pa.types.is_list(table[name].type) or pa.types.is_large_list(table[name].type):
            longest = compute.max(compute.list_value_length(table[name])).as_py() or 0
            if longest > MAX_NUMBERS:
                raise ConfigError(
                    f"fields: found {count_text(longest, 'number')} in {name}, expected at most {MAX_NUMBERS:,}"
                )


def _columns(stream: Stream, fields: Sequence[str], row: Feature) -> Values:
    """The numbers in columns of the table of the stream, or the text in one."""
    import pyarrow as pa

    table, rows = stream.arrow_and_rows()
    known = _value_columns(table)
    for name in fields:
        if name.endswith(_STAMP):
            raise ConfigError(
                f"fields: found {name!r}, of which float32 keeps steps of minutes, expected another column; "
                "stamps = true in [dataset] has stamps"
            )
        if name not in known:
            raise ConfigError(f"fields: found {name!r}, expected columns of {stream.key}, {one_of(name, known)}")
    _check_lengths(table, fields)
    if any(pa.types.is_string(table[name].type) for name in fields):
        if len(fields) > 1:
            raise ConfigError(f"fields: found {counted(len(fields), 'column')} with a string, expected one")
        texts = table[fields[0]].to_pylist()
        good = np.array([each is not None for each in texts], bool)
        units = _units(table, row.fields, stream) if row.fields else ()
        return Values("text", rows[good], [each for each in texts if each is not None], (fields[0],), units)
    found, names = _numbers(table, rows, stream, fields, row)
    good = _finite_float32(found)
    recorded = Recorded(rows, _numbers(table, rows, stream, fields, row, as_recorded=True)[0]) if row.native else None
    return Values("numbers", rows[good], found[good], names, _units(table, fields, stream), recorded=recorded)


def _units(table: Any, fields: Sequence[str], stream: Stream) -> tuple[str, ...]:
    found = [(table.schema.field(name).metadata or {}).get(b"unit", b"").decode() for name in fields]
    units = [_UNITS.get(each, (each, 1.0))[0] for each in found]
    if stream.type == "SENSOR":
        units += sorted({each for each in table["unit"].to_pylist() if each is not None})
    return tuple(units)


def _numbers(
    table: Any, rows: Times, stream: Stream, fields: Sequence[str], row: Feature, *, as_recorded: bool = False
) -> tuple[Array, tuple[str, ...]]:
    """The numbers (M, K) of all messages in a table, and their names; ``as_recorded``: none of another message."""
    blocks, names = [], []
    for name in fields:
        unit = (table.schema.field(name).metadata or {}).get(b"unit", b"").decode()
        wanted, factor = _UNITS.get(unit, (unit, 1.0))
        values = table[name].to_pylist()
        shown = f"{name.removesuffix(f'_{unit}')}_{wanted}" if unit and name.endswith(f"_{unit}") else name
        size = next((len(each) for each in values if isinstance(each, list) and each), 0)
        if size and (named := _by_name(table, values, stream, rows, row, name, as_recorded)):
            blocks.append(named[1] * factor)
            names += [f"{joint}.{shown}" for joint in named[0]]
        elif any(isinstance(each, list) for each in values):
            blocks.append(np.array([_row(each, size) for each in values]).reshape(len(values), size) * factor)
            names += [f"{shown}_{number}" for number in range(size)]
        else:
            blocks.append(np.array([np.nan if each is None else float(each) for each in values])[:, None] * factor)
            names.append(shown)
    found = np.concatenate(blocks, axis=1)
    if not found.shape[1]:
        raise ConfigError(f"fields: found no number in {', '.join(fields)} of {stream.key}, expected one or more")
    return found, tuple(names)


def _finite_float32(values: Array) -> npt.NDArray[np.bool_]:
    """The rows of which float32 holds every number: others have no value."""
    with np.errstate(over="ignore"):
        return np.asarray(np.isfinite(values.astype(np.float32)).all(axis=1))


def _row(values: Any, size: int) -> list[float]:
    if values is None or len(values) != size or any(each is None for each in values):
        return [float("nan")] * size
    return [float(each) for each in values]


def _by_name(
    table: Any, values: list[Any], stream: Stream, rows: Times, row: Feature, column: str, as_recorded: bool
) -> tuple[tuple[str, ...], Array] | None:
    """The names of the joints and their values (N, K), of messages with any of them in any order; None without names.

    A message that does not have a joint has the value by the rule of the row, within its tolerance: so the last value
    of each joint, or the one between two, is exact at the times of all messages.  ``as_recorded``: it has NaN.
    """
    field = next((each for each in NAME_FIELDS if each in table.schema.names), "")
    lists = table[field].to_pylist() if field else []
    if not any(isinstance(each, list) and each and isinstance(each[0], str) for each in lists):
        return None
    found = by_name(lists, values)
    if found is None:
        return None
    if len(found.names) > MAX_NUMBERS:
        raise ConfigError(f"fields: found {count_text(len(found.names), 'name')}, expected at most {MAX_NUMBERS:,}")
    names = tuple(each if each.isprintable() else repr(each) for each in found.names)
    if as_recorded:
        return names, found.values
    sources = stream.stamps[rows]
    times = sources if np.all(sources > 0) else stream.times[rows]
    most_ns = (1 << 62) - 1 if row.tolerance_ms is None else round(row.tolerance_ms * 1e6)
    half_turn = np.pi if (stream.type, column) == (JOINTS, POSITION) else np.inf
    return names, completed(found, times, row.rule or "hold", most_ns, half_turn)
