"""Rows of one entity as columns for rerun: poses, numbers, sizes and lines."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import rerun as rr

from igtl_gateway.addons.view.arrays import ColumnOf, array_of, component, each_of, lists_of, vector_type, vectors_of

Array = npt.NDArray[Any]

#: Number of rows of one entity that are collected before they are sent; of lines, which are long.
_ROWS, _LINES = 4096, 64
_LINE_POINTS = 1.5  # half the width of a line in points of the screen

_TRANSLATION, _QUATERNION = vector_type(pa.float32(), 3), vector_type(pa.float32(), 4)
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
        columns: makes columns for rerun from the looks (all but the numbers), the look of each row, and the numbers.
    """

    most: int
    dtype: str
    columns: Callable[[Sequence[Any], Array, Any], list[ColumnOf]]


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

    def take(self, gaps: Callable[[Array], list[int]] | None = None) -> list[tuple[Rows, list[ColumnOf]]]:
        """Return all rows, and forget them: chunks of rows that have the same time lines.

        Args:
            gaps: returns which of some gateway times, ascending, come after a gap: it gets a row without numbers.
        """
        self._close()
        looks, rows, look, numbers = list(self.looks), *self._joined()
        if gaps and rows.stamps.all():
            order = np.argsort(rows.numbers, kind="stable")  # those of one form came first
            if found := gaps(rows.stamps[order]):
                order = np.insert(order, found, order[found])
                numbers = numbers[order]
                numbers[np.array(found) + np.arange(len(found))] = np.nan
                rows, look = rows.where(order), look[order]
        self.count = 0
        self.looks.clear()
        self.parts.clear()
        groups = (rows.stamps > 0) * 2 + (rows.sources > 0)
        if (groups == groups[0]).all():
            parts = [slice(begin, begin + self.kind.most) for begin in range(0, len(rows), self.kind.most)]
            return [(rows.where(part), self.kind.columns(looks, look[part], numbers[part])) for part in parts]
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
    return ColumnOf(line, array_of(pa.int64() if is_number else pa.timestamp("ns"), stamps))


_TRANSLATIONS = component("Transform3D", "translation", "Translation3D")
_ROTATIONS = component("Transform3D", "quaternion", "RotationQuat")
_PARENTS = component("Transform3D", "parent_frame", "TransformFrameId")
_CHILDREN = component("Transform3D", "child_frame", "TransformFrameId")
_AXES = component("TransformAxes3D", "axis_length", "AxisLength")
_SHOWN = component("TransformAxes3D", "show_frame", "ShowLabels")
_FRAMES = component("CoordinateFrame", "frame", "TransformFrameId")
_SCALARS = component("Scalars", "scalars", "Scalar")
_STRIPS = component("LineStrips3D", "strips", "LineStrip3D")
_COLOURS = component("LineStrips3D", "colors", "Color")
_RADII = component("LineStrips3D", "radii", "Radius")
_BYTES = rr.ComponentDescriptor("bytes")


def _column(name: rr.ComponentDescriptor, values: pa.Array, each: int = 1) -> ColumnOf:
    """A component with ``each`` values in a row."""
    offsets = np.arange(0, len(values) + 1, each, dtype=np.int32)
    return ColumnOf(name, lists_of(values, offsets))


def _pose_columns(looks: Sequence[tuple[str, str, float, bool]], look: Array, numbers: Array) -> list[ColumnOf]:
    parents, children, lengths, labelled = zip(*looks, strict=True)
    shown = [bool(child) and label for child, label in zip(children, labelled, strict=True)]
    columns = [
        _column(_TRANSLATIONS, vectors_of(_TRANSLATION, numbers[:, :3])),
        _column(_ROTATIONS, vectors_of(_QUATERNION, numbers[:, 3:])),
        _column(_PARENTS, each_of(pa.utf8(), parents, look)),
        _column(_AXES, each_of(pa.float32(), lengths, look)),
        _column(_SHOWN, each_of(pa.bool_(), shown, look)),
    ]
    if children[0]:
        names = each_of(pa.utf8(), children, look)
        columns += [_column(_CHILDREN, names), _column(_FRAMES, names)]
    return columns


def _number_columns(_looks: Sequence[Any], _look: Array, numbers: Array) -> list[ColumnOf]:
    return [_column(_SCALARS, array_of(pa.float64(), numbers.reshape(-1)), numbers.shape[1])]


def _size_columns(_looks: Sequence[Any], _look: Array, numbers: Array) -> list[ColumnOf]:
    return [_column(_BYTES, array_of(pa.int64(), numbers.reshape(-1)))]


def _line_columns(looks: Sequence[tuple[str, int]], look: Array, lines: Sequence[Array]) -> list[ColumnOf]:
    frames, colours = zip(*looks, strict=True)
    offsets = np.cumsum([0, *map(len, lines)], dtype=np.int32)
    points = vectors_of(_TRANSLATION, np.concatenate(lines))
    radius = float(rr.Radius.ui_points(_LINE_POINTS))
    return [
        _column(_FRAMES, each_of(pa.utf8(), frames, look)),
        _column(_STRIPS, lists_of(points, offsets, _LINE)),
        _column(_COLOURS, each_of(pa.uint32(), colours, look)),
        _column(_RADII, each_of(pa.float32(), [radius], look)),
    ]


POSES = RowKind(_ROWS, "f4", _pose_columns)
NUMBERS, SIZES = RowKind(_ROWS, "f8", _number_columns), RowKind(_ROWS, "i8", _size_columns)
LINES = RowKind(_LINES, "", _line_columns)
