"""Surfaces, lines and markers where they belong."""

from __future__ import annotations

import math

import numpy as np
import pytest

pytest.importorskip("rerun", reason="rerun is not installed (extra 'view')")

from igtl_gateway.addons.view.contents import EntityKind
from igtl_gateway.addons.view.markers import MarkerArray
from igtl_gateway.addons.view.other_msgs import Path
from igtl_gateway.convert.cdr import CdrWriter
from igtl_gateway.convert.common_msgs import PoseStamped
from igtl_gateway.convert.igtl_msgs import PolyData, PolyDataAttribute, Trajectory, TrajectoryList
from igtl_gateway.convert.rosmsg import Header, Marker, Mesh

from .conftest import Draw

HEADER = Header(0, "base")
CORNERS = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
HALF_TURN = (0.0, 0.0, 1.0, 0.0)  # about z
CELLS = np.uint32


class Several:
    """A MarkerArray that can be packed."""

    TYPE = MarkerArray.TYPE

    def __init__(self, *markers: Marker) -> None:
        self.markers = markers

    def pack(self) -> bytes:
        """Each marker as ``Marker.pack`` has it; one after the other, so padding counts from the whole message."""
        out = CdrWriter()
        out.u32(len(self.markers))
        for each in self.markers:
            each.header.write(out)
            out.string(each.ns)
            out.i32(each.id)
            out.i32(each.type)
            out.i32(each.action)
            out.f64s(*each.position, *each.orientation, *each.scale)
            for part in np.asarray(each.color, np.float32):
                out.array(np.array([part]), 4)
            out.u32(0)
            out.u32(0)
            out.bool(False)
            out.sequence(np.asarray(each.points, np.float64), 8, len(each.points))
            out.sequence(np.asarray(each.colors, np.float32), 4, len(each.colors))
            out.string("")
            Header().write(out)
            out.string("")
            out.octets(b"")
            out.u32(0)
            out.string(each.text)
            out.string("")
            out.string("")
            out.octets(b"")
            out.bool(False)
        return out.finish()


def marker(kind: int, ns: str = "n", number: int = 0, **more: object) -> Marker:
    return Marker(HEADER, ns, number, kind, **more)  # type: ignore[arg-type]


def test_a_mesh_has_light_and_shade(draw: Draw) -> None:
    drawn = draw(Mesh(np.array([[0, 1, 2], [0, 2, 3]]), CORNERS), base_frame="room")
    row = drawn.one("topic")
    assert row["Mesh3D:triangle_indices"] == [[0, 1, 2], [0, 2, 3]]
    assert row["Mesh3D:vertex_normals"] == [[0.0, 0.0, 1.0]] * 4
    assert row["CoordinateFrame:frame"] == ["room"]


def test_faces_of_polydata_in_the_colours_of_their_points(draw: Draw) -> None:
    colours = PolyDataAttribute("RGBA", 4, 4, np.array([255, 0, 0, 255] * 3 + [0, 0, 255, 255], np.float32))
    lines = np.array([2, 0, 2], CELLS)
    said = PolyData(HEADER, CORNERS, lines=lines, polygons=np.array([4, 0, 1, 2, 3], CELLS), attributes=(colours,))
    drawn = draw(said)
    row = drawn.one("topic")
    assert row["Mesh3D:triangle_indices"] == [[0, 1, 2], [0, 2, 3]]
    assert row["Mesh3D:vertex_colors"] == [0xFF0000FF] * 3 + [0x0000FFFF]
    assert drawn.one("topic/lines")["LineStrips3D:strips"] == [[[0.0, 0, 0], [1, 1, 0]]]
    assert drawn.view.seen.shown["/topic"].what is EntityKind.MESH


def test_polydata_of_lines_and_of_points(draw: Draw) -> None:
    drawn = draw(
        ("/lines", PolyData(HEADER, CORNERS, lines=np.array([3, 0, 1, 2], CELLS))),
        ("/points", PolyData(HEADER, CORNERS, vertices=np.array([1, 0], CELLS))),
    )
    assert len(drawn.one("lines")["LineStrips3D:strips"]) == 2
    assert len(drawn.one("points")["Points3D:positions"]) == 4
    assert [shown.what for shown in drawn.view.seen.shown.values()] == [EntityKind.LINES, EntityKind.CLOUD]


def test_a_marker_is_moved_by_its_pose(draw: Draw) -> None:
    said = marker(Marker.LINE_STRIP, position=(10.0, 0.0, 0.0), orientation=HALF_TURN, points=CORNERS[:3])
    (strip,) = draw(said).one("topic")["LineStrips3D:strips"]
    np.testing.assert_allclose(strip, [[10, 0, 0], [9, 0, 0], [9, -1, 0]], atol=1e-6)


def test_each_line_of_a_plan_has_its_colour(draw: Draw) -> None:
    colours = np.array([[1, 0, 0, 1], [1, 0, 0, 1], [0, 1, 0, 1], [0, 1, 0, 1]], np.float32)
    row = draw(marker(Marker.LINE_LIST, points=CORNERS, colors=colours, scale=(0.002, 0, 0))).one("topic")
    assert row["LineStrips3D:colors"] == [0xFF0000FF, 0x00FF00FF]
    assert row["LineStrips3D:radii"] == [pytest.approx(0.001)]
    assert len(row["LineStrips3D:strips"]) == 2


@pytest.mark.parametrize(
    ("kind", "archetype"),
    [
        (0, "Arrows3D"),
        (1, "Boxes3D"),
        (2, "Ellipsoids3D"),
        (3, "Cylinders3D"),
        (6, "Boxes3D"),
        (Marker.SPHERE_LIST, "Points3D"),
        (Marker.POINTS, "Points3D"),
        (9, "Points3D"),
        (Marker.TRIANGLE_LIST, "Mesh3D"),
    ],
)
def test_every_form_of_marker_is_drawn_in_its_colour(kind: int, archetype: str, draw: Draw) -> None:
    said = marker(kind, points=CORNERS[:3], color=(0.0, 0.0, 1.0, 1.0), text="T1", position=(0.0, 2.0, 0.0))
    row = draw(said).one("topic")
    colour = "Mesh3D:albedo_factor" if archetype == "Mesh3D" else f"{archetype}:colors"
    assert set(row[colour]) == {0x0000FFFF}
    if kind == 9:
        assert row["Points3D:labels"] == ["T1"]


def test_an_arrow_points_along_its_pose(draw: Draw) -> None:
    quarter = (0.0, 0.0, math.sin(math.pi / 4), math.cos(math.pi / 4))
    row = draw(marker(0, orientation=quarter, scale=(0.5, 0.1, 0.1))).one("topic")
    np.testing.assert_allclose(row["Arrows3D:vectors"], [[0, 0.5, 0]], atol=1e-6)


def test_a_form_without_picture_is_said_and_counts(draw: Draw) -> None:
    drawn = draw(marker(10), marker(10))
    assert drawn.count("topic") == 2
    assert sum("markers of type 10 are not drawn" in line for line in drawn.log()) == 1


def test_markers_are_told_apart_and_deleted(draw: Draw) -> None:
    dot = CORNERS[:1]
    drawn = draw(
        marker(Marker.POINTS, "a", 1, points=dot),
        marker(Marker.POINTS, "a", 2, points=dot),
        marker(Marker.POINTS, "a", 1, action=2),
        marker(Marker.POINTS, "a", 2, action=2),
    )
    assert drawn.count("topic") == 4  # the first one's two rows, and one for each message of the other
    assert [row.get("Clear:is_recursive") for row in drawn.rows("topic/a/2")] == [None, [False]]
    assert [row["Clear:is_recursive"] for row in drawn.rows("topic") if "Clear:is_recursive" in row] == [[False]]


def test_markers_of_namespaces_that_differ_in_signs_are_told_apart(draw: Draw) -> None:
    said = [
        marker(Marker.POINTS, ns, 1, points=CORNERS[:1] + number)
        for number, ns in enumerate(("a b", "a_b", "", "unnamed"))
    ]
    drawn = draw(Several(*said), Several(*said))
    paths = ("a_b", "a_b_2", "unnamed", "unnamed_2")
    for number, path in enumerate(paths):
        rows = [row["Points3D:positions"] for row in drawn.rows(f"topic/{path}/1")]
        np.testing.assert_allclose(rows, [[list(CORNERS[0] + number)]] * 2)
    assert sum("is drawn at" in line for line in drawn.log()) == 2


def test_all_markers_of_an_array(draw: Draw) -> None:
    said = Several(marker(Marker.POINTS, "x", 1, points=CORNERS, text="one"), marker(1, "y", 7), marker(3, "y", 8))
    drawn = draw(said)
    assert drawn.count("topic") == 1
    assert len(drawn.one("topic/x/1")["Points3D:positions"]) == 4
    assert "Boxes3D:half_sizes" in drawn.one("topic/y/7")
    assert "Cylinders3D:lengths" in drawn.one("topic/y/8")


def test_trajectories_run_from_entry_to_target(draw: Draw) -> None:
    path = Trajectory("Biopsy", "g", 3, (0, 255, 0, 255), (0.0, 0.0, 0.1), (0.0, 0.0, 0.0), 0.002, "")
    row = draw(TrajectoryList(HEADER, (path,))).one("topic")
    np.testing.assert_allclose(np.array(row["LineStrips3D:strips"]), [[path.entry, path.target]], atol=1e-7)
    assert (row["LineStrips3D:labels"], row["LineStrips3D:colors"]) == (["Biopsy"], [0x00FF00FF])


def test_a_path_is_one_line(draw: Draw) -> None:
    poses = tuple(PoseStamped(HEADER, (float(k), 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)) for k in range(3))
    assert draw(Path(HEADER, poses)).one("topic")["LineStrips3D:strips"] == [[[0.0, 0, 0], [1, 0, 0], [2, 0, 0]]]
