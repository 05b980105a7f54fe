"""PLY and VTK files by the readers of others: attributes that fit, and those that do not."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from igtl_gateway.addons.exchange.account import ExportAccount
from igtl_gateway.addons.exchange.targets import export_to
from igtl_gateway.base.buffers import join
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.record.sessionfile.reader import SessionFile
from igtl_gateway.record.sessionfile.writer import SessionWriter
from igtl_gateway.wire import Message, encode
from igtl_gateway.wire.polydata import CELL, NORMAL, RGBA, SCALAR, TENSOR, VECTOR, Attribute, Cells, PolyData
from tests.addons.exchange.judges import by_meshio, by_vtk

POINTS = np.array([[0, 0, 0], [10, 0, 0], [0, 10, 0], [0, 0, 10]], ">f4")
VALUES = np.arange(64, dtype=">f4")


def attribute(kind: int, name: str, tuples: int, components: int) -> Attribute:
    return Attribute.of(kind, name, VALUES[: tuples * components].reshape(tuples, components))


def exported(tmp_path: Path, to: str, content: PolyData) -> tuple[Path, ExportAccount]:
    """The only file of an export of one POLYDATA, and the account."""
    path = tmp_path / "some.mcap"
    writer = SessionWriter(path, {})
    data = join(encode(Message("POLYDATA", "Surface", content)))
    writer.write(Entry(1, 1, Kind.IGTL_IN, "POLYDATA/Surface", "POLYDATA", (data,), (1,)))
    writer.close({})
    with SessionFile.open(path) as file:
        account = export_to(to, file, tmp_path / to, ())
    (made,) = (tmp_path / to).iterdir()
    return made, account


def told(account: ExportAccount, unit: str) -> tuple[int, int, int, str]:
    (row,) = (row for row in account.parts if row.unit == unit)
    return row.declared, row.taken, row.left_out, row.why


ALL_CELLS = PolyData(
    POINTS,
    Cells.of([[0], [1]]),
    Cells.of([[0, 1], [1, 2, 3]]),
    Cells.of([[0, 1, 2], [0, 1, 2, 3]]),
    Cells.of([[0, 1, 2, 3]]),
)


@pytest.mark.slow
def test_vtk_reads_every_attribute_that_fits(tmp_path: Path) -> None:
    fitting = (
        attribute(SCALAR, "heat", 4, 1),
        attribute(VECTOR, "flow", 4, 3),
        attribute(NORMAL, "normals", 4, 3),
        attribute(TENSOR, "stress", 4, 9),
        attribute(SCALAR, "of 7", 4, 7),
        attribute(CELL | SCALAR, "quality", 7, 1),
        attribute(CELL | VECTOR, "heat", 7, 3),  # of cells: another one
    )
    content = PolyData(*(POINTS, *ALL_CELLS.cells), attributes=fitting)
    path, account = exported(tmp_path, "vtk", content)
    found = by_vtk(path)
    assert (found.points == POINTS).all()
    assert found.cells == [cell for cells in content.cells for cell in cells.lists()]
    assert list(found.of_points) == ["normals", "heat", "flow", "stress", "of 7"]
    assert list(found.of_cells) == ["quality", "heat"]
    for one in fitting:
        array = (found.of_cells if one.type & CELL else found.of_points)[one.name]
        assert (array == one.values).all()
    assert told(account, "attributes") == (7, 7, 0, "")
    assert not [row for row in account.parts if row.left_out]


@pytest.mark.parametrize("to", ["vtk", "ply"])
def test_attributes_that_fit_nothing_are_counted(tmp_path: Path, to: str) -> None:
    unfit = (attribute(SCALAR, "heat", 3, 1), attribute(CELL | SCALAR, "quality", 4, 1), attribute(RGBA, "RGBA", 5, 4))
    good = attribute(NORMAL, "normals", 4, 3)
    path, account = exported(tmp_path, to, PolyData(*(POINTS, *ALL_CELLS.cells), attributes=(*unfit, good)))
    found = by_vtk(path)
    assert len(found.of_points) == 1
    assert not found.of_cells
    why = "1: 3 values for 4 points; 1: 4 values for 7 cells; 1: 5 values for 4 points"
    assert told(account, "attributes") == (4, 1, 3, why)


def test_ply_counts_what_it_has_no_place_for(tmp_path: Path) -> None:
    twice = (attribute(NORMAL, "a", 4, 3), attribute(NORMAL, "b", 4, 3), attribute(SCALAR, "heat", 4, 1))
    path, account = exported(tmp_path, "ply", PolyData(*(POINTS, *ALL_CELLS.cells), attributes=twice))
    assert sorted(by_vtk(path).cells) == sorted(by_meshio(path).cells) == [[0, 1, 2], [0, 1, 2, 3]]
    assert told(account, "attributes")[:3] == (3, 1, 2)
    assert told(account, "polygons")[:3] == (2, 2, 0)
    for unit, count in (("vertex cells", 2), ("lines", 2), ("triangle strips", 1)):
        assert told(account, unit) == (count, 0, count, "PLY has no cells of this kind")


@pytest.mark.parametrize(("highest", "scale"), [(1.0, 255.0), (255.0, 1.0)])
def test_colours_of_ply_are_bytes(tmp_path: Path, highest: float, scale: float) -> None:
    colours = np.array([[1, 0, 0, 1], [0, 1, 0, 1], [0, 0, 1, 0], [np.nan, -1, 0.5, 1]], ">f4") * highest
    path, _ = exported(tmp_path, "ply", PolyData(POINTS, attributes=(Attribute.of(RGBA, "", colours),)))
    expected = np.rint(np.clip(np.nan_to_num(colours.astype(float)), 0, highest) * scale)
    assert (by_vtk(path).of_points["RGBA"] == expected).all()
    other = by_meshio(path).of_points
    assert (np.stack([other[name] for name in ("red", "green", "blue", "alpha")], axis=1) == expected).all()


def test_programs_use_normals_and_colours_of_vtk_as_such(tmp_path: Path) -> None:
    """A plain field is neither: the surface would be flat-shaded and grey."""
    vtk = pytest.importorskip("vtk")
    colours = np.array([[1, 0, 0, 1], [0, 1, 0, 1], [0, 0, 1, 0], [0.2, 0.4, 0.6, 1]], ">f4")
    given = (attribute(NORMAL, "n", 4, 3), attribute(NORMAL, "m", 4, 3), Attribute.of(RGBA, "RGBA", colours))
    path, account = exported(tmp_path, "vtk", PolyData(POINTS, attributes=given))
    reader = vtk.vtkPolyDataReader()
    reader.SetFileName(str(path))
    reader.Update()
    data = reader.GetOutput().GetPointData()
    assert data.GetNormals().GetName() == "n"
    scalars = data.GetScalars()
    assert (scalars.GetName(), scalars.GetDataTypeAsString()) == ("colours", "unsigned char")
    found = by_vtk(path).of_points
    assert (found["colours"] == np.rint(colours * 255)).all() and (found["RGBA"] == colours).all()
    assert told(account, "attributes") == (3, 3, 0, "")


def test_names_of_attributes_are_kept_apart(tmp_path: Path) -> None:
    names = ["", "a b", "a b", 'x"y%z', "Größe", "POINT_DATA 4\nFIELD x 1", "a b_"]
    given = tuple(attribute(SCALAR, name, 4, 1) for name in names)
    path, account = exported(tmp_path, "vtk", PolyData(POINTS, attributes=given))
    found = by_vtk(path)
    assert list(found.of_points) == ["attribute0", "a b", "a b_", *names[3:6], "a b__"]
    assert all((values == given[0].values).all() for values in found.of_points.values())
    assert told(account, "attributes") == (7, 7, 0, "")


@pytest.mark.parametrize("to", ["vtk", "ply"])
def test_nothing_is_a_surface_too(tmp_path: Path, to: str) -> None:
    empty = PolyData(np.empty((0, 3), ">f4"), attributes=(Attribute(SCALAR, "none", 0, np.empty(0, ">f4")),))
    path, account = exported(tmp_path, to, empty)
    found = by_vtk(path)
    assert (len(found.points), found.cells, found.of_points) == (0, [], {})
    assert told(account, "attributes")[:3] == (1, 0, 1)


@pytest.mark.parametrize("to", ["vtk", "ply"])
def test_slicer_is_told_the_space(to: str, tmp_path: Path) -> None:
    """3D Slicer takes points for LPS where neither title nor comment has ``SPACE=RAS``."""
    path, _ = exported(tmp_path, to, ALL_CELLS)
    assert by_vtk(path).title == "igtl-gateway, millimetres, SPACE=RAS"


@pytest.mark.parametrize(("corners", "kind"), [(3, b"uchar"), (255, b"uchar"), (256, b"uint")])
def test_counts_of_faces_have_one_byte_where_they_fit(corners: int, kind: bytes, tmp_path: Path) -> None:
    points = np.arange(3 * 300, dtype=">f4").reshape(300, 3)
    faces = [list(range(corners)), [7, 6, 5], [1, 2, 3, 4]]
    path, _ = exported(tmp_path, "ply", PolyData(points, polygons=Cells.of(faces)))
    assert b"property list " + kind + b" int vertex_indices" in path.read_bytes()
    assert sorted(by_meshio(path).cells) == sorted(faces)
    if corners <= 255:  # VTK's reader of PLY counts in one byte, and shows a larger face as an empty one
        assert sorted(by_vtk(path).cells) == sorted(faces)
