"""What 3D Slicer writes and ``import`` reads: transforms and markups, with Slicer's own numbers as the truth."""

from __future__ import annotations

from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from igtl_gateway.addons.exchange.formats import open_source
from igtl_gateway.base.errors import UnsupportedRecording
from igtl_gateway.gateway.log.entry import Kind
from igtl_gateway.wire import decode
from igtl_gateway.wire.message import Message
from igtl_gateway.wire.point import Points
from igtl_gateway.wire.polydata import PolyData
from igtl_gateway.wire.trajectory import Trajectories
from igtl_gateway.wire.transform import Transform
from tests import slicer

#: Turned about three axes, scaled, sheared and moved.
GENERAL = np.array([[0.9, -0.2, 0.3, 120.5], [0.1, 1.2, -0.4, -33.25], [-0.25, 0.5, 0.8, 7.125], [0, 0, 0, 1]])
POINTS = [(1.0, 2.0, 3.0), (-40.5, 5.25, 7.0), (8.0, -1.0, 2.5)]
LABELS = ["F-1", 'a, "quoted" one', "Öse"]
TRANSFORMS = (".h5", ".tfm", ".mat", ".txt")


@pytest.fixture(name="scene")
def _scene(tmp_path: Path) -> Any:
    return slicer.new_scene(tmp_path / "cache")


def imported(path: Path) -> list[Message]:
    """The messages that a file is imported as."""
    with closing(open_source(path)) as source:
        messages = [decode(item.payload) for item in source.items() if item.kind is Kind.IGTL_IN]
        assert [row for row in source.rows if not row.good] == []
    return messages


@pytest.mark.parametrize("suffix", TRANSFORMS)
def test_a_transform_that_slicer_wrote(scene: Any, tmp_path: Path, suffix: str) -> None:
    node = slicer.new_node(scene, "LinearTransform")
    node.SetMatrixTransformToParent(slicer.new_matrix(GENERAL))
    path = slicer.write(node, "Transform", tmp_path / f"ProbeToTracker{suffix}")
    (message,) = imported(path)
    assert isinstance(message.content, Transform)
    assert np.allclose(message.content.rows, slicer.to_parent(slicer.read(scene, "Transform", "Transform", path)))
    assert message.device_name == "ProbeToTracker"
    assert np.allclose(message.content.rows, GENERAL, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("suffix", (".h5", ".tfm", ".txt"))
def test_a_composite_that_slicer_wrote(scene: Any, tmp_path: Path, suffix: str) -> None:
    import vtk

    inner, both = vtk.vtkTransform(), vtk.vtkGeneralTransform()
    inner.SetMatrix(GENERAL.ravel().tolist())
    both.Concatenate(inner)
    both.RotateWXYZ(30, 0.1, 0.2, 0.9)
    both.Translate(5, 6, 7)
    node = slicer.new_node(scene, "Transform")
    node.SetAndObserveTransformToParent(both)
    (message,) = imported(slicer.write(node, "Transform", tmp_path / f"t{suffix}"))
    assert isinstance(message.content, Transform)
    matrix = np.array(message.content.rows)
    for point in POINTS:
        assert np.allclose((matrix @ [*point, 1.0])[:3], both.TransformPoint(point), atol=1e-4)


@pytest.mark.parametrize("suffix", (".h5", ".tfm"))
def test_a_grid_that_slicer_wrote_is_refused_by_name(scene: Any, tmp_path: Path, suffix: str) -> None:
    module = slicer.slicer()
    import vtk

    grid, picture = module.vtkOrientedGridTransform(), vtk.vtkImageData()
    picture.SetDimensions(4, 5, 6)
    picture.AllocateScalars(vtk.VTK_DOUBLE, 3)
    slicer.values_of(picture.GetPointData().GetScalars())[:] = 1.5
    grid.SetDisplacementGridData(picture)
    node = slicer.new_node(scene, "GridTransform")
    node.SetAndObserveTransformFromParent(grid)
    path = slicer.write(node, "Transform", tmp_path / f"t{suffix}")
    with pytest.raises(UnsupportedRecording, match=r"found a displacement grid .*expected a linear transform"):
        open_source(path)


def markup(scene: Any, kind: str) -> Any:
    """A node of a kind with the points and labels above, as many as it takes."""
    node = slicer.new_node(scene, f"Markups{kind}")
    count = {"Line": 2, "Plane": 0, "ROI": 0}.get(kind, 3)
    for position, label in zip(POINTS[:count], LABELS, strict=False):
        slicer.add_point(node, position, label)
    return node


@pytest.mark.parametrize("kind", ["Fiducial", "Angle", "Curve", "ClosedCurve"])
@pytest.mark.parametrize("suffix", [".mrk.json", ".fcsv"])
def test_points_that_slicer_wrote(scene: Any, tmp_path: Path, kind: str, suffix: str) -> None:
    if suffix == ".fcsv" and kind != "Fiducial":
        return
    storage = "MarkupsFiducial" if suffix == ".fcsv" else "MarkupsJson"
    (message,) = imported(slicer.write(markup(scene, kind), storage, tmp_path / f"Plan{suffix}"))
    assert isinstance(message.content, Points)
    assert np.array_equal(message.content.elements["position"], np.array(POINTS, np.float32))
    assert [bytes(name).decode() for name in message.content.elements["name"]] == LABELS
    assert {bytes(group).decode() for group in message.content.elements["group"]} == {kind}


def test_a_line_that_slicer_wrote_is_a_path(scene: Any, tmp_path: Path) -> None:
    (message,) = imported(slicer.write(markup(scene, "Line"), "MarkupsJson", tmp_path / "Needle.mrk.json"))
    assert isinstance(message.content, Trajectories)
    assert message.content.elements["entry"].tolist() == [list(POINTS[0])]
    assert message.content.elements["target"].tolist() == [list(POINTS[1])]


@pytest.mark.parametrize("suffix", [".mrk.json", ".fcsv"])
def test_points_without_a_position_are_left_out(scene: Any, tmp_path: Path, suffix: str) -> None:
    node = markup(scene, "Fiducial")
    node.UnsetNthControlPointPosition(1)
    path = slicer.write(node, "MarkupsFiducial" if suffix == ".fcsv" else "MarkupsJson", tmp_path / f"F{suffix}")
    with closing(open_source(path)) as source:
        (message,) = [decode(item.payload) for item in source.items() if item.kind is Kind.IGTL_IN]
        assert [row.why for row in source.rows] == ["without 1 control point that has no position"]
    assert isinstance(message.content, Points)
    assert np.array_equal(message.content.elements["position"], np.array(POINTS[::2], np.float32))


def test_a_plane_and_a_box_that_slicer_wrote_are_surfaces_too(scene: Any, tmp_path: Path) -> None:
    import vtk

    plane = slicer.new_node(scene, "MarkupsPlane")
    plane.SetCenter(1, 2, 3)
    plane.SetNormal(0, 0.6, 0.8)
    plane.SetSize(10, 20)
    points, surface = imported(slicer.write(plane, "MarkupsPlaneJson", tmp_path / "Cut.mrk.json"))
    assert isinstance(points.content, Points) and isinstance(surface.content, PolyData)
    corners = vtk.vtkPoints()
    plane.GetPlaneCornerPoints(corners)
    assert _same(surface.content.points, slicer.values_of(corners.GetData()))

    box = slicer.new_node(scene, "MarkupsROI")
    box.SetCenter(1, 2, 3)
    box.SetSize(10, 20, 30)
    _, surface = imported(slicer.write(box, "MarkupsROIJson", tmp_path / "Box.mrk.json"))
    assert isinstance(surface.content, PolyData)
    bounds = [0.0] * 6
    box.GetRASBounds(bounds)
    assert surface.content.points.min(0).tolist() == bounds[::2]
    assert surface.content.points.max(0).tolist() == bounds[1::2]
    assert surface.content.polygons.count == 6


#: Points of other versions of 3D Slicer: the head, and a point at (-1.5, 2, 3) in it.
_COLUMNS = "# columns = id,x,y,z,ow,ox,oy,oz,vis,sel,lock,label,desc,associatedNodeID"
_ROW = "vtkMRMLMarkupsFiducialNode_0,-1.5,2,3,0,0,0,1,1,1,0,F-1,,"
OLDER = {
    "4.0": f"# Markups fiducial file version = 4.0\n# CoordinateSystem = 0\n{_COLUMNS}\n{_ROW}\n",
    "4.6": f"# Markups fiducial file version = 4.6\n# CoordinateSystem = 1\n{_COLUMNS}\n{_ROW}Volume1\n",
    "4.10": f"# Markups fiducial file version = 4.10\n# CoordinateSystem = RAS\n{_COLUMNS}\n{_ROW}\n",
    "4.11": f"# Markups fiducial file version = 4.11\n# CoordinateSystem = LPS\n{_COLUMNS}\n{_ROW},2,0\n",
    "5.0": f"# Markups fiducial file version = 5.0\r\n# CoordinateSystem = LPS\r\n{_COLUMNS}\r\n{_ROW},2,0\r\n",
    "no space": f"# Markups fiducial file version = 4.4\n{_COLUMNS}\n{_ROW}\n",
}


@pytest.mark.parametrize("version", OLDER)
def test_points_of_other_versions_are_where_slicer_reads_them(scene: Any, tmp_path: Path, version: str) -> None:
    path = tmp_path / "Old.fcsv"
    path.write_bytes(OLDER[version].encode())
    node, position = slicer.new_node(scene, "MarkupsFiducial"), [0.0] * 3
    storage = scene.AddNewNodeByClass("vtkMRMLMarkupsFiducialStorageNode")
    storage.SetFileName(str(path))
    with slicer.log_of():  # which warns of old spaces
        assert storage.ReadData(node)
    node.GetNthControlPointPosition(0, position)
    (message,) = imported(path)
    assert isinstance(message.content, Points)
    assert message.content.elements["position"].tolist() == [position]
    assert node.GetNthControlPointLabel(0) == bytes(message.content.elements["name"][0]).decode()


@pytest.mark.parametrize("space", ['"LPS"', '"RAS"', '"0"', '"1"', ""])
def test_spaces_of_markups_are_those_of_slicer(scene: Any, tmp_path: Path, space: str) -> None:
    path, position = tmp_path / "F.mrk.json", [0.0] * 3
    stated = f'"coordinateSystem": {space}, ' if space else ""
    path.write_text(
        f'{{"@schema": "markups-schema-v1.0.0.json#", "markups": [{{"type": "Fiducial", {stated}'
        '"controlPoints": [{"label": "F-1", "position": [-1.5, 2.0, 3.0]}]}]}'
    )
    storage = scene.AddNewNodeByClass("vtkMRMLMarkupsJsonStorageNode")
    storage.SetFileName(str(path))
    node = slicer.new_node(scene, "MarkupsFiducial")
    with slicer.log_of():
        assert storage.ReadData(node)
    node.GetNthControlPointPosition(0, position)
    (message,) = imported(path)
    assert isinstance(message.content, Points)
    assert message.content.elements["position"].tolist() == [position]


def _same(found: np.ndarray, expected: np.ndarray) -> bool:
    """Whether two sets of points are equal, in any order."""
    found, expected = (np.round(points.astype(float), 4) + 0.0 for points in (found, expected))
    return sorted(map(tuple, found.tolist())) == sorted(map(tuple, expected.tolist()))
