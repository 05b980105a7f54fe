"""POLYDATA: points, cells and attributes of a surface or a cloud (``Protocol/polydata.md``).

Content: a head of ten u32 (points; then number and byte size of vertices, lines, polygons, strips; then the
number of attributes), points as 3 × float32, four cell arrays (per cell u32 count and that many u32 indices),
attribute heads (u8 type, u8 components, u32 tuples), attribute names (NUL-terminated, together padded to an
even size), attribute data as float32.

The document packs type and components into one u16; on the wire the type byte comes first.  The reference
library writes nine components for every attribute type but 0x00 … 0x02: ``Attribute.values`` undoes that.  Its reader
takes nine floats a tuple for these types, whatever the head has, and the number of cell scalars from the head.
"""

from __future__ import annotations

import struct
from array import array
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from struct import Struct
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt

from igtl_gateway.base.buffers import Buffer, join
from igtl_gateway.base.errors import MalformedBody, TruncatedMessage
from igtl_gateway.base.quantities import counted
from igtl_gateway.base.versions import Self
from igtl_gateway.wire.fields import decode_text, visible
from igtl_gateway.wire.layout import Field, Layout, compile_struct
from igtl_gateway.wire.traits import Traits

U4 = np.dtype(">u4")
F4 = np.dtype(">f4")

#: Attribute types; 0x10 is added for attributes of cells instead of points.
SCALAR, VECTOR, NORMAL, TENSOR, RGBA, TCOORDS = range(6)
CELL = 0x10

#: Real components of the types that the reference library pads to nine.
_PADDED = {RGBA: 4, TCOORDS: 3, CELL | SCALAR: 1, CELL | VECTOR: 3, CELL | NORMAL: 3, CELL | RGBA: 4, CELL | TCOORDS: 3}
_PADDED_TO = 9

MAX_ATTRIBUTE_NAME = 255
MAX_COMPONENTS = 255

#: Each costs a few microseconds to read, whatever it holds; real files have a dozen.
MAX_ATTRIBUTES = 256


@dataclass(frozen=True, slots=True)
class Cells:
    """A cell array.

    Attributes:
        count: number of cells.
        data: flat u32: per cell its number of indices, then the indices (0-based, into the points).
    """

    count: int
    data: npt.NDArray[Any]

    @classmethod
    def unpack(cls, place: str, count: int, content: memoryview, num_points: int) -> Self:
        """From ``content``; every count and index is checked.  Raises MalformedBody."""
        if content.nbytes % U4.itemsize:
            raise MalformedBody(place, counted(content.nbytes, "byte"), "a multiple of 4")
        data = np.frombuffer(content, U4)
        cells = cls(count, data)
        if not count and not len(data):
            return cells
        if (table := cells.table) is not None:
            indices = table
        else:
            inside = np.ones(len(data), bool)
            inside[cells.starts(place)] = False
            indices = data[inside]
        if indices.size and (highest := int(indices.max())) >= num_points:
            raise MalformedBody(place, f"point index {highest}", f"below {num_points}, the number of points")
        return cells

    @property
    def table(self) -> npt.NDArray[Any] | None:
        """(count, width) indices where all cells have the same number of them, else None: a view on ``data``."""
        width = self.width
        return None if width is None else self.data.reshape(self.count, width + 1)[:, 1:]

    @property
    def width(self) -> int | None:
        """Indices per cell where all cells have the same number of them, else None."""
        if not self.count or len(self.data) % self.count:
            return None
        width = len(self.data) // self.count
        if not width:
            return None
        # equal is equal in any byte order, and in the machine's own it is found several times as fast
        words, wanted = np.asarray(self.data, U4).view(np.uint32), np.array(width - 1, U4).view(np.uint32)
        return width - 1 if bool((words.reshape(self.count, width)[:, 0] == wanted).all()) else None

    def starts(self, place: str = "cells") -> npt.NDArray[np.int64]:
        """Where each cell's count stands in ``data``.  Raises MalformedBody if the cells do not fill the data."""
        if (width := self.width) is not None:
            return np.arange(0, len(self.data), width + 1, dtype=np.int64)
        # a memoryview of native words: only the counts become Python numbers, not every index
        starts, position, sizes = array("q"), 0, self.data.astype(np.uint32).data
        end = len(sizes)
        for _ in range(min(self.count, end + 1)):
            if position >= end:
                break
            starts.append(position)
            position += sizes[position] + 1
        if position != end or len(starts) != self.count:
            raise MalformedBody(
                place,
                f"{counted(len(starts), 'cell')} in {counted(4 * position, 'byte')}",
                f"{counted(self.count, 'cell')} in {counted(4 * end, 'byte')}",
            )
        return np.array(starts, np.int64)

    @classmethod
    def of(cls, cells: npt.NDArray[Any] | Sequence[Sequence[int]]) -> Self:
        """From an (n, k) index array, or from lists of indices of any length."""
        if isinstance(cells, np.ndarray) and cells.ndim == 2:
            data = np.empty((cells.shape[0], cells.shape[1] + 1), U4)
            data[:, 0] = cells.shape[1]
            if len(cells) > cells.shape[1]:  # column by column where these are the longer ones: twice as fast
                for column, indices in enumerate(cells.T, start=1):
                    data[:, column] = indices
            else:
                data[:, 1:] = cells
            return cls(len(cells), data.reshape(-1))
        flat = [value for cell in cells for value in (len(cell), *cell)]
        return cls(len(cells), np.array(flat, U4))

    @classmethod
    def of_all(cls, num_points: int) -> Self:
        """One cell of all points, in their order; its array is not to be changed, for others have it too."""
        return cls(1, (_shared if num_points <= _SHARED else _all_points)(num_points))

    def is_all(self, num_points: int) -> bool:
        """Whether they are what ``of_all`` gives."""
        # equal is equal in any byte order, and in the machine's own it is found four times as fast
        return (
            self.count == 1
            and len(self.data) == num_points + 1
            and bool((np.asarray(self.data, U4).view(np.uint32) == self.of_all(num_points).data.view(np.uint32)).all())
        )

    def lists(self) -> list[list[int]]:
        """Every cell as a list of indices."""
        data = self.data.tolist()
        return [data[start + 1 : start + 1 + data[start]] for start in self.starts().tolist()]


#: Up to this number of points, the cell of all of them is cached for the next message: clouds of a sensor have few
#: different sizes.
_SHARED = 1 << 18


def _all_points(count: int) -> npt.NDArray[Any]:
    """``count``, then 0, 1, 2, …"""
    data = np.arange(-1, count, dtype=np.int32).astype(U4)
    data[0] = count
    data.flags.writeable = False
    return data


_shared = lru_cache(maxsize=8)(_all_points)

NO_CELLS = Cells(0, np.empty(0, U4))


@dataclass(frozen=True, slots=True)
class Attribute:
    """A value per point or per cell.

    Attributes:
        type: SCALAR … TCOORDS, + CELL.
        name: at most 255 bytes.
        components: values per tuple, as written in the head.
        data: flat float32, tuples · components.
        is_padded: whether the data have nine floats a tuple although ``components`` is another number: the values
            one after the other, then the rest, as the reader of the C++ library needs it.
    """

    type: int
    name: str
    components: int
    data: npt.NDArray[Any]
    is_padded: bool = False

    @property
    def tuples(self) -> int:
        """Number of points or cells that it covers."""
        components = _PADDED_TO if self.is_padded else self.components
        return len(self.data) // components if components else 0

    @property
    def values(self) -> npt.NDArray[Any]:
        """(tuples, real components) view: without the tail that the reference library appends."""
        real = self.components if self.is_padded else _PADDED.get(self.type, 0)
        if self.is_padded or (real and self.components == _PADDED_TO):
            return self.data[: self.tuples * real].reshape(self.tuples, real)
        return self.data.reshape(self.tuples, self.components)

    @property
    def may_have_more(self) -> bool:
        """Whether there may be more components than ``values`` has.

        The reference library writes nine of the scalars of cells, and the number of real ones nowhere.  What follows
        one a cell is either more of them, or what was in its memory.
        """
        is_unstated = self.type == CELL | SCALAR and self.components == _PADDED_TO and not self.is_padded
        return is_unstated and bool(self.data[self.tuples :].view(np.uint32).any())

    @classmethod
    def of(cls, kind: int, name: str, values: npt.NDArray[Any]) -> Self:
        """From an (n, components) array of at most 255 components."""
        return cls(kind, name, values.shape[1], np.ascontiguousarray(values, F4).reshape(-1))


@dataclass(frozen=True, slots=True, eq=False)
class PolyData:
    """POLYDATA: points, cells and attributes of a surface or a cloud.

    Two are equal if their bytes on the wire are.

    Accepted: attributes with nine components of which only the first are valid, as written by the reference library;
    nine floats a tuple whatever their head has, as it reads them.  Every count and index is checked.

    Sent: attributes as in the document, except to peers whose profile requires nine floats a tuple.

    Attributes:
        points: (n, 3) float32.  The document has no unit; every peer uses millimetres.
        vertices, lines, polygons, triangle_strips: per cell the number of its points, then their indices (from 0).
        attributes: values of points and cells.
        name_padding: the byte that makes the size of the attribute names even, if present.
    """

    PROTOCOL: ClassVar[str] = "2"
    TRAITS: ClassVar[Traits] = Traits(is_bulky=True)
    LAYOUT: ClassVar[Layout] = (
        Field("num_points", "u32", 1, "number of points"),
        Field("vertices_count", "u32", 1, "number of vertex cells"),
        Field("vertices_size", "u32", 1, "bytes of their cell array"),
        Field("lines_count", "u32", 1, "number of line cells"),
        Field("lines_size", "u32", 1, "bytes of their cell array"),
        Field("polygons_count", "u32", 1, "number of polygons"),
        Field("polygons_size", "u32", 1, "bytes of their cell array"),
        Field("strips_count", "u32", 1, "number of triangle strips"),
        Field("strips_size", "u32", 1, "bytes of their cell array"),
        Field("num_attributes", "u32", 1, "number of attributes, at most 256"),
        Field(
            "points",
            "f32",
            "3 · num_points",
            "x, y, z in millimetres; the document has no unit, every peer uses millimetres",
        ),
        Field("vertices", "u32", "vertices_size / 4"),
        Field("lines", "u32", "lines_size / 4"),
        Field("polygons", "u32", "polygons_size / 4"),
        Field("triangle_strips", "u32", "strips_size / 4"),
        Field(
            *("type", "u8", 1),
            "0 scalar, 1 vector, 2 normal, 3 tensor, 4 RGBA, 5 texture coordinates; + 16 for values of cells",
            "attribute",
        ),
        Field("components", "u8", 1, "values of one tuple", per="attribute"),
        Field("tuples", "u32", 1, "number of points or cells", per="attribute"),
        Field("names", "char", "to the last NUL", "names of all attributes, each at most 255 bytes and a NUL"),
        Field("name_padding", "u8", "0 or 1"),
        Field("data", "f32", "components · tuples", "tuple after tuple", per="attribute"),
    )
    _HEAD: ClassVar[Struct] = compile_struct(LAYOUT)
    _ATTRIBUTE: ClassVar[Struct] = compile_struct(LAYOUT, "attribute")

    points: npt.NDArray[Any]
    vertices: Cells = NO_CELLS
    lines: Cells = NO_CELLS
    polygons: Cells = NO_CELLS
    triangle_strips: Cells = NO_CELLS
    attributes: tuple[Attribute, ...] = ()
    name_padding: int = 0

    def __eq__(self, other: object) -> bool:
        return join(self.pack()) == join(other.pack()) if isinstance(other, PolyData) else NotImplemented

    # holds arrays that their owner may change: no key of a dict
    __hash__ = None  # type: ignore[assignment]

    @property
    def cells(self) -> tuple[Cells, Cells, Cells, Cells]:
        """The four cell arrays in wire order."""
        return self.vertices, self.lines, self.polygons, self.triangle_strips

    @classmethod
    def unpack(cls, content: memoryview) -> Self:
        take = _ContentReader(content)
        num_points, *sizes, num_attributes = cls._HEAD.unpack(take("head", cls._HEAD.size))
        points = np.frombuffer(take("points", 12 * num_points), F4).reshape(num_points, 3)
        vertices, lines, polygons, strips = (
            Cells.unpack(f"POLYDATA {name}", count, take(name, size), num_points)
            for name, count, size in zip(_SECTIONS, sizes[::2], sizes[1::2], strict=True)
        )
        if num_attributes > MAX_ATTRIBUTES:
            raise MalformedBody(
                "POLYDATA head, offset 36", counted(num_attributes, "attribute"), f"at most {MAX_ATTRIBUTES}"
            )
        heads = take("attribute heads", cls._ATTRIBUTE.size * num_attributes)
        names_size = 0
        names = []
        for index in range(num_attributes):
            names.append(take.until_nul(f"name of attribute {index}"))
            names_size += len(names[-1]) + 1
        padding = take("padding of the attribute names", 1)[0] if names_size % 2 else 0
        attributes = []
        table = list(cls._ATTRIBUTE.iter_unpack(heads))
        by_library = _has_size_of_library(table, take.left)
        for index, (kind, components, tuples) in enumerate(table):
            if tuples and not components:
                raise MalformedBody(
                    f"POLYDATA attribute {index}", f"{counted(tuples, 'tuple')} of no components", "1 or more"
                )
            padded = by_library and kind > NORMAL and components != _PADDED_TO
            data = take(f"data of attribute {index}", 4 * (_PADDED_TO if padded else components) * tuples)
            name = decode_text(names[index])
            attributes.append(Attribute(kind, name, components, np.frombuffer(data, F4), padded))
        take.end()
        return cls(points, vertices, lines, polygons, strips, tuple(attributes), padding)

    def pack(self) -> list[Buffer]:
        head = [len(self.points)]
        for cells in self.cells:
            head += (cells.count, U4.itemsize * len(cells.data))
        parts: list[Buffer] = [self._HEAD.pack(*head, len(self.attributes))]
        parts += (_raw(array) for array in (self.points, *(cells.data for cells in self.cells)) if array.size)
        if self.attributes:
            heads, names = bytearray(), bytearray()
            for attribute in self.attributes:
                name = attribute.name.encode("utf-8", "surrogateescape")
                if len(name) > MAX_ATTRIBUTE_NAME or b"\x00" in name:
                    raise MalformedBody("POLYDATA attribute name", repr(attribute.name), "at most 255 bytes, no NUL")
                if not 0 <= attribute.components <= MAX_COMPONENTS:
                    found = counted(attribute.components, "component")
                    raise MalformedBody(f"POLYDATA attribute {attribute.name!r}", found, f"at most {MAX_COMPONENTS}")
                heads += self._ATTRIBUTE.pack(attribute.type, attribute.components, attribute.tuples)
                names += name + b"\x00"
            parts.append(bytes(heads + names) + struct.pack("B", self.name_padding)[: len(names) % 2])
            parts += (_raw(attribute.data) for attribute in self.attributes if attribute.data.size)
        return parts

    def describe(self) -> dict[str, Any]:
        shown: dict[str, Any] = {"num_points": len(self.points), "points": self.points.tolist()}
        shown |= {name: cells.lists() for name, cells in zip(_SECTIONS, self.cells, strict=True)}
        shown["attributes"] = [
            {
                "type": attribute.type,
                "ncomponents": attribute.components,
                "n": attribute.tuples,
                "name": visible(attribute.name),
                "data": attribute.data.tolist(),
            }
            for attribute in self.attributes
        ]
        return shown


_SECTIONS = ("vertices", "lines", "polygons", "triangle_strips")


def _raw(array: npt.NDArray[Any]) -> memoryview:
    """The bytes of a contiguous big-endian array, not copied; any other array is converted once."""
    wire = np.ascontiguousarray(array, U4 if array.dtype.kind in "ui" else F4)
    return wire.reshape(-1).view(np.uint8).data


def _has_size_of_library(heads: list[tuple[int, int, int]], left: int) -> bool:
    """Return whether the data have the size that the C++ library reads, and not that of the heads."""
    stated = sum(components * tuples for _, components, tuples in heads)
    read = sum((components if kind <= NORMAL else _PADDED_TO) * tuples for kind, components, tuples in heads)
    return F4.itemsize * stated != left == F4.itemsize * read


class _ContentReader:
    """Cuts sections off the content, each checked against what is left before anything is allocated."""

    def __init__(self, content: memoryview) -> None:
        self._content = content
        self._offset = 0

    @property
    def left(self) -> int:
        """Number of bytes that are not read yet."""
        return self._content.nbytes - self._offset

    def __call__(self, what: str, size: int) -> memoryview:
        left = self._content.nbytes - self._offset
        if size > left:
            raise TruncatedMessage(
                f"POLYDATA {what}, offset {self._offset}", counted(left, "byte"), counted(size, "byte")
            )
        self._offset += size
        return self._content[self._offset - size : self._offset]

    def until_nul(self, what: str) -> bytes:
        window = bytes(self._content[self._offset : self._offset + MAX_ATTRIBUTE_NAME + 1])
        name, nul, _ = window.partition(b"\x00")
        if not nul:
            raise MalformedBody(f"POLYDATA {what}, offset {self._offset}", "no NUL", "a NUL within 256 bytes")
        self._offset += len(name) + 1
        return name

    def end(self) -> None:
        if self._offset != self._content.nbytes:
            raise MalformedBody(
                "POLYDATA content",
                counted(self._content.nbytes, "byte"),
                f"{counted(self._offset, 'byte')} by its own counts",
            )
