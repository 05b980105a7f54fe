"""POLYDATA ⇄ igtl_msgs/PolyData: every cell and every attribute, there and back to the same bytes."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given

from igtl_gateway.base.buffers import join
from igtl_gateway.base.errors import ConversionError
from igtl_gateway.convert import igtl_msgs
from igtl_gateway.convert.context import ToIgtlContext, ToRosContext
from igtl_gateway.convert.igtl_msgs import MetadataItem, PolyDataAttribute
from igtl_gateway.convert.polydata import exceeds_standard, polydata_to_igtl, polydata_to_ros
from igtl_gateway.convert.profiles import BY_NAME
from igtl_gateway.convert.rosmsg import Header
from igtl_gateway.wire.polydata import (
    CELL,
    MAX_ATTRIBUTES,
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
from tests.strategies import finite32, polydatas
from tests.tables import table

ITEMS = (MetadataItem("key", 3, "value"),)
POINTS = np.arange(12, dtype=">f4").reshape(4, 3)


def to_ros() -> ToRosContext:
    return ToRosContext("Model", 5, "frame", "", metadata=ITEMS)


def there_and_back(content: PolyData) -> PolyData:
    message = polydata_to_ros(content, to_ros())
    assert (message.header, message.metadata) == (Header(5, "frame"), ITEMS)
    out = polydata_to_igtl(igtl_msgs.PolyData.unpack(message.pack()), ToIgtlContext())
    assert (out.stamp_ns, out.frame_id, out.metadata) == (5, "frame", ITEMS)
    assert isinstance(out.content, PolyData)
    return out.content


def sent(**fields: Any) -> PolyData:
    everything: dict[str, Any] = {"header": Header(), "points": np.zeros((4, 3))} | fields
    message = igtl_msgs.PolyData(**everything)
    content = polydata_to_igtl(message, ToIgtlContext()).content
    assert isinstance(content, PolyData)
    return content


def test_by_hand() -> None:
    content = PolyData(
        POINTS,
        Cells.of([[0]]),
        Cells.of([[0, 1], [1, 2, 3]]),
        Cells.of([[0, 1, 2, 3]]),
        Cells.of([[0, 1, 2, 3], []]),
        (Attribute.of(CELL | SCALAR, "label", np.array([[7.0]])),),
    )
    message = polydata_to_ros(content, to_ros())
    assert message.points.tolist() == (np.arange(12).reshape(4, 3) / 1000).tolist()
    assert message.vertices.tolist() == [1, 0]
    assert message.lines.tolist() == [2, 0, 1, 3, 1, 2, 3]
    assert message.polygons.tolist() == [4, 0, 1, 2, 3]
    assert message.triangle_strips.tolist() == [4, 0, 1, 2, 3, 0]
    (attribute,) = message.attributes
    assert (attribute.name, attribute.type, attribute.components) == ("label", 16, 1)
    assert attribute.values.tolist() == [7.0]
    assert there_and_back(content) == content


@given(polydatas(finite32))
def test_there_and_back_to_the_same_bytes(content: PolyData) -> None:
    shown = [replace(a, name=a.name.encode("utf-8", "surrogateescape").decode("utf-8", "replace")) for a in
             content.attributes]  # fmt: skip
    content = replace(content, attributes=tuple(shown))
    assert join(there_and_back(content).pack()) == join(defined(content).pack())


@given(polydatas(finite32))
def test_the_message_is_the_same_the_second_time(content: PolyData) -> None:
    first = polydata_to_ros(content, to_ros()).pack()
    again = polydata_to_igtl(igtl_msgs.PolyData.unpack(first), ToIgtlContext()).content
    assert isinstance(again, PolyData)
    assert polydata_to_ros(again, to_ros()).pack() == first


def defined(content: PolyData) -> PolyData:
    """The content without the tails that the C++ library appends to attributes."""
    attributes = (Attribute(a.type, a.name, a.values.shape[1], a.values.reshape(-1)) for a in content.attributes)
    return replace(content, attributes=tuple(attributes))


def test_bits_of_attributes_are_not_looked_at() -> None:
    """Signalling NaNs and all."""
    bits = np.frombuffer(bytes.fromhex("3f000000 7fa00001 ffffffff 00000001") * 9, ">f4")
    content = PolyData(POINTS, attributes=(Attribute(RGBA, "Colors", 4, bits),))
    assert join(there_and_back(content).pack()) == join(content.pack())


@pytest.mark.parametrize(
    "kind, data, is_unclear",
    [
        (CELL | SCALAR, [1, 2, 3, 4, 5, 6] + [0] * 12, True),  # two cells of three components
        (CELL | SCALAR, [1, 2] + [0] * 15 + [float("nan")], True),  # of one; the rest is what was in the memory
        (CELL | SCALAR, [1, 2] + [0] * 16, False),
        (CELL | VECTOR, [1, 2, 3, 4, 5, 6, 7] + [0] * 11, False),
        (SCALAR, range(1, 19), False),
    ],
)
def test_scalars_of_cells_whose_number_of_components_is_unknown_have_a_note(
    kind: int, data: list[float], is_unclear: bool
) -> None:
    context = to_ros()
    attribute = Attribute(kind, "label", 9, np.array(data, ">f4"))
    polydata_to_ros(PolyData(POINTS, attributes=(attribute,)), context)
    assert [code for code, _ in context.warnings] == ["cell_scalars"] * is_unclear
    assert all("'label'" in text for _, text in context.warnings)


@pytest.mark.parametrize(
    "kind, real",
    [
        (RGBA, 4),
        (TCOORDS, 3),
        (CELL | SCALAR, 1),
        (CELL | VECTOR, 3),
        (CELL | NORMAL, 3),
        (CELL | RGBA, 4),
        (TENSOR, 9),
    ],
)
def test_attributes_of_the_c_library_have_the_values_of_their_type_only(kind: int, real: int) -> None:
    """It writes nine components: the values in one row, then what is in its memory; a tensor has nine."""
    values = np.arange(4 * real, dtype=">f4") + 1
    data = np.concatenate([values, np.full(4 * (9 - real), np.nan, ">f4")])
    content = PolyData(POINTS, attributes=(Attribute(kind, "a", 9, data),))
    (attribute,) = polydata_to_ros(content, to_ros()).attributes
    assert (attribute.components, attribute.values.tolist()) == (real, values.tolist())
    back = BY_NAME["slicer"].adapt[PolyData](there_and_back(content))[0]
    (again,) = back.attributes
    # of cell scalars it reads the number of components from the head
    components = 1 if kind == CELL | SCALAR else 9
    assert (again.components, again.data[: len(values)].tolist()) == (components, values.tolist())
    assert len(again.data) == 4 * 9
    assert not again.data[len(values) :].any()


def test_columns_and_foreign_byte_order() -> None:
    message = igtl_msgs.PolyData(
        Header(),
        np.zeros((4, 3), ">f8"),
        lines=np.array([2, 0, 1, 2, 2, 3], ">u4"),
        attributes=(PolyDataAttribute("a", 0, 1, np.array([1, 2], ">f4")),),
    )
    content = polydata_to_igtl(message, ToIgtlContext()).content
    assert isinstance(content, PolyData)
    assert content.lines.lists() == [[0, 1], [2, 3]]
    assert content.attributes[0].data.tolist() == [1.0, 2.0]


@table("section", ["vertices", "lines", "polygons", "triangle_strips"])
@table(
    "row",
    [[1], [3, 0, 1], [2, 0, 1, 5], [1, 4], [2, 0, 4, 2, 0, 1], [2**32 - 1], [0, 2**32 - 1, 0]],
    ids=str,
)
def test_rows_that_are_no_cells(section: str, row: list[int]) -> None:
    sent(**{section: np.array([2, 0, 1, 1, 3, 0], np.uint32)})
    with pytest.raises(ConversionError, match=f"igtl_msgs/msg/PolyData, {section}"):
        sent(**{section: np.array(row, np.uint32)})


@pytest.mark.parametrize(
    "attribute",
    [
        PolyDataAttribute("a", 0, 2, np.zeros(3, np.float32)),
        PolyDataAttribute("a", 0, 0, np.zeros(1, np.float32)),
    ],
)
def test_values_that_are_no_tuples(attribute: PolyDataAttribute) -> None:
    with pytest.raises(ConversionError, match="attribute 'a'"):
        sent(attributes=(attribute,))


def test_attributes_beyond_what_can_be_read_again() -> None:
    one = PolyDataAttribute("a", 0, 1, np.zeros(0, np.float32))
    join(sent(attributes=(one,) * MAX_ATTRIBUTES).pack())
    with pytest.raises(ConversionError, match="4097 attributes"):
        sent(attributes=(one,) * 4097)


@pytest.mark.parametrize("number", [np.nan, np.inf, 1e36])
def test_coordinates_that_are_no_numbers_of_the_wire(number: float) -> None:
    with pytest.raises(ConversionError, match="not finite"):
        sent(points=np.full((1, 3), number))


@pytest.mark.parametrize(("name", "kept"), [("ü" * 200, "ü" * 127), ("a\x00b", "a"), ("fine", "fine")])
def test_names_are_cut_with_a_word(name: str, kept: str) -> None:
    to = ToIgtlContext()
    message = igtl_msgs.PolyData(
        Header(), np.zeros((0, 3)), attributes=(PolyDataAttribute(name, 0, 1, np.zeros(0, np.float32)),)
    )
    content = polydata_to_igtl(message, to).content
    assert isinstance(content, PolyData)
    assert content.attributes[0].name == kept
    assert [code for code, _ in to.warnings] == ([] if kept == name else ["text_cut"])
    join(content.pack())


TRIANGLES = Cells.of([[0, 1, 2], [1, 2, 3]])
SCALARS = Attribute.of(SCALAR, "depth", np.zeros((4, 1)))


@table(
    ("content", "wanted"),
    [
        (PolyData(POINTS), False),
        (PolyData(POINTS[:0]), False),
        (PolyData(POINTS, Cells.of([[0, 1, 2, 3]])), False),
        (PolyData(POINTS, Cells.of([[0], [1], [2], [3]])), False),
        (PolyData(POINTS, Cells.of([[0], [1], [3], [2]])), True),
        (PolyData(POINTS, Cells.of([[0, 1], [2, 3]])), True),
        (PolyData(POINTS, Cells.of([[0, 1, 2]])), True),
        (PolyData(POINTS, Cells.of([[0], [1, 2, 3]])), True),
        (PolyData(POINTS, Cells.of([[]])), True),
        (PolyData(POINTS, attributes=(SCALARS,)), False),
        (PolyData(POINTS, attributes=(SCALARS, Attribute.of(NORMAL, "n", np.zeros((4, 3))))), False),
        (PolyData(POINTS, attributes=(Attribute.of(VECTOR, "v", np.zeros((4, 3))),)), True),
        (PolyData(POINTS, attributes=(Attribute.of(SCALAR, "short", np.zeros((3, 1))),)), True),
        (PolyData(POINTS, attributes=(Attribute.of(CELL, "cells", np.zeros((4, 1))),)), True),
        (PolyData(POINTS, polygons=TRIANGLES), False),
        (PolyData(POINTS, polygons=TRIANGLES, attributes=(SCALARS,)), True),
        (PolyData(POINTS, Cells.of([[0]]), polygons=TRIANGLES), True),
        (PolyData(POINTS, lines=Cells.of([[0, 1]]), polygons=TRIANGLES), True),
        (PolyData(POINTS, polygons=Cells.of([[0, 1, 2, 3]])), True),
        (PolyData(POINTS, polygons=Cells.of([[0, 1, 2], [0, 1, 2, 3]])), True),
        (PolyData(POINTS, triangle_strips=Cells.of([[0, 1, 2]])), True),
        (PolyData(POINTS, lines=Cells.of([[0, 1]])), True),
    ],
)
def test_what_clouds_and_meshes_do_not_hold(content: PolyData, wanted: bool) -> None:
    assert exceeds_standard(content) is wanted


def test_many_cells_of_one_length() -> None:
    points = np.zeros((1000, 3), ">f4")
    indices = (np.arange(300_000) % 1000).reshape(-1, 3)
    content = PolyData(points, polygons=Cells.of(indices))
    back = there_and_back(content)
    assert back.polygons.count == 100_000
    assert (back.polygons.data == content.polygons.data).all()
