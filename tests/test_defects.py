"""``docs/evidence/defects.md``: every test that it names is there, and the defects that no other test has."""

from __future__ import annotations

import ast
import re
import struct
from functools import cache

import numpy as np

from igtl_gateway.base.buffers import join
from igtl_gateway.base.stamp import ns_to_ticks
from igtl_gateway.convert import rosmsg
from igtl_gateway.convert.igtl_msgs import PointList
from igtl_gateway.convert.rosmsg import Header, Image, Mesh
from igtl_gateway.wire import Message, encode
from igtl_gateway.wire import image as wire
from igtl_gateway.wire.header import crc64
from igtl_gateway.wire.point import Points
from igtl_gateway.wire.polydata import Cells, PolyData
from igtl_gateway.wire.text import String
from tests.places import ROOT
from tests.script import T0_NS, Script

PAGE = (ROOT / "docs" / "evidence" / "defects.md").read_text("utf-8")
ROWS = [line for line in PAGE.splitlines() if line.startswith("|") and "::" in line]


@cache
def names(path: str) -> frozenset[str]:
    """The tests of a file."""
    tree = ast.parse((ROOT / "tests" / path).read_text("utf-8"))
    return frozenset(node.name for node in ast.walk(tree) if isinstance(node, ast.FunctionDef))


def test_every_test_of_the_page_is_there() -> None:
    found = [tuple(one.split("::")) for row in ROWS for one in re.findall(r"`([\w/]+\.py::\w+)`", row)]
    assert len(found) > len(ROWS) > 25
    assert [f"{path}::{name}" for path, name in found if name not in names(path)] == []


def session() -> Script:
    script = Script()
    script.up(1)
    return script


def test_a_surface_with_200000_vertex_cells_costs_nothing_but_time() -> None:
    points = np.zeros((200_000, 3), ">f4")
    points[:, 0] = np.arange(200_000)
    script = session()
    content = PolyData(points, vertices=Cells.of(np.arange(200_000).reshape(-1, 1)))
    assert script.igtl(Message("POLYDATA", "Cloud", content)) == ["ros /igtl/in/Cloud/points"]
    cloud = rosmsg.PointCloud2.unpack(script.published("/igtl/in/Cloud/points"))
    assert cloud.width * cloud.height == 200_000
    assert script.igtl(Message("STRING", "Next", String.of("hello"))) == ["ros /igtl/in/Next/string"]


def test_a_polygon_of_one_vertex_costs_itself_only() -> None:
    script = session()
    points = np.array([[0, 0, 0], [10, 0, 0], [0, 10, 0]], ">f4")
    script.igtl(Message("POLYDATA", "Model", PolyData(points, polygons=Cells.of([[0], [0, 1, 2]]))))
    assert Mesh.unpack(script.published("/igtl/in/Model/mesh")).triangles.tolist() == [[0, 1, 2]]


def test_a_text_of_70000_bytes_is_refused_in_both_directions_with_a_word() -> None:
    script = session()
    assert script.ros("/igtl/out/Text", rosmsg.String("x" * 70_000)) == ["note conversion"]
    body = struct.pack(">HH", 3, 70_000 & 0xFFFF) + b"x" * 70_000
    head = struct.pack(">H12s20sQQQ", 1, b"STRING", b"Text", 0, len(body), crc64(body))
    assert script.igtl(head + body) == ["note malformed"], "not cut, not empty"


def test_stamps_survive_both_ways() -> None:
    script = session()
    stamp_ns = T0_NS - 123_456_789_000
    script.igtl(Message("STRING", "Text", String.of("a"), ns_to_ticks(stamp_ns)))
    assert [entry.source_ns for entry in script.last if entry.channel == "/igtl/in/Text/string"] == [stamp_ns]
    pose = rosmsg.TransformStamped(Header(stamp_ns, "base"), "tool", (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))
    script.ros("/igtl/out/Tool", pose)
    (sent,) = script.sent()
    assert sent.ticks == ns_to_ticks(stamp_ns)


def test_an_image_of_ros_that_is_shorter_than_it_says_costs_itself_only() -> None:
    script = session()
    short = Image(Header(T0_NS, "cam"), 480, 640, "mono8", 0, 640, bytes(100))
    assert script.ros("/igtl/out/Camera", short) == ["note conversion"]
    whole = Image(Header(T0_NS, "cam"), 2, 3, "rgb8", 0, 9, bytes(range(18)))
    assert script.ros("/igtl/out/Camera", whole) == ["igtl IMAGE/Camera v1 to 1"]
    content = script.sent()[0].content
    assert isinstance(content, wire.Image)
    assert (content.dimensions, content.num_components) == ((3, 2, 1), 3), "columns first, colours kept"
    assert bytes(content.pixels) == bytes(range(18))


def test_n_points_are_one_message_with_their_names() -> None:
    script = session()
    content = Points.of(np.arange(300.0).reshape(-1, 3))
    content.elements["name"] = [f"P{index}".encode() for index in range(100)]
    script.igtl(Message("POINT", "Fiducials", content))
    (told,) = [PointList.unpack(e.data()) for e in script.last if e.type == PointList.TYPE]
    assert [point.name for point in told.points] == [f"P{index}" for index in range(100)]


def test_a_wrong_checksum_is_seen() -> None:
    data = bytearray(join(encode(Message("STRING", "Text", String.of("hello")))))
    data[-1] ^= 1
    assert session().igtl(bytes(data)) == ["note bad_crc"]
