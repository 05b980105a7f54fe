"""One message of each type of the ROS-IGTL-Bridge paper, from both sides, at a second's distance.

The test node and the test server of the paper in one: small values that are easy to recognise.  Two peers are
connected, one that reads header version 1 only and one that shows version 2, as 3D Slicer does.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from igtl_gateway.base.stamp import NS_PER_S, ns_to_ticks
from igtl_gateway.convert import rosmsg
from igtl_gateway.convert.rosmsg import Header, RosMessage
from igtl_gateway.wire import Item, Message
from igtl_gateway.wire.body import Body
from igtl_gateway.wire.image import LITTLE_ENDIAN, Image
from igtl_gateway.wire.point import Points
from igtl_gateway.wire.polydata import RGBA, SCALAR, Attribute, Cells, PolyData
from igtl_gateway.wire.text import Status, String
from igtl_gateway.wire.transform import Position, Transform
from igtl_gateway_lab.simulate.scenario import (
    ScenarioInput,
    link_down_input,
    link_up_input,
    peer_input,
    ros_input,
    stamped,
)

START_NS = 1_767_225_600 * NS_PER_S
_STEP_NS = NS_PER_S // 10
_OLD, _NEW = 1, 2  # links: a peer of protocol 2, a peer of protocol 3

_TETRAHEDRON = np.array([[0, 0, 0], [30, 0, 0], [0, 40, 0], [0, 0, 50]], np.float64)
_FACES = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]])
_QUARTER_TURN = (0.0, 0.0, 0.7071067811865476, 0.7071067811865476)


def _named_points() -> Points:
    points = Points.of(np.array([[10.0, 15.0, 20.0], [25.0, 30.0, 35.0], [-40.0, 45.0, -50.0]]), None, 2.5)
    points.elements["name"] = ["Landmark_1", "Landmark_2", "Landmark_3"]
    points.elements["group"] = "Landmarks"
    points.elements["rgba"] = [[255, 0, 0, 255], [0, 255, 0, 255], [0, 0, 255, 128]]
    return points


def _gradient(width: int, height: int, components: int) -> np.ndarray[Any, Any]:
    return np.arange(width * height * components, dtype=np.uint32).astype(np.uint8).reshape(height, width, components)


def _igtl_messages() -> Iterator[tuple[str, str, Body]]:
    grey, colour = _gradient(8, 6, 1), _gradient(8, 6, 3)
    deep = np.arange(48, dtype="<u2") * 1000
    yield "STRING", "Greeting", String.of("hello from OpenIGTLink")
    yield "STRING", "Greeting", String.of("Grüße, 你好")
    yield "TRANSFORM", "ProbeToTracker", Transform((0, 1, 0, -1, 0, 0, 0, 0, 1, 100.0, -200.0, 300.5))
    yield "POSITION", "Pointer", Position((1.0, 2.0, 3.0), (0.0, 0.0, 0.6, 0.8))
    yield "IMAGE", "Grey", Image((8, 6, 1), 3, grey.tobytes())
    yield "IMAGE", "Colour", Image((8, 6, 1), 3, colour.tobytes(), 3)
    yield "IMAGE", "Deep", Image((8, 6, 1), 5, deep.tobytes(), 1, LITTLE_ENDIAN)
    yield "POINT", "Target", Points.of(np.array([[1.5, -2.5, 3.5]]), None, 4.0)
    yield "POINT", "Landmarks", _named_points()
    yield "POLYDATA", "Surface", PolyData(_TETRAHEDRON.astype(">f4"), polygons=Cells.of(_FACES))
    yield "POLYDATA", "Path", PolyData(_TETRAHEDRON.astype(">f4"), lines=Cells.of([[0, 1, 2, 3], [3, 0]]))
    colours = Attribute.of(RGBA, "Colors", np.array([[1, 0, 0, 1], [0, 1, 0, 1], [0, 0, 1, 1], [1, 1, 1, 0.5]]))
    heat = Attribute.of(SCALAR, "heat", np.array([[0.0], [0.25], [0.5], [1.0]]))
    vertices = Cells.of(np.arange(4).reshape(1, 4))
    yield "POLYDATA", "Cloud", PolyData(_TETRAHEDRON.astype(">f4"), vertices, attributes=(heat, colours))
    yield "STATUS", "Device", Status(1, 0, "", "ready")
    yield "STATUS", "Device", Status(13, 7, "NOT_HOMED", "move to the home position first")


def _cloud(header: Header) -> rosmsg.PointCloud2:
    points = np.zeros(4, np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("rgb", "<u4"), ("intensity", "<f4")]))
    for axis, name in enumerate("xyz"):
        points[name] = _TETRAHEDRON[:, axis] / 1000
    points["rgb"] = [0xFF0000, 0x00FF00, 0x0000FF, 0xFFFFFF]
    points["intensity"] = [0.0, 0.25, 0.5, 1.0]
    points["x"][3] = np.nan  # a hole of the organised cloud
    fields = tuple(rosmsg.PointField(name, 4 * at, 7) for at, name in enumerate(points.dtype.names or ()))
    return rosmsg.PointCloud2(header, 2, 2, fields, False, 20, 40, points.tobytes(), False)


def _ros_messages(header: Header) -> Iterator[tuple[str, RosMessage]]:
    triangles, vertices = _FACES.astype(np.uint32), _TETRAHEDRON / 1000
    corners = vertices[_FACES.reshape(-1)]
    yield "Greeting", rosmsg.String("hello from ROS 2")
    yield "ToolToBase", rosmsg.TransformStamped(header, "tool", (0.1, -0.2, 0.3), _QUARTER_TURN)
    for name, encoding, components, item in (
        ("Mono8", "mono8", 1, 1),
        ("Mono16", "mono16", 1, 2),
        ("Rgb8", "rgb8", 3, 1),
        ("Bgr8", "bgr8", 3, 1),
        ("Rgba8", "rgba8", 4, 1),
        ("Bgra8", "bgra8", 4, 1),
        ("Depth", "32FC1", 1, 4),
    ):
        data = _gradient(8 * item, 6, components).tobytes()
        if encoding == "32FC1":
            data = (np.arange(48, dtype="<f4") / 8).tobytes()
        yield name, rosmsg.Image(header, 6, 8, encoding, 0, 8 * components * item, data)
    yield "Target", rosmsg.PointStamped(header, (0.0015, -0.0025, 0.0035))
    yield "Cloud", _cloud(header)
    yield "Surface", rosmsg.Mesh(triangles, vertices)
    yield "SurfaceMarker", rosmsg.Marker(header, "demo", 0, rosmsg.Marker.TRIANGLE_LIST, points=corners)
    yield "PathMarker", rosmsg.Marker(header, "demo", 1, rosmsg.Marker.LINE_LIST, points=vertices)
    values = (("code", "1"), ("subcode", "0"), ("error_name", ""))
    yield "Device", rosmsg.DiagnosticStatus(0, "arm", "ready", "lwr", values)


def inputs() -> Iterator[ScenarioInput]:
    """The whole session, in order of time."""
    time_ns = START_NS
    yield link_up_input(time_ns, _OLD, "127.0.0.1:52001")
    yield link_up_input(time_ns + 1, _NEW, "127.0.0.1:52002")
    # the first message of 3D Slicer: it shows header version 2
    hello = Message("STATUS", "", Status(1), 0, 2, 0, (Item("dummy", b"dummy"),))
    yield peer_input(time_ns + 2, _NEW, hello)
    for index, (type_name, device, content) in enumerate(_igtl_messages()):
        time_ns += _STEP_NS
        link = _NEW if index % 2 else _OLD
        # one of them unstamped, as everything from 3D Slicer is
        ticks = 0 if type_name == "POSITION" else ns_to_ticks(time_ns - 5_000_000)
        yield peer_input(time_ns, link, Message(type_name, device, content, ticks, header_version=link))
    for name, message in _ros_messages(Header(0, "base")):
        time_ns += _STEP_NS
        late = stamped(message, time_ns - 3_000_000)
        yield ros_input(time_ns, f"/igtl/out/{name}", late, sent_ns=time_ns - 2_000_000)
    yield link_down_input(time_ns + _STEP_NS, _OLD, "127.0.0.1:52001")
    yield link_down_input(time_ns + _STEP_NS + 1, _NEW, "127.0.0.1:52002")
