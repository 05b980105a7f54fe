"""Clouds: positions, colours in both packings, holes, padding, attributes of every shape."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from igtl_gateway.base.buffers import join
from igtl_gateway.base.errors import ConversionError
from igtl_gateway.convert.clouds import (
    cloud_to_points,
    cloud_to_polydata,
    point_to_igtl,
    point_to_ros,
    points_to_cloud,
    polydata_to_cloud,
)
from igtl_gateway.convert.context import ToIgtlContext, ToRosContext
from igtl_gateway.convert.rosmsg import POINT_FIELD_DTYPES, Header, PointCloud2, PointField, PointStamped
from igtl_gateway.convert.units import LengthUnits
from igtl_gateway.wire.point import Points
from igtl_gateway.wire.polydata import CELL, NORMAL, RGBA, SCALAR, VECTOR, Attribute, PolyData
from tests.tables import table

XYZ = [[0.001, -0.002, 0.003], [1.0, 2.0, -3.0]]
MM = [[1.0, -2.0, 3.0], [1000.0, 2000.0, -3000.0]]
CODES = {kind: code for code, kind in POINT_FIELD_DTYPES.items()}


def cloud(
    columns: dict[str, Any], kinds: dict[str, str] | None = None, *, big: bool = False, pad: int = 0
) -> PointCloud2:
    """A cloud of one row from columns; ``pad`` bytes behind every point."""
    kinds = {"x": "f4", "y": "f4", "z": "f4"} | (kinds or {})
    order = ">" if big else "<"
    fields, layout, offset = [], [], 0
    for name, values in columns.items():
        width = np.asarray(values).shape[1] if np.asarray(values).ndim > 1 else 1
        dtype = np.dtype(order + kinds.get(name, "f4"))
        fields.append(PointField(name, offset, CODES[kinds.get(name, "f4")], width))
        layout.append((name, dtype, (width,)) if width > 1 else (name, dtype))
        offset += dtype.itemsize * width
    points = np.zeros(len(columns["x"]), np.dtype([*layout, ("", "V1", (pad,))] if pad else layout))
    for name, values in columns.items():
        points[name] = values
    step = offset + pad
    return PointCloud2(
        Header(7, "f"), 1, len(points), tuple(fields), big, step, step * len(points), points.tobytes(), True
    )


def xyz(values: Any = XYZ) -> dict[str, Any]:
    array = np.array(values, float).reshape(-1, 3)
    return {"x": array[:, 0], "y": array[:, 1], "z": array[:, 2]}


def sent(message: PointCloud2, warnings: list[str] | None = None) -> PolyData:
    to = ToIgtlContext()
    out = cloud_to_polydata(message, to)
    assert out.stamp_ns == 7
    assert [code for code, _ in to.warnings] == (warnings or [])
    assert isinstance(out.content, PolyData)
    return PolyData.unpack(memoryview(join(out.content.pack())))


def published(content: PolyData) -> dict[str, Any]:
    message = polydata_to_cloud(content, ToRosContext("d", 5, "frame", ""))
    assert message.header == Header(5, "frame")
    assert message.row_step == message.point_step * message.width == memoryview(message.data).nbytes
    layout = np.dtype(
        {
            "names": [item.name for item in message.fields],
            "formats": [("<" + POINT_FIELD_DTYPES[item.datatype], (item.count,)) for item in message.fields],
            "offsets": [item.offset for item in message.fields],
            "itemsize": message.point_step,
        }
    )
    points = np.frombuffer(message.data, layout)
    return {name: points[name].tolist() for name in layout.names or ()}


@table("big", [False, True])
@table("kind", ["f4", "f8"])
@table("pad", [0, 4, 5])
def test_positions(big: bool, kind: str, pad: int) -> None:
    content = sent(cloud(xyz(), dict.fromkeys("xyz", kind), big=big, pad=pad))
    assert content.points.tolist() == MM  # the signs of x and y, too, which the original turned
    assert content.vertices.lists() == [[0, 1]]
    assert content.attributes == ()


def test_there_and_back_keeps_every_sign() -> None:
    assert published(sent(cloud(xyz()))) == {
        name: [[float(np.float32(row[axis]))] for row in XYZ] for axis, name in enumerate("xyz")
    }


def test_integers_as_positions() -> None:
    assert sent(cloud(xyz([[1, -2, 3]]), dict.fromkeys("xyz", "i2"))).points.tolist() == [[1000, -2000, 3000]]


def test_fields_without_a_name_of_their_own_are_left_out() -> None:
    """Padding, and a second x that nothing distinguishes from the first."""
    plain = cloud(xyz(), pad=8)
    odd = (*plain.fields, PointField("", 12, CODES["f4"], 1), PointField("x", 16, CODES["f4"], 1))
    content = sent(replace(plain, fields=odd))
    assert content.points.tolist() == MM
    assert content.attributes == ()


def test_rows_with_padding_and_holes() -> None:
    """An organised cloud, 2 × 2, with a NaN and an infinity; rows end in four foreign bytes."""
    rows = np.array([[[1, 2, 3], [math.nan, 0, 0]], [[4, 5, 6], [0, 0, math.inf]]], "<f4")
    data = b"".join(row.tobytes() + b"####" for row in rows)
    fields = tuple(PointField(name, 4 * axis, 7) for axis, name in enumerate("xyz"))
    for tail in (len(data), len(data) - 4):
        message = PointCloud2(Header(7), 2, 2, fields, False, 12, 28, data[:tail], False)
        content = sent(message)
        assert content.points.tolist() == [[1000, 2000, 3000], [4000, 5000, 6000]]
        assert content.vertices.lists() == [[0, 1]]


@table("kind", ["f4", "u4"])
@table("big", [False, True])
@table(("field", "colour"), [("rgb", (10, 20, 30)), ("rgba", (10, 20, 30, 40))])
def test_packed_colours(kind: str, big: bool, field: str, colour: tuple[int, ...]) -> None:
    """0xAARRGGBB in a word that is called float32 or uint32."""
    word = np.array([40 << 24 | 10 << 16 | 20 << 8 | 30] * 2, ">u4" if big else "<u4")
    columns = xyz() | {field: word.view(">f4" if big else "<f4") if kind == "f4" else word}
    message = cloud(columns, {field: kind}, big=big)
    (attribute,) = sent(message).attributes
    assert (attribute.type, attribute.name) == (SCALAR, field.upper())
    assert np.rint(attribute.values * 255).tolist() == [list(colour)] * 2
    points = cloud_to_points(message, ToIgtlContext()).content
    assert isinstance(points, Points)
    assert points.elements["rgba"].tolist() == [list(colour) if len(colour) == 4 else [*colour, 255]] * 2
    assert points.elements["position"].tolist() == MM
    back = published(sent(message))[field]
    words = np.array(back, "<f4").view("<u4") if field == "rgb" else np.array(back, "<u4")
    assert {hex(value) for value in words.ravel()} == {"0xff0a141e" if field == "rgb" else "0x280a141e"}


def test_every_byte_of_a_colour_survives() -> None:
    word = np.arange(256, dtype="<u4") * 0x01010101
    message = cloud(xyz(np.zeros((256, 3))) | {"rgba": word}, {"rgba": "u4"})
    assert [value for (value,) in published(sent(message))["rgba"]] == word.tolist()


def test_normals_and_further_fields() -> None:
    columns = xyz() | {
        "normal_x": [1, 0],
        "normal_y": [0, 1],
        "normal_z": [0, 0],
        "intensity": [0.5, 7],
        "ring": [3, 4],
    }
    content = sent(cloud(columns | {"pair": [[1, 2], [3, 4]]}, {"ring": "u2"}))
    assert [(a.type, a.name, a.values.tolist()) for a in content.attributes] == [
        (NORMAL, "Normals", [[1, 0, 0], [0, 1, 0]]),
        (SCALAR, "intensity", [[0.5], [7]]),
        (SCALAR, "ring", [[3], [4]]),
        (SCALAR, "pair", [[1, 2], [3, 4]]),
    ]
    back = published(content)
    assert back["normal_y"] == [[0], [1]]
    assert back["pair"] == [[1, 2], [3, 4]]


def test_half_a_normal_and_wide_colours_are_plain_fields() -> None:
    content = sent(cloud(xyz() | {"normal_x": [1, 2], "rgb": [3, 4]}, {"rgb": "f8"}), ["float32_attribute"])
    assert [a.name for a in content.attributes] == ["normal_x", "rgb"]


@pytest.mark.parametrize("kind", ["f8", "i4", "u4"])
def test_what_float32_cannot_hold_is_told(kind: str) -> None:
    sent(cloud(xyz() | {"time": [1, 2]}, {"time": kind}), ["float32_attribute"])


def test_a_field_too_wide_for_an_attribute_is_left_out_and_told() -> None:
    content = sent(cloud(xyz() | {"shot": np.zeros((2, 352)), "a": [1, 2]}), ["field_left_out"])
    assert [a.name for a in content.attributes] == ["a"]


@pytest.mark.parametrize("columns", [xyz([]), xyz([[math.nan] * 3] * 2)])
def test_no_points(columns: dict[str, Any]) -> None:
    count = len(columns["x"])
    content = sent(cloud(columns | {"intensity": np.zeros(count), "pair": np.zeros((count, 2))}))
    assert (len(content.points), content.vertices.count) == (0, 0)
    assert published(content)["x"] == []
    assert len(cloud_to_points(cloud(columns), ToIgtlContext()).content.elements) == 0  # type: ignore[attr-defined]


@table(
    "changes",
    [
        {"fields": ()},
        {"fields": (PointField("x", 0, 7), PointField("y", 4, 7))},
        {"fields": (PointField("x", 0, 7, 2), PointField("y", 8, 7), PointField("z", 12, 7))},
        {"fields": (PointField("x", 0, 9), PointField("y", 4, 7), PointField("z", 8, 7))},
        {"fields": (PointField("x", 2**32 - 1, 7), PointField("y", 4, 7), PointField("z", 8, 7))},
        {"width": 3},
        {"width": 2**32 - 1},
        {"height": 2**32 - 1},
        {"height": 2},
        {"point_step": 2**32 - 1},
        {"point_step": 0},
        {"row_step": 0, "height": 2, "width": 1},
    ],
)
def test_contradictions(changes: dict[str, Any]) -> None:
    message = cloud(xyz())
    fields = {name: getattr(message, name) for name in PointCloud2.__slots__} | changes
    for convert in (cloud_to_polydata, cloud_to_points):
        convert(message, ToIgtlContext())
        with pytest.raises(ConversionError):
            convert(PointCloud2(**fields), ToIgtlContext())


def test_positions_that_lie_on_each_other() -> None:
    """Found by tools/fuzz_gateway.py: they were taken for an array of all three, which ended behind the data."""
    fields = (PointField("x", 8, 7), PointField("y", 4, 7), PointField("z", 8, 7))
    content = sent(replace(cloud(xyz()), fields=fields))
    assert content.points.tolist() == [[z, y, z] for _, y, z in np.array(MM, ">f4").tolist()]


def test_a_huge_layout_of_no_points() -> None:
    fields = tuple(PointField(name, 2**31 + 4 * axis, 7) for axis, name in enumerate("xyz"))
    message = PointCloud2(Header(7), 1, 0, fields, False, 2**32 - 1, 0, b"", True)
    assert len(sent(message).points) == 0


def polydata(*attributes: Attribute) -> PolyData:
    return PolyData(np.array(MM, ">f4"), attributes=attributes)


def test_no_attribute_takes_the_place_of_another() -> None:
    def one(name: str, value: float) -> Attribute:
        return Attribute.of(SCALAR, name, np.full((2, 1), value))

    fields = published(polydata(one("x", 5), one("a", 1), one("a", 2), one("rgb", 3), one("", 4)))
    assert list(fields) == ["x", "y", "z", "x_", "a", "a_", "rgb_", "attribute7"]
    assert fields["x"] == [[pytest.approx(0.001)], [1.0]]
    assert (fields["a"], fields["a_"]) == ([[1], [1]], [[2], [2]])


def test_many_attributes_of_one_name_have_short_names() -> None:
    one = Attribute.of(SCALAR, "a", np.zeros((2, 1)))
    names = list(published(polydata(*[one] * 12)))[3:]
    assert names == [*("a" + "_" * number for number in range(9)), "a_9", "a_10", "a_11"]


@pytest.mark.parametrize(
    "attribute",
    [
        Attribute.of(NORMAL, "n", np.ones((2, 1))),
        Attribute.of(VECTOR, "n", np.ones((2, 3))),
        Attribute.of(RGBA, "n", np.ones((2, 2))),
        Attribute.of(SCALAR, "n", np.ones((2, 255))),
    ],
)
def test_odd_attributes_become_plain_fields(attribute: Attribute) -> None:
    assert published(polydata(attribute))["n"] == attribute.values.tolist()


@pytest.mark.parametrize(
    "attribute",
    [
        Attribute.of(SCALAR | CELL, "n", np.ones((2, 1))),
        Attribute.of(SCALAR, "n", np.ones((3, 1))),
        Attribute(SCALAR, "n", 0, np.empty(0)),
    ],
)
def test_what_belongs_to_no_point_is_left_out(attribute: Attribute) -> None:
    assert list(published(polydata(attribute))) == ["x", "y", "z"]


def test_names_become_readable_text() -> None:
    assert list(published(polydata(Attribute.of(SCALAR, "caf\udce9", np.ones((2, 1))))))[3] == "caf\ufffd"


@pytest.mark.parametrize(
    ("values", "word"),
    [
        ([1.0, 0.5, 0.0], 0xFFFF8000),
        ([255.0, 128.0, 0.0], 0xFFFF8000),
        ([2.0, math.nan, -1.0], 0xFF020000),
        ([0.0, 0.0, math.inf], 0xFF0000FF),
    ],
)
def test_colours_in_both_ranges(values: list[float], word: int) -> None:
    fields = published(polydata(Attribute.of(SCALAR, "Colors", np.array([values, values]))))
    assert {int(value) for value in np.array(fields["rgb"], "<f4").view("<u4").ravel()} == {word}


def test_quirk_of_the_reference_library() -> None:
    """RGBA with nine components: the first four per point are meant."""
    data = np.array([1, 0, 0, 1, 0, 1, 0, 0] + [9e9] * 10, ">f4")
    fields = published(polydata(Attribute(RGBA, "c", 9, data)))
    assert fields["rgba"] == [[0xFFFF0000], [0x0000FF00]]


def test_points_to_ros() -> None:
    content = Points.of(np.array(MM), np.array([[1, 2, 3, 4], [5, 6, 7, 8]], np.uint8), np.array([2.0, 4.0]))
    message = points_to_cloud(content, ToRosContext("d", 5, "f", ""))
    assert [(item.name, item.offset, item.datatype) for item in message.fields] == [
        ("x", 0, 7), ("y", 4, 7), ("z", 8, 7), ("rgba", 12, 6), ("diameter", 16, 7)
    ]  # fmt: skip
    back = cloud_to_points(message, ToIgtlContext()).content
    assert isinstance(back, Points)
    assert (back.elements == content.elements).all()


def test_one_point() -> None:
    message = point_to_ros(Points.of(np.array(MM[:1])), ToRosContext("d", 5, "f", ""))
    assert message == PointStamped(Header(5, "f"), (0.001, -0.002, 0.003))
    content = point_to_igtl(message, ToIgtlContext()).content
    assert isinstance(content, Points)
    assert content.elements["position"].tolist() == MM[:1]
    assert content.elements["rgba"].tolist() == [[255] * 4]


@pytest.mark.parametrize("x", [math.nan, math.inf, 1e300])
def test_a_point_without_a_place(x: float) -> None:
    with pytest.raises(ConversionError):
        point_to_igtl(PointStamped(Header(), (x, 0.0, 0.0)), ToIgtlContext())


def test_configured_units() -> None:
    content = cloud_to_polydata(cloud(xyz([[1, 2, 3]])), ToIgtlContext(LengthUnits("mm", "cm"))).content
    assert isinstance(content, PolyData)
    assert content.points.tolist() == [[np.float32(0.1), np.float32(0.2), np.float32(0.3)]]
