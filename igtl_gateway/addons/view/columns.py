"""Rows of one entity as columns for rerun: poses, numbers, sizes and lines.

The arrays are those that ``rerun.X.columns`` makes, made of the buffers of numpy: rerun's own way converts and checks
them for as long as it takes to send them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import rerun as rr

Array = npt.NDArray[Any]

#: Number of rows of one entity that are collected before they are sent; of lines, which are long.
_ROWS, _LINES = 4096, 64
_LINE_POINTS = 1.5  # half the width of a line in points of the screen

_TRANSLATION = pa.list_(pa.field("item", pa.float32(), nullable=False), 3)
_QUATERNION = pa.list_(pa.field("item", pa.float32(), nullable=False), 4)
_LINE = pa.list_(pa.field("item", _TRANSLATION, nullable=False))


@dataclass(frozen=True, slots=True)
class Rows:
    """The times of many messages, one element each, int64: entry number, gateway time, source stamp (0 = unset)."""

    numbers: Array
    stamps: Array
    sources: Array

    def __len__(self) -> int:
        return len(self.numbers)

    def where(self, rows: Array | slice) -> Rows:
        """The times of some of them."""
        return Rows(self.numbers[rows], self.stamps[rows], self.sources[rows])


@dataclass(frozen=True, slots=True)
class RowKind:
    """What rows of one entity have.

    Attributes:
        most: number of rows that are collected.
        dtype: of their numbers; "" for arrays of different lengths.
        columns: makes columns for rerun of looks (what is not a number), the look of each row, and numbers.
    """

    most: int
    dtype: str
    columns: Callable[[Sequence[Any], Array, Any], list[ColumnOf]]


@dataclass(frozen=True, slots=True)
class ColumnOf:
    """A column of times or of a component, as rerun asks for it."""

    name: Any
    values: pa.Array

    def timeline_name(self) -> str:
        """Of times: the time line."""
        return str(self.name)

    def component_descriptor(self) -> Any:
        """Of a component: what it is."""
        return self.name

    def as_arrow_array(self) -> pa.Array:
        """The values of all rows."""
        return self.values


@dataclass(slots=True)
class Collected:
    """Collected rows of one entity: single ones (number, stamp, source, look, numbers), and many at once."""

    kind: RowKind
    count: int = 0
    looks: dict[Any, int] = field(default_factory=dict)
    single: list[tuple[int, int, int, int, Any]] = field(default_factory=list)
    parts: list[tuple[Rows, Array, Any]] = field(default_factory=list)

    def add(self, times: tuple[int, int, int], look: Any, numbers: Any) -> None:
        """Add a row."""
        self.single.append((*times, self.looks.setdefault(look, len(self.looks)), numbers))
        self.count += 1

    def add_rows(self, rows: Rows, look: Any, table: Array) -> None:
        """Add many rows: a table (rows, numbers)."""
        self._close()
        self.parts.append((rows, np.full(len(rows), self.looks.setdefault(look, len(self.looks)), np.int32), table))
        self.count += len(rows)

    def take(self) -> list[tuple[Rows, list[ColumnOf]]]:
        """Return all rows, and forget them: chunks of rows that have the same time lines."""
        self._close()
        looks, rows, look, numbers = list(self.looks), *self._joined()
        self.count = 0
        self.looks.clear()
        self.parts.clear()
        groups = (rows.stamps > 0) * 2 + (rows.sources > 0)
        if (groups == groups[0]).all():
            return [(rows, self.kind.columns(looks, look, numbers))]
        chunks = []
        for group in np.unique(groups):
            places = np.flatnonzero(groups == group)
            some = numbers[places] if self.kind.dtype else [numbers[place] for place in places]
            chunks.append((rows.where(places), self.kind.columns(looks, look[places], some)))
        return chunks

    def _joined(self) -> tuple[Rows, Array, Any]:
        if len(self.parts) == 1:
            return self.parts[0]
        rows, looks, numbers = zip(*self.parts, strict=True)
        times = [np.concatenate([getattr(each, name) for each in rows]) for name in ("numbers", "stamps", "sources")]
        joined = np.concatenate(numbers) if self.kind.dtype else [each for part in numbers for each in part]
        return Rows(*times), np.concatenate(looks), joined

    def _close(self) -> None:
        """Make a part of the single rows."""
        if self.single:
            *times, looks, numbers = zip(*self.single, strict=True)
            table = np.array(numbers, self.kind.dtype) if self.kind.dtype else numbers
            rows = Rows(*(np.array(each, np.int64) for each in times))
            self.parts.append((rows, np.array(looks, np.int32), table))
            self.single.clear()


def times_of(line: str, stamps: Array, *, is_number: bool = False) -> ColumnOf:
    """The column of a time line: (n,) UTC ns, or numbers."""
    return ColumnOf(line, _array(pa.int64() if is_number else pa.timestamp("ns"), stamps))


def _component(archetype: str, name: str, kind: str) -> rr.ComponentDescriptor:
    return rr.ComponentDescriptor(
        f"{archetype}:{name}", archetype=f"rerun.archetypes.{archetype}", component_type=f"rerun.components.{kind}"
    )


_TRANSLATIONS = _component("Transform3D", "translation", "Translation3D")
_ROTATIONS = _component("Transform3D", "quaternion", "RotationQuat")
_PARENTS = _component("Transform3D", "parent_frame", "TransformFrameId")
_CHILDREN = _component("Transform3D", "child_frame", "TransformFrameId")
_AXES = _component("TransformAxes3D", "axis_length", "AxisLength")
_SHOWN = _component("TransformAxes3D", "show_frame", "ShowLabels")
_FRAMES = _component("CoordinateFrame", "frame", "TransformFrameId")
_SCALARS = _component("Scalars", "scalars", "Scalar")
_STRIPS = _component("LineStrips3D", "strips", "LineStrip3D")
_COLOURS = _component("LineStrips3D", "colors", "Color")
_RADII = _component("LineStrips3D", "radii", "Radius")
_BYTES = rr.ComponentDescriptor("bytes")


def _array(kind: pa.DataType, values: Array) -> pa.Array:
    """Numbers of this type as an array of Arrow, which has their buffer."""
    return pa.Array.from_buffers(kind, len(values), [None, pa.py_buffer(np.ascontiguousarray(values))])


def _vectors(kind: pa.DataType, values: Array) -> pa.Array:
    """Rows (n, k) of float32 as vectors."""
    return pa.FixedSizeListArray.from_arrays(_array(pa.float32(), values.reshape(-1)), type=kind)


def _each(kind: pa.DataType, values: Sequence[Any], looks: Array) -> pa.Array:
    """The value of each row, of which there is one for each look."""
    count = len(looks)
    if len({*values}) > 1:
        return pa.array(values, kind).take(_array(pa.int32(), looks))
    (value,) = {*values}
    if pa.types.is_string(kind):
        text = value.encode()
        offsets = np.arange(count + 1, dtype=np.int32) * np.int32(len(text))
        return pa.Array.from_buffers(kind, count, [None, pa.py_buffer(offsets), pa.py_buffer(text * count)])
    if pa.types.is_boolean(kind):
        bits = (b"\xff" if value else b"\0") * (count // 8 + 1)
        return pa.Array.from_buffers(kind, count, [None, pa.py_buffer(bits)])
    return _array(kind, np.full(count, value, kind.to_pandas_dtype()))


def _column(name: rr.ComponentDescriptor, values: pa.Array, each: int = 1) -> ColumnOf:
    """A component with ``each`` values in a row."""
    offsets = np.arange(0, len(values) + 1, each, dtype=np.int32)
    return ColumnOf(name, pa.ListArray.from_arrays(_array(pa.int32(), offsets), values))


def _pose_columns(looks: Sequence[tuple[str, str, float, bool]], look: Array, numbers: Array) -> list[ColumnOf]:
    parents, children, lengths, labelled = zip(*looks, strict=True)
    shown = [bool(child) and label for child, label in zip(children, labelled, strict=True)]
    columns = [
        _column(_TRANSLATIONS, _vectors(_TRANSLATION, numbers[:, :3])),
        _column(_ROTATIONS, _vectors(_QUATERNION, numbers[:, 3:])),
        _column(_PARENTS, _each(pa.utf8(), parents, look)),
        _column(_AXES, _each(pa.float32(), lengths, look)),
        _column(_SHOWN, _each(pa.bool_(), shown, look)),
    ]
    if children[0]:
        names = _each(pa.utf8(), children, look)
        columns += [_column(_CHILDREN, names), _column(_FRAMES, names)]
    return columns


def _number_columns(_looks: Sequence[Any], _look: Array, numbers: Array) -> list[ColumnOf]:
    return [_column(_SCALARS, _array(pa.float64(), numbers.reshape(-1)), numbers.shape[1])]


def _size_columns(_looks: Sequence[Any], _look: Array, numbers: Array) -> list[ColumnOf]:
    return [_column(_BYTES, _array(pa.int64(), numbers.reshape(-1)))]


def _line_columns(looks: Sequence[tuple[str, int]], look: Array, lines: Sequence[Array]) -> list[ColumnOf]:
    frames, colours = zip(*looks, strict=True)
    offsets = np.cumsum([0, *map(len, lines)], dtype=np.int32)
    points = _vectors(_TRANSLATION, np.concatenate(lines))
    radius = float(rr.Radius.ui_points(_LINE_POINTS))
    return [
        _column(_FRAMES, _each(pa.utf8(), frames, look)),
        _column(_STRIPS, pa.ListArray.from_arrays(_array(pa.int32(), offsets), points, type=_LINE)),
        _column(_COLOURS, _each(pa.uint32(), colours, look)),
        _column(_RADII, _each(pa.float32(), [radius], look)),
    ]


POSES = RowKind(_ROWS, "f4", _pose_columns)
NUMBERS, SIZES = RowKind(_ROWS, "f8", _number_columns), RowKind(_ROWS, "i8", _size_columns)
LINES = RowKind(_LINES, "", _line_columns)
