"""Files of 3D Slicer as messages: names of devices and points, lines as paths, planes and boxes as surfaces."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from igtl_gateway.addon import GatewayError
from igtl_gateway.addon.igtl import Points, PolyData, Trajectories
from igtl_gateway.addons.exchange.markups import LINE, Markup
from igtl_gateway.addons.exchange.slicer_file import SlicerFile, content_of, open_markups, open_transform
from igtl_gateway.addons.exchange.source import ImportedItem
from igtl_gateway.gateway.log.entry import Kind
from igtl_gateway.wire import Message, decode
from tests.tables import table


def read(path: Path) -> tuple[list[Message], SlicerFile, list[ImportedItem]]:
    source = (open_transform if path.suffix == ".tfm" else open_markups)(path, 7)
    items = list(source.items())
    source.close()
    return [decode(bytes(item.payload)) for item in items if item.kind is Kind.IGTL_IN], source, items


def markups(folder: Path, *rows: dict[str, Any], name: str = "Targets.mrk.json") -> Path:
    path = folder / name
    path.write_text(json.dumps({"markups": rows}))
    return path


def row(kind: str, *points: list[float], **more: Any) -> dict[str, Any]:
    found = [{"label": f"{kind[0]}-{number}", "position": point} for number, point in enumerate(points, 1)]
    return {"type": kind, "coordinateSystem": "RAS", "coordinateUnits": "mm", "controlPoints": found} | more


def test_points_keep_their_order_and_labels(tmp_path: Path) -> None:
    (message,), source, items = read(markups(tmp_path, row("Fiducial", [1, 2, 3], [4, 5, 6])))
    assert (message.type, message.device_name) == ("POINT", "Targets")
    points = message.content
    assert isinstance(points, Points)
    assert points.elements["name"].tolist() == [b"F-1", b"F-2"] and set(points.elements["group"]) == {b"Fiducial"}
    assert points.elements["position"].tolist() == [[1, 2, 3], [4, 5, 6]]
    assert [(each.stream, each.declared, each.taken, each.type) for each in source.rows] == [("Targets", 1, 1, "POINT")]
    assert {item.time_ns for item in items} == {7} and source.notes == []


def test_a_file_of_lps_is_in_ras(tmp_path: Path) -> None:
    (message,), _, _ = read(markups(tmp_path, row("Fiducial", [1, 2, 3], coordinateSystem="LPS")))
    assert message.content.elements["position"].tolist() == [[-1, -2, 3]]  # type: ignore[attr-defined]


def test_a_line_is_a_path_from_its_first_point_to_its_second(tmp_path: Path) -> None:
    (message,), _, _ = read(markups(tmp_path, row("Line", [1, 2, 3], [4, 5, 6])))
    path = message.content
    assert message.type == "TRAJ" and isinstance(path, Trajectories)
    (one,) = path.elements
    assert (one["name"], one["group"], one["type"]) == (b"L-1", b"Line", 3)
    assert one["entry"].tolist() == [1, 2, 3] and one["target"].tolist() == [4, 5, 6]
    (half,), _, _ = read(markups(tmp_path, row("Line", [1, 2, 3]), name="half.mrk.json"))
    assert half.type == "POINT", "a line with one point is no path"


@table("kind", ["Angle", "Curve", "ClosedCurve"])
def test_other_kinds_are_points(kind: str, tmp_path: Path) -> None:
    (message,), _, _ = read(markups(tmp_path, row(kind, [1, 2, 3], [4, 5, 6], [7, 8, 9])))
    assert message.type == "POINT" and set(message.content.elements["group"]) == {kind.encode()}  # type: ignore[attr-defined]


def test_a_box_with_a_size_is_a_closed_surface_too(tmp_path: Path) -> None:
    box = row("ROI", [10, 20, 30], center=[10, 20, 30], size=[2, 4, 6], orientation=[1, 0, 0, 0, 1, 0, 0, 0, 1])
    (points, surface), source, _ = read(markups(tmp_path, box))
    assert points.type == "POINT" and surface.type == "POLYDATA"
    mesh = surface.content
    assert isinstance(mesh, PolyData)
    assert sorted(mesh.points.tolist()) == sorted([x, y, z] for x in (9, 11) for y in (18, 22) for z in (27, 33))
    faces = mesh.polygons.lists()
    edges = [edge for face in faces for edge in zip(face, [*face[1:], face[0]], strict=True)]
    assert len(faces) == 6 and sorted(edges) == sorted((b, a) for a, b in edges), "each edge is of two faces"
    centre = mesh.points.mean(axis=0)
    for face in faces:
        a, b, c = (mesh.points[index] for index in face[:3])
        assert np.dot(np.cross(b - a, c - b), a - centre) > 0, "its faces look outwards"
    assert [each.type for each in source.rows] == ["POINT", "POLYDATA"]


def test_a_plane_without_a_size_has_points_only_and_it_is_noted(tmp_path: Path) -> None:
    (message,), source, _ = read(markups(tmp_path, row("ROI", [1, 2, 3])))
    assert message.type == "POINT"
    assert source.notes == ["Targets: the ROI has no size around its centre: only its points are imported"]


def test_points_without_a_position_are_counted(tmp_path: Path) -> None:
    points = row("Fiducial", [1, 2, 3])
    points["controlPoints"].append({"label": "x", "position": [0, 0, 0], "positionStatus": "undefined"})
    (message,), source, _ = read(markups(tmp_path, points))
    assert len(message.content.elements) == 1  # type: ignore[attr-defined]
    assert source.rows[0].why == "without 1 control point that has no position"


def test_several_markups_have_numbers_behind_their_names(tmp_path: Path) -> None:
    path = markups(tmp_path, *[row("Fiducial", [1, 2, 3])] * 12, name="a" * 30 + ".mrk.json")
    messages, source, _ = read(path)
    names = [message.device_name for message in messages]
    assert names == [*("a" * 19 + str(n) for n in range(1, 10)), *("a" * 18 + str(n) for n in range(10, 13))]
    assert source.notes == [f"{'a' * 30}: shortened to {'a' * 20}, because a device name has at most 20 bytes"]


@table(
    ("name", "device"),
    [("Targets.mrk.json", "Targets"), ("A.B.JSON", "A.B"), ("Größe.mrk.json", "Größe"), ("é" * 11 + ".json", "é" * 10)],
)
def test_the_device_has_the_name_of_the_file(name: str, device: str, tmp_path: Path) -> None:
    (message,), _, _ = read(markups(tmp_path, row("Fiducial", [1, 2, 3]), name=name))
    assert message.device_name == device


def test_long_labels_are_cut_and_noted(tmp_path: Path) -> None:
    points = row("Fiducial", [1, 2, 3], [4, 5, 6])
    points["controlPoints"][0]["label"] = "é" * 32 + "x"
    (message,), source, _ = read(markups(tmp_path, points))
    assert message.content.elements["name"].tolist() == [("é" * 32).encode(), b"F-2"]  # type: ignore[attr-defined]
    assert source.notes == ["Targets: 1 label is cut to 64 bytes, which is the most that POINT has"]


def test_a_file_without_markups_or_without_a_space(tmp_path: Path) -> None:
    with pytest.raises(GatewayError, match="found no markups, expected some"):
        open_markups(markups(tmp_path), 7)
    space = row("Fiducial", [1, 2, 3])
    del space["coordinateSystem"]
    (message,), source, _ = read(markups(tmp_path, space))
    assert source.notes == ["Targets: the file states no coordinate system: LPS, as in 3D Slicer"]
    assert message.content.elements["position"].tolist() == [[-1, -2, 3]]  # type: ignore[attr-defined]


def test_colours_are_those_of_all_points() -> None:
    kind, points = content_of(Markup("Fiducial", ["a", "b"], [(0.0, 0.0, 0.0)] * 2, rgba=(1, 2, 3, 4)))
    assert kind == "POINT" and points.elements["rgba"].tolist() == [[1, 2, 3, 4]] * 2  # type: ignore[attr-defined]
    kind, path = content_of(Markup(LINE, ["a", "b"], [(0.0, 0.0, 0.0)] * 2, rgba=(1, 2, 3, 4)))
    assert kind == "TRAJ" and path.elements["rgba"].tolist() == [[1, 2, 3, 4]]  # type: ignore[attr-defined]


TRANSFORM = (
    "#Insight Transform File V1.0\n#Transform 0\nTransform: AffineTransform_double_3_3\n"
    "Parameters: {}\nFixedParameters: 0 0 0\n"
)


def test_a_transform_is_that_of_the_node_in_ras(tmp_path: Path) -> None:
    (tmp_path / "Tool.tfm").write_text(TRANSFORM.format("1 0 0 0 1 0 0 0 1 10 20 30"))
    (message,), source, _ = read(tmp_path / "Tool.tfm")
    assert (message.type, message.device_name) == ("TRANSFORM", "Tool")
    rows = message.content.rows  # type: ignore[attr-defined]
    assert [each[3] for each in rows[:3]] == [10.0, 20.0, -30.0]
    assert source.facts["imported_format"] == "transform"
    assert source.notes == ["AffineTransform: the transform from the node to its parent in RAS, which 3D Slicer shows"]


def test_a_matrix_that_is_no_pose_is_refused(tmp_path: Path) -> None:
    (tmp_path / "Tool.tfm").write_text(TRANSFORM.format("1 0 0 0 1 0 0 0 1 10 1e300 30"))
    with pytest.raises(GatewayError, match=r"found a matrix \(not finite, or beyond float32\), expected"):
        open_transform(tmp_path / "Tool.tfm", 7)
