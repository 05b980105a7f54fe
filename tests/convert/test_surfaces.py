"""Surfaces and lines: cells cut up in order, poses applied, colours and units kept, signs as they are."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from igtl_gateway.base.errors import ConversionError
from igtl_gateway.convert import surfaces
from igtl_gateway.convert.context import ToIgtlContext, ToRosContext
from igtl_gateway.convert.rosmsg import Header, Marker, Mesh
from igtl_gateway.wire.polydata import RGBA, SCALAR, Attribute, Cells, PolyData

TO = ToRosContext("Model", 7, "base", "")
POINTS = np.array([[0, 0, 0], [10, 0, 0], [10, 20, 0], [0, 20, 0], [-5, -10, 30]], ">f4")


def test_polygons_and_strips_become_triangles_in_their_order() -> None:
    content = PolyData(POINTS, polygons=Cells.of([[0, 1, 2, 3], [0, 1, 4], [4, 3, 2, 1, 0]]))
    mesh = surfaces.polydata_to_mesh(content, TO)
    fans = [[0, 1, 2], [0, 2, 3], [0, 1, 4], [4, 3, 2], [4, 2, 1], [4, 1, 0]]
    assert mesh.triangles.tolist() == fans
    strip = PolyData(POINTS, polygons=Cells.of([[0, 1, 4]]), triangle_strips=Cells.of([[0, 1, 2, 3, 4]]))
    turned = [[0, 1, 4], [0, 1, 2], [2, 1, 3], [2, 3, 4]]
    assert surfaces.polydata_to_mesh(strip, TO).triangles.tolist() == turned


def test_cells_too_small_for_a_piece_vanish() -> None:
    content = PolyData(POINTS, polygons=Cells.of([[0], [0, 1], [0, 1, 2]]), lines=Cells.of([[3], [3, 4]]))
    assert surfaces.polydata_to_mesh(content, TO).triangles.tolist() == [[0, 1, 2]]
    assert len(surfaces.polydata_to_lines(content, TO).points) == 2
    nothing = PolyData(POINTS, polygons=Cells.of([[0], [0, 1]]), lines=Cells.of([[0], [1], []]))
    assert surfaces.polydata_to_mesh(nothing, TO).triangles.tolist() == []
    assert len(surfaces.polydata_to_lines(nothing, TO).points) == 0


@pytest.mark.parametrize("cells", [[[0, 1, 2, 3]] * 3, [[0, 1, 2, 3], [0, 1, 2, 3, 0], [0]]])
def test_more_pieces_than_any_surface_has_are_refused(cells: list[list[int]], monkeypatch: pytest.MonkeyPatch) -> None:
    """A strip of 256 MiB would become 6 GB of triangles."""
    content = PolyData(POINTS, triangle_strips=Cells.of(cells), lines=Cells.of(cells))
    triangles, segments = (9 - 3, 9) if len(cells[2]) > 1 else (5, 7)
    for convert, pieces in ((surfaces.polydata_to_mesh, triangles), (surfaces.polydata_to_lines, segments)):
        monkeypatch.setattr(surfaces, "MAX_PIECES", pieces)
        convert(content, TO)
        monkeypatch.setattr(surfaces, "MAX_PIECES", pieces - 1)
        with pytest.raises(ConversionError, match=f"found cells of {pieces} pieces, expected at most {pieces - 1}"):
            convert(content, TO)


def test_a_mesh_there_and_back_keeps_every_sign() -> None:
    content = PolyData(POINTS, polygons=Cells.of([[0, 1, 2], [2, 3, 4]]))
    back = surfaces.mesh_to_igtl(surfaces.polydata_to_mesh(content, TO), ToIgtlContext()).content
    assert isinstance(back, PolyData)
    assert back.points.tolist() == POINTS.tolist()
    assert back.polygons.lists() == [[0, 1, 2], [2, 3, 4]]


def test_lines_become_segments() -> None:
    marker = surfaces.polydata_to_lines(PolyData(POINTS, lines=Cells.of([[0, 1, 2], [4, 3]])), TO)
    assert (marker.type, marker.header, marker.ns) == (Marker.LINE_LIST, Header(7, "base"), "Model")
    assert marker.points.tolist() == (POINTS[[0, 1, 1, 2, 4, 3]].astype(float) / 1000).tolist()


@pytest.mark.parametrize(
    ("attribute", "last"),
    [
        (Attribute.of(RGBA, "c", np.tile([0.5, 0.25, 1.0, 0.75], (5, 1))), [0.5, 0.25, 1.0, 0.75]),
        (Attribute.of(SCALAR, "RGB", np.tile([0.5, 0.25, 1.0], (5, 1))), [0.5, 0.25, 1.0, 1.0]),
    ],
)
def test_colours_of_points_colour_the_marker(attribute: Attribute, last: list[float]) -> None:
    content = PolyData(POINTS, polygons=Cells.of([[0, 1, 2]]), attributes=(attribute,))
    assert surfaces.polydata_to_marker(content, TO).colors[-1].tolist() == last


def test_other_attributes_do_not_colour_it() -> None:
    heat = Attribute.of(SCALAR, "heat", np.zeros((5, 1)))
    content = PolyData(POINTS, polygons=Cells.of([[0, 1, 2]]), attributes=(heat,))
    assert surfaces.polydata_to_marker(content, TO).colors.shape == (0, 4)


CORNERS = np.array([[0.001, 0.002, 0.003], [0.004, 0.005, 0.006], [-0.007, -0.008, -0.009]])


def marker(kind: int, **changes: object) -> Marker:
    return replace(Marker(Header(5, "base"), "ns", 0, kind, points=CORNERS), **changes)  # type: ignore[arg-type]


def polydata(message: Marker) -> PolyData:
    outgoing = surfaces.marker_to_igtl(message, ToIgtlContext())
    assert outgoing.stamp_ns == 5
    assert isinstance(outgoing.content, PolyData)
    return outgoing.content


@pytest.mark.parametrize(
    ("kind", "section", "cells"),
    [
        (Marker.TRIANGLE_LIST, "polygons", [[0, 1, 2]]),
        (Marker.LINE_STRIP, "lines", [[0, 1, 2]]),
        (Marker.POINTS, "vertices", [[0, 1, 2]]),
        (Marker.SPHERE_LIST, "vertices", [[0, 1, 2]]),
        (6, "vertices", [[0, 1, 2]]),
    ],
)
def test_lists_of_points_become_cells(kind: int, section: str, cells: list[list[int]]) -> None:
    content = polydata(marker(kind))
    assert getattr(content, section).lists() == cells
    assert sum(each.count for each in content.cells) == 1
    assert content.points.tolist() == (CORNERS * 1000).astype("f4").tolist()


def test_a_line_list_takes_pairs() -> None:
    four = np.concatenate([CORNERS, CORNERS[:1]])
    assert polydata(marker(Marker.LINE_LIST, points=four)).lines.lists() == [[0, 1], [2, 3]]


def test_the_pose_of_a_marker_moves_its_points() -> None:
    half = math.sqrt(0.5)
    turned = polydata(marker(Marker.POINTS, position=(1.0, 0.0, 0.0), orientation=(0.0, 0.0, half, half)))
    wanted = np.stack([1.0 - CORNERS[:, 1], CORNERS[:, 0], CORNERS[:, 2]], axis=1) * 1000
    assert turned.points.tolist() == pytest.approx(wanted.astype("f4"), abs=1e-4)
    unset = polydata(marker(Marker.POINTS, orientation=(0.0, 0.0, 0.0, 0.0)))
    assert unset.points.tolist() == (CORNERS * 1000).astype("f4").tolist()


def test_triangles_are_scaled_as_viewers_do_and_lines_are_not() -> None:
    scale = (2.0, 3.0, 4.0)
    triangles = polydata(marker(Marker.TRIANGLE_LIST, scale=scale)).points
    assert triangles.tolist() == pytest.approx((CORNERS * scale * 1000).astype("f4"))
    strip = polydata(marker(Marker.LINE_STRIP, scale=scale)).points
    assert strip.tolist() == (CORNERS * 1000).astype("f4").tolist()


def test_colours_of_a_marker_travel_and_a_wrong_number_of_them_is_told() -> None:
    colours = np.tile(np.array([1.0, 0.5, 0.25, 1.0], "f4"), (3, 1))
    (attribute,) = polydata(marker(Marker.POINTS, colors=colours)).attributes
    assert (attribute.name, attribute.values.tolist()) == ("RGBA", colours.tolist())
    to = ToIgtlContext()
    surfaces.marker_to_igtl(marker(Marker.POINTS, colors=colours[:2]), to)
    assert [code for code, _ in to.warnings] == ["colours_left_out"]


@pytest.mark.parametrize("action", [2, 3])
def test_a_deleted_marker_is_an_empty_surface(action: int) -> None:
    assert len(polydata(marker(Marker.POINTS, action=action)).points) == 0


@pytest.mark.parametrize(
    "message",
    [
        marker(0),  # an arrow
        marker(10),  # a mesh by its file name
        marker(Marker.TRIANGLE_LIST, points=CORNERS[:2]),
        marker(Marker.LINE_LIST),
        marker(Marker.POINTS, points=CORNERS[:0]),
    ],
)
def test_what_holds_no_list_of_points_is_refused(message: Marker) -> None:
    with pytest.raises(ConversionError, match=r"found .* expected"):
        surfaces.marker_to_igtl(message, ToIgtlContext())


def test_an_index_beyond_the_vertices_is_refused() -> None:
    with pytest.raises(ConversionError, match="found vertex index 3, expected less than 3"):
        surfaces.mesh_to_igtl(Mesh(np.array([[0, 1, 3]], "u4"), np.zeros((3, 3))), ToIgtlContext())


def test_colours_up_to_255_are_brought_to_what_markers_hold() -> None:
    colours = Attribute.of(SCALAR, "RGB", np.tile([255.0, 51.0, 0.0], (5, 1)))
    content = PolyData(POINTS, polygons=Cells.of([[0, 1, 2]]), attributes=(colours,))
    assert surfaces.polydata_to_marker(content, TO).colors[0].tolist() == pytest.approx([1.0, 0.2, 0.0, 1.0])


@pytest.mark.parametrize("bad", [math.nan, math.inf, 1e300])
def test_a_surface_with_a_point_nowhere_is_refused(bad: float) -> None:
    """Its cells refer to the point, so it cannot be left out as from a cloud."""
    points = CORNERS.copy()
    points[1, 1] = bad
    with pytest.raises(ConversionError, match="not finite"):
        surfaces.mesh_to_igtl(Mesh(np.array([[0, 1, 2]], "u4"), points), ToIgtlContext())
    with pytest.raises(ConversionError, match="not finite"):
        surfaces.marker_to_igtl(marker(Marker.POINTS, points=points), ToIgtlContext())
    with pytest.raises(ConversionError, match="finite"):
        surfaces.marker_to_igtl(marker(Marker.POINTS, orientation=(bad, 0.0, 0.0, 1.0)), ToIgtlContext())
