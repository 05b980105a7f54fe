"""Exports of streams whose unit is not the millimetre: files have millimetres, as their columns are named."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import numpy as np
import pyarrow.parquet
import pytest

import igtl_gateway
from igtl_gateway.addons.exchange.targets import export_to
from igtl_gateway.base.buffers import join
from igtl_gateway.cli import main
from igtl_gateway.config.configuration import Config, ToRosRow
from igtl_gateway.convert.igtl_msgs import Volume
from igtl_gateway.convert.rosmsg import Header
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.record.sessionfile.reader import SessionFile
from igtl_gateway.record.sessionfile.writer import SessionWriter
from igtl_gateway.wire import Message, encode
from igtl_gateway.wire.body import Body
from igtl_gateway.wire.image import Image
from igtl_gateway.wire.point import POINT_DTYPE, Points
from igtl_gateway.wire.polydata import NO_CELLS, PolyData
from igtl_gateway.wire.transform import Transform
from tests.places import FIXTURES

POSE = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0, 0.25, -0.5, 2.0)
#: Pixels of 0.5 m: axes as long as a pixel, and the centre.
PIXELS = (0.5, 0.0, 0.0, 0.0, 0.5, 0.0, 0.0, 0.0, 0.5, 0.25, -0.5, 2.0)


def recorded(path: Path, **messages: Body) -> Path:
    """A session of a peer whose unit is the metre."""
    config = Config(to_ros=(ToRosRow(device="Peer", igtl_unit="m"),), ros_unit="cm")
    writer = SessionWriter(path, {"config": json.dumps(config.to_dict())})
    for number, (kind, content) in enumerate(messages.items(), 1):
        data = join(encode(Message(kind, "Peer", content)))
        writer.write(Entry(number, number, Kind.IGTL_IN, f"{kind}/Peer", kind, (data,), (1,)))
    volume = Volume(
        Header(1, "ct"), (1, 1, 1), 3, 1, False, 1, (1, 0, 0, 0, 1, 0, 0, 0, 1), (2, 2, 2), (3, 4, 5), b"\0"
    )
    writer.write(Entry(9, 9, Kind.ROS_IN, "/ct", Volume.TYPE, (volume.pack(),)))
    writer.close({})
    return path


def test_tables_of_a_robot_of_crtk(tmp_path: Path) -> None:
    """The finding: ``x_mm`` contained metres."""
    source, stream = FIXTURES / "crtk.mcap", "TRANSFORM/PSM1/measured_cp"
    for to in ("csv", "parquet"):
        assert main(["export", str(source), "--to", to, "--streams", stream, "-o", str(tmp_path / to)]) == 0
    (made,) = (tmp_path / "csv").iterdir()
    with made.open(newline="") as text:
        rows = list(csv.DictReader(text))
    (made,) = (tmp_path / "parquet").iterdir()
    table = pyarrow.parquet.read_table(made)
    with igtl_gateway.open(source) as recording:
        poses = recording[stream].poses()
        of_python = recording[stream].to_arrow()
    assert poses.unit == "m" and 0.001 < np.abs(poses.positions).max() < 1.0
    for axis, name in enumerate(("x_mm", "y_mm", "z_mm")):
        expected = poses.positions[:, axis] * 1000
        assert [float(row[name]) for row in rows] == expected.tolist()
        assert table[name].to_pylist() == of_python[name].to_pylist() == expected.tolist()


def test_every_table_has_millimetres(tmp_path: Path) -> None:
    points = np.zeros(1, POINT_DTYPE)
    points["position"], points["diameter"] = (0.5, 1.0, -2.0), 0.25
    surface = PolyData(np.array([[0.5, 1.0, -2.0]], ">f4"), NO_CELLS, NO_CELLS, NO_CELLS, NO_CELLS, ())
    path = recorded(tmp_path / "some.mcap", TRANSFORM=Transform(POSE), POINT=Points(points), POLYDATA=surface)
    with SessionFile.open(path) as file:
        for to in ("csv", "arrow"):
            export_to(to, file, tmp_path / to, ())
    (made,) = (tmp_path / "csv").glob("*POINT*")
    with made.open(newline="") as text:
        (row,) = csv.DictReader(text)
    names = ("x_mm", "y_mm", "z_mm")
    assert [float(row[f"elements.position.{name}"]) for name in names] == [500.0, 1000.0, -2000.0]
    assert float(row["elements.diameter_mm"]) == 250.0
    (made,) = (tmp_path / "arrow").glob("*POLYDATA*")
    assert pyarrow.ipc.open_file(made).read_all()["points_mm"].to_pylist() == [[[500.0, 1000.0, -2000.0]]]
    (made,) = (tmp_path / "arrow").glob("*TRANSFORM*")
    table = pyarrow.ipc.open_file(made).read_all()
    assert [table[name].to_pylist() for name in names] == [[250.0], [-500.0], [2000.0]]


@pytest.mark.parametrize("to", ["ply", "vtk"])
def test_surfaces_have_millimetres(tmp_path: Path, to: str) -> None:
    surface = PolyData(np.array([[0.5, 1.0, -2.0]], ">f4"), NO_CELLS, NO_CELLS, NO_CELLS, NO_CELLS, ())
    with SessionFile.open(recorded(tmp_path / "some.mcap", POLYDATA=surface)) as file:
        export_to(to, file, tmp_path / to, ())
    (made,) = (tmp_path / to).iterdir()
    wanted = np.array([500.0, 1000.0, -2000.0], "<f4" if to == "ply" else ">f4").tobytes()
    assert wanted in made.read_bytes()


def test_pictures_have_millimetres(tmp_path: Path) -> None:
    image = Image((1, 1, 1), 3, b"\0", wire_matrix=PIXELS)
    path = recorded(tmp_path / "some.mcap", TRANSFORM=Transform(POSE), IMAGE=image)
    with SessionFile.open(path) as file:
        export_to("nrrd", file, tmp_path / "nrrd", ())
        export_to("igs.mha", file, tmp_path / "some.igs.mha", ())
    (made,) = (tmp_path / "nrrd").glob("*IMAGE*")
    assert b"space directions: (500,0,0) (0,500,0) (0,0,500)\nspace origin: (250,-500,2000)" in made.read_bytes()
    (made,) = (tmp_path / "nrrd").glob("*ct*")
    assert b"space directions: (20,0,0) (0,20,0) (0,0,20)\nspace origin: (30,40,50)" in made.read_bytes()
    (made,) = tmp_path.glob("some.igs.mha")
    text = made.read_bytes()
    assert b"ElementSpacing = 500 500" in text
    assert b"Seq_Frame0000_PeerTransform = 1 0 0 250 0 1 0 -500 0 0 1 2000 0 0 0 1\n" in text
