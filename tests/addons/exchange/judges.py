"""Programs of others that read what an export wrote, and count it."""

from __future__ import annotations

import csv
from collections import Counter
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader

from igtl_gateway.record.sessionfile.layout import KIND_KEY

MESSAGE_KINDS = {"igtl_in", "igtl_out", "ros_in", "ros_out"}


def messages_in(recording: Path) -> int:
    """OpenIGTLink and ROS messages of a session, counted by the reader of the mcap package."""
    with recording.open("rb") as stream:
        return sum(channel.metadata[KIND_KEY] in MESSAGE_KINDS for _, channel, _ in make_reader(stream).iter_messages())


def entries_of_tables(folder: Path) -> Counter[int]:
    """Rows of each entry in a folder of CSV files, by Python's csv module and by pandas."""
    pandas = pytest.importorskip("pandas")
    rows: Counter[int] = Counter()
    for path in sorted(folder.iterdir()):
        with path.open(encoding="utf-8", newline="") as stream:
            reader = csv.reader(stream)
            header = next(reader)
            assert len(set(header)) == len(header), path
            lines = list(reader)
        assert {len(line) for line in lines} == {len(header)}, path
        frame = pandas.read_csv(path, low_memory=False)
        assert list(frame.columns) == header
        assert list(frame["entry"]) == [int(line[0]) for line in lines]
        rows.update(int(line[0]) for line in lines)
    return rows


@dataclass
class Shape:
    """What a reader finds in the file of a surface."""

    points: np.ndarray
    cells: list[list[int]]
    of_points: dict[str, np.ndarray] = field(default_factory=dict)
    of_cells: dict[str, np.ndarray] = field(default_factory=dict)
    title: str = ""


def by_vtk(path: Path) -> Shape:
    """A legacy VTK or PLY file by VTK itself."""
    vtk = pytest.importorskip("vtk")
    support = pytest.importorskip("vtk.util.numpy_support")
    reader: Any = vtk.vtkPolyDataReader() if path.suffix == ".vtk" else vtk.vtkPLYReader()
    problems: list[str] = []
    reader.AddObserver("ErrorEvent", lambda *_: problems.append("error"))
    reader.AddObserver("WarningEvent", lambda *_: problems.append("warning"))
    reader.SetFileName(str(path))
    reader.Update()
    assert not problems, path
    found = reader.GetOutput()
    cells: list[list[int]] = []
    for section in (found.GetVerts(), found.GetLines(), found.GetPolys(), found.GetStrips()):
        offsets = support.vtk_to_numpy(section.GetOffsetsArray()).tolist()
        indices = support.vtk_to_numpy(section.GetConnectivityArray()).tolist()
        cells += (indices[start:end] for start, end in pairwise(offsets))
    data = found.GetPoints()
    points = support.vtk_to_numpy(data.GetData()) if data and found.GetNumberOfPoints() else np.empty((0, 3))
    title = reader.GetHeader() if path.suffix == ".vtk" else reader.GetComments().GetValue(0)
    return Shape(points, cells, _arrays(found.GetPointData(), support), _arrays(found.GetCellData(), support), title)


def _arrays(data: Any, support: Any) -> dict[str, np.ndarray]:
    found = {}
    for index in range(data.GetNumberOfArrays()):
        array = data.GetArray(index)
        values = support.vtk_to_numpy(array)
        found[array.GetName()] = values.reshape(array.GetNumberOfTuples(), array.GetNumberOfComponents())
    return found


def by_meshio(path: Path) -> Shape:
    """A PLY file by meshio; it does not read the POLYDATA of VTK."""
    mesh = pytest.importorskip("meshio").read(path)
    cells = [list(map(int, cell)) for block in mesh.cells for cell in block.data]
    return Shape(mesh.points, cells, dict(mesh.point_data))
