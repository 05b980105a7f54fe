"""The fast path gives what the full path gives, to the last bit; the functions in C what those in Python give."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given
from hypothesis import strategies as st

from igtl_gateway.base.buffers import join
from igtl_gateway.base.errors import ConversionError
from igtl_gateway.base.stamp import NS_PER_S, ns_to_ticks
from igtl_gateway.config.configuration import Config, ToIgtlRow, ToRosRow
from igtl_gateway.convert import express, poses, rosmsg
from igtl_gateway.convert.common_msgs import JointState, PoseArray, PoseStamped
from igtl_gateway.convert.igtl_msgs import MetadataItem, TrackedTool, TrackingData
from igtl_gateway.gateway import LINK_DOWN, LINK_UP, LISTENED, Gateway, Session
from igtl_gateway.gateway.fastpath import cache
from igtl_gateway.gateway.live_settings import LiveSettings
from igtl_gateway.gateway.log.changes import SETTING
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.gateway.log.note import Level, Note
from igtl_gateway.gateway.peers import MAX_RELEASES
from igtl_gateway.wire import HEADER_SIZE, Item, Message, decode, encode
from igtl_gateway.wire.header import crc64
from igtl_gateway.wire.image import SCALARS, Image
from igtl_gateway.wire.message import EXTENDED_SIZE
from igtl_gateway.wire.point import Points
from igtl_gateway.wire.polydata import NO_CELLS, SCALAR, Attribute, Cells, PolyData
from igtl_gateway.wire.query import EmptyQuery, StartTracking
from igtl_gateway.wire.text import Status
from igtl_gateway.wire.text import String as StringBody
from igtl_gateway.wire.tracking import QuaternionTrackingData as QuaternionTracked
from igtl_gateway.wire.tracking import TrackingData as Tracked
from igtl_gateway.wire.transform import Position, Transform
from tests.script import Script
from tests.tables import table

T0_NS = 1_700_000_000 * NS_PER_S

Step = tuple[Any, ...]

_ODD = [
    (0.0,) * 4,
    (1.0, 0.0, 0.0, 0.0),
    (0.0, 1.0, 0.0, 0.0),
    (0.0, 0.0, 1.0, 0.0),
    (0.0, 0.0, 0.0, -2.0),
    (math.nan,) * 4,
]

angles = st.floats(-4.0, 4.0)
lengths = st.sampled_from([0.0, -0.0, 1e-40, 3.5, -1e3, 3e38, 1e39, math.nan, math.inf]) | st.floats(-1e3, 1e3)
stamps = st.sampled_from(
    [0, -5, 1, 999_999_999, T0_NS, T0_NS, T0_NS + 123_456_789, T0_NS + NS_PER_S, 2**32 * NS_PER_S - 1]
)


@st.composite
def rotations(draw: st.DrawFn) -> tuple[float, float, float, float]:
    """Quaternions x, y, z, w: of any rotation, half turns, no length, and worse."""
    if draw(st.booleans()):
        q = [draw(angles) for _ in range(4)]
        return q[0], q[1], q[2], q[3]
    return draw(
        st.sampled_from([(0, 0, 0, 0), (1, 0, 0, 0), (0, 1, 0, 0), (0, 0, 1, 0), (0, 0, 0, -2), (math.nan,) * 4])
    )


@st.composite
def matrices(draw: st.DrawFn) -> tuple[float, ...]:
    """The twelve numbers of TRANSFORM: rotations rounded to float32, and matrices that are not orthonormal."""
    x, y, z, w = draw(rotations())
    n = math.sqrt(x * x + y * y + z * z + w * w) or 1.0
    x, y, z, w = x / n, y / n, z / n, w / n
    m = [1 - 2 * (y * y + z * z), 2 * (x * y + z * w), 2 * (x * z - y * w)]
    m += [2 * (x * y - z * w), 1 - 2 * (x * x + z * z), 2 * (y * z + x * w)]
    m += [2 * (x * z + y * w), 2 * (y * z - x * w), 1 - 2 * (x * x + y * y)]
    if draw(st.integers(0, 5)) == 0:
        m[draw(st.integers(0, 8))] *= draw(st.sampled_from([-1.0, 1.001, 0.0, 1 + 1e-6]))
    position = [draw(lengths.filter(lambda value: not abs(value) > 3.1e38 or math.isinf(value))) for _ in range(3)]
    return (*m, *position)


#: What 3D Slicer sends with each TRANSFORM.
SLICER = tuple(
    Item(key, value)
    for key, value in (
        ("MRMLNodeName", b"Probe"),
        ("STREAM_ID_FROM", b"unknown"),
        ("STREAM_ID_TO", b"unknown"),
        ("TransformStatus", b"OK"),
    )
)
MISSING = (*SLICER[:3], Item("TransformStatus", b"MISSING"))
#: Metadata of messages: those of Slicer, in other orders, with keys twice, without values, in other encodings, long
#: ones, and those that have a meaning for the gateway.
BLOCKS: tuple[tuple[Item, ...], ...] = (
    *(SLICER, SLICER, SLICER, MISSING, MISSING),
    *((), (Item("key", b"value"),), SLICER[::-1], (*SLICER, SLICER[0]), (Item("", b""),)),
    (Item("TransformStatus", b"OK", 106), Item("Bild", "für".encode(), 106), Item("odd", b"\xff\0", 17)),
    (Item("long", b"x" * 3000),),
    (Item("longer", b"x" * 5000),),
    (Item("ros.stamp", b"1700000000123456789"),),
    (Item("ros.frame_id", b"table"), Item("DeviceName", b"no")),
    (Item("ros.stamp", b"soon"),),
)


def deviating(draw: st.DrawFn, message: Message) -> bytes:
    """A message as programs write it that deviate: bare, or of header version 3, now and then."""
    kind = draw(st.sampled_from(["", *[""] * 12, "bare", "version 3"]))
    if kind == "bare":
        message = replace(message, header_version=1, message_id=0, metadata=())
    data = join(encode(message))
    return data[:1] + bytes([2 if kind == "bare" else 3 if kind else data[1]]) + data[2:]


def with_odd_sizes(draw: st.DrawFn, data: bytes) -> bytes:
    """A message of header version 2, whose sizes are wrong or whose extended header is longer now and then."""
    if data[1] != 2 or draw(st.integers(0, 9)):
        return data
    at = HEADER_SIZE + draw(st.sampled_from([1, 3, 7]))
    odd = bytearray(data)
    odd[at] = (odd[at] + draw(st.sampled_from([1, 2, 255]))) % 256
    if draw(st.booleans()):  # another extended header, and room for it
        odd[HEADER_SIZE : HEADER_SIZE + 2] = b"\0\x10"
        odd[HEADER_SIZE + EXTENDED_SIZE : HEADER_SIZE + EXTENDED_SIZE] = b"more"
        odd[42:50] = (len(odd) - HEADER_SIZE).to_bytes(8, "big")
    odd[50:58] = crc64(odd[HEADER_SIZE:]).to_bytes(8, "big")
    return bytes(odd)


@st.composite
def igtl_messages(draw: st.DrawFn) -> Step:
    device, version = draw(st.sampled_from("AB")), draw(st.sampled_from([1, 2, 2]))
    content: Any = Transform(draw(matrices()))
    if draw(st.integers(0, 2)) == 0:
        position = draw(st.tuples(*[st.floats(-1e3, 1e3, width=32)] * 3))
        content = Position(position, draw(rotations()), draw(st.sampled_from(["all", "all", "quaternion3"])))
    items = draw(st.sampled_from(BLOCKS)) if version == 2 else ()
    name = "TRANSFORM" if isinstance(content, Transform) else "POSITION"
    message = Message(name, device, content, ns_to_ticks(draw(stamps)), version, draw(st.integers(0, 3)), items)
    data = bytearray(with_odd_sizes(draw, deviating(draw, message)))
    if draw(st.integers(0, 9)) == 0:
        data[draw(st.sampled_from([50, 60, len(data) - 1]))] ^= 1
    return "igtl", bytes(data), draw(st.sampled_from([1, 2]))


@st.composite
def ros_messages(draw: st.DrawFn) -> Step:
    header = rosmsg.Header(draw(stamps.filter(lambda ns: ns < 2**31 * NS_PER_S)), draw(st.sampled_from(["base", "m"])))
    position = (draw(lengths), draw(lengths), draw(lengths))
    if draw(st.booleans()):
        child = draw(st.sampled_from(["tool", "needle1"]))
        message: Any = rosmsg.TransformStamped(header, child, position, draw(rotations()))
    else:
        message = PoseStamped(header, (*position, *draw(rotations())))
    topic = draw(st.sampled_from(["/igtl/out/T", "/igtl/out/P"])) + message.TYPE[-4:]
    return "ros", topic, message.TYPE, message.pack() + draw(st.sampled_from([b"", b"", b"", b"\0"])), draw(stamps)


xyz = st.lists(st.tuples(*[st.floats(-1e3, 1e3, width=32)] * 3), min_size=1, max_size=4)
odd_xyz = st.tuples(*[st.sampled_from([0.0, 1e-42, 3e38, math.nan, math.inf])] * 3)


def _mostly(draw: st.DrawFn, usual: Any, *odd: Any) -> Any:
    """One that is odd now and then: the fast path is for what is usual."""
    return draw(st.sampled_from(odd)) if draw(st.integers(0, 5)) == 0 else usual


@st.composite
def positions(draw: st.DrawFn) -> npt.NDArray[np.float64]:
    """A few points, or so many that their CRC is taken another way; some are no numbers."""
    rows = draw(xyz) * _mostly(draw, 1, 30)
    if draw(st.integers(0, 5)) == 0:
        rows[draw(st.integers(0, len(rows) - 1))] = draw(odd_xyz)
    return np.array(rows[: _mostly(draw, len(rows), 0)]).reshape(-1, 3)


def _points(draw: st.DrawFn) -> Points:
    places = draw(positions())
    points = Points.of(places.astype(">f4"), None if draw(st.booleans()) else np.full((len(places), 4), 200, np.uint8))
    points.elements["diameter"] = _mostly(draw, draw(st.floats(0, 50, width=32)), math.inf)
    if len(places):
        points.elements[_mostly(draw, draw(st.sampled_from(["rgba", "name"])), "group", "owner")][-1] = 7
    return points


def _cloud(draw: st.DrawFn) -> PolyData:
    places = draw(positions()).astype(">f4")
    count = len(places)
    vertices = _mostly(
        draw, Cells.of_all(count) if count else NO_CELLS, NO_CELLS, Cells.of([[i] for i in range(count)])
    )
    attributes = _mostly(draw, (), (Attribute.of(SCALAR, "RGB", np.ones((count, 3))),))
    lines = Cells.of([[0, count - 1]]) if _mostly(draw, False, count > 1) else NO_CELLS
    return PolyData(places, vertices, lines, attributes=attributes)


def _surface(draw: st.DrawFn) -> PolyData:
    """Mostly of triangles."""
    places = draw(positions()).astype(">f4")
    count = len(places) + _mostly(draw, 0, 1)
    corners = st.integers(0, count - 1) if count else st.just(0)
    size = _mostly(draw, 3, 4, 2)
    triangles = draw(st.lists(st.tuples(*[corners] * size), min_size=1, max_size=4))
    polygons = Cells.of([list(triangle) for triangle in triangles] + _mostly(draw, [], [[0, 0, 0, 0]]))
    strips = Cells.of([[0, 0, 0]]) if _mostly(draw, False, bool(count)) else NO_CELLS
    return PolyData(places, polygons=polygons, triangle_strips=strips)


def _image(draw: st.DrawFn) -> Image:
    size = draw(st.sampled_from([(2, 3, 1), (2, 3, 1), (5, 1, 1), (40, 30, 1), (2, 1, 2)]))
    part = _mostly(draw, size, (1, 1, 1))
    scalar, components = _mostly(draw, draw(st.sampled_from([(3, 3), (3, 1)])), (5, 1), (7, 1))
    pixels = bytes([draw(st.integers(0, 255))]) * (math.prod(part) * components * np.dtype(SCALARS[scalar]).itemsize)
    matrix = draw(st.sampled_from([Image.IDENTITY, (*Image.IDENTITY[:9], 1.0, 2.0, 0.0), (2.0, *Image.IDENTITY[1:])]))
    return Image(size, scalar, pixels, components, draw(st.sampled_from([1, 2, 2])), 1, matrix, (0, 0, 0), part)


@st.composite
def igtl_bulk(draw: st.DrawFn) -> Step:
    """STRING, POINT, POLYDATA and IMAGE."""
    name = draw(st.sampled_from(["STRING", "POINT", "POLYDATA", "SURFACE", "IMAGE"]))
    content: Any
    match name:
        case "STRING":
            text = draw(st.sampled_from([b"", b"Hello", b"Hello, world", b"x" * 3000]))
            text = _mostly(draw, text, "für".encode(), b"a\0b", b"\xff", b"end\0")
            content = StringBody(text, _mostly(draw, 3, 4, 106, 1013, 2252, 17, 0))
        case "POINT":
            content = _points(draw)
        case "IMAGE":
            content = _image(draw)
        case "SURFACE":
            name, content = "POLYDATA", _surface(draw)
        case _:
            content = _cloud(draw)
    version = _mostly(draw, draw(st.sampled_from([1, 2])), 2)
    items = draw(st.sampled_from(BLOCKS)) if version == 2 else ()
    message = Message(name, "B", content, ns_to_ticks(draw(stamps)), version, draw(st.integers(0, 3)), items)
    data = bytearray(join(encode(message)))
    if draw(st.integers(0, 9)) == 0:
        data[draw(st.sampled_from([49, 50, min(58, len(data) - 1), min(70, len(data) - 1), len(data) - 1]))] ^= 1
    return "igtl", bytes(data), draw(st.sampled_from([1, 2]))


@st.composite
def ros_bulk(draw: st.DrawFn) -> Step:
    """String, PointCloud2, Mesh, Marker and Image."""
    end = draw(st.sampled_from([b"", b"", b"\0", b"\0\0\0"]))
    if draw(st.booleans()):
        text = _mostly(draw, draw(st.sampled_from(["", "Hello", "Hello, world", "x" * 3000])), "für", "a\0b", "end\0")
        cdr = rosmsg.String(text * _mostly(draw, 1, 30)).pack()
        return "ros", "/igtl/out/S", rosmsg.String.TYPE, cdr + end, draw(stamps)
    header = rosmsg.Header(draw(stamps.filter(lambda ns: ns < 2**31 * NS_PER_S)), draw(st.sampled_from(["base", "m"])))
    if draw(st.booleans()):
        name, size, big = draw(st.sampled_from([("rgb8", 3, 0), ("bgr8", 3, 0), ("mono16", 2, 1), ("bgra8", 4, 0)]))
        padding = _mostly(draw, 0, 4)
        data = draw(st.binary(min_size=6, max_size=6)) * ((2 * size + padding) // 2) + _mostly(draw, b"", b"more")
        image = rosmsg.Image(header, 3, 2, name, big, 2 * size + padding, data)
        return "ros", "/igtl/out/I", image.TYPE, image.pack() + end, draw(stamps)
    places = draw(positions())
    if draw(st.integers(0, 3)) == 0:
        corners = np.array(draw(st.lists(st.tuples(*[st.integers(0, len(places))] * 3), max_size=4)), np.uint32)
        if not draw(st.booleans()):
            corners = np.minimum(corners, max(len(places) - 1, 0))
        cdr = rosmsg.Mesh(corners.reshape(-1, 3), places * _mostly(draw, 1e-3, 1e36)).pack() + end
        return "ros", "/igtl/out/M", rosmsg.Mesh.TYPE, cdr[: len(cdr) - _mostly(draw, 0, 1, 5)], draw(stamps)
    if draw(st.integers(0, 3)) == 0:
        marker = rosmsg.Marker(
            header,
            draw(st.sampled_from(["", "ns", "longer"])),
            draw(st.integers(0, 1)),
            _mostly(draw, rosmsg.Marker.TRIANGLE_LIST, rosmsg.Marker.LINE_LIST, 0),
            _mostly(draw, 0, 2),
            _mostly(draw, (0.0, 0.0, 0.0), (0.1, -0.2, 1e-9)),
            _mostly(draw, (0.0, 0.0, 0.0, 1.0), (0.0,) * 4, (0.0, 0.6, 0.0, 0.8)),
            _mostly(draw, (1.0, 1.0, 1.0), (0.3, 1.0, -2.0)),
            points=np.repeat(places, _mostly(draw, 3, 2, 1), axis=0) * _mostly(draw, 1e-3, 1e36),
            colors=np.ones((_mostly(draw, 0, 3), 4), np.float32),
            text=draw(st.sampled_from(["", "text"])),
        )
        cdr = marker.pack() + end
        return "ros", "/igtl/out/K", marker.TYPE, cdr[: len(cdr) - _mostly(draw, 0, 1, 5, 30)], draw(stamps)
    kind, datatype = _mostly(draw, ("<f4", 7), (">f4", 7), ("<f8", 8))
    step = draw(st.sampled_from([12, 12, 16])) * (2 if datatype == 8 else 1)
    names = _mostly(draw, "xyz", "zyx", "xyzi", "xyy")
    size = np.dtype(kind).itemsize
    fields = tuple(rosmsg.PointField(one, size * place, datatype, 1) for place, one in enumerate(names[: step // size]))
    height = 2 if len(places) % 2 == 0 and draw(st.booleans()) else 1
    row = step * (len(places) // height)
    padding = _mostly(draw, 0, 4) if height > 1 else 0
    data = np.zeros((height, row + padding), np.uint8)
    block = np.zeros((len(places), step), np.uint8)
    block[:, : 3 * size] = places.astype(kind).view(np.uint8).reshape(len(places), 3 * size)
    data[:, :row] = block.reshape(height, row)
    message = rosmsg.PointCloud2(
        header, height, len(places) // height, fields, kind[0] == ">", step, row + padding, data.tobytes(), True
    )
    cdr = message.pack() + end
    topic = draw(st.sampled_from(["/igtl/out/C", "/igtl/out/POINT"]))
    return "ros", topic, message.TYPE, cdr[: len(cdr) - _mostly(draw, 0, 1, 5)], draw(stamps)


#: Of rotations.
tool_poses = st.tuples(*[st.floats(-1e3, 1e3, width=32)] * 3, *[st.floats(0.5, 4.0, width=32)] * 4)
_NAMES: dict[str, tuple[str, ...]] = {
    "": ("Probe", "NeedleToRef", ""),
    "other name": ("Probe", "Needle", ""),
    "long name": ("Probe", "x" * 20, ""),
    "own parent": ("Probe", "ToolToTool", ""),
    "not ASCII": ("Probe", "für", ""),
    "fewer": ("Probe", "NeedleToRef"),
    "none": (),
}
_ODDITIES = (*_NAMES, "type", "pose", "frame", "items", "version", "link", "end", "damage")


def _matrix(pose: tuple[float, ...]) -> tuple[float, ...]:
    """The twelve numbers of TDATA."""
    rotation = np.array(poses.rotation_matrix(poses.unit_quaternion(pose[3:]))).T.ravel()
    return (*rotation, *pose[:3])


@st.composite
def igtl_tools(draw: st.DrawFn) -> Step:
    """TDATA and QTDATA with at most one oddity."""
    name, odd = draw(st.sampled_from(["TDATA", "TDATA", "QTDATA"])), _mostly(draw, "", *_ODDITIES)
    names = _NAMES.get(odd, _NAMES[""])
    elements = np.zeros(len(names), (Tracked if name == "TDATA" else QuaternionTracked).DTYPE)
    for element, name_of_tool in zip(elements, names, strict=True):
        element["name"], element["type"] = name_of_tool.encode(), 9 if odd == "type" else 2
        element["reserved"] = draw(st.sampled_from([0, 0, 5]))
        pose, is_odd = draw(tool_poses), odd == "pose" and draw(st.booleans())
        if name == "TDATA":
            element["matrix"] = draw(matrices()) if is_odd else _matrix(pose)
        else:
            element["position"], element["quaternion"] = pose[:3], draw(rotations()) if is_odd else pose[3:]
    version, items = (2, draw(st.sampled_from(BLOCKS))) if odd == "items" else (1 + (odd == "version"), ())
    content = (Tracked if name == "TDATA" else QuaternionTracked)(elements)
    message = Message(name, "B", content, ns_to_ticks(draw(stamps)), version, draw(st.integers(0, 3)), items)
    data = bytearray(join(encode(message)))
    if odd == "damage":
        data[draw(st.sampled_from([49, 50, min(58, len(data) - 1), min(100, len(data) - 1), len(data) - 1]))] ^= 1
    return "igtl", bytes(data), 2 if odd == "link" else 1


@st.composite
def ros_tools(draw: st.DrawFn) -> Step:
    """TrackingData and PoseArray with at most one oddity, and padding as it was in the memory of the sender."""
    odd = _mostly(draw, "", *_ODDITIES)
    header = rosmsg.Header(draw(stamps.filter(lambda ns: ns < 2**31 * NS_PER_S)), "m" if odd == "frame" else "base")
    names = _NAMES.get(odd, _NAMES[""])
    moved = [draw(tool_poses) for _ in names]
    if odd == "pose":
        moved[draw(st.integers(0, 2))] = (*draw(st.tuples(lengths, lengths, lengths)), *draw(rotations()))
    end = b"\0" if odd == "end" else b""
    if draw(st.integers(0, 2)) == 0:
        array = PoseArray(header, np.array(moved).reshape(-1, 7))
        return "ros", "/igtl/out/Array", array.TYPE, array.pack() + end, draw(stamps)
    tools = tuple(TrackedTool(name, 1 if odd == "type" else 2, pose) for name, pose in zip(names, moved, strict=True))
    cdr = TrackingData(header, tools, (MetadataItem("key", 3, "value"),) if odd == "items" else ()).pack()
    if (at := cdr.find(b"Probe\0")) > 0:  # behind its type
        cdr = cdr[: at + 7] + draw(st.sampled_from([b"\0", b"?"])) + cdr[at + 8 :]
    topic = draw(st.sampled_from(["/igtl/out/Tools", "/igtl/out/Tools", "/igtl/out/QTools"]))
    return "ros", topic, TrackingData.TYPE, cdr + end, draw(stamps)


_JOINT_ODDITIES = ("frame", "name", "fewer", "velocity", "effort", "none", "end", "cut", "count", "nan", "stamp")


@st.composite
def ros_joints(draw: st.DrawFn) -> Step:
    """JointState with at most one oddity, and padding as it was in the memory of the sender."""
    odd = _mostly(draw, "", *_JOINT_ODDITIES)
    stamp_ns = 0 if odd == "stamp" else draw(stamps.filter(lambda ns: ns < 2**31 * NS_PER_S))
    count = 0 if odd == "none" else 2 if odd == "fewer" else 3
    numbers = draw(st.lists(st.floats(), min_size=9, max_size=9))
    if odd == "nan":
        numbers[1] = math.nan
    position, velocity, effort = (np.array(numbers[3 * part :][:count]) for part in range(3))
    joints = JointState(
        rosmsg.Header(stamp_ns, "m" if odd == "frame" else "base"),
        ("q1", "elbow" if odd == "name" else "wrist", "q3")[: 2 if odd == "count" else count],
        position,
        velocity[: 1 if odd == "velocity" else count],
        effort if odd == "effort" else effort[:0],
    )
    cdr = joints.pack()
    if (at := cdr.find(b"q1\0")) > 0:
        cdr = cdr[: at + 3] + draw(st.sampled_from([b"\0", b"?"])) + cdr[at + 4 :]
    cdr = cdr[: len(cdr) - (8 if odd == "cut" else 0)] + (b"\0" if odd == "end" else b"")
    topic = draw(st.sampled_from(["/igtl/out/Joints", "/igtl/out/Joints", "/igtl/out/Array", "/arm/measured_js"]))
    return "ros", topic, JointState.TYPE, cdr, draw(stamps)


#: Changes of settings that matter for what is compiled.
CHANGES: tuple[dict[str, Any], ...] = (
    {"active": False},
    {},
    {},
    {"max_age_s": 0.05},
    {"max_age_s": 3.0},
    {"kinds": ["transform", "points"]},
    {"kinds": ["+marker"]},
    {"deny_in": ["TRANSFORM"]},
    {"deny_out": ["TRANSFORM", "POINT"]},
)


@st.composite
def others(draw: st.DrawFn) -> Step:
    kinds = [LINK_UP, LINK_DOWN, "STT", "STP", "GET", LISTENED, SETTING]
    kind, link = draw(st.sampled_from(kinds)), draw(st.sampled_from([1, 2, 3]))
    if kind == LISTENED:
        return "listened", draw(
            st.sampled_from(
                [
                    "/igtl/in/B/points",
                    "/igtl/in/B/mesh",
                    "/igtl/in/B/marker",
                    "/igtl/in/B/volume",
                    "/igtl/in/B/landmarks",
                ]
            )
        )
    if kind == SETTING:
        return "change", draw(st.sampled_from(CHANGES))
    if kind in ("STT", "STP", "GET"):
        types = ["TDATA", "TDATA", "QTDATA", "TRANS", "POINT", "STRING", "IMAGE"]
        name = f"{kind}_{draw(st.sampled_from(types))}"
        content = StartTracking(20, "") if name in ("STT_TDATA", "STT_QTDATA") else EmptyQuery()
        return "igtl", join(encode(Message(name, "", content, 0, 2))), link
    return "link", kind, link


CONFIGS = (
    Config(),
    Config(to_igtl=(ToIgtlRow(topic="/igtl/out/POINT", type="POINT"), ToIgtlRow()), to_ros=(ToRosRow(ros_unit="um"),)),
    Config(stamp="receive", check_crc=False, publish_tf=False),
    Config(
        to_ros=(ToRosRow(device="A", ros_unit="mm", frame_id="A"),),
        to_igtl=(
            ToIgtlRow(topic="/igtl/out/P*", type="POSITION", metadata=(("owner", "1111111111111111111"),)),
            ToIgtlRow(topic="/igtl/out/QTools", type="QTDATA"),
            ToIgtlRow(),
        ),
    ),
    Config(watch=True),
    Config().watched(),
    Config(profile="slicer"),
    Config(profile="slicer", stamp="receive", fitting=1),
    Config(
        watch=True,
        to_ros=(ToRosRow(device="A", max_age_s=3.0),),
        to_igtl=(ToIgtlRow(topic="/igtl/out/P*", max_age_s=2.0, stamp="receive"), ToIgtlRow(max_age_s=1.0)),
    ),
    Config(to_ros=(ToRosRow(max_age_s=0.1),), to_igtl=(ToIgtlRow(max_age_s=0.05),)),
)


def played(steps: list[Step], config: Config, heard: set[str] | None, fast_path: bool) -> tuple[list[Any], Any]:
    """The entries and the ledger of a session."""
    gateway = Gateway(config, fast_path=fast_path)
    if heard is not None:
        gateway.has_subscriber = lambda topic, _type: topic in heard
    session = Session(gateway)
    told: list[Any] = []
    for index, step in enumerate([("link", LINK_UP, 1), ("link", LINK_UP, 2), *steps]):
        now_ns = T0_NS + index * 40_000_000
        match step:
            case ("igtl", data, link):
                entries = session.input(now_ns, Kind.IGTL_IN, (data,), links=(link,))
            case ("ros", topic, ros_type, cdr, source_ns):
                entries = session.input(
                    now_ns, Kind.ROS_IN, (cdr,), channel=topic, type_name=ros_type, source_ns=source_ns
                )
            case ("listened", topic):
                note = Note(Level.INFO, LISTENED, "", stream=topic)
                entries = session.input(now_ns, Kind.EDGE_NOTE, (note.pack(),))
            case ("change", values):
                note = LiveSettings().changed(values).note(LiveSettings())
                entries = session.input(now_ns, Kind.EDGE_NOTE, (note.pack(),))
            case ("link", code, link):
                note = Note(Level.INFO, code, "", data={"peer": "127.0.0.1:1", "role": "server"})
                entries = session.input(now_ns, Kind.LINK, (note.pack(),), links=(link,))
        told += [_plain(entry) for entry in entries]
    return told, gateway.ledger.to_dict()


def _plain(entry: Entry) -> tuple[Any, ...]:
    return (
        *(getattr(entry, name) for name in ("seq", "stamp_ns", "kind", "channel", "type", "links", "source_ns")),
        entry.data(),
    )


@pytest.mark.slow
@pytest.mark.parametrize("functions", ["plain", "in use"])
@given(
    st.lists(igtl_messages() | igtl_messages() | ros_messages() | ros_messages() | others(), max_size=25),
    st.sampled_from(CONFIGS),
    st.sampled_from([None, None, set(), {"/tf"}, {"/igtl/in/A/transform"}, {"/igtl/in/A/metadata", "/tf"}]),
)
def test_a_session_with_the_fast_path_is_the_session_without(
    functions: str, steps: list[Step], config: Config, heard: set[str] | None
) -> None:
    with pytest.MonkeyPatch.context() as patch:
        if functions == "plain":
            patch.setattr(express, "pose_to_ros", express.PLAIN[0])
            patch.setattr(express, "pose_to_igtl", express.PLAIN[1])
        assert played(steps, config, heard, fast_path=True) == played(steps, config, heard, fast_path=False)


@given(
    st.lists(igtl_bulk() | igtl_bulk() | ros_bulk() | ros_bulk() | others(), max_size=25),
    st.sampled_from(CONFIGS),
    st.sampled_from(
        [
            *(None, set(), {"/igtl/in/B/point"}, {"/igtl/in/B/points", "/igtl/in/B/image"}, {"/igtl/in/B/metadata"}),
            *({"/igtl/in/B/image"}, {"/igtl/in/B/volume"}, {"/igtl/in/B/landmarks"}),
            *({"/igtl/in/B/mesh"}, {"/igtl/in/B/marker"}, {"/igtl/in/B/mesh", "/igtl/in/B/marker"}),
        ]
    ),
)
def test_so_is_one_of_texts_points_and_pictures(steps: list[Step], config: Config, heard: set[str] | None) -> None:
    assert played(steps, config, heard, fast_path=True) == played(steps, config, heard, fast_path=False)


@given(
    st.lists(igtl_tools() | igtl_tools() | ros_tools() | ros_tools() | others(), max_size=25),
    st.sampled_from(CONFIGS),
    st.sampled_from([None, set(), {"/tf"}, {"/igtl/in/B/tracking", "/igtl/in/B/poses"}]),
)
def test_so_is_one_of_tracking_data(steps: list[Step], config: Config, heard: set[str] | None) -> None:
    assert played(steps, config, heard, fast_path=True) == played(steps, config, heard, fast_path=False)


@given(
    st.lists(ros_joints() | ros_joints() | ros_joints() | others(), max_size=25),
    st.sampled_from(
        [
            Config(to_igtl=(ToIgtlRow(topic="/igtl/out/Array", type="NDARRAY"), ToIgtlRow())),
            Config(to_igtl=(ToIgtlRow(topic="/*/*", type="NDARRAY", max_age_s=2.0, stamp="receive"),)),
            Config(to_igtl=(ToIgtlRow(topic="/**", metadata=(("owner", "1111111111111111111"),)),)),
        ]
    ),
)
def test_so_is_one_of_joints(steps: list[Step], config: Config) -> None:
    shown = join(encode(Message("STATUS", "Peer", Status(1), header_version=2)))  # it gets types of version 2
    steps = [("igtl", shown, 1), *steps]
    assert played(steps, config, None, fast_path=True) == played(steps, config, None, fast_path=False)


POSE = Transform((0.36, 0.48, -0.8, -0.8, 0.6, 0.0, 0.48, 0.64, 0.6, 1.0, 2.0, 3.0))
TOOL = rosmsg.TransformStamped(rosmsg.Header(T0_NS, "base"), "tool", (0.1, 0.2, 0.3), (0.0, 0.0, 0.6, 0.8))


def watched_session(config: Config | None = None) -> tuple[Session, list[Kind]]:
    """With one peer; and what took the full path since it came."""
    gateway = Gateway(config or Config())
    session = Session(gateway)
    note = Note(Level.INFO, LINK_UP, "", data={"peer": "127.0.0.1:1", "role": "server"})
    session.input(T0_NS, Kind.LINK, (note.pack(),), links=(1,))
    general: list[Kind] = []
    handle = gateway.handle

    def watched(entry: Entry) -> list[Entry]:
        general.append(entry.kind)
        return handle(entry)

    gateway.handle = watched  # type: ignore[method-assign]
    return session, general


@pytest.mark.parametrize("version", [1, 2])
def test_the_second_pose_of_a_stream_takes_the_fast_path(version: int) -> None:
    session, general = watched_session()
    data = join(encode(Message("TRANSFORM", "Probe", POSE, ns_to_ticks(T0_NS), version)))
    cdr = TOOL.pack()
    for _ in range(6):
        session.input(T0_NS, Kind.IGTL_IN, (data,), links=(1,))
    for _ in range(4):
        session.input(T0_NS, Kind.ROS_IN, (cdr,), channel="/igtl/out/Tool", type_name=TOOL.TYPE)
    # the first message of a peer also shows what it is, so the second one is compiled
    assert general == [Kind.IGTL_IN, Kind.IGTL_IN, Kind.ROS_IN]
    changed = replace(TOOL, child_frame_id="other")
    session.input(T0_NS, Kind.ROS_IN, (changed.pack(),), channel="/igtl/out/Tool", type_name=TOOL.TYPE)
    session.input(T0_NS, Kind.ROS_IN, (changed.pack(),), channel="/igtl/out/Tool", type_name=TOOL.TYPE)
    assert general[3:] == [Kind.ROS_IN]


def test_a_query_leaves_the_streams_of_all_peers_on_the_fast_path() -> None:
    """A peer that asks a thousand times a second would otherwise have every stream compiled as often."""
    session, general = watched_session()
    pose, cdr = join(encode(Message("TRANSFORM", "Probe", POSE, ns_to_ticks(T0_NS)))), TOOL.pack()

    def poses() -> list[Kind]:
        for _ in range(3):
            session.input(T0_NS, Kind.IGTL_IN, (pose,), links=(1,))
            session.input(T0_NS, Kind.ROS_IN, (cdr,), channel="/igtl/out/Tool", type_name=TOOL.TYPE)
        found, general[:] = general[:], []
        return found

    poses()
    for name in ("GET_STATUS", "GET_TRANS", "GET_IMAGE", "STT_IMAGE", "STT_IMAGE", "STP_IMAGE", "GET_CAPABIL"):
        query = join(encode(Message(name, "Probe", EmptyQuery())))
        session.input(T0_NS, Kind.IGTL_IN, (query,), links=(1,))
        if name == "STT_IMAGE":
            poses()  # once more: the peer might have asked for them
    assert poses() == [Kind.IGTL_IN] * 2  # the last queries
    session.input(T0_NS, Kind.IGTL_IN, (join(encode(Message("STT_TRANS", "Tool", EmptyQuery()))),), links=(1,))
    assert poses().count(Kind.ROS_IN) == 3  # it is sent as often as the peer asked for


def test_poses_take_the_full_path_only_while_a_peer_wants_tracking_data() -> None:
    """STP_TDATA of twenty peers once sent all poses there: at 1 kHz they came half a second late."""
    session, general = watched_session()
    cdr = TOOL.pack()

    def poses_after(name: str) -> int:
        content = StartTracking(20, "") if name.startswith("STT") else EmptyQuery()
        session.input(T0_NS, Kind.IGTL_IN, (join(encode(Message(name, "", content, 0, 2))),), links=(1,))
        session.input(T0_NS, Kind.ROS_IN, (cdr,), channel="/igtl/out/Tool", type_name=TOOL.TYPE)
        general.clear()
        for _ in range(3):
            session.input(T0_NS, Kind.ROS_IN, (cdr,), channel="/igtl/out/Tool", type_name=TOOL.TYPE)
        return general.count(Kind.ROS_IN)

    assert [poses_after(name) for name in ("STP_TDATA", "STP_QTDATA")] == [0, 0]
    for _ in range(MAX_RELEASES):
        assert [poses_after(name) for name in ("STT_TDATA", "STT_QTDATA", "STP_TDATA", "STP_QTDATA")] == [3, 3, 3, 0]
    # now this peer's poses stay there: each return is compiled for all
    assert [poses_after(name) for name in ("STT_TDATA", "STP_TDATA")] == [3, 3]


#: After the first coordinate.
TOOL_POSE = (0.2, 0.3, 0.0, 0.0, 0.6, 0.8)


def tracked(kind: type[Any], number: int) -> Any:
    """Two tools that move with the number."""
    elements = np.zeros(2, kind.DTYPE)
    elements["name"], elements["type"] = [b"Probe", b"NeedleToReference"], [2, 3]
    if kind is Tracked:
        elements["matrix"] = [(*POSE.wire_matrix[:9], number, 2.0, 3.0), (*POSE.wire_matrix[:9], 0.0, number, 9.0)]
    else:
        elements["position"], elements["quaternion"] = [(number, 2.0, 3.0), (0.0, 0.0, number)], (0.0, 0.6, 0.0, 0.8)
    return kind(elements)


compiled = pytest.mark.skipif(not express.COMPILED, reason="installed without the C part")
ROWS = np.arange(900.0).reshape(300, 3)


def fields(*names: str) -> tuple[rosmsg.PointField, ...]:
    return tuple(rosmsg.PointField(name, 4 * place, 7, 1) for place, name in enumerate(names))


@compiled
@pytest.mark.parametrize("version", [1, 2])
@pytest.mark.parametrize(
    "made",
    [
        ("STRING", lambda n: StringBody(b"text" * n)),
        ("POINT", lambda n: Points.of(ROWS[:n])),
        ("POLYDATA", lambda n: PolyData(ROWS[:n].astype(">f4"), Cells.of_all(n))),
        ("POLYDATA", lambda n: PolyData(ROWS[:n].astype(">f4"))),
        ("POLYDATA", lambda n: PolyData(ROWS[:n].astype(">f4"), polygons=Cells.of(np.zeros((n, 3), int)))),
        ("IMAGE", lambda n: Image((2, 2, 1), 3, bytes([n % 256]) * 12, 3)),
        ("TDATA", lambda n: tracked(Tracked, n)),
        ("QTDATA", lambda n: tracked(QuaternionTracked, n)),
    ],
)
def test_so_does_the_second_text_cloud_or_picture_of_a_peer(made: tuple[str, Any], version: int) -> None:
    session, general = watched_session()
    name, content = made
    for count in (5, 5, 1, 300, 2):
        data = join(encode(Message(name, "Probe", content(count), ns_to_ticks(T0_NS), version)))
        session.input(T0_NS, Kind.IGTL_IN, (memoryview(data),), links=(1,))
    assert general == [Kind.IGTL_IN, Kind.IGTL_IN]


@compiled
def test_a_tool_out_of_sight_leaves_the_others_on_the_fast_path() -> None:
    """Trackers send zeros for it, also in the first message."""
    session, general = watched_session()
    for number in (0, 0, 1, 2, 3, *[0] * 20, 4, 5):
        content = tracked(Tracked, number)
        if not number:
            content.elements["matrix"][1] = 0.0
        data = join(encode(Message("TDATA", "Probe", content, ns_to_ticks(T0_NS))))
        session.input(T0_NS, Kind.IGTL_IN, (data,), links=(1,))
    assert len(general) == 23  # those without a pose, and the first with one


@compiled
@pytest.mark.parametrize("version", [1, 2])
@pytest.mark.parametrize(
    "made",
    [
        lambda n: rosmsg.String("text" * n),
        lambda n: rosmsg.PointCloud2(
            rosmsg.Header(T0_NS, "m"), 1, n, fields("x", "y", "z"), False, 12, 12 * n, bytes(12 * n), True
        ),
        lambda n: rosmsg.PointCloud2(
            rosmsg.Header(T0_NS, "map"), n, 2, fields("z", "y", "x"), False, 16, 32, bytes(32 * n), True
        ),
        lambda n: rosmsg.Mesh(np.zeros((n, 3), np.uint32), ROWS[:n]),
        lambda n: rosmsg.Marker(
            rosmsg.Header(T0_NS, "map"), "ns", n, rosmsg.Marker.TRIANGLE_LIST, points=np.repeat(ROWS[:n], 3, axis=0)
        ),
        lambda n: rosmsg.Image(rosmsg.Header(T0_NS, "map"), 2, 2, "bgr8", 0, 6, bytes([n % 256]) * 12),
        lambda n: TrackingData(
            rosmsg.Header(T0_NS, "map"), (TrackedTool("Tool", 2, (n, *TOOL_POSE)), TrackedTool("", 3, (n, *TOOL_POSE)))
        ),
        lambda n: PoseArray(rosmsg.Header(T0_NS, "map"), np.tile((n, *TOOL_POSE), (3, 1))),
        lambda n: JointState(rosmsg.Header(T0_NS, "map"), ("q", "r"), ROWS[0, :2] * n, ROWS[1, :2]),
    ],
)
def test_and_of_a_topic(made: Any, version: int) -> None:
    session, general = watched_session()
    shown = join(encode(Message("STATUS", "Peer", Status(1), header_version=version)))
    session.input(T0_NS, Kind.IGTL_IN, (shown,), links=(1,))
    for count in (5, 1, 300, 2):
        message = made(count)
        session.input(T0_NS, Kind.ROS_IN, (message.pack(),), channel="/igtl/out/T", type_name=message.TYPE)
    assert general == [Kind.IGTL_IN, Kind.ROS_IN]


@compiled
@pytest.mark.parametrize("stamp_ns", [0, T0_NS])
@pytest.mark.parametrize("stamp", ["source", "receive"])
@pytest.mark.parametrize(
    "made",
    [
        lambda ns, n: replace(TOOL, header=rosmsg.Header(ns, "base"), translation=(n, 0.0, 0.0)),
        lambda ns, n: PoseStamped(rosmsg.Header(ns, "base"), (n, *TOOL_POSE)),
        lambda _ns, n: rosmsg.String("text" * n),
        lambda ns, n: rosmsg.Image(rosmsg.Header(ns, "map"), 2, 2, "bgr8", 0, 6, bytes([n]) * 12),
        lambda ns, n: rosmsg.Image(rosmsg.Header(ns, "map"), 200, 200, "mono8", 0, 200, bytes([n]) * 40_000),
        lambda _ns, n: rosmsg.Mesh(np.zeros((n, 3), np.uint32), ROWS[:n]),
    ],
    ids=["transform", "pose", "text", "picture", "large picture", "mesh"],
)
def test_and_of_one_for_slicer_with_its_stamp_in_the_metadata(made: Any, stamp: str, stamp_ns: int) -> None:
    config = Config(profile="slicer", stamp=stamp).watched()
    session, general = watched_session(config)
    other = Session(Gateway(config, fast_path=False))
    up = Note(Level.INFO, LINK_UP, "", data={"peer": "127.0.0.1:1", "role": "server"})
    other.input(T0_NS, Kind.LINK, (up.pack(),), links=(1,))
    shown = join(encode(Message("STATUS", "Peer", Status(1), header_version=2)))
    for one in (session, other):
        one.input(T0_NS, Kind.IGTL_IN, (shown,), links=(1,))
    for number in (1, 5, 6, 30):
        message = made(stamp_ns, number)
        told = [
            one.input(
                T0_NS + number * NS_PER_S,
                Kind.ROS_IN,
                (message.pack(),),
                channel="/igtl/out/T",
                type_name=message.TYPE,
                source_ns=T0_NS + number * NS_PER_S,
            )
            for one in (session, other)
        ]
        found, expected = ([_plain(entry) for entry in entries if entry.kind is not Kind.NOTE] for entries in told)
        assert found == expected and b"ros.stamp" in found[-1][-1]
    assert general == [Kind.IGTL_IN, Kind.ROS_IN]


@compiled
def test_clouds_for_slicer_have_lines_also_after_an_empty_one() -> None:
    session, _ = watched_session(Config(profile="slicer"))
    for count in (0, 0, 3):
        header, xyz = rosmsg.Header(T0_NS, "m"), fields("x", "y", "z")
        cloud = rosmsg.PointCloud2(header, 1, count, xyz, False, 12, 12 * count, bytes(12 * count), True)
        entries = session.input(T0_NS, Kind.ROS_IN, (cloud.pack(),), channel="/igtl/out/T", type_name=cloud.TYPE)
    (sent,) = [decode(entry.data()) for entry in entries if entry.kind is Kind.IGTL_OUT]
    assert isinstance(sent.content, PolyData)
    assert sent.content.lines.lists() == [[0, 0], [1, 1], [2, 2]] and not sent.content.vertices.count


@pytest.fixture(params=[True, False], ids=["AVX2", "plain"])
def vectors(request: pytest.FixtureRequest) -> Iterator[None]:
    """Run with the loops for AVX2, if the processor has it, and without."""
    module = pytest.importorskip("igtl_gateway.native._express", reason="installed without the C part")
    module.allow_avx2(request.param)
    yield
    module.allow_avx2(True)


#: More points than one block has: the C part converts a large content in blocks.
MANY = 12_345
PLACES = np.random.default_rng(5).uniform(-500.0, 500.0, (MANY, 3)).astype(np.float32)


def _at_place(places: npt.NDArray[np.float32], index: int, value: float) -> npt.NDArray[np.float32]:
    odd = places.copy()
    odd[index, 1] = value
    return odd


CORNERS = np.random.default_rng(6).integers(0, MANY, (9999, 3)).astype(np.uint32)


def _large_triangles() -> list[npt.NDArray[np.uint32]]:
    """Triangles in several blocks: an odd and an even number, then with an index beyond the points at three places."""
    found = [CORNERS, CORNERS[:-1]]
    for place in (0, 5000, len(CORNERS) - 1):
        found.append(CORNERS.copy())
        found[-1][place, 2] = MANY
    return found


def _large_contents() -> list[tuple[str, Any]]:
    """Contents of several blocks, and then with something odd in the first, a middle and the last one."""
    places = PLACES.astype(">f4")
    labelled = Points.of(PLACES[:4000])
    labelled.elements["name"][3000] = b"here"
    colours, sizes = np.random.default_rng(7).integers(0, 256, (3999, 4), np.uint8), PLACES[:3999, 0]
    coloured = Points.of(PLACES[:3999], rgba=colours, diameters=sizes)
    sizeless = Points.of(PLACES[:3999], rgba=colours, diameters=np.append(sizes[1:], math.nan))
    vertices = Cells.of_all(MANY)
    disordered = vertices.data.copy()
    disordered[-1], disordered[-2] = disordered[-2], disordered[-1]
    contents: list[tuple[str, Any]] = [
        ("POLYDATA", PolyData(places, vertices)),
        ("POLYDATA", PolyData(places)),
        *(("POLYDATA", PolyData(_at_place(places, index, math.nan), vertices)) for index in (0, 7000, MANY - 1)),
        ("POLYDATA", PolyData(places, replace(vertices, data=disordered))),
        *(("POLYDATA", PolyData(places, polygons=Cells.of(corners))) for corners in _large_triangles()),
        ("POLYDATA", PolyData(_at_place(places, 7000, math.nan), polygons=Cells.of(CORNERS))),
        ("POINT", Points.of(PLACES[:4000])),
        *(("POINT", points) for points in (labelled, coloured, sizeless)),
        ("STRING", StringBody(b"x" * 65_000)),
        ("STRING", StringBody(b"x" * 65_400 + b"\xff")),
        ("IMAGE", Image((401, 307, 1), 3, PLACES.tobytes()[: 401 * 307], 1)),
        ("IMAGE", Image((401, 307, 1), 3, PLACES.tobytes()[1 : 401 * 307 + 1], 1)),
    ]
    return contents


@pytest.mark.slow
@pytest.mark.usefixtures("vectors")
@pytest.mark.parametrize("version", [1, 2])
def test_large_contents_are_converted_as_on_the_full_path(version: int) -> None:
    steps: list[Step] = []
    for index, (name, content) in enumerate(_large_contents()):
        data = join(encode(Message(name, f"B{index}", content, ns_to_ticks(T0_NS), version)))
        damaged = bytearray(data)
        damaged[min(len(data) - 1, 70_000)] ^= 1
        steps += [("igtl", data, 1)] * 3 + [("igtl", bytes(damaged), 1)] * 2
    assert played(steps, Config(), None, fast_path=True) == played(steps, Config(), None, fast_path=False)


@pytest.mark.usefixtures("vectors")
@table("topic", ["/igtl/out/C", "/igtl/out/POINT"])
@table(("names", "step"), [("xyz", 12), ("xyz", 16), ("xyz", 20), ("zyx", 12), ("yxz", 32)])
def test_large_clouds_are_converted_as_on_the_full_path(topic: str, names: str, step: int) -> None:
    shown = join(encode(Message("STATUS", "Peer", Status(1), header_version=2)))
    steps: list[Step] = [("igtl", shown, 1)]  # peers of both header versions
    odd = [_at_place(PLACES, index, math.inf) for index in (0, 9999, MANY - 1)]
    for places in (PLACES, PLACES, PLACES[::-1], odd[0], PLACES, PLACES, odd[1], PLACES, PLACES, odd[2]):
        data = np.full((MANY, step // 4), 1e-40, "<f4")
        data[:, :3] = places
        message = rosmsg.PointCloud2(
            rosmsg.Header(T0_NS, "m"), 1, MANY, fields(*names), False, step, step * MANY, data.tobytes(), True
        )
        steps.append(("ros", topic, message.TYPE, memoryview(message.pack()), T0_NS))
    config = CONFIGS[1]
    assert played(steps, config, None, fast_path=True) == played(steps, config, None, fast_path=False)


@pytest.mark.usefixtures("vectors")
def test_large_surfaces_are_converted_as_on_the_full_path() -> None:
    shown = join(encode(Message("STATUS", "Peer", Status(1), header_version=2)))
    steps: list[Step] = [("igtl", shown, 1)]  # peers of both header versions
    for place, corners in [(PLACES, corners) for corners in _large_triangles()] + [
        (_at_place(PLACES, index, math.nan), CORNERS) for index in (0, 9999)
    ]:
        good = rosmsg.Mesh(CORNERS[::-1], PLACES.astype(np.float64) * 1.1)
        mesh = rosmsg.Mesh(corners, place.astype(np.float64) / 3)
        steps += [("ros", "/igtl/out/M", mesh.TYPE, one.pack(), T0_NS) for one in (good, good, mesh)]
    head = (
        rosmsg.Header(T0_NS, "m"),
        "ns",
        1,
        rosmsg.Marker.TRIANGLE_LIST,
        0,
        (0.1, 0.2, 0.3),
        (0.0,) * 4,
        (2.0, 0.3, 1.0),
    )
    for place in (PLACES, _at_place(PLACES, 0, math.nan), PLACES[::-1], _at_place(PLACES, MANY - 1, math.inf)):
        markers = (
            rosmsg.Marker(*head, points=one.astype(np.float64) / 7) for one in (PLACES[:-3], place, place[:-300])
        )
        steps += [("ros", "/igtl/out/K", one.TYPE, one.pack(), T0_NS) for one in markers]
    assert played(steps, Config(), None, fast_path=True) == played(steps, Config(), None, fast_path=False)


@pytest.mark.parametrize("heard", [{"/igtl/in/B/mesh"}, {"/igtl/in/B/marker"}])
def test_a_surface_waits_for_the_first_subscriber_of_its_other_topic(heard: set[str]) -> None:
    steps: list[Step] = []
    for index in range(4):
        surface = PolyData(PLACES[index : index + 3].astype(">f4"), polygons=Cells.of([[0, 1, 2]]))
        steps.append(("igtl", join(encode(Message("POLYDATA", "B", surface, ns_to_ticks(T0_NS)))), 1))
        steps += [("listened", f"/igtl/in/B/{name}") for name in ("mesh", "marker") if index % 2]
    entries, counts = played(steps, Config(), heard, fast_path=True)
    assert (entries, counts) == played(steps, Config(), heard, fast_path=False)
    assert counts["ros_out"].keys() >= {"/igtl/in/B/mesh", "/igtl/in/B/marker"}


@compiled
@pytest.mark.parametrize("attributes", [(3, 0, 0), (0, 3, 0, 0), (4, 4, 0, 3, 0)])
def test_a_cloud_has_no_field_of_the_one_before(attributes: tuple[int, ...]) -> None:
    """Its stream was compiled from a cloud with colours, and plain ones then had their field, and no data for it."""
    steps: list[Step] = []
    for count, components in enumerate(attributes, 2):
        colours = (Attribute.of(SCALAR, "RGB", np.ones((count, components))),) if components else ()
        cloud = PolyData(ROWS[:count].astype(">f4"), Cells.of_all(count), attributes=colours)
        steps.append(("igtl", join(encode(Message("POLYDATA", "B", cloud, ns_to_ticks(T0_NS)))), 1))
    entries, counts = played(steps, Config(), None, fast_path=True)
    assert (entries, counts) == played(steps, Config(), None, fast_path=False)


@pytest.mark.usefixtures("vectors")
@table("encoding", ["rgb8", "bgr8"])
@table("width", [1, 2, 5, 6, 253])
def test_large_pictures_are_converted_as_on_the_full_path(encoding: str, width: int) -> None:
    steps: list[Step] = []
    for begin in range(3):
        data = PLACES.tobytes()[begin : begin + 3 * width * 190]
        message = rosmsg.Image(rosmsg.Header(T0_NS, "m"), 190, width, encoding, 0, 3 * width, data)
        steps += [("ros", "/igtl/out/I", message.TYPE, kind(message.pack()), T0_NS) for kind in (bytes, memoryview)]
    assert played(steps, Config(), None, fast_path=True) == played(steps, Config(), None, fast_path=False)


@compiled
@pytest.mark.parametrize("bad", [(), (1,) * 9, (b"", b"", 0, 48, True, True, 0, (1.0, 1.0), ((b"", 0),))])
def test_the_compiled_functions_refuse_what_they_cannot_use(bad: tuple[Any, ...]) -> None:
    for function in (express.pose_to_ros, express.pose_to_igtl, express.bulk_to_ros, express.bulk_to_igtl):
        assert function
        with pytest.raises((TypeError, ValueError)):
            function(*bad)


@pytest.mark.parametrize("heard", [None, set(), {"/igtl/in/B/points"}])
def test_what_nobody_hears_is_refused_all_the_same(heard: set[str] | None) -> None:
    """Found by tools/fuzz_gateway.py: without subscribers, the fast path did not look at the content."""
    cloud = PolyData(np.arange(12, dtype=">f4").reshape(4, 3))
    good = join(encode(Message("POLYDATA", "B", cloud, ns_to_ticks(T0_NS))))
    bad = bytearray(good[:-4])
    bad[42:50] = (len(bad) - HEADER_SIZE).to_bytes(8, "big")
    bad[50:58] = crc64(bad[HEADER_SIZE:]).to_bytes(8, "big")
    steps: list[Step] = [("igtl", data, 1) for data in (good, good, good, bytes(bad), good)]
    entries, counts = played(steps, Config(), heard, fast_path=True)
    assert (entries, counts) == played(steps, Config(), heard, fast_path=False)
    assert counts["igtl_in"]["POLYDATA/B"]["dropped"] == {"truncated": 1}


def test_of_peers_that_invent_names_few_are_compiled() -> None:
    script = Script()
    script.up(1)
    script.up(2)

    def send(number: int, link: int) -> None:
        script.igtl(Message("TRANSFORM", f"D{number}", POSE, ns_to_ticks(script.now_ns)), link)

    for number in range(cache.MOST_AT_ONCE + 20):  # the first message opens a stream
        send(number, 1)
        send(number, 2)
    compiled = script.gateway.fast_path.to_ros
    assert 0 < (made := len(compiled)) <= cache.MOST_AT_ONCE
    send(cache.MOST_AT_ONCE + 10, 2)
    assert len(compiled) == made + 1, "a stream has a second message"


# -- what is compiled again, prepared, and given to the native passage -------------------------------------------------

TOPIC = "/igtl/out/T"


def peer_up(session: Session, link: int) -> None:
    note = Note(Level.INFO, LINK_UP, "", data={"peer": f"127.0.0.1:{link}", "role": "server"})
    session.input(T0_NS, Kind.LINK, (note.pack(),), links=(link,))


def send_ros(session: Session, cdr: bytes, type_name: str, times: int = 1) -> None:
    for _ in range(times):
        session.input(T0_NS, Kind.ROS_IN, (cdr,), channel=TOPIC, type_name=type_name)


@compiled
@pytest.mark.parametrize(("size", "stays"), [(32 << 10, True), ((32 << 10) + 4, False)])
def test_a_stream_of_small_messages_is_compiled_again_at_once_when_a_peer_comes(size: int, stays: bool) -> None:
    """From its last message, which is kept if it has 32 KiB at most; a larger one waits for its next message."""
    session, general = watched_session()
    cdr = rosmsg.String("x" * (size - 9)).pack()
    assert len(cdr) == size
    send_ros(session, cdr, rosmsg.String.TYPE, 2)
    assert general.count(Kind.ROS_IN) == 1
    peer_up(session, 2)
    send_ros(session, cdr, rosmsg.String.TYPE, 2)
    assert general.count(Kind.ROS_IN) == (1 if stays else 2)


@compiled
@pytest.mark.parametrize(
    ("pixels", "is_prepared"), [(100, False), ((64 << 10) - 1_000, False), ((64 << 10) + 1_000, True)]
)
def test_only_a_large_message_of_a_compiled_stream_is_prepared(pixels: int, is_prepared: bool) -> None:
    """What takes microseconds is done under the lock; without a compiled stream the full path is prepared."""
    session, _ = watched_session()
    data = join(encode(Message("IMAGE", "Probe", Image((pixels // 2, 2, 1), 3, bytes(pixels)), ns_to_ticks(T0_NS))))
    picture = rosmsg.Image(rosmsg.Header(T0_NS, "map"), 1, pixels, "mono8", 0, pixels, bytes(pixels))
    for _ in range(3):
        session.input(T0_NS, Kind.IGTL_IN, (data,), links=(1,))
    send_ros(session, picture.pack(), picture.TYPE, 2)
    found = (
        session.prepare(Kind.IGTL_IN, data, "", "", (1,), 0),
        session.prepare(Kind.ROS_IN, picture.pack(), TOPIC, picture.TYPE, (), 0),
    )
    assert isinstance(found[0], tuple) is is_prepared
    assert is_prepared or found == (None, None)


class Copies:
    """The native passage as the fast path sees it: notes what it is given."""

    def __init__(self) -> None:
        self.calls: list[tuple[Any, ...]] = []

    def __getattr__(self, name: str) -> Any:
        return lambda *arguments: self.calls.append((name, *arguments))

    def of(self, name: str) -> list[tuple[Any, ...]]:
        found = [arguments for call, *arguments in self.calls if call == name]
        self.calls = [each for each in self.calls if each[0] != name]
        return [tuple(each) for each in found]


def test_the_native_passage_gets_the_stream_that_was_compiled_again() -> None:
    session, _ = watched_session()
    copies = Copies()
    fast = session.gateway.fast_path  # type: ignore[attr-defined]
    fast.native = copies
    send_ros(session, TOOL.pack(), TOOL.TYPE, 2)
    key = (TOPIC, TOOL.TYPE)
    assert copies.of("handled") == [(key, before := fast.to_igtl[key])]
    peer_up(session, 2)
    after = fast.to_igtl[key]
    assert after is not before and copies.of("replace") == [(key, after)]
    assert sum(links for _, links, _ in after.outputs) == 2
    send_ros(session, TOOL.pack(), TOOL.TYPE)
    assert copies.of("handled") == [(key, after)]
    send_ros(session, replace(TOOL, child_frame_id="other").pack(), TOOL.TYPE)
    assert copies.of("drop") == [(key,)], "it does not fit"


@compiled
@pytest.mark.parametrize(
    "message",
    [
        rosmsg.PointCloud2(rosmsg.Header(T0_NS, "ma"), 1, 2, fields("x", "y", "z"), False, 12, 24, bytes(24), True),
        rosmsg.PointCloud2(rosmsg.Header(T0_NS, "world"), 2, 2, fields("z", "x", "y"), False, 16, 32, bytes(64), False),
        rosmsg.Image(rosmsg.Header(T0_NS, "ma"), 2, 2, "mono8", 0, 2, bytes(4)),
        rosmsg.Image(rosmsg.Header(T0_NS, "world"), 2, 2, "mono16", 0, 4, bytes(8)),
        rosmsg.Marker(rosmsg.Header(T0_NS, "ma"), "s", 1, rosmsg.Marker.TRIANGLE_LIST, points=ROWS[:3]),
    ],
    ids=["cloud", "another cloud", "picture", "another picture", "marker"],
)
def test_bytes_between_the_fields_may_have_any_content_and_the_fields_may_not(message: Any) -> None:
    """ROS leaves its padding undefined: a stream must not leave the fast path for it; all else is the full path's."""
    cdr, kind = message.pack(), type(message)
    begin = 12  # after encapsulation and stamp
    end = len(cdr) - len(join((getattr(message, "data", None) or ROWS[:3].tobytes(),)))
    session, general = watched_session()
    send_ros(session, cdr, kind.TYPE, 2)
    paddings, steps = 0, list[Step]()
    for at in range(begin, end):
        changed = bytearray(cdr)
        changed[at] ^= 0x41
        steps += [("ros", TOPIC, kind.TYPE, data, T0_NS) for data in (cdr, cdr, bytes(changed))]
        with suppress(ConversionError):
            if kind.unpack(bytes(changed)).pack() == cdr:
                paddings += 1
                send_ros(session, bytes(changed), kind.TYPE)
                assert general.count(Kind.ROS_IN) == 1, f"byte {at} is padding"
    assert paddings
    for some in (steps[number : number + 60] for number in range(0, len(steps), 60)):
        assert played(some, Config(), None, fast_path=True) == played(some, Config(), None, fast_path=False)
