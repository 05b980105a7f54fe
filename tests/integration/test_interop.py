"""Every type of the conversion table through the running bridge, with programs that share no code with it.

OpenIGTLink side: the C++ library of Debian (two clients) and pyigtl; ROS side: two typed rclpy nodes.  All are
connected at the same time, and what is compared is what the receiving program itself decoded.
"""

from __future__ import annotations

import math
import os
import signal
import struct
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest

from tests.integration.bridge import (
    SECOND_DOMAIN,
    Bridge,
    RawPeer,
    RosClient,
    extended,
    free_port,
    message,
    unextended,
)
from tests.peers import reference
from tests.peers.pyigtl_peer import PyigtlPeer
from tests.peers.reference import SCALARS, ReferencePeer
from tests.tables import table

pytestmark = [
    pytest.mark.ros,
    pytest.mark.skipif(reference.available() is not None, reason=str(reference.available())),
]

TRANSFORM, STRING, STATUS = (
    "geometry_msgs/msg/TransformStamped",
    "std_msgs/msg/String",
    "diagnostic_msgs/msg/DiagnosticStatus",
)
IMAGE, POINT, CLOUD = "sensor_msgs/msg/Image", "geometry_msgs/msg/PointStamped", "sensor_msgs/msg/PointCloud2"
MESH, MARKER = "shape_msgs/msg/Mesh", "visualization_msgs/msg/Marker"

#: A stamp that is exact in both clocks: 2⁻⁹ s are 2²³ ticks and 1,953,125 ns.
SEC, NINTHS = 1_700_000_000, 77
FRAC, NANOSEC = NINTHS << 23, NINTHS * 1_953_125

LONG_NAME = "NameAboveTwentyBytes/Tool"
CLOUD_AS_POINTS = "/camera/cloud"
RAS, LITTLE, BIG = 1, 2, 1
UINT8, UINT16, UINT32, FLOAT32, FLOAT64 = 3, 5, 7, 10, 11

SUBSCRIBED = {
    "/igtl/in/ProbeToTracker/transform": TRANSFORM,
    "/igtl/in/Needle/transform": TRANSFORM,
    "/igtl/in/Text/string": STRING,
    "/igtl/in/Machine/status": STATUS,
    "/igtl/in/Picture/image": IMAGE,
    "/igtl/in/One/point": POINT,
    "/igtl/in/One/points": CLOUD,
    "/igtl/in/Many/points": CLOUD,
    "/igtl/in/Scan/points": CLOUD,
    "/igtl/in/Organ/mesh": MESH,
    "/igtl/in/Organ/marker": MARKER,
    "/igtl/in/Path/lines": MARKER,
    "/igtl/in/PyPose/transform": TRANSFORM,
    "/igtl/in/PyText/string": STRING,
    "/igtl/in/PyPicture/image": IMAGE,
    "/igtl/in/PyPoints/points": CLOUD,
    "/igtl/in/FromSecond/string": STRING,
    "/igtl/in/Slicer/status": STATUS,
}
ADVERTISED = {
    "/igtl/out/ToolToBase": TRANSFORM,
    "/igtl/out/Robot": STRING,
    "/igtl/out/Health": STATUS,
    "/igtl/out/Camera": IMAGE,
    "/igtl/out/Target": POINT,
    "/igtl/out/Cloud": CLOUD,
    "/igtl/out/Model": MESH,
    "/igtl/out/Shape": MARKER,
    f"/igtl/out/{LONG_NAME}": TRANSFORM,
    CLOUD_AS_POINTS: CLOUD,
}
SECOND = {"/igtl/out/Other": STRING}


@dataclass
class World:
    """Everybody who is connected."""

    bridge: Bridge
    ros: RosClient
    second_ros: RosClient
    cpp: ReferencePeer
    second_cpp: ReferencePeer
    py: PyigtlPeer


@pytest.fixture(scope="module")
def world() -> Iterator[World]:
    with (
        RosClient("first", subscribe=SUBSCRIBED, advertise=ADVERTISED) as ros,
        RosClient("second", subscribe={"/igtl/in/Text/string": STRING}, advertise=SECOND) as second_ros,
    ):
        bridge = Bridge("--send", f"{CLOUD_AS_POINTS}=Marks:POINT")
        try:
            with (
                ReferencePeer.client("127.0.0.1", bridge.port) as cpp,
                ReferencePeer.client("127.0.0.1", bridge.port) as second_cpp,
                PyigtlPeer.client("127.0.0.1", bridge.port) as py,
            ):
                bridge.wait_code("link_up", 3)
                ros.wait_readers(*ADVERTISED)
                second_ros.wait_readers(*SECOND)
                yield World(bridge, ros, second_ros, cpp, second_cpp, py)
        finally:
            told = bridge.end()
            bridge.close()
    assert (told.code, told.err) == (0, "")
    assert not [event for event in bridge.events if event.get("code") == "internal_error"]
    assert bridge.events[-1]["event"] == "stopped"


def stamp() -> dict[str, int]:
    return {"sec": SEC, "nanosec": NANOSEC}


def head(frame_id: str = "camera") -> dict[str, Any]:
    return {"stamp": stamp(), "frame_id": frame_id}


def xyz(*values: float) -> dict[str, float]:
    return dict(zip("xyz", values, strict=True))


def values(fields: dict[str, float], names: str = "xyz") -> list[float]:
    return [fields[name] for name in names]


def wire_stamp(got: dict[str, Any]) -> tuple[int, int]:
    return got["timestamp"]["sec"], got["timestamp"]["frac"]


# ── OpenIGTLink → ROS ──────────────────────────────────────────────────────────────────────────────────────────────

#: A third of a turn about (1, 1, 1), then one about z by the angle of the triangle 3, 4, 5.
CYCLE: tuple[list[list[float]], list[float]] = ([[0, 0, 1], [1, 0, 0], [0, 1, 0]], [0.5, 0.5, 0.5, 0.5])
ABOUT_Z: tuple[list[list[float]], list[float]] = (
    [[0.6, -0.8, 0], [0.8, 0.6, 0], [0, 0, 1]],
    [0, 0, math.sqrt(0.2), math.sqrt(0.8)],
)


@pytest.mark.parametrize(("rotation", "quaternion"), [CYCLE, ABOUT_Z])
def test_transform_to_ros(world: World, rotation: list[list[float]], quaternion: list[float]) -> None:
    translation = [100.0, -200.0, 300.5]
    matrix = [[*row, shift] for row, shift in zip(rotation, translation, strict=True)]
    world.cpp.send("TRANSFORM", "ProbeToTracker", {"matrix": matrix}, SEC, FRAC)
    got = world.ros.receive("/igtl/in/ProbeToTracker/transform")
    assert got["header"] == head("Tracker")
    assert got["child_frame_id"] == "Probe"
    assert values(got["transform"]["translation"]) == [0.1, -0.2, 0.3005]
    assert values(got["transform"]["rotation"], "xyzw") == pytest.approx(quaternion, abs=1e-7)


def test_position_to_ros(world: World) -> None:
    content = {"position": [1.5, 2.5, -3.5], "quaternion": [0.5, -0.5, 0.5, 0.5]}
    world.cpp.send("POSITION", "Needle", content, SEC, FRAC)
    got = world.ros.receive("/igtl/in/Needle/transform")
    assert got["header"] == head("igtl")
    assert got["child_frame_id"] == "Needle"
    assert values(got["transform"]["translation"]) == [0.0015, 0.0025, -0.0035]
    assert values(got["transform"]["rotation"], "xyzw") == [0.5, -0.5, 0.5, 0.5]


@pytest.mark.parametrize(
    "text", ["hello", "", "Größe 5 µm, 手術", "x" * 65_535], ids=["ascii", "empty", "utf8", "longest"]
)
def test_string_to_ros_reaches_both_nodes(world: World, text: str) -> None:
    world.cpp.send("STRING", "Text", {"string": text, "encoding": 106})
    assert world.ros.receive("/igtl/in/Text/string") == {"data": text}
    assert world.second_ros.receive("/igtl/in/Text/string") == {"data": text}


def test_status_to_ros(world: World) -> None:
    content = {"code": 13, "subcode": -42, "error_name": "Warming", "status_string": "not ready yet"}
    world.cpp.send("STATUS", "Machine", content)
    assert world.ros.receive("/igtl/in/Machine/status") == {
        "level": {"hex": "01"},
        "name": "Machine",
        "message": "not ready yet",
        "hardware_id": "",
        "values": [
            {"key": "code", "value": "13"},
            {"key": "subcode", "value": "-42"},
            {"key": "error_name", "value": "Warming"},
        ],
    }


NAMED = {(UINT8, 1): "mono8", (UINT8, 3): "rgb8", (UINT8, 4): "rgba8", (UINT16, 1): "mono16", (UINT16, 3): "rgb16"}
OPENCV = {2: "8SC", 4: "16SC", 6: "32SC", FLOAT32: "32FC", FLOAT64: "64FC", UINT32: "64FC"}
PICTURES = [
    (scalar, components, endian)
    for scalar in SCALARS
    for components in ((1, 3, 4) if scalar == UINT8 else (1, 3))
    for endian in (LITTLE, BIG)
]


@table(("scalar", "components", "endian"), PICTURES)
def test_image_to_ros(world: World, scalar: int, components: int, endian: int) -> None:
    width, height = 5, 3
    sent = (np.arange(width * height * components) * 7 - (40 if SCALARS[scalar][0] in "if" else 0)).astype(
        SCALARS[scalar]
    )
    content = {
        "dimensions": [width, height, 1],
        "scalar_type": scalar,
        "num_components": components,
        "endian": endian,
        "coordinate": RAS,
        "wire_matrix": [1, 0, 0, 0, 1, 0, 0, 0, 1, 0, 0, 0],
        "data": sent,
    }
    world.cpp.send("IMAGE", "Picture", content, SEC, FRAC)
    got = world.ros.receive("/igtl/in/Picture/image")
    assert got["header"] == head("igtl")
    assert (got["width"], got["height"]) == (width, height)
    assert got["encoding"] == NAMED.get((scalar, components), f"{OPENCV.get(scalar)}{components}")
    # ROS has no uint32: float64 holds every value of it
    shown = "f8" if scalar == UINT32 else SCALARS[scalar]
    pixels = np.frombuffer(bytes.fromhex(got["data"]["hex"]), (">" if got["is_bigendian"] else "<") + shown)
    assert got["step"] * height == pixels.nbytes
    assert pixels.tolist() == sent.tolist()


MARKS: list[dict[str, Any]] = [
    {"name": "A", "group": "G", "rgba": [255, 128, 1, 200], "position": [10, 20, 30], "diameter": 2.5, "owner": ""},
    {"name": "B", "group": "G", "rgba": [0, 1, 2, 255], "position": [-1.5, 0, 4096.25], "diameter": 0, "owner": "X"},
]


def cloud_columns(got: dict[str, Any]) -> dict[str, list[Any]]:
    """The fields of a PointCloud2, read as its documentation describes."""
    formats = {7: "f4", 6: "u4"}
    order = ">" if got["is_bigendian"] else "<"
    kind = np.dtype(
        {
            "names": [field["name"] for field in got["fields"]],
            "formats": [order + formats[field["datatype"]] for field in got["fields"]],
            "offsets": [field["offset"] for field in got["fields"]],
            "itemsize": got["point_step"],
        }
    )
    points = np.frombuffer(bytes.fromhex(got["data"]["hex"]), kind)
    assert len(points) == got["width"] * got["height"]
    return {name: points[name].tolist() for name in kind.names or ()}


def f32(*numbers: float) -> list[float]:
    """These numbers as the nearest float32."""
    return [float(np.float32(number)) for number in numbers]


def test_one_point_to_ros(world: World) -> None:
    world.cpp.send("POINT", "One", {"elements": MARKS[:1]}, SEC, FRAC)
    got = world.ros.receive("/igtl/in/One/point")
    assert got == {"header": head("igtl"), "point": xyz(0.01, 0.02, 0.03)}
    assert cloud_columns(world.ros.receive("/igtl/in/One/points"))["x"] == f32(0.01)


def test_points_to_ros(world: World) -> None:
    world.cpp.send("POINT", "Many", {"elements": MARKS}, SEC, FRAC)
    got = world.ros.receive("/igtl/in/Many/points")
    assert got["header"] == head("igtl")
    assert cloud_columns(got) == {
        "x": f32(0.01, -0.0015),
        "y": f32(0.02, 0),
        "z": f32(0.03, 4.09625),
        "rgba": [0xC8FF8001, 0xFF000102],
        "diameter": f32(0.0025, 0),
    }


CORNERS: list[list[float]] = [[0, 0, 0], [10, 0, 0], [10, 10, 0], [0, 10, 0], [5, 5, 8.5]]
CORNERS_M = [[value / 1000 for value in corner] for corner in CORNERS]


def test_polydata_cloud_to_ros(world: World) -> None:
    attributes = [{"type": 0, "ncomponents": 1, "n": 5, "name": "intensity", "data": [0.5, 1, 1.5, 2, 2.5]}]
    world.cpp.send(
        "POLYDATA", "Scan", {"points": CORNERS, "vertices": [[0, 1, 2, 3, 4]], "attributes": attributes}, SEC, FRAC
    )
    got = world.ros.receive("/igtl/in/Scan/points")
    assert got["header"] == head("igtl")
    assert cloud_columns(got) == {
        "x": f32(0, 0.01, 0.01, 0, 0.005),
        "y": f32(0, 0, 0.01, 0.01, 0.005),
        "z": f32(0, 0, 0, 0, 0.0085),
        "intensity": [0.5, 1, 1.5, 2, 2.5],
    }


def test_polydata_surface_to_ros(world: World) -> None:
    """A quad is cut into two triangles, a strip of four into two with equal winding."""
    content = {"points": CORNERS, "polygons": [[0, 1, 2, 3], [0, 1, 4]], "triangle_strips": [[1, 2, 4, 3]]}
    world.cpp.send("POLYDATA", "Organ", content, SEC, FRAC)
    triangles = [[0, 1, 2], [0, 2, 3], [0, 1, 4], [1, 2, 4], [4, 2, 3]]
    mesh = world.ros.receive("/igtl/in/Organ/mesh")
    assert [triangle["vertex_indices"] for triangle in mesh["triangles"]] == triangles
    assert [values(vertex) for vertex in mesh["vertices"]] == CORNERS_M
    marker = world.ros.receive("/igtl/in/Organ/marker")
    assert marker["header"] == head("igtl")
    assert (marker["type"], marker["action"], marker["ns"]) == (11, 0, "Organ")  # TRIANGLE_LIST, ADD
    assert [values(point) for point in marker["points"]] == [CORNERS_M[i] for three in triangles for i in three]
    assert marker["scale"] == xyz(1, 1, 1)
    assert marker["pose"]["orientation"]["w"] == 1


def test_polydata_lines_to_ros(world: World) -> None:
    world.cpp.send("POLYDATA", "Path", {"points": CORNERS, "lines": [[0, 1, 2], [3, 4]]}, SEC, FRAC)
    got = world.ros.receive("/igtl/in/Path/lines")
    assert got["type"] == 5  # LINE_LIST
    assert [values(point) for point in got["points"]] == [CORNERS_M[i] for i in (0, 1, 1, 2, 3, 4)]


# ── ROS → OpenIGTLink ──────────────────────────────────────────────────────────────────────────────────────────────


@pytest.mark.parametrize(("rotation", "quaternion"), [CYCLE, ABOUT_Z])
def test_transform_to_igtl(world: World, rotation: list[list[float]], quaternion: list[float]) -> None:
    fields = {
        "header": head("Base"),
        "child_frame_id": "Tool",
        "transform": {
            "translation": xyz(0.4, -0.25, 1.125),
            "rotation": dict(zip("xyzw", map(float, quaternion), strict=True)),
        },
    }
    world.ros.publish("/igtl/out/ToolToBase", fields)
    for peer in (world.cpp, world.second_cpp):
        got = peer.receive("TRANSFORM", "ToolToBase")
        assert got["crc_ok"]
        assert wire_stamp(got) == (SEC, FRAC)
        matrix = np.array(got["content"]["matrix"])
        assert matrix[:3, :3] == pytest.approx(np.array(rotation), abs=1e-6)
        assert matrix[:3, 3].tolist() == [400.0, -250.0, 1125.0]


@pytest.mark.parametrize(
    "text", ["hello", "", "Größe 5 µm, 手術", "x" * 65_535], ids=["ascii", "empty", "utf8", "longest"]
)
def test_string_to_igtl(world: World, text: str) -> None:
    world.ros.publish("/igtl/out/Robot", {"data": text})
    got = world.cpp.receive("STRING", "Robot")
    assert got["content"]["string"] == text
    assert got["content"]["encoding"] == (3 if text.isascii() else 106)
    assert got["timestamp"]["sec"] > SEC  # no stamp in the message, so it is the publisher's


def test_status_to_igtl(world: World) -> None:
    codes = [("code", "13"), ("subcode", "-42"), ("error_name", "Warming")]
    fields = {
        "level": {"hex": "01"},
        "name": "robot",
        "message": "not ready yet",
        "values": [{"key": key, "value": value} for key, value in codes],
    }
    world.ros.publish("/igtl/out/Health", fields)
    assert world.cpp.receive("STATUS", "Health")["content"] == {
        "code": 13,
        "subcode": -42,
        "error_name": "Warming",
        "status_string": "not ready yet",
        "nul_terminated": True,
    }
    world.ros.publish("/igtl/out/Health", {"level": {"hex": "00"}, "message": "fine"})
    got = world.cpp.receive("STATUS", "Health")["content"]
    assert (got["code"], got["status_string"]) == (1, "fine")


ENCODINGS = [
    ("mono8", UINT8, 1),
    ("rgb8", UINT8, 3),
    ("bgr8", UINT8, 3),
    ("rgba8", UINT8, 4),
    ("bgra8", UINT8, 4),
    ("mono16", UINT16, 1),
    ("32FC1", FLOAT32, 1),
    ("64FC3", FLOAT64, 3),
]


@table(("encoding", "scalar", "components"), ENCODINGS)
@table("order", [LITTLE, BIG])
def test_image_to_igtl(world: World, encoding: str, scalar: int, components: int, order: int) -> None:
    """With rows that are padded, as cameras send them."""
    width, height, padding = 4, 3, 8
    numbers = np.arange(width * height * components).reshape(height, width, components) * 5 + 1
    pixels = numbers.astype((">" if order == BIG else "<") + SCALARS[scalar])
    row = width * components * pixels.itemsize
    padded = np.full((height, row + padding), 0xEE, np.uint8)
    padded[:, :row] = pixels.view(np.uint8).reshape(height, row)
    fields = {
        "header": head(),
        "width": width,
        "height": height,
        "encoding": encoding,
        "is_bigendian": int(order == BIG),
        "step": row + padding,
        "data": {"hex": padded.tobytes().hex()},
    }
    world.ros.publish("/igtl/out/Camera", fields)
    got = world.cpp.receive("IMAGE", "Camera")
    assert wire_stamp(got) == (SEC, FRAC)
    content = got["content"]
    assert content["dimensions"] == [width, height, 1]
    assert content["subvol_size"] == [width, height, 1]
    assert (content["scalar_type"], content["num_components"]) == (scalar, components)
    expected = pixels[..., [2, 1, 0, 3][:components]] if encoding.startswith("bgr") else pixels
    assert content["data"] == expected.ravel().tolist()
    assert got["lib"]["lib_spacing"] == [1, 1, 1]


def test_point_to_igtl(world: World) -> None:
    world.ros.publish("/igtl/out/Target", {"header": head(), "point": xyz(0.01, -0.02, 1.5)})
    got = world.cpp.receive("POINT", "Target")
    assert wire_stamp(got) == (SEC, FRAC)
    (element,) = got["content"]["elements"]
    assert element["position"] == f32(10, -20, 1500)


def organised_cloud() -> dict[str, Any]:
    """Two rows of three coloured points, of which one is a hole, as depth cameras send them."""
    points = np.zeros(
        (2, 3), np.dtype({"names": ["x", "y", "z", "rgb"], "formats": ["<f4"] * 3 + ["<u4"], "itemsize": 20})
    )
    points["x"], points["y"], points["z"] = [[0.01, 0.02, math.nan]] * 2, [[0.5], [-0.5]], 0.25
    points["rgb"] = [[0x00FF0000, 0x0000FF00, 0], [0x000000FF, 0x00FF8000, 0x00FFFFFF]]
    points["x"][1, 2] = 0.03
    names = [("x", 0, 7), ("y", 4, 7), ("z", 8, 7), ("rgb", 12, 7)]  # PCL packs colours into a float
    return {
        "header": head(),
        "height": 2,
        "width": 3,
        "fields": [{"name": name, "offset": at, "datatype": kind, "count": 1} for name, at, kind in names],
        "point_step": 20,
        "row_step": 60,
        "is_dense": False,
        "data": {"hex": points.tobytes().hex()},
    }


POSITIONS = [f32(10, 500, 250), f32(20, 500, 250), f32(10, -500, 250), f32(20, -500, 250), f32(30, -500, 250)]
COLOURS = [[255, 0, 0], [0, 255, 0], [0, 0, 255], [255, 128, 0], [255, 255, 255]]


def test_cloud_to_polydata(world: World) -> None:
    world.ros.publish("/igtl/out/Cloud", organised_cloud())
    got = world.cpp.receive("POLYDATA", "Cloud")
    assert wire_stamp(got) == (SEC, FRAC)
    content = got["content"]
    assert np.array(content["points"]) == pytest.approx(np.array(POSITIONS), rel=1e-6)
    assert content["vertices"] == [[0, 1, 2, 3, 4]]
    (colours,) = content["attributes"]
    assert (colours["name"], colours["ncomponents"], colours["n"]) == ("RGB", 3, 5)
    assert np.rint(np.array(colours["data"]).reshape(-1, 3) * 255).tolist() == COLOURS


def test_cloud_to_points_by_configuration(world: World) -> None:
    world.ros.publish(CLOUD_AS_POINTS, organised_cloud())
    got = world.cpp.receive("POINT", "Marks")
    assert wire_stamp(got) == (SEC, FRAC)
    elements = got["content"]["elements"]
    assert np.array([element["position"] for element in elements]) == pytest.approx(np.array(POSITIONS), rel=1e-6)
    assert [element["rgba"][:3] for element in elements] == COLOURS


def test_mesh_to_igtl(world: World) -> None:
    triangles = [[0, 1, 2], [0, 2, 3], [0, 1, 4]]
    fields = {
        "triangles": [{"vertex_indices": three} for three in triangles],
        "vertices": [xyz(*corner) for corner in CORNERS_M],
    }
    world.ros.publish("/igtl/out/Model", fields)
    content = world.cpp.receive("POLYDATA", "Model")["content"]
    assert content["points"] == CORNERS
    assert content["polygons"] == triangles


def test_marker_to_igtl(world: World) -> None:
    """Triangles with colours, scaled, then turned about z by 90° and moved."""
    fields = {
        "header": head(),
        "type": 11,
        "pose": {
            "position": xyz(1.0, 0.0, 0.0),
            "orientation": {"x": 0.0, "y": 0.0, "z": math.sqrt(0.5), "w": math.sqrt(0.5)},
        },
        "scale": xyz(2.0, 2.0, 2.0),
        "points": [xyz(*CORNERS_M[i]) for i in (0, 1, 4)],
        "colors": [{"r": 1.0, "g": 0.5, "b": 0.25, "a": 1.0}, {"r": 0.0, "a": 0.5}, {"b": 1.0, "a": 1.0}],
    }
    world.ros.publish("/igtl/out/Shape", fields)
    got = world.cpp.receive("POLYDATA", "Shape")
    assert wire_stamp(got) == (SEC, FRAC)
    content = got["content"]
    assert np.array(content["points"]) == pytest.approx(
        np.array([[1000, 0, 0], [1000, 20, 0], [990, 10, 17]]), abs=1e-3
    )
    assert content["polygons"] == [[0, 1, 2]]
    (colours,) = content["attributes"]
    assert (colours["name"], colours["ncomponents"]) == ("RGBA", 4)
    assert colours["data"] == [1, 0.5, 0.25, 1, 0, 0, 0, 0.5, 0, 0, 1, 1]


def test_line_marker_to_igtl(world: World) -> None:
    fields = {"header": head(), "type": 4, "points": [xyz(*corner) for corner in CORNERS_M]}  # LINE_STRIP
    world.ros.publish("/igtl/out/Shape", fields)
    content = world.cpp.receive("POLYDATA", "Shape")["content"]
    assert content["points"] == CORNERS
    assert content["lines"] == [[0, 1, 2, 3, 4]]


def test_late_peer_gets_the_last_surface(world: World) -> None:
    """Plans and surfaces are published once."""
    for vertex in (0.001, 0.002):
        fields = {"triangles": [{"vertex_indices": [0, 0, 0]}], "vertices": [xyz(vertex, 0, 0)]}
        world.ros.publish("/igtl/out/Model", fields)
        assert world.cpp.receive("POLYDATA", "Model")["content"]["points"] == [[1000 * vertex, 0, 0]]
    with RawPeer(world.bridge.port) as late:
        points = late.receive("Model").body[40:52]
    assert struct.unpack(">3f", points) == (2, 0, 0)


# ── pyigtl ─────────────────────────────────────────────────────────────────────────────────────────────────────────


def test_pyigtl_to_ros(world: World) -> None:
    matrix = [[0, 0, 1, 100.0], [1, 0, 0, -200.0], [0, 1, 0, 300.5], [0, 0, 0, 1]]
    world.py.send("TRANSFORM", "PyPose", {"matrix": matrix}, SEC, FRAC)
    got = world.ros.receive("/igtl/in/PyPose/transform")
    assert values(got["transform"]["translation"]) == [0.1, -0.2, 0.3005]
    assert values(got["transform"]["rotation"], "xyzw") == [0.5, 0.5, 0.5, 0.5]
    assert got["header"] == head("igtl")

    world.py.send("STRING", "PyText", {"string": "from pyigtl"})
    assert world.ros.receive("/igtl/in/PyText/string") == {"data": "from pyigtl"}

    pixels = list(range(0, 240, 20))
    content = {
        "dimensions": [4, 3, 1],
        "scalar_type": UINT8,
        "wire_matrix": [1, 0, 0, 0, 1, 0, 0, 0, 1, 0, 0, 0],
        "data": pixels,
    }
    world.py.send("IMAGE", "PyPicture", content, SEC, FRAC)
    got = world.ros.receive("/igtl/in/PyPicture/image")
    assert (got["width"], got["height"], got["encoding"]) == (4, 3, "mono8")
    assert list(bytes.fromhex(got["data"]["hex"])) == pixels

    world.py.send("POINT", "PyPoints", {"elements": MARKS})
    got = cloud_columns(world.ros.receive("/igtl/in/PyPoints/points"))
    assert got["z"] == f32(0.03, 4.09625)
    assert got["rgba"] == [0xC8FF8001, 0xFF000102]


def test_ros_to_pyigtl(world: World) -> None:
    turned = {"translation": xyz(0.4, -0.25, 1.125), "rotation": {"x": 0.5, "y": 0.5, "z": 0.5, "w": 0.5}}
    world.ros.publish("/igtl/out/ToolToBase", {"header": head("Base"), "transform": turned})
    got = world.py.receive("TRANSFORM", "ToolToBase")
    while got["content"]["matrix"][2][3] != 1125.0:  # it has got those of the tests before, too
        got = world.py.receive("TRANSFORM", "ToolToBase")
    matrix = np.array(got["content"]["matrix"])
    assert got["timestamp"]["sec"] == SEC
    assert matrix[:3, 3].tolist() == [400.0, -250.0, 1125.0]

    world.ros.publish("/igtl/out/Robot", {"data": "to pyigtl"})
    while world.py.receive("STRING", "Robot")["content"]["string"] != "to pyigtl":
        pass

    data = bytes(range(36))
    fields = {"header": head(), "width": 4, "height": 3, "encoding": "rgb8", "step": 12, "data": {"hex": data.hex()}}
    world.ros.publish("/igtl/out/Camera", fields)
    got = world.py.receive("IMAGE", "Camera")
    while got["content"]["data_hex"] != data.hex():
        got = world.py.receive("IMAGE", "Camera")
    assert (got["content"]["dimensions"], got["content"]["num_components"]) == ([4, 3, 1], 3)

    world.ros.publish("/igtl/out/Target", {"header": head(), "point": xyz(0.125, 0.25, 0.5)})
    while world.py.receive("POINT", "Target")["content"]["elements"][0]["position"] != [125.0, 250.0, 500.0]:
        pass


# ── several peers, header versions, client mode ────────────────────────────────────────────────────────────────────


def test_every_node_reaches_every_peer(world: World) -> None:
    world.second_ros.publish("/igtl/out/Other", {"data": "from the second node"})
    for peer in (world.cpp, world.second_cpp):
        assert peer.receive("STRING", "Other")["content"]["string"] == "from the second node"
    world.second_cpp.send("STRING", "FromSecond", {"string": "from the second peer"})
    assert world.ros.receive("/igtl/in/FromSecond/string") == {"data": "from the second peer"}


def test_version_two_for_who_has_shown_it(world: World) -> None:
    """As 3D Slicer begins: a version 2 STATUS with an item of metadata."""
    status = struct.pack(">Hq20s", 1, 0, b"") + b"hello\0"
    fields: dict[str, Any] = {
        "header": head("Base"),
        "transform": {"translation": xyz(0.001, 0.002, 0.003), "rotation": {"w": 1.0}},
    }
    topic = f"/igtl/out/{LONG_NAME}"
    with RawPeer(world.bridge.port) as slicer:
        world.bridge.wait_events(
            lambda event: event.get("code") == "link_up" and event["data"]["peer"] == slicer.name, "link of Slicer"
        )
        world.ros.publish(topic, fields)
        before = slicer.receive(type_name="TRANSFORM")
        assert (before.version, before.type, before.crc_ok) == (1, "TRANSFORM", True)

        slicer.send(message("STATUS", extended(status, {"dummy": "metadata"}), device="Slicer", version=2))
        assert world.ros.receive("/igtl/in/Slicer/status")["message"] == "hello"
        world.ros.publish(topic, fields)
        # a newcomer gets the latched messages of the tests before, too, now or later
        after = slicer.receive(before.device)
        assert (after.version, after.type, after.crc_ok) == (2, "TRANSFORM", True)
        content, metadata = unextended(after.body)
        assert content == before.body
        told = fields["header"]["stamp"]
        assert metadata == {
            "DeviceName": LONG_NAME.replace("/", "_"),
            "ros.frame_id": "Base",
            "ros.stamp": str(told["sec"] * 10**9 + told["nanosec"]),
        }

        for _ in range(2):  # the peer of version 1 beside it
            got = world.cpp.receive("TRANSFORM", before.device)
            assert got["header_version"] == 1
            assert [row[3] for row in got["content"]["matrix"][:3]] == [1, 2, 3]


def kill_while_it_is_sent_to(server: ReferencePeer, send: Callable[[], None]) -> None:
    """Stop the program, send, kill it: the unread bytes reset the connection.

    (The library's server does not set SO_REUSEADDR: after an orderly end its port would be taken for a minute.)
    """
    server._process.send_signal(signal.SIGSTOP)
    os.waitpid(server._process.pid, os.WUNTRACED)
    send()
    server._process.kill()


def test_client_mode_outlives_its_server() -> None:
    """The server comes late, is killed and comes back on its port; each time both directions work."""
    port = free_port()
    with RosClient(
        "beside",
        subscribe={"/igtl/in/Server/string": STRING},
        advertise={"/igtl/out/Words": STRING},
        domain=SECOND_DOMAIN,
    ) as ros:
        bridge = Bridge("--connect", f"127.0.0.1:{port}", ROS_DOMAIN_ID=str(SECOND_DOMAIN))  # and a server, too
        try:
            bridge.wait_code("connect_failed")

            def converse(server: ReferencePeer, turn: str) -> None:
                ros.publish("/igtl/out/Words", {"data": f"first {turn}"})
                assert server.receive("STRING", "Words")["content"]["string"] == f"first {turn}"
                server.send("STRING", "Server", {"string": f"answer {turn}"})
                assert ros.receive("/igtl/in/Server/string") == {"data": f"answer {turn}"}

            with ReferencePeer.server(port) as server:
                server.wait_connected()
                bridge.wait_code("link_up")
                ros.wait_readers("/igtl/out/Words")
                converse(server, "late")
                with RawPeer(bridge.port) as beside:
                    bridge.wait_code("link_up", 2)

                    def send() -> None:
                        ros.publish("/igtl/out/Words", {"data": "for no peer"})
                        # links are served in the order in which they came: the server was before this one
                        assert beside.receive().body.endswith(b"for no peer")

                    kill_while_it_is_sent_to(server, send)
                    assert bridge.wait_code("link_down")["data"]["role"] == "client"
            with ReferencePeer.server(port) as server:
                server.wait_connected()
                bridge.wait_code("link_up", 3)
                converse(server, "again")
            told = bridge.end()
        finally:
            bridge.close()
    assert (told.code, told.err) == (0, "")
