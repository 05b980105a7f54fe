"""The messages of the peers of ``every-type``: each type of the protocol, in each form of its document.

Small values that are easy to recognise; rotations are permutations of the axes or 3-4-5 triangles, so that no
processor rounds them otherwise.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, TypeVar

import numpy as np

from igtl_gateway.base.stamp import NS_PER_MS, NS_PER_S, ns_to_ticks
from igtl_gateway.wire import Item
from igtl_gateway.wire.bind import Bind, BindChild
from igtl_gateway.wire.body import Body, Raw
from igtl_gateway.wire.capability import Capability
from igtl_gateway.wire.client_info import ClientInfo
from igtl_gateway.wire.colort import MAP_RGB, MAP_U8, MAP_U16, ColorTable
from igtl_gateway.wire.command import Command
from igtl_gateway.wire.elements import Elements
from igtl_gateway.wire.image import BIG_ENDIAN, LITTLE_ENDIAN, LPS, RAS, SCALARS, Image
from igtl_gateway.wire.metalists import ImageMetaList, LabelMetaList, VideoMetaList
from igtl_gateway.wire.ndarray import NDARRAY_SCALARS, NdArray
from igtl_gateway.wire.point import Points
from igtl_gateway.wire.polydata import CELL, NORMAL, RGBA, SCALAR, TCOORDS, TENSOR, VECTOR, Attribute, Cells, PolyData
from igtl_gateway.wire.query import QUERIES, GetBind, QueryReply, StartBind, StartPolyData, StartTracking, StartVideo
from igtl_gateway.wire.sensor import Sensor, parse_unit
from igtl_gateway.wire.text import Status, String
from igtl_gateway.wire.tracking import (
    TOOL_3D,
    TOOL_5D,
    TOOL_6D,
    TRACKER,
    QuaternionTrackingData,
    TrackingData,
)
from igtl_gateway.wire.trajectory import ENTRY_AND_TARGET, ENTRY_ONLY, TARGET_ONLY, Trajectories
from igtl_gateway.wire.transform import Position, Transform
from igtl_gateway.wire.video import Video

#: Type name, device name, content: a message without stamp and header version.
Said = tuple[str, str, Body]

#: Columns of a 3-4-5 rotation about z, and the quarter turn about x.
TILTED = (0.6, 0.8, 0.0, -0.8, 0.6, 0.0, 0.0, 0.0, 1.0)
QUARTER = (1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, -1.0, 0.0)
#: Half the angle of TILTED has cosine 2 and sine 1 over √5; this one is exact: 0.6² + 0.8² = 1.
TURNED = (0.0, 0.0, 0.6, 0.8)

#: A frame of 32 × 32 pixels as H.264 by x264 (baseline, without its text about itself), and the one that follows it.
H264_KEY = bytes.fromhex(
    "000000016742c00ada25a1000003000100000300328f1226a00000000168ce0fc8000000016588843a1183800088f0000855f1000040ec"
    "000407e20000817000080949d75e"
)
H264_NEXT = bytes.fromhex("00000001419a2022a370700012310001171e200008440000837c400010730001056a3f50")

_E = TypeVar("_E", bound=Elements)

_CORNERS = np.array([[0, 0, 0], [30, 0, 0], [30, 40, 0], [0, 40, 0], [15, 20, 50]], ">f4")


def _list(kind: type[_E], *rows: tuple[Any, ...]) -> _E:
    return kind(np.array(list(rows), kind.DTYPE))


def volume(offset: tuple[int, int, int] = (0, 0, 0), size: tuple[int, int, int] = (4, 3, 6), add: int = 0) -> Image:
    """A volume of 4 × 3 × 6 int16 with a place of its own, or a part of it."""
    count = size[0] * size[1] * size[2]
    pixels = (np.arange(count, dtype="<i2") * 10 - 100 + add).astype("<i2").tobytes()
    matrix = (*TILTED[:3], *(2.0 * v for v in TILTED[3:6]), 0.0, 0.0, 2.5, 10.0, -20.0, 30.0)
    return Image((4, 3, 6), 4, pixels, 1, LITTLE_ENDIAN, RAS, matrix, offset, size)


def _images() -> Iterator[Said]:
    for scalar, code in SCALARS.items():
        for endian, order in ((LITTLE_ENDIAN, "<"), (BIG_ENDIAN, ">")):
            pixels = np.arange(12).astype(order + code).tobytes()
            yield "IMAGE", "Slice", Image((4, 3, 1), scalar, pixels, 1, endian)
    yield "IMAGE", "Slice", Image((4, 3, 1), 3, bytes(range(36)), 3)
    yield "IMAGE", "Slice", Image((4, 3, 1), 3, bytes(range(48)), 4)
    yield "IMAGE", "Volume", Image((2, 2, 2), 10, np.arange(16, dtype="<f4").tobytes(), 2)
    yield "IMAGE", "Volume", Image((2, 2, 2), 3, bytes(range(8)), 1, LITTLE_ENDIAN, LPS, (*QUARTER, 1.0, 2.0, 3.0))
    yield "IMAGE", "Volume", volume()
    # in two parts, then one of them again
    yield "IMAGE", "InParts", volume((0, 0, 0), (4, 3, 4))
    yield "IMAGE", "InParts", volume((0, 0, 4), (4, 3, 2), 1000)
    yield "IMAGE", "InParts", volume((1, 1, 1), (2, 2, 1), -500)
    yield "IMAGE", "SlicedVolume", volume()


def _surface() -> PolyData:
    """All kinds of cells, all kinds of attributes; counts and names of odd lengths."""
    points, cells = len(_CORNERS), 8

    def each(kind: int, name: str, components: int) -> Attribute:
        count = cells if kind & CELL else points
        return Attribute.of(kind, name, np.arange(count * components).reshape(count, components) / 64)

    return PolyData(
        _CORNERS,
        Cells.of([[0], [1, 2]]),
        Cells.of([[0, 4], [1, 4, 3]]),
        Cells.of([[0, 1, 2, 3], [0, 1, 4], [2, 3, 4]]),
        Cells.of([[0, 1, 3, 4]]),
        (
            each(SCALAR, "heat", 1),
            each(VECTOR, "flow", 3),
            each(NORMAL, "normals", 3),
            each(TENSOR, "stress", 9),
            each(RGBA, "Colors", 4),
            each(TCOORDS, "texture", 3),
            each(CELL | SCALAR, "quality", 1),
            each(CELL | RGBA, "Größe", 4),
        ),
    )


def _geometry() -> Iterator[Said]:
    red, clear = (255, 0, 0, 255), (0, 0, 0, 0)
    yield "POINT", "Points", Points.of(np.array([[1.5, -2.5, 3.5]]), None, 4.0)
    yield "POINT", "Points", Points.of(np.array([[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]]))
    landmarks = (
        (b"Nasion", b"Fiducials", red, (0, 90, 40), 2.5, b"Head"),
        ("Gehörgang".encode(), b"Fiducials", clear, (-70.5, 0, 0), 2.5, b""),
    )
    yield "POINT", "Points", _list(Points, *landmarks)
    yield "POLYDATA", "Surface", _surface()
    yield "POLYDATA", "Surface", PolyData(_CORNERS, Cells.of([[0, 1, 2, 3, 4]]))
    yield "POLYDATA", "Surface", PolyData(_CORNERS, lines=Cells.of([[0, 1, 2], [3, 4]]))
    plan = (
        (b"Left", b"Plan", ENTRY_AND_TARGET, 0, red, (10, 20, 30), (40, 50, 60), 1.5, b"Head"),
        (b"EntryOnly", b"Plan", ENTRY_ONLY, 0, clear, (1, 2, 3), (0, 0, 0), 0, b""),
        (b"TargetOnly", b"", TARGET_ONLY, 0, red, (0, 0, 0), (4, 5, 6), 0, b""),
    )
    yield "TRAJ", "Plan", _list(Trajectories, *plan)


def _poses() -> Iterator[Said]:
    yield "TRANSFORM", "MarkerToCamera", Transform((*QUARTER, 100.0, -200.0, 300.5))
    yield "TRANSFORM", "NoParent", Transform((*TILTED, 1.0, 2.0, 3.0))
    yield "TRANSFORM", "NoParent", Transform((2.0, 0.0, 0.0, 0.5, 1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0))
    yield "TRANSFORM", "NoParent", Transform((-1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0))
    yield "POSITION", "Pointer", Position((1.0, 2.0, 3.0), TURNED)
    yield "POSITION", "Pointer", Position((4.0, 5.0, 6.0), TURNED, "quaternion3")
    yield "POSITION", "Pointer", Position((7.0, 8.0, 9.0), form="position_only")
    yield "QTRANS", "Pointer", Position((-1.0, -2.0, -3.0), (0.6, 0.0, 0.0, -0.8))
    tools = (
        (b"Tracker", TRACKER, 0, (*QUARTER, 0, 0, 0)),
        (b"Probe", TOOL_6D, 0, (*TILTED, 100, 200, 300)),
        ("Nädel".encode(), TOOL_5D, 0, (*QUARTER, -1.5, 2.5, -3.5)),
    )
    yield "TDATA", "Tracking", _list(TrackingData, *tools)
    quaternions = ((b"Stylus", TOOL_3D, 0, (10, 20, 30), (0, 0, 0, 1)), (b"Drill", TOOL_6D, 0, (1, 2, 3), TURNED))
    yield "QTDATA", "Tracking", _list(QuaternionTrackingData, *quaternions)


def _texts() -> Iterator[Said]:
    yield "STRING", "Greeting", String.of("hello from OpenIGTLink")
    yield "STRING", "Greeting", String.of("Grüße, 你好")
    yield "STRING", "Greeting", String("Grüße".encode("latin-1"), 4)
    yield "STRING", "Greeting", String("Grüße".encode("utf-16-be"), 1013)
    yield "STRING", "Greeting", String(b"ends\x00here")
    yield "CLIENTINFO", "Greeting", ClientInfo.of("<ClientInfo/>")
    yield "STATUS", "Device", Status(1, 0, "", "ready")
    yield "STATUS", "Device", Status(13, -7, "NOT_HOMED", "move to the home position first")
    yield "STATUS", "Device", Status(2, 0, "", "without a NUL", nul_terminated=False)
    yield "CAPABILITY", "Peer", Capability(("TRANSFORM", "IMAGE", "GET_CAPABIL"))
    yield "CAPABIL", "Peer", Capability(("STATUS",))


def _numbers() -> Iterator[Said]:
    yield "SENSOR", "Force", Sensor(np.array([0.5, -1.25, 9.75]), parse_unit("N"))
    yield "SENSOR", "Force", Sensor(np.array([1e-3]), parse_unit("mm/s^2"), 1)
    yield "SENSOR", "Force", Sensor(np.empty(0))
    for scalar, code in NDARRAY_SCALARS.items():
        values = np.arange(6).astype(code)
        yield "NDARRAY", "Array", NdArray(scalar, (2, 3), values.tobytes())
    ramp = np.arange(256)
    yield "COLORT", "Colors", ColorTable(3, MAP_U8, ramp[::-1].astype("u1").tobytes())
    yield "COLORT", "Colors", ColorTable(3, MAP_U16, (ramp * 257).astype(">u2").tobytes())
    yield "COLORTABLE", "Colors", ColorTable(3, MAP_RGB, np.repeat(ramp, 3).astype("u1").tobytes())


def robot_messages() -> Iterator[tuple[str, str, Body]]:
    """Type, kind of the message in ROS, and content of what an arm with CRTK devices sends and receives."""
    joints = np.array([[1, 1], [0.25, 0.125], [0, 0], [0, 0], [1, 1], [0.5, 1]], ">f8")
    yield "TRANSFORM", "pose", Transform((*TILTED, 10.0, 20.0, 30.0))
    yield "NDARRAY", "joint_state", NdArray(11, (6, 2), joints.tobytes())
    yield "SENSOR", "joint_command", Sensor(np.array([0.25, 0.125]))
    yield "SENSOR", "twist", Sensor(np.array([0.125, 0.25, 0.5, 1.0, 2.0, 4.0]))
    yield "SENSOR", "wrench", Sensor(np.array([1.0, 2.0, 3.0, 0.125, 0.25, 0.5]))
    yield "SENSOR", "buttons", Sensor(np.array([1.0]))
    yield "STRING", "operating_state", String.of("ENABLED homed")
    yield "STRING", "string_stamped", String.of("home")
    yield "STRING", "empty", String.of("")


def _lists() -> Iterator[Said]:
    scanned = ns_to_ticks(1_700_000_000 * NS_PER_S + 500 * NS_PER_MS)
    head = (b"Head", b"MR_1", b"MR", b"Phantom^One", b"P-1", scanned, (256, 256, 60), 5, 0)
    yield "IMGMETA", "Images", _list(ImageMetaList, head, (b"Blank", b"", b"", b"", b"", 0, (0, 0, 0), 3, 0))
    liver = (b"Liver", b"Labels_1", 7, 0, (160, 80, 40, 255), (256, 256, 60), b"MR_1")
    yield "LBMETA", "Labels", _list(LabelMetaList, liver)
    scope = (b"Scope", b"Endoscope", b"Phantom^One", b"P-1", -2, 35.5, (1920, 1080, 1), (*TILTED, 1, 2, 3), 3, 0)
    yield "VIDEOMETA", "Videos", _list(VideoMetaList, scope)
    yield "VIDEO", "Camera", Video("H264", (32, 32, 1), H264_KEY)
    yield "VIDEO", "Camera", Video("H264", (32, 32, 1), H264_NEXT, 3)
    grey = Video("I420", (4, 2, 1), bytes(12), 0x0100, BIG_ENDIAN, LPS, (*QUARTER, 4.0, 5.0, 6.0), (1, 0, 0), (2, 2, 1))
    yield "VIDEO", "Camera", grey


def _binds() -> Iterator[Said]:
    def child(igtl_type: str, name: str, content: Body) -> BindChild:
        return BindChild(igtl_type, name, b"".join(bytes(part) for part in content.pack()))

    inner = Bind((child("STRING", "Inner", String.of("deep")),))
    yield (
        "BIND",
        "Bundle",
        Bind(
            (
                child("TRANSFORM", "BoundTool", Transform((*QUARTER, 1.0, 2.0, 3.0))),
                child("STRING", "BoundText", String.of("odd")),
                child("BIND", "Nested", inner),
                BindChild("MYTYPE", "BoundRaw", b"\x01\x02\x03"),
                BindChild("SENSOR", "Broken", b"\x05"),
            )
        ),
    )
    yield "BIND", "Bundle", Bind(())


def contents() -> Iterator[Said]:
    """Every type that has content, and an unknown type."""
    yield from _poses()
    yield from _texts()
    yield from _images()
    yield from _geometry()
    yield from _numbers()
    yield from _lists()
    yield from _binds()
    yield "MYTYPE", "Custom", Raw(b"what no gateway knows")
    yield "IMAGE", "NoImage", Raw(b"")


def query(name: str) -> Body:
    """The content of a query, with a value in every field that it has."""
    kind = QUERIES[name]
    made: dict[type[Body], Body] = {
        QueryReply: QueryReply(0),
        GetBind: GetBind((("TRANSFORM", "Tool"), ("SENSOR", "Force"))),
        StartBind: StartBind(50 * NS_PER_MS, (("TRANSFORM", "Tool"),)),
        StartTracking: StartTracking(50, "Base"),
        StartVideo: StartVideo("H264", 40),
        StartPolyData: StartPolyData(50 * NS_PER_MS),
    }
    return made.get(kind) or kind.unpack(memoryview(b""))


#: Metadata of a user, with what the gateway itself understands and what marks a node of 3D Slicer.
METADATA = (
    Item.of("DeviceName", "A probe with a name of more than twenty bytes"),
    Item.of("operator", "A. B."),
    Item.of("ros.child_frame_id", "probe"),
    Item.of("ros.frame_id", "tracker"),
    Item.of("ros.stamp", "1767225599123456789"),
    Item("site", "Zürich".encode("latin-1"), 4),
)


def command_content(command_id: int, name: str) -> Command:
    return Command.of(command_id, name, f'<Command Name="{name}" Größe="3"/>')
