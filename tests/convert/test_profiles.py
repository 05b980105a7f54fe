"""Content that a peer would misread is sent in a form that it reads; all other content is sent unchanged."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from igtl_gateway.base.buffers import join
from igtl_gateway.base.quantities import counted
from igtl_gateway.convert.profiles import BY_NAME, profile_shown_by
from igtl_gateway.wire import Item, Message, Raw
from igtl_gateway.wire.image import LPS, RAS, Image
from igtl_gateway.wire.polydata import CELL, RGBA, SCALAR, TCOORDS, TENSOR, VECTOR, Attribute, Cells, PolyData
from igtl_gateway.wire.text import Status, String

SLICER, PLUS = BY_NAME["slicer"], BY_NAME["plus"]
CELL_SCALAR = CELL | SCALAR  # of the kinds that the C++ reader takes nine components for


def image(dtype: str, scalar_type: int, values: list[int], coordinate: int = RAS) -> Image:
    return Image((len(values), 1, 1), scalar_type, np.array(values, dtype).tobytes(), 1, 2, coordinate)


@pytest.mark.parametrize(("dtype", "scalar_type"), [("<i4", 6), ("<u4", 7)])
def test_slicer_gets_whole_numbers_of_32_bits_as_float32(dtype: str, scalar_type: int) -> None:
    adapt = SLICER.adapt[Image]
    adapted, warning = adapt(image(dtype, scalar_type, [0, 1, 2**24]))
    assert (adapted.scalar_type, adapted.array.ravel().tolist(), warning) == (10, [0.0, 1.0, 2.0**24], "")
    adapted, warning = adapt(image(dtype, scalar_type, [2**24 + 1]))
    assert adapted.array.ravel().tolist() == [2.0**24] and "rounded" in warning


def test_slicer_gets_lps_as_ras() -> None:
    adapted, warning = SLICER.adapt[Image](image("<u2", 5, [1, 2], LPS))
    assert (adapted.coordinate, warning) == (RAS, "")
    assert np.array_equal(adapted.array, image("<u2", 5, [1, 2]).array)
    # x and y of every axis and of the origin change their sign
    signs = np.array([-1, -1, 1] * 4)
    assert np.array_equal(adapted.wire_matrix, signs * image("<u2", 5, [1, 2], LPS).wire_matrix)


def test_slicer_gets_other_images_as_they_are() -> None:
    same = image("<u2", 5, [1, 2])
    adapted, warning = SLICER.adapt[Image](same)
    assert adapted is same and not warning


POINTS = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], ">f4")


def surface(*attributes: Attribute) -> PolyData:
    return PolyData(POINTS, polygons=Cells.of([[0, 1, 2]]), attributes=attributes)


@pytest.mark.parametrize("profile", [SLICER, PLUS], ids=lambda profile: profile.name)
def test_the_cpp_reader_gets_nine_floats_where_it_takes_nine(profile: object) -> None:
    """It takes the number of cell scalars from the head, and nine floats a cell from the data."""
    adapt = profile.adapt[PolyData]  # type: ignore[attr-defined]
    plain = surface(Attribute.of(SCALAR, "depth", np.array([[1.0], [2.0], [3.0]])))
    assert adapt(plain) == (plain, "")
    mixed = surface(*plain.attributes, Attribute.of(CELL_SCALAR, "label", np.array([[7.0]])))
    adapted, warning = adapt(mixed)
    assert not warning and adapted.attributes[0] == plain.attributes[0]
    wide = adapted.attributes[1]
    assert (wide.name, wide.type, wide.components, wide.data.tolist()) == ("label", CELL_SCALAR, 1, [7.0] + [0.0] * 8)
    assert (wide.tuples, wide.values.tolist()) == (1, [[7.0]])
    assert adapt(adapted)[0].attributes[1] == wide, "once is enough"
    data = join(adapted.pack())
    again = PolyData.unpack(memoryview(data))
    assert again == adapted and again.attributes[1].values.tolist() == [[7.0]], "it is readable here, too"


@pytest.mark.parametrize(
    ("kind", "found", "sent"),
    [
        (CELL | RGBA, [[0.1, 0.2, 0.3]], [0.1, 0.2, 0.3, 1.0]),  # opaque
        (RGBA, [[0.1, 0.2, 0.3]] * 3, [0.1, 0.2, 0.3, 1.0] * 3),
        (TCOORDS, [[0.5, 0.25]] * 3, [0.5, 0.25, 0.0] * 3),
        (CELL | VECTOR, [[1.0, 2.0]], [1.0, 2.0, 0.0]),
        (VECTOR, [[1.0, 2.0]] * 3, [1.0, 2.0, 0.0] * 3),
        (CELL | SCALAR, [[1.0, 2.0, 3.0]], [1.0, 2.0, 3.0]),
    ],
)
def test_the_cpp_reader_gets_what_it_takes(kind: int, found: list[list[float]], sent: list[float]) -> None:
    adapted, warning = SLICER.adapt[PolyData](surface(Attribute.of(kind, "a", np.array(found))))
    (attribute,) = adapted.attributes
    assert not warning and attribute.values.reshape(-1).tolist() == pytest.approx(sent)
    assert attribute.tuples == len(found)
    assert len(attribute.data) == len(found) * (3 if kind == VECTOR else 9)


@pytest.mark.parametrize(
    ("kind", "components"),
    [
        (CELL | SCALAR, 10),
        (SCALAR, 128),
        (TENSOR, 6),
        (VECTOR, 4),
        (RGBA, 2),
        (TCOORDS, 4),
        (6, 1),
        (CELL | 6, 9),
        (32, 1),
    ],
)
def test_what_the_cpp_reader_would_misread_is_left_out_and_said(kind: int, components: int) -> None:
    bad = Attribute.of(kind, "bad", np.ones((3, components)))
    good = Attribute.of(SCALAR, "good", np.ones((3, 1)))
    adapted, warning = SLICER.adapt[PolyData](surface(bad, good))
    assert adapted.attributes == (good,)
    assert f"'bad' (type {kind:#x}, {counted(components, 'component')})" in warning


@pytest.mark.parametrize(
    ("message", "name"),
    [
        (Message("STATUS", "", Status(1), 0, 2, 0, (Item("dummy", b"dummy"),)), "slicer"),
        (Message("STATUS", "Tool", Status(1), 0, 2, 0, (Item("dummy", b"dummy"),)), None),
        (Message("STRING", "A", String.of("b"), 0, 2, 0, (Item("MRMLNodeName", b"A"),)), "slicer"),
        (Message("STRING", "A", String.of("b"), 0, 2, 0, (Item("TransformValid", b"1"),)), "plus"),
        (Message("USMESSAGE", "A", Raw(b"")), "plus"),
        (Message("STATUS", "", Status(1)), None),
    ],
)
def test_what_a_message_shows_of_its_sender(message: Message, name: str | None) -> None:
    shown = profile_shown_by(message)
    assert (shown.name if shown else None) == name


def test_what_may_be_sent() -> None:
    holoscan, default = BY_NAME["holoscan"], BY_NAME["default"]
    assert [name for name in ("IMAGE", "TRANSFORM", "GET_IMAGE", "RTS_TDATA") if holoscan.may_send(name)] == ["IMAGE"]
    assert SLICER.may_send("RTS_COMMAND") and SLICER.may_send("TRANSFORM") and SLICER.may_send("RTS_TDATA")
    assert not SLICER.may_send("GET_IMAGE") and not SLICER.may_send("RTS_POLYDATA")
    assert PLUS.may_send("GET_STATUS") and not PLUS.may_send("UNHEARDOF")
    assert default.may_send("STT_ANYTHING")


CLOUD = PolyData(np.arange(9, dtype=">f4").reshape(3, 3), vertices=Cells.of_all(3))
SINGLE = replace(CLOUD, vertices=Cells.of(np.array([[0], [2]])), lines=Cells.of([[0, 1, 2]]))


@pytest.mark.parametrize(
    "content, lines", [(CLOUD, [[0, 0], [1, 1], [2, 2]]), (SINGLE, [[0, 0], [2, 2], [0, 1, 2]])], ids=["one", "several"]
)
def test_slicer_gets_each_vertex_as_a_line(content: PolyData, lines: list[list[int]]) -> None:
    adapted, warning = SLICER.adapt[PolyData](content)
    assert not warning and not adapted.vertices.count and adapted.lines.lists() == lines
    assert SLICER.adapt[PolyData](adapted)[0] is adapted, "it is adapted once"
    assert PolyData.unpack(memoryview(b"".join(bytes(part) for part in adapted.pack()))) == adapted


def test_values_of_vertices_stay_with_their_lines() -> None:
    colours = Attribute.of(CELL | SCALAR, "c", np.arange(3.0)[:, None])
    adapted, _ = SLICER.adapt[PolyData](replace(SINGLE, attributes=(colours,)))
    assert adapted.attributes[0].values[:, 0].tolist() == [0.0, 1.0, 2.0], "vertices are before lines in VTK"
    several = replace(CLOUD, attributes=(Attribute.of(CELL | SCALAR, "c", np.ones((1, 1))),))
    adapted, warning = SLICER.adapt[PolyData](several)
    assert not adapted.attributes and "vertices" in warning
