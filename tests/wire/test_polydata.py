"""POLYDATA: layout, cells of every shape, attributes with the library's quirk, lies about sizes."""

from __future__ import annotations

import struct
import tracemalloc
from typing import Any

import numpy as np
import pytest
from hypothesis import given

from igtl_gateway.base.buffers import join
from igtl_gateway.base.errors import MalformedBody, TruncatedMessage, WireError
from igtl_gateway.wire import Message, decode, encode
from igtl_gateway.wire.polydata import (
    CELL,
    MAX_ATTRIBUTES,
    NO_CELLS,
    NORMAL,
    RGBA,
    SCALAR,
    TCOORDS,
    TENSOR,
    VECTOR,
    Attribute,
    Cells,
    PolyData,
)
from tests import strategies
from tests.tables import table
from tests.timing import quick

XYZ = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], ">f4")


def words(*values: int) -> bytes:
    return struct.pack(f">{len(values)}I", *values)


def f32(*values: float) -> bytes:
    return struct.pack(f">{len(values)}f", *values)


GOLDEN = (
    words(4, 2, 20, 1, 12, 1, 16, 1, 20, 2)
    + f32(0, 0, 0, 1, 0, 0, 0, 1, 0, 0, 0, 1)
    + words(1, 0, 2, 1, 2)  # two vertices cells, of one and of two points
    + words(2, 0, 3)  # one line
    + words(3, 0, 1, 2)  # one triangle
    + words(4, 0, 1, 2, 3)  # one strip
    + b"\x00\x01" + words(4) + b"\x02\x03" + words(4)  # a scalar and a normal for four points
    + b"a\0" + b"bc\0" + b"\0"  # five bytes of names and one of padding
    + f32(1, 2, 3, 4) + f32(*range(12))
)  # fmt: skip


def test_golden_bytes() -> None:
    content = PolyData(
        XYZ,
        Cells.of([[0], [1, 2]]),
        Cells.of([[0, 3]]),
        Cells.of(np.array([[0, 1, 2]])),
        Cells.of([[0, 1, 2, 3]]),
        (
            Attribute.of(SCALAR, "a", np.array([[1], [2], [3], [4]])),
            Attribute.of(NORMAL, "bc", np.arange(12).reshape(4, 3)),
        ),
    )
    assert join(content.pack()) == GOLDEN
    again = PolyData.unpack(memoryview(GOLDEN))
    assert again.describe() == content.describe()
    assert [cells.lists() for cells in again.cells] == [[[0], [1, 2]], [[0, 3]], [[0, 1, 2]], [[0, 1, 2, 3]]]
    assert join(again.pack()) == GOLDEN


def test_every_truncation() -> None:
    for size in range(len(GOLDEN)):
        with pytest.raises(WireError):
            PolyData.unpack(memoryview(GOLDEN[:size]))
    with pytest.raises(MalformedBody):
        PolyData.unpack(memoryview(GOLDEN + b"\0"))


def head(**changes: int) -> bytes:
    """The head of GOLDEN with some of its ten words changed."""
    names = ["points", "vertices", "vertex_bytes", "lines", "line_bytes", "polygons", "polygon_bytes", "strips",
             "strip_bytes", "attributes"]  # fmt: skip
    values = dict(zip(names, struct.unpack_from(">10I", GOLDEN), strict=True)) | changes
    return words(*values.values()) + GOLDEN[40:]


HUGE = 2**32 - 1


@table("name", ["points", "vertices", "vertex_bytes", "lines", "line_bytes", "polygons",
                                  "polygon_bytes", "strips", "strip_bytes", "attributes"])  # fmt: skip
@table("value", [0, 1, 2, 3, 5, 2**31, HUGE - 3, HUGE])
def test_lying_counts(name: str, value: int) -> None:
    """No count is trusted: neither memory nor time is spent on it."""
    data = head(**{name: value})
    if data == GOLDEN:
        return
    tracemalloc.start()
    with quick(), pytest.raises(WireError):
        PolyData.unpack(memoryview(data))
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 200_000


@pytest.mark.parametrize(
    ("cells", "points"),
    [
        (words(3, 0, 1, 4), 4),  # index behind the last point
        (words(3, 0, 1, HUGE), 4),
        (words(4, 0, 1, 2), 4),  # count reaches behind the section
        (words(HUGE, 0, 1, 2), 4),
        (words(1, 0, 0, 1), 4),  # ends inside a cell
        (words(0, 0, 0), 4),  # three cells instead of one
        (words(1, 0), 0),  # no points at all
    ],
)
def test_broken_cells(cells: bytes, points: int) -> None:
    with pytest.raises(MalformedBody):
        Cells.unpack("x", 1, memoryview(cells), points)


def test_cells_of_no_points() -> None:
    cells = Cells.unpack("x", 3, memoryview(words(0, 0, 0)), 0)
    assert cells.lists() == [[], [], []]
    assert NO_CELLS.lists() == []
    assert NO_CELLS.width is None


@pytest.mark.parametrize(
    ("lists", "width"),
    [([[0, 1, 2], [2, 1, 0]], 3), ([[0, 1], [2]], None), ([[0], [1], [2]], 1), ([[1, 1], [1, 1]], 2), ([[]], 0)],
)
def test_width(lists: list[list[int]], width: int | None) -> None:
    cells = Cells.of(lists)
    assert cells.width == width
    assert cells.lists() == lists


def test_mixed_cells_that_look_regular() -> None:
    """Two cells in six words: only the counts distinguish 2 + 2 from 1 + 3."""
    assert Cells(2, np.array([1, 2, 3, 2, 2, 2], ">u4")).lists() == [[2], [2, 2, 2]]


def test_mixed_cells_take_no_more_memory_than_they_are() -> None:
    mixed = np.tile(np.array([3, 0, 1, 2, 4, 0, 1, 2, 3], ">u4"), 20_000)
    tracemalloc.start()
    starts = Cells(40_000, mixed).starts()
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert starts[:3].tolist() == [0, 4, 9]
    assert peak < 4 * mixed.nbytes


@table(
    ("kind", "real"),
    [
        (RGBA, 4),
        (TCOORDS, 3),
        (CELL | SCALAR, 1),
        (CELL | VECTOR, 3),
        (CELL | NORMAL, 3),
        (CELL | RGBA, 4),
        (CELL | TCOORDS, 3),
        (TENSOR, 9),
        (CELL | TENSOR, 9),
        (SCALAR, 9),
    ],
)
def test_nine_components_of_the_reference_library(kind: int, real: int) -> None:
    """It writes 9·n floats, of which the first k·n are meant; the tail is heap garbage."""
    data = np.arange(18, dtype=">f4")
    attribute = Attribute(kind, "a", 9, data)
    assert attribute.tuples == 2
    assert attribute.values.tolist() == data[: 2 * real].reshape(2, real).tolist()
    content = PolyData(XYZ, attributes=(attribute,))
    assert join(PolyData.unpack(memoryview(join(content.pack()))).pack()) == join(content.pack())


@pytest.mark.parametrize("components", [0, 1, 4])
def test_attributes_without_tuples(components: int) -> None:
    data = words(0, *[0] * 8, 1) + bytes([SCALAR, components]) + words(0) + b"n\0"
    (attribute,) = PolyData.unpack(memoryview(data)).attributes
    assert attribute.tuples == 0
    assert attribute.values.shape == (0, components)


@pytest.mark.parametrize(
    "attribute",
    [
        Attribute(SCALAR, "n" * 256, 1, np.zeros(4)),
        Attribute(SCALAR, "a\0b", 1, np.zeros(4)),
        Attribute(SCALAR, "wide", 256, np.zeros(1024)),
    ],
)
def test_attributes_that_do_not_fit(attribute: Attribute) -> None:
    with pytest.raises(MalformedBody):
        PolyData(XYZ, attributes=(attribute,)).pack()


def test_names_of_any_bytes() -> None:
    for name in ["", "x" * 255, "\udcff odd", "é"]:
        data = join(PolyData(XYZ, attributes=(Attribute(SCALAR, name, 1, np.zeros(4, ">f4")),)).pack())
        (attribute,) = PolyData.unpack(memoryview(data)).attributes
        assert attribute.name == name


def test_a_name_without_end() -> None:
    data = words(0, *[0] * 8, 1) + bytes([SCALAR, 1]) + words(0) + b"n" * 300
    with pytest.raises(MalformedBody, match="NUL"):
        PolyData.unpack(memoryview(data))


def test_a_flood_of_attributes_is_refused_at_once() -> None:
    count = MAX_ATTRIBUTES + 1
    data = words(0, *[0] * 8, count) + bytes(7 * count + count % 2)
    with pytest.raises(MalformedBody, match="attributes"):
        PolyData.unpack(memoryview(data))


def test_attribute_data_that_is_not_there() -> None:
    with pytest.raises(TruncatedMessage):
        PolyData.unpack(memoryview(words(0, *[0] * 8, 1) + b"\x00\xff" + words(HUGE) + b"n\0"))


def test_nothing_at_all() -> None:
    empty = PolyData(np.empty((0, 3)))
    assert join(empty.pack()) == bytes(40)
    assert PolyData.unpack(memoryview(bytes(40))).describe()["num_points"] == 0


@given(strategies.polydatas(strategies.finite32))
def test_views_and_no_copies(content: PolyData) -> None:
    data = join(encode(Message("POLYDATA", "d", content)))
    again = decode(data).content
    assert isinstance(again, PolyData)
    received = np.frombuffer(data, np.uint8)
    arrays: list[Any] = [again.points, *(cells.data for cells in again.cells), *(a.data for a in again.attributes)]
    packed = [np.frombuffer(part, np.uint8) for part in again.pack()]
    for array in arrays:
        if array.size:
            assert np.shares_memory(array, received)
            assert any(np.shares_memory(array, part) for part in packed)


def test_other_arrays_are_converted_once() -> None:
    """Native float64 points and int64 indices become what the wire wants."""
    content = PolyData(XYZ.astype(float), Cells(1, np.array([2, 0, 3])))
    again = PolyData.unpack(memoryview(join(content.pack())))
    assert (again.points == XYZ).all()
    assert again.vertices.lists() == [[0, 3]]


def test_the_cell_of_all_points() -> None:
    for count in (1, 3, (1 << 18) + 1):
        cells = Cells.of_all(count)
        assert cells.count == 1 and cells.data.tolist() == [count, *range(count)]
        assert not cells.data.flags.writeable
        assert cells.is_all(count) and Cells(1, np.array(cells.data)).is_all(count)
        assert not cells.is_all(count + 1)
    for other in (Cells.of([[0, 2, 1]]), Cells.of([[0], [1], [2]]), Cells.of([[0, 1]])):
        assert not other.is_all(3)
