"""Every row of the conversion table live: a typed rclpy node on one side, OpenIGTLink sockets on the other.

One bridge and one node for all.  What peers send is packed by hand, byte by byte; what the node must have received
is written out beside it.  What peers receive is decoded by the C++ library where it has the type, and by us.
Queries, streams, commands, frames and peer profiles follow, where a message is more than its content.
"""

from __future__ import annotations

import struct
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pytest
from fastcrc import crc64

from igtl_gateway.convert.table import TO_IGTL, TO_ROS, Role, row_to_igtl
from igtl_gateway.wire import decode
from igtl_gateway.wire.registry import describe_content
from tests.integration.bridge import Bridge, Event, RawPeer, RosClient, Wire, extended, free_port, header, unextended
from tests.peers import only, reference
from tests.peers.reference import ReferencePeer
from tests.tables import table

pytestmark = pytest.mark.ros

Json = dict[str, Any]

#: A stamp that is exact in both clocks: 2⁻⁹ s are 2²³ ticks and 1,953,125 ns.
SEC, NINTHS = 1_700_000_000, 77
TICKS, NANOSEC = SEC << 32 | NINTHS << 23, NINTHS * 1_953_125
STAMP = {"sec": SEC, "nanosec": NANOSEC}
IN, OUT = "/igtl/in/", "/igtl/out/"
SERVICE = "/igtl_gateway/send_command"


def packed(type_name: str, device: str, content: bytes, metadata: dict[str, str] | None = None) -> bytes:
    """A whole message; of header version 2 with metadata."""
    version = 1 if metadata is None else 2
    body = content if metadata is None else extended(content, metadata)
    crc = crc64.ecma_182(body)
    return header(type_name, len(body), crc, device=device, version=version, ticks=TICKS) + body


def head(frame_id: str = "igtl") -> Json:
    return {"stamp": STAMP, "frame_id": frame_id}


def xyz(*values: float) -> dict[str, float]:
    return dict(zip("xyz", values, strict=True))


def quaternion(*values: float) -> dict[str, float]:
    return dict(zip("xyzw", values, strict=True))


def f32(number: float) -> float:
    """The nearest float32."""
    return float(np.float32(number))


def hexed(data: bytes) -> Json:
    return {"hex": data.hex()}


def item(key: str, value: str) -> Json:
    return {"key": key, "encoding": 3, "value": value}


# ── OpenIGTLink → ROS ──────────────────────────────────────────────────────────────────────────────────────────────


@dataclass(frozen=True)
class Case:
    """A message of a peer, and what the node receives, by kind: type and value of each message."""

    type: str
    device: str
    content: bytes
    heard: dict[str, tuple[str, Json]]
    metadata: dict[str, str] | None = field(default=None, kw_only=True)

    def __str__(self) -> str:
        return f"{self.type}-{self.device}"

    def topic(self, kind: str) -> str:
        return "/tf" if kind == "tf" else f"{IN}{self.device}/{kind}"


TRANSFORM, TF = "geometry_msgs/msg/TransformStamped", "tf2_msgs/msg/TFMessage"
IMAGE, CLOUD, MARKER = "sensor_msgs/msg/Image", "sensor_msgs/msg/PointCloud2", "visualization_msgs/msg/Marker"
GREY = dict(zip("rgba", (f32(0.8), f32(0.8), f32(0.8), 1.0), strict=True))
NO_PLACE = {"position": xyz(0, 0, 0), "orientation": quaternion(0, 0, 0, 1)}

#: A third of a turn about (1, 1, 1), and the same as columns on the wire.
TURN = quaternion(0.5, 0.5, 0.5, 0.5)
TURNED = (0, 1, 0, 0, 0, 1, 1, 0, 0)


def frame(parent: str, child: str, translation: dict[str, float], rotation: dict[str, float]) -> Json:
    transform = {"translation": translation, "rotation": rotation}
    return {"header": head(parent), "child_frame_id": child, "transform": transform}


def cloud(names: dict[str, int], layout: str, *points: tuple[float, ...]) -> Json:
    """A PointCloud2 of fields of 4 bytes (7: float32, 6: uint32)."""
    fields = [
        {"name": name, "offset": 4 * index, "datatype": kind, "count": 1}
        for index, (name, kind) in enumerate(names.items())
    ]
    step = 4 * len(names)
    return {
        "header": head(),
        "height": 1,
        "width": len(points),
        "fields": fields,
        "is_bigendian": False,
        "point_step": step,
        "row_step": step * len(points),
        "data": hexed(b"".join(struct.pack(f"<{layout}", *point) for point in points)),
        "is_dense": True,
    }


def marker(device: str, kind: int, width: float, points: list[Json], colors: list[Json]) -> Json:
    return {
        "header": head(),
        "ns": device,
        "id": 0,
        "type": kind,
        "action": 0,
        "pose": NO_PLACE,
        "scale": xyz(width, width, width),
        "color": GREY,
        "lifetime": {"sec": 0, "nanosec": 0},
        "frame_locked": False,
        "points": points,
        "colors": colors,
        "texture_resource": "",
        "texture": {
            "header": {"stamp": {"sec": 0, "nanosec": 0}, "frame_id": ""},
            "format": "",
            "data": hexed(b""),
        },
        "uv_coordinates": [],
        "text": "",
        "mesh_resource": "",
        "mesh_file": {"filename": "", "data": hexed(b"")},
        "mesh_use_embedded_materials": False,
    }


def poses(*frames: Json) -> list[Json]:
    """Frames as poses."""
    return [
        {"position": one["transform"]["translation"], "orientation": one["transform"]["rotation"]} for one in frames
    ]


PROBE = frame("Tracker", "Probe", xyz(0.1, -0.2, 0.3005), TURN)


def needle(name: str) -> Json:
    return frame("igtl", name, xyz(0.0015, 0.0025, -0.0035), quaternion(0.5, -0.5, 0.5, 0.5))


def position(type_name: str, device: str) -> Case:
    content = struct.pack(">7f", 1.5, 2.5, -3.5, 0.5, -0.5, 0.5, 0.5)
    heard = {"transform": (TRANSFORM, needle(device)), "tf": (TF, {"transforms": [needle(device)]})}
    return Case(type_name, device, content, heard)


TEXT = "Größe 5 µm, 手術"
STATUS_MESSAGE = {
    "level": hexed(b"\1"),
    "name": "Machine",
    "message": "not ready yet",
    "hardware_id": "",
    "values": [
        {"key": "code", "value": "13"},
        {"key": "subcode", "value": "-42"},
        {"key": "error_name", "value": "Warming"},
    ],
}
POSES = [
    position("POSITION", "Needle"),
    position("QTRANS", "Catheter"),
    Case(
        "TRANSFORM",
        "ProbeToTracker",
        struct.pack(">12f", *TURNED, 100, -200, 300.5),
        {"transform": (TRANSFORM, PROBE), "tf": (TF, {"transforms": [PROBE]})},
    ),
]
TEXTS = [
    Case(
        "STRING",
        "Text",
        struct.pack(">HH", 106, len(TEXT.encode())) + TEXT.encode(),
        {"string": ("std_msgs/msg/String", {"data": TEXT})},
    ),
    Case(
        "CLIENTINFO",
        "Client",
        struct.pack(">HH", 3, 13) + b"<ClientInfo/>",
        {"client_info": ("std_msgs/msg/String", {"data": "<ClientInfo/>"})},
    ),
    Case(
        "STATUS",
        "Machine",
        struct.pack(">Hq20s", 13, -42, b"Warming") + b"not ready yet\0",
        {"status": ("diagnostic_msgs/msg/DiagnosticStatus", STATUS_MESSAGE)},
    ),
]

#: Columns (0, 2, 0), (−3, 0, 0), (0, 0, 4) and the centre.
PLACE = (0, 2, 0, -3, 0, 0, 0, 0, 4, 100, -200, 300)
#: The same in ROS.
DIRECTION, SPACING, CENTER = [0, 1, 0, -1, 0, 0, 0, 0, 1], [0.002, 0.003, 0.004], xyz(0.1, -0.2, 0.3)
VOLUME = "igtl_msgs/msg/Volume"


def image(size: tuple[int, int, int], scalar: int, components: int, pixels: bytes, place: tuple[float, ...]) -> bytes:
    layout = struct.pack(">HBBBB3H12f3H3H", 1, components, scalar, 2, 1, *size, *place, 0, 0, 0, *size)
    return layout + pixels


def volume(size: list[int], origin: tuple[float, float, float], pixels: bytes) -> Json:
    return {
        "header": head(),
        "size": size,
        "scalar_type": 3,
        "components": 1,
        "is_bigendian": False,
        "coordinate_system": 1,
        "direction": DIRECTION,
        "spacing": pytest.approx(SPACING),
        "origin": pytest.approx(xyz(*origin)),
        "data": hexed(pixels),
        "metadata": [],
    }


def picture(width: int, height: int, encoding: str, data: bytes) -> Json:
    return {
        "header": head(),
        "height": height,
        "width": width,
        "encoding": encoding,
        "is_bigendian": 0,
        "step": len(data) // height,
        "data": hexed(data),
    }


IMAGES = [
    Case(
        "IMAGE",
        "Picture",
        image((3, 2, 1), 3, 3, bytes(range(18)), (1, 0, 0, 0, 1, 0, 0, 0, 1, 0, 0, 0)),
        {"image": (IMAGE, picture(3, 2, "rgb8", bytes(range(18))))},
    ),
    Case(
        "IMAGE",
        "Slice",
        image((2, 3, 1), 3, 1, b"slice!", PLACE),
        # half of one step along (0, 1, 0), one along (-1, 0, 0)
        {
            "image": (IMAGE, picture(2, 3, "mono8", b"slice!")),
            "volume": (VOLUME, volume([2, 3, 1], (0.103, -0.201, 0.3), b"slice!")),
        },
    ),
    Case(
        "IMAGE",
        "CT",
        image((2, 1, 2), 3, 1, b"abcd", PLACE),
        {
            "slices": (IMAGE, picture(2, 1, "mono8", b"ab")),  # the first of two
            "volume": (VOLUME, volume([2, 1, 2], (0.1, -0.201, 0.298), b"abcd")),
        },
    ),
]

POINTS = (
    struct.pack(">64s32s4B3ff20s", b"Entry", b"Plan", 255, 128, 1, 200, 10, 20, 30, 2.5, b"CT"),
    struct.pack(">64s32s4B3ff20s", b"", b"", 0, 1, 2, 255, -1.5, 0, 4096.25, 0, b""),
)
POINT_FIELDS = {"x": 7, "y": 7, "z": 7, "rgba": 6, "diameter": 7}
FIRST, SECOND = (0.01, 0.02, 0.03, 0xC8FF8001, 0.0025), (-0.0015, 0, 4.09625, 0xFF000102, 0)


def labeled(name: str, group: str, rgba: list[int], place: Json, diameter: float, owner: str) -> Json:
    return {"name": name, "group": group, "rgba": rgba, "position": place, "diameter": diameter, "owner": owner}


LANDMARKS = [
    labeled("Entry", "Plan", [255, 128, 1, 200], xyz(0.01, 0.02, 0.03), 0.0025, "CT"),
    labeled("", "", [0, 1, 2, 255], xyz(-0.0015, 0, 4.09625), 0, ""),
]
CORNERS: list[list[float]] = [[0, 0, 0], [10, 0, 0], [10, 10, 0], [0, 10, 8.5]]
VERTICES: list[Json] = [xyz(*(value / 1000 for value in corner)) for corner in CORNERS]
LOADS = (0.5, 1, 1.5, 2)


def polydata(
    vertices: list[list[int]], lines: list[list[int]], polygons: list[list[int]], strips: list[list[int]], *, name: str
) -> bytes:
    """With a scalar for each of the four corners."""
    sections = [
        b"".join(struct.pack(f">{1 + len(cell)}I", len(cell), *cell) for cell in cells)
        for cells in (vertices, lines, polygons, strips)
    ]
    counts = [
        number
        for cells, data in zip((vertices, lines, polygons, strips), sections, strict=True)
        for number in (len(cells), len(data))
    ]
    names = name.encode() + (b"\0" if len(name) % 2 else b"\0\0")
    return (
        struct.pack(">10I", len(CORNERS), *counts, 1)
        + np.array(CORNERS, ">f4").tobytes()
        + b"".join(sections)
        + struct.pack(">BBI", 0, 1, 4)
        + names
        + struct.pack(">4f", *LOADS)
    )


def poly_message(**cells: list[int]) -> Json:
    sections: Json = {"vertices": [], "lines": [], "polygons": [], "triangle_strips": []}
    attribute = {"name": "load", "type": 0, "components": 1, "values": list(LOADS)}
    return {"header": head(), "points": VERTICES} | sections | cells | {"attributes": [attribute], "metadata": []}


#: The quad as a fan, the strip with alternating winding.
TRIANGLES = [[0, 1, 2], [0, 2, 3], [1, 2, 0], [0, 2, 3]]
POLYDATA, MESH = "igtl_msgs/msg/PolyData", "shape_msgs/msg/Mesh"
SHAPES = [
    Case(
        "POINT",
        "Entry",
        POINTS[0],
        {
            "point": ("geometry_msgs/msg/PointStamped", {"header": head(), "point": xyz(0.01, 0.02, 0.03)}),
            "points": (CLOUD, cloud(POINT_FIELDS, "3fIf", FIRST)),
            "landmarks": (
                "igtl_msgs/msg/PointList",
                {"header": head(), "points": LANDMARKS[:1], "metadata": []},
            ),
        },
    ),
    Case(
        "POINT",
        "Marks",
        POINTS[0] + POINTS[1],
        {
            "points": (CLOUD, cloud(POINT_FIELDS, "3fIf", FIRST, SECOND)),
            "landmarks": ("igtl_msgs/msg/PointList", {"header": head(), "points": LANDMARKS, "metadata": []}),
        },
    ),
    Case(
        "POLYDATA",
        "Scan",
        polydata([[0, 1, 2, 3]], [], [], [], name="load"),
        {
            "points": (
                CLOUD,
                cloud(
                    {"x": 7, "y": 7, "z": 7, "load": 7},
                    "4f",
                    *((*map(vertex.__getitem__, "xyz"), load) for vertex, load in zip(VERTICES, LOADS, strict=True)),
                ),
            )
        },
    ),
    Case(
        "POLYDATA",
        "Organ",
        polydata([], [], [[0, 1, 2, 3]], [[1, 2, 0, 3]], name="load"),
        {
            "mesh": (
                MESH,
                {"triangles": [{"vertex_indices": three} for three in TRIANGLES], "vertices": VERTICES},
            ),
            "marker": (MARKER, marker("Organ", 11, 1.0, [VERTICES[i] for three in TRIANGLES for i in three], [])),
            "polydata": (
                POLYDATA,
                poly_message(polygons=[4, 0, 1, 2, 3], triangle_strips=[4, 1, 2, 0, 3]),
            ),
        },
    ),
    Case(
        "POLYDATA",
        "Path",
        polydata([], [[0, 1, 2], [3, 0]], [], [], name="load"),
        {
            "lines": (MARKER, marker("Path", 5, 0.001, [VERTICES[i] for i in (0, 1, 1, 2, 3, 0)], [])),
            "polydata": (POLYDATA, poly_message(lines=[3, 0, 1, 2, 2, 3, 0])),
        },
    ),
]


def tools(type_name: str, device: str, tip: str, wand: str, content: bytes) -> Case:
    """Two tools: one in the stream's frame, one that names its own."""
    named = (frame("igtl", tip, xyz(0.1, -0.2, 0.3005), TURN), frame("Table", wand, xyz(0, 0, 0.5), quaternion(*ONE)))
    kinds = zip((f"{tip}", f"{wand}ToTable"), (2, 3), poses(*named), strict=True)
    listed = [{"name": name, "type": kind, "pose": pose} for name, kind, pose in kinds]
    return Case(
        type_name,
        device,
        content,
        {
            "tracking": ("igtl_msgs/msg/TrackingData", {"header": head(), "tools": listed, "metadata": []}),
            "poses": ("geometry_msgs/msg/PoseArray", {"header": head(), "poses": poses(*named)}),
            "tf": (TF, {"transforms": list(named)}),
        },
    )


ONE = (0, 0, 0, 1)
TRACKING = [
    tools(
        "TDATA",
        "Tracker",
        "Tip",
        "Wand",
        struct.pack(">20sBx12f", b"Tip", 2, *TURNED, 100, -200, 300.5)
        + struct.pack(">20sBx12f", b"WandToTable", 3, 1, 0, 0, 0, 1, 0, 0, 0, 1, 0, 0, 500),
    ),
    tools(
        "QTDATA",
        "Optical",
        "Tip2",
        "Wand2",
        struct.pack(">20sBx7f", b"Tip2", 2, 100, -200, 300.5, 0.5, 0.5, 0.5, 0.5)
        + struct.pack(">20sBx7f", b"Wand2ToTable", 3, 0, 0, 500, *ONE),
    ),
]

#: mm/s²: prefix milli, m to the 1, s to the −2.
MM_S2 = 0xB0443E0000000000
READINGS = [1.5, -5e-324, 1.7976931348623157e308]
#: Scalar type → its letter in struct, name in ROS, two numbers at the ends of its range.
NUMBERS: dict[int, tuple[str, str, list[float]]] = {
    2: ("b", "Int8", [-128, 127]),
    3: ("B", "UInt8", [0, 255]),
    4: ("h", "Int16", [-32768, 32767]),
    5: ("H", "UInt16", [1, 65535]),
    6: ("i", "Int32", [-(2**31), 2**31 - 1]),
    7: ("I", "UInt32", [1, 2**32 - 1]),
    10: ("f", "Float32", [2.0**-149, -1.5]),
    11: ("d", "Float64", [5e-324, 1.7976931348623157e308]),
}
KIND_OF = {name: f"{name.lower()}_array" for _, name, _ in NUMBERS.values()}


def multi_array(name: str, numbers: list[float]) -> Json:
    """As std_msgs has it: bytes are no list for JSON."""
    dimensions = [{"label": "", "size": 1, "stride": 2}, {"label": "", "size": 2, "stride": 2}]
    data = hexed(bytes(map(int, numbers))) if name == "UInt8" else numbers
    return {"layout": {"dim": dimensions, "data_offset": 0}, "data": data}


def array_message(scalar: int, size: list[int], data: bytes) -> Json:
    return {
        "header": head(),
        "scalar_type": scalar,
        "size": size,
        "is_bigendian": True,
        "data": hexed(data),
        "metadata": [],
    }


ND_ARRAY = "igtl_msgs/msg/NdArray"
ARRAYS = [
    Case(
        "SENSOR",
        "Force",
        struct.pack(">BBQ3d", 3, 0, MM_S2, *READINGS),
        {
            "sensor": (
                "igtl_msgs/msg/Sensor",
                {
                    "header": head("flange"),
                    "status": 0,
                    "unit": MM_S2,
                    "unit_text": "mm/s^2",
                    "values": READINGS,
                    "metadata": [item("operator", "A. B.")],
                },
            ),
            "values": (
                "std_msgs/msg/Float64MultiArray",
                {
                    "layout": {"dim": [{"label": "", "size": 3, "stride": 3}], "data_offset": 0},
                    "data": READINGS,
                },
            ),
        },
        metadata={"operator": "A. B.", "ros.frame_id": "flange"},
    ),
    *(
        Case(
            "NDARRAY",
            name,
            struct.pack(f">BB2H2{code}", scalar, 2, 1, 2, *numbers),
            {
                "array": (ND_ARRAY, array_message(scalar, [1, 2], struct.pack(f">2{code}", *numbers))),
                KIND_OF[name]: (f"std_msgs/msg/{name}MultiArray", multi_array(name, numbers)),
            },
        )
        for scalar, (code, name, numbers) in NUMBERS.items()
    ),
    Case(
        "NDARRAY",
        "Complex",
        struct.pack(">BBH2d", 13, 1, 1, 1.5, -2.5),
        {"array": (ND_ARRAY, array_message(13, [1], struct.pack(">2d", 1.5, -2.5)))},
    ),
]

#: Trajectories: one from entry to target, one of a target only, which no line shows.
TRAJECTORY = ">64s32sBx4B3f3ff20s"
TRAJECTORIES = struct.pack(
    TRAJECTORY, b"Left", b"Plan", 3, 255, 0, 51, 255, 10, 20, 30, -10, 0, 2.5, 1.5, b"CT"
) + struct.pack(TRAJECTORY, b"Right", b"", 2, 0, 0, 0, 0, 0, 0, 0, 1, 2, 3, 0, b"")
LEFT: Json = {
    "name": "Left",
    "group": "Plan",
    "type": 3,
    "rgba": [255, 0, 51, 255],
    "entry": xyz(0.01, 0.02, 0.03),
    "target": xyz(-0.01, 0, 0.0025),
    "diameter": 0.0015,
    "owner": "CT",
}
RIGHT = {
    "name": "Right",
    "group": "",
    "type": 2,
    "rgba": [0, 0, 0, 0],
    "entry": xyz(0, 0, 0),
    "target": xyz(0.001, 0.002, 0.003),
    "diameter": 0,
    "owner": "",
}
MAGENTA = dict(zip("rgba", (1, 0, f32(0.2), 1), strict=True))
CT_IMAGE = {
    "name": "Head",
    "device_name": "CT1",
    "modality": "CT",
    "patient_name": "Müller",
    "patient_id": "P-1",
    "scan_time": STAMP,
    "size": [512, 256, 65535],
    "scalar_type": 4,
}
LABEL = {
    "name": "Liver",
    "device_name": "Labels",
    "label": 7,
    "rgba": [255, 128, 1, 0],
    "size": [1, 2, 3],
    "owner": "CT1",
}
VIDEO_META = {
    "name": "Endoscope",
    "device_name": "Scope",
    "patient_name": "Müller",
    "patient_id": "P-1",
    "zoom_level": -2,
    "focal_length": 0.0355,
    "size": [640, 480, 1],
    "direction": DIRECTION,
    "spacing": SPACING,
    "center": CENTER,
    "scalar_type": 3,
}
GREYS = bytes(range(255, -1, -1))
SHIFT = struct.pack(">12f", *TURNED, 100, -200, 300.5)
BOUND = (
    struct.pack(">H12sQ12sQ", 2, b"STRING", 9, b"TRANSFORM", 48)
    + struct.pack(">H22s", 22, b"BoundText\0BoundToBase\0")
    + struct.pack(">HH5sx", 3, 5, b"child")
    + SHIFT
)


def one_of(name: str, kind: str, element: Json) -> tuple[str, Json]:
    return f"igtl_msgs/msg/{name}", {"header": head(), kind: [element], "metadata": []}


def capability(type_name: str, device: str) -> Case:
    message = {"header": head(), "types": ["TRANSFORM", "GET_CAPABIL"], "metadata": []}
    content = struct.pack(">12s12s", b"TRANSFORM", b"GET_CAPABIL")
    return Case(type_name, device, content, {"capability": ("igtl_msgs/msg/Capability", message)})


def colors(type_name: str, device: str) -> Case:
    message = {
        "header": head(),
        "index_type": 3,
        "map_type": 3,
        "is_bigendian": True,
        "table": hexed(GREYS),
        "metadata": [],
    }
    return Case(type_name, device, b"\3\3" + GREYS, {"color_table": ("igtl_msgs/msg/ColorTable", message)})


LISTS = [
    Case(
        "TRAJ",
        "Plan",
        TRAJECTORIES,
        {
            "trajectories": (
                "igtl_msgs/msg/TrajectoryList",
                {"header": head(), "trajectories": [LEFT, RIGHT], "metadata": []},
            ),
            "lines": (MARKER, marker("Plan", 5, 0.001, [LEFT["entry"], LEFT["target"]], [MAGENTA, MAGENTA])),
        },
    ),
    Case(
        "IMGMETA",
        "Archive",
        struct.pack(
            ">64s20s32s64s64sQ3HBx",
            *(text.encode() for text in ("Head", "CT1", "CT", "Müller", "P-1")),
            *(TICKS, 512, 256, 65535, 4),
        ),
        {"images": one_of("ImageMetaList", "images", CT_IMAGE)},
    ),
    Case(
        "LBMETA",
        "Atlas",
        struct.pack(">64s20sBx4B3H20s", b"Liver", b"Labels", 7, 255, 128, 1, 0, 1, 2, 3, b"CT1"),
        {"labels": one_of("LabelMetaList", "labels", LABEL)},
    ),
    Case(
        "VIDEOMETA",
        "Tower",
        struct.pack(
            ">64s64s64s64shd3H12fBx",
            *(text.encode() for text in ("Endoscope", "Scope", "Müller", "P-1")),
            *(-2, 35.5, 640, 480, 1, *PLACE, 3),
        ),
        {"videos": one_of("VideoMetaList", "videos", VIDEO_META)},
    ),
    colors("COLORT", "Greys"),
    colors("COLORTABLE", "OldGreys"),
    capability("CAPABILITY", "Skills"),
    capability("CAPABIL", "ShortSkills"),
    Case(
        "BIND",
        "Both",
        BOUND,
        {
            "bind": (
                "igtl_msgs/msg/Bind",
                {
                    "header": head(),
                    "children": [
                        {"type": "STRING", "name": "BoundText", "content": hexed(struct.pack(">HH5s", 3, 5, b"child"))},
                        {"type": "TRANSFORM", "name": "BoundToBase", "content": hexed(SHIFT)},
                    ],
                    "metadata": [],
                },
            )
        },
    ),
]

#: A grey key frame of 64 × 48 in H.264, as x264 made it, and the start of one that needs it.
KEY_FRAME = bytes.fromhex(
    "000000016742c00adc47a10000030001000003003c8f1227800000000168ce0fc8000000016588843a272727275d75d75d75d780"
)
DELTA_FRAME = bytes.fromhex("00000001419a") + b"delta"
VIDEO = struct.pack(">HB4sHB3H12f3H3H", 1, 2, b"H264", 1, 1, 64, 48, 1, *PLACE, 0, 0, 0, 64, 48, 1) + KEY_FRAME
VIDEO_FRAME = {
    "header": head(),
    "codec": "H264",
    "frame_type": 1,
    "is_bigendian": False,
    "size": [64, 48, 1],
    "offset": [0, 0, 0],
    "part_size": [64, 48, 1],
    "coordinate_system": 1,
    "direction": DIRECTION,
    "spacing": SPACING,
    "center": CENTER,
    "data": hexed(KEY_FRAME),
    "metadata": [],
}
VIDEOS = [
    Case(
        "VIDEO",
        "Scope",
        VIDEO,
        {
            "video_frame": ("igtl_msgs/msg/VideoFrame", VIDEO_FRAME),
            "compressed_image": (
                "sensor_msgs/msg/CompressedImage",
                {"header": head(), "format": "h264", "data": hexed(KEY_FRAME)},
            ),
            "compressed_video": (
                "foxglove_msgs/msg/CompressedVideo",
                {"timestamp": STAMP, "frame_id": "igtl", "format": "h264", "data": hexed(KEY_FRAME)},
            ),
        },
    )
]


def command(number: int, name: str, text: str) -> bytes:
    return struct.pack(">I128sHI", number, name.encode(), 3, len(text)) + text.encode()


SIX = [0.125, 0.25, 0.5, 1.0, 2.0, 4.0]
SIX_BY_NAME = xyz(*SIX[:3]), xyz(*SIX[3:])


def string(text: str) -> bytes:
    return struct.pack(">HH", 3, len(text)) + text.encode()


ROBOTS = [
    Case(
        "TRANSFORM",
        "Wrist",
        struct.pack(">12f", *TURNED, 400, -250, 1125),
        {
            "pose": (
                "geometry_msgs/msg/PoseStamped",
                {"header": head(), "pose": {"position": xyz(0.4, -0.25, 1.125), "orientation": TURN}},
            )
        },
    ),
    Case(
        "NDARRAY",
        "ArmJoints",
        struct.pack(">BB2H12d", 11, 2, 6, 2, 1, 1, 0.5, -1.25, 0, 0, 9, 9, 1, 1, 2.0, 3.0),
        {
            "joint_state": (
                "sensor_msgs/msg/JointState",
                {"header": head(), "name": [], "position": [0.5, -1.25], "velocity": [], "effort": [2.0, 3.0]},
            )
        },
    ),
    *(
        Case("SENSOR", device, struct.pack(f">BBQ{len(values)}d", len(values), 0, 0, *values), {kind: (ros_type, told)})
        for device, kind, ros_type, values, told in (
            (
                *("Goal", "joint_command", "sensor_msgs/msg/JointState", READINGS),
                {"header": head(), "name": [], "position": READINGS, "velocity": [], "effort": []},
            ),
            (
                *("Speed", "twist", "geometry_msgs/msg/TwistStamped", SIX),
                {"header": head(), "twist": {"linear": SIX_BY_NAME[0], "angular": SIX_BY_NAME[1]}},
            ),
            (
                *("Load", "wrench", "geometry_msgs/msg/WrenchStamped", SIX),
                {"header": head(), "wrench": {"force": SIX_BY_NAME[0], "torque": SIX_BY_NAME[1]}},
            ),
            (*("Pedal", "buttons", "sensor_msgs/msg/Joy", [2.0]), {"header": head(), "axes": [], "buttons": [2]}),
        )
    ),
    *(
        Case("STRING", device, string(text), {kind: (ros_type, told)})
        for device, kind, ros_type, text, told in (
            (
                *("State", "operating_state", "crtk_msgs/msg/OperatingState", "ENABLED homed"),
                {"header": head(), "state": "ENABLED", "is_homed": True, "is_busy": False},
            ),
            (
                *("Word", "string_stamped", "crtk_msgs/msg/StringStamped", "home"),
                {"header": head(), "string": "home"},
            ),
            ("Stop", "empty", "std_msgs/msg/Empty", "now", {}),
        )
    ),
]

CASES = [*ROBOTS, *POSES, *TEXTS, *IMAGES, *SHAPES, *TRACKING, *ARRAYS, *LISTS, *VIDEOS]

#: Type of what is asked for → its names behind the prefix, where that is not itself.
SHORT_NAMES = {
    "TRANS": "TRANSFORM",
    "TRANSFOR": "TRANSFORM",
    "QTRANS": "POSITION",
    "CAPABIL": "CAPABILITY",
    "VMETA": "VIDEOMETA",
}
STREAMED = "TDATA QTDATA IMAGE TRANS TRANSFOR POSITION QTRANS SENSOR POLYDATA NDARRAY BIND VIDEO".split()
ASKED = [*STREAMED, *"STATUS CAPABIL STRING POINT TRAJ IMGMETA LBMETA COLORT VMETA".split()]
ACKNOWLEDGED = [*STREAMED, *"STATUS CAPABIL POINT TRAJ IMGMETA LBMETA".split()]
#: Prefix → its number in ROS, the names behind it.
QUERIES = {"GET": (1, ASKED), "STT": (2, STREAMED), "STP": (3, STREAMED), "RTS": (4, ACKNOWLEDGED)}
#: Queries with a content: bytes, and their meaning.
CONTENTS: dict[str, tuple[bytes, Json]] = {
    "STT_TDATA": (struct.pack(">i32s", 40, b"Tracker"), {"resolution": 40, "coordinate_name": "Tracker"}),
    "STT_QTDATA": (struct.pack(">i32s", 0, b""), {}),
    "STT_VIDEO": (struct.pack(">4sI", b"VP90", 33), {"codec": "VP90", "resolution": 33}),
    "STT_POLYDATA": (struct.pack(">Q", 250_000_001), {"resolution": 251}),
    **{f"RTS_{name}": (b"\1", {"status": 1}) for name in ACKNOWLEDGED},
}
COMMANDS = {("COMMAND", "command"), ("RTS_COMMAND", "command_reply")}

QUERY, QUERY_TOPIC, LINKS_TOPIC = "igtl_msgs/msg/Query", f"{IN}Asker/query", "/igtl/links"
COMMAND_TYPE, REPLY_TYPE = "igtl_msgs/msg/Command", "igtl_msgs/msg/CommandReply"
STRING_TYPE = "std_msgs/msg/String"
SUBSCRIBED = {case.topic(kind): heard[0] for case in CASES for kind, heard in case.heard.items()} | {
    QUERY_TOPIC: QUERY,
    f"{IN}Console/command": COMMAND_TYPE,
    f"{IN}Robot/command_reply": REPLY_TYPE,
    f"{IN}Note/metadata": "igtl_msgs/msg/Metadata",
    f"{IN}Odd/raw": "igtl_msgs/msg/RawMessage",
    f"{IN}BoundText/string": STRING_TYPE,
    f"{IN}BoundToBase/transform": TRANSFORM,
}


def test_every_row_of_the_table_to_ros_has_a_case() -> None:
    rows = {(name, row.kind): row.message.TYPE for row in TO_ROS for name in row.igtl_types}
    heard = {(case.type, kind): told[0] for case in CASES for kind, told in case.heard.items()}
    heard |= {(f"{prefix}_{name}", "query"): QUERY for prefix, (_, names) in QUERIES.items() for name in names}
    heard |= {pair: {"command": COMMAND_TYPE, "command_reply": REPLY_TYPE}[pair[1]] for pair in COMMANDS}
    assert heard == rows


# ── ROS → OpenIGTLink ──────────────────────────────────────────────────────────────────────────────────────────────


@dataclass(frozen=True)
class Sent:
    """A message of the node, and what a peer gets; the names of the contents are those of the corpus.

    Attributes:
        stamped: whether the message has a stamp that the peer gets.
    """

    ros_type: str
    type: str
    device: str
    fields: Json
    content: Json
    stamped: bool = True

    def __str__(self) -> str:
        return f"{self.ros_type.rpartition('/')[2]}-{self.type}"

    @property
    def topic(self) -> str:
        return OUT + self.device


POSE = {"position": xyz(0.4, -0.25, 1.125), "orientation": TURN}
MOVED = [[0, 0, 1, 400], [1, 0, 0, -250], [0, 1, 0, 1125], [0, 0, 0, 1]]
MOVED_BY = {"pack": "all", "position": [400, -250, 1125], "quaternion": [0.5, 0.5, 0.5, 0.5]}
TRANSFORMED = {"translation": POSE["position"], "rotation": TURN}
TOOL_FRAME = {"header": head("Base"), "child_frame_id": "Tool", "transform": TRANSFORMED}
TOOLS = {"header": head("Base"), "tools": [{"name": "Tip", "type": 3, "pose": POSE}]}
POINT_CLOUD = cloud({"x": 7, "y": 7, "z": 7, "rgba": 6}, "3fI", (0.125, 0.25, -0.5, 0xFF800000), (0, 0, 1, 0x00FF00FF))
SEEN = [[125, 250, -500], [0, 0, 1000]]
WHOLE = {"subvol_offset": [0, 0, 0], "subvol_size": [2, 1, 2]}
NO_CELLS: Json = {"vertices": [], "lines": [], "polygons": [], "triangle_strips": []}
COMPLETE = ["TRANSFORM", "GET_CAPABIL"]
LIGHT = {**GREY, "a": 0.5}


def unit(word: int) -> str:
    return f"{word:016x}"


def elements(*rows: Json) -> Json:
    return {"elements": list(rows)}


def ours(name: str, device: str, type_name: str, fields: Json, content: Json) -> Sent:
    """Of a message of igtl_msgs, all of which have a header."""
    return Sent(f"igtl_msgs/msg/{name}", type_name, device, {"header": head("Base"), **fields}, content)


OUTGOING = [
    Sent(TRANSFORM, "TRANSFORM", "ToolToBase", TOOL_FRAME, {"matrix": MOVED}),
    Sent(TRANSFORM, "POSITION", "ToolPosition", TOOL_FRAME, MOVED_BY),
    Sent(
        "geometry_msgs/msg/PoseStamped",
        "TRANSFORM",
        "Goal",
        {"header": head("Base"), "pose": POSE},
        {"matrix": MOVED},
    ),
    Sent("geometry_msgs/msg/PoseStamped", "POSITION", "GoalPosition", {"header": head("Base"), "pose": POSE}, MOVED_BY),
    Sent(
        "geometry_msgs/msg/PoseArray",
        "TDATA",
        "Grasps",
        {"header": head("Base"), "poses": [POSE, POSE]},
        elements(*({"name": name, "type": 2, "matrix": MOVED} for name in ("Tool1", "Tool2"))),
    ),
    Sent("igtl_msgs/msg/TrackingData", "TDATA", "Tools", TOOLS, elements({"name": "Tip", "type": 3, "matrix": MOVED})),
    Sent(
        "igtl_msgs/msg/TrackingData",
        "QTDATA",
        "QTools",
        TOOLS,
        elements({"name": "Tip", "type": 3, "position": [400, -250, 1125], "quaternion": [0.5, 0.5, 0.5, 0.5]}),
    ),
    Sent(STRING_TYPE, "CLIENTINFO", "Wish", {"data": "<x/>"}, {"string": "<x/>", "encoding": 3}, stamped=False),
    Sent(STRING_TYPE, "STRING", "Words", {"data": TEXT}, {"string": TEXT, "encoding": 106}, stamped=False),
    Sent(
        "diagnostic_msgs/msg/DiagnosticStatus",
        "STATUS",
        "Health",
        STATUS_MESSAGE,
        {"code": 13, "subcode": -42, "error_name": "Warming", "status_string": "not ready yet"},
        stamped=False,
    ),
    Sent(
        IMAGE,
        "IMAGE",
        "Camera",
        picture(3, 2, "rgb8", bytes(range(18))),
        {"dimensions": [3, 2, 1], "scalar_type": 3, "num_components": 3, "data": list(range(18))},
    ),
    ours(
        "Volume",
        "Scanner",
        "IMAGE",
        {
            "size": [2, 1, 2],
            "scalar_type": 3,
            "components": 1,
            "coordinate_system": 1,
            "direction": DIRECTION,
            "spacing": SPACING,
            "origin": xyz(0.1, -0.201, 0.298),
            "data": hexed(b"abcd"),
        },
        {"dimensions": [2, 1, 2], "scalar_type": 3, "wire_matrix": list(PLACE), "data": list(b"abcd"), **WHOLE},
    ),
    Sent(
        "geometry_msgs/msg/PointStamped",
        "POINT",
        "Target",
        {"header": head("Base"), "point": xyz(0.125, -0.02, 1.5)},
        elements({"name": "", "position": [125, -20, 1500], "diameter": 0}),
    ),
    Sent(
        CLOUD,
        "POLYDATA",
        "Cloud",
        POINT_CLOUD,
        {
            **NO_CELLS,
            "points": SEEN,
            "vertices": [[0, 1]],
            "attributes": [
                {"type": 0, "ncomponents": 4, "n": 2, "name": "RGBA", "data": [f32(128 / 255), 0, 0, 1, 1, 0, 1, 0]}
            ],
        },
    ),
    Sent(
        CLOUD,
        "POINT",
        "CloudPoints",
        POINT_CLOUD,
        elements(
            {"position": SEEN[0], "rgba": [128, 0, 0, 255]},
            {"position": SEEN[1], "rgba": [255, 0, 255, 0]},
        ),
    ),
    ours(
        "PointList",
        "Landmarks",
        "POINT",
        {"points": LANDMARKS},
        elements(
            {
                "name": "Entry",
                "group": "Plan",
                "rgba": [255, 128, 1, 200],
                "position": [10, 20, 30],
                "diameter": 2.5,
                "owner": "CT",
            },
            {"name": "", "group": "", "rgba": [0, 1, 2, 255], "position": [-1.5, 0, 4096.25], "diameter": 0},
        ),
    ),
    Sent(
        MESH,
        "POLYDATA",
        "Model",
        {"triangles": [{"vertex_indices": [0, 1, 2]}, {"vertex_indices": [0, 2, 3]}], "vertices": VERTICES},
        {**NO_CELLS, "points": CORNERS, "polygons": [[0, 1, 2], [0, 2, 3]], "attributes": []},
        stamped=False,
    ),
    Sent(
        MARKER,
        "POLYDATA",
        "Shape",
        {"header": head("Base"), "type": 4, "points": VERTICES, "colors": [LIGHT] * 4},
        {
            **NO_CELLS,
            "points": CORNERS,
            "lines": [[0, 1, 2, 3]],
            "attributes": [{"type": 0, "ncomponents": 4, "n": 4, "name": "RGBA", "data": [*([f32(0.8)] * 3), 0.5] * 4}],
        },
    ),
    ours(
        "PolyData",
        "Liver",
        "POLYDATA",
        {
            "points": VERTICES,
            "vertices": [1, 0],
            "lines": [2, 0, 1, 2, 1, 2],
            "polygons": [4, 0, 1, 2, 3],
            "triangle_strips": [3, 1, 2, 0],
            "attributes": [{"name": "load", "type": 0, "components": 1, "values": list(LOADS)}],
        },
        {
            "points": CORNERS,
            "vertices": [[0]],
            "lines": [[0, 1], [1, 2]],
            "polygons": [[0, 1, 2, 3]],
            "triangle_strips": [[1, 2, 0]],
            "attributes": [{"type": 0, "ncomponents": 1, "n": 4, "name": "load", "data": list(LOADS)}],
        },
    ),
    ours(
        "Sensor",
        "Gauge",
        "SENSOR",
        {"unit_text": "mm/s^2", "values": READINGS},
        {"unit": unit(MM_S2), "values": READINGS, "status": 0},
    ),
    Sent(
        "sensor_msgs/msg/JointState",
        "SENSOR",
        "Joints",
        {"header": head("Base"), "name": ["a", "b"], "position": [0.5, -1.25], "velocity": [0.0, 0.0]},
        {"unit": unit((0x08 << 4 | 1) << 50), "values": [0.5, -1.25]},  # rad,
    ),
    Sent(
        "std_msgs/msg/Float64MultiArray",
        "SENSOR",
        "Values",
        {"data": READINGS},
        {"unit": unit(0), "values": READINGS},
        stamped=False,
    ),
    ours(
        "NdArray",
        "Matrix",
        "NDARRAY",
        {"scalar_type": 4, "size": [2, 1], "data": hexed(struct.pack("<2h", -2, 3))},
        {"scalar_type": 4, "size": [2, 1], "data": [-2, 3]},
    ),
    *(
        Sent(
            f"std_msgs/msg/{name}MultiArray",
            "NDARRAY",
            f"Send{name}",
            multi_array(name, numbers),
            {"scalar_type": scalar, "size": [1, 2], "data": numbers},
            stamped=False,
        )
        for scalar, (_, name, numbers) in NUMBERS.items()
    ),
    ours(
        "TrajectoryList",
        "Routes",
        "TRAJ",
        {"trajectories": [LEFT]},
        elements(
            {
                "name": "Left",
                "group": "Plan",
                "type": 3,
                "rgba": [255, 0, 51, 255],
                "entry": [10, 20, 30],
                "target": [-10, 0, 2.5],
                "diameter": 1.5,
                "owner": "CT",
            }
        ),
    ),
    ours(
        "ImageMetaList",
        "Shelf",
        "IMGMETA",
        {"images": [{**CT_IMAGE, "scan_time": {"sec": SEC, "nanosec": 0}}]},
        elements(
            {
                "name": "Head",
                "device_name": "CT1",
                "modality": "CT",
                "patient_name": "Müller",
                "patient_id": "P-1",
                "timestamp": {"sec": SEC, "nanosec": 0},
                "size": [512, 256, 65535],
                "scalar_type": 4,
            }
        ),
    ),
    ours("LabelMetaList", "Regions", "LBMETA", {"labels": [LABEL]}, elements(LABEL)),
    ours(
        "VideoMetaList",
        "Channels",
        "VIDEOMETA",
        {"videos": [VIDEO_META]},
        elements(
            {
                **{key: VIDEO_META[key] for key in ("name", "device_name", "patient_name", "patient_id", "size")},
                "zoom_level": -2,
                "focal_length": 35.5,
                "wire_matrix": list(PLACE),
                "scalar_type": 3,
            }
        ),
    ),
    ours(
        "ColorTable",
        "Palette",
        "COLORT",
        {"index_type": 3, "map_type": 3, "table": hexed(GREYS)},
        {"index_type": 3, "map_type": 3, "table": list(GREYS)},
    ),
    ours("Capability", "Abilities", "CAPABILITY", {"types": COMPLETE}, {"types": COMPLETE}),
    ours(
        "Bind",
        "Bundle",
        "BIND",
        {
            "children": [
                {"type": "STRING", "name": "Odd", "content": hexed(struct.pack(">HH5s", 3, 5, b"child"))},
                {"type": "TRANSFORM", "name": "Even", "content": hexed(SHIFT)},
            ],
        },
        {
            "children": [
                {"type": "STRING", "name": "Odd", "size": 9, "content": {"string": "child", "encoding": 3}},
                {
                    "type": "TRANSFORM",
                    "name": "Even",
                    "size": 48,
                    "content": {"matrix": [[0, 0, 1, 100], [1, 0, 0, -200], [0, 1, 0, 300.5], [0, 0, 0, 1]]},
                },
            ]
        },
    ),
]
VIDEOS_OUT = [
    Sent(
        "igtl_msgs/msg/VideoFrame",
        "VIDEO",
        "Frames",
        VIDEO_FRAME,
        {
            "codec": "H264",
            "frame_type": 1,
            "size": [64, 48, 1],
            "wire_matrix": list(PLACE),
            "subvol_size": [64, 48, 1],
            "data_crc64": f"{crc64.ecma_182(KEY_FRAME):016x}",
        },
    ),
    *(
        Sent(
            ros_type,
            "VIDEO",
            device,
            {**fields, "format": "h264", "data": hexed(KEY_FRAME)},
            {
                "codec": "H264",
                "frame_type": 1,
                "size": [64, 48, 1],
                "data_crc64": f"{crc64.ecma_182(KEY_FRAME):016x}",
            },
        )
        for ros_type, device, fields in (
            ("sensor_msgs/msg/CompressedImage", "Compressed", {"header": head("Base")}),
            ("foxglove_msgs/msg/CompressedVideo", "Foxglove", {"timestamp": STAMP, "frame_id": "Base"}),
        )
    ),
]
OUTGOING += VIDEOS_OUT
OUTGOING += [
    Sent(
        "sensor_msgs/msg/JointState",
        "NDARRAY",
        "ArmState",
        {"header": head("Base"), "name": ["a", "b"], "position": [0.5, -1.25], "effort": [2.0, 3.0]},
        {
            "scalar_type": 11,
            "size": [6, 2],
            "data": [1, 1, 0.5, -1.25, 0, 0, 0, 0, 1, 1, 2, 3],
        },
    ),
    *(
        Sent(ros_type, "SENSOR", device, {"header": head("Base"), **fields}, {"unit": unit(0), "values": values})
        for ros_type, device, fields, values in (
            (
                *("geometry_msgs/msg/TwistStamped", "ArmSpeed"),
                {"twist": {"linear": SIX_BY_NAME[0], "angular": SIX_BY_NAME[1]}},
                SIX,
            ),
            (
                *("geometry_msgs/msg/WrenchStamped", "ArmLoad"),
                {"wrench": {"force": SIX_BY_NAME[0], "torque": SIX_BY_NAME[1]}},
                SIX,
            ),
            ("sensor_msgs/msg/Joy", "ArmPedal", {"axes": [0.5], "buttons": [1, 0]}, [1.0, 0.0]),
        )
    ),
    *(
        Sent(f"crtk_msgs/msg/{name}", "STRING", device, {"header": head("Base"), **fields}, {"string": text})
        for name, device, fields, text in (
            ("OperatingState", "ArmMode", {"state": "PAUSED", "is_busy": True}, "PAUSED busy"),
            ("StringStamped", "ArmWord", {"string": "enable"}, "enable"),
        )
    ),
]

#: More than a content: they have tests of their own below.
SPECIAL = {(COMMAND_TYPE, "COMMAND"), (REPLY_TYPE, "RTS_COMMAND"), (QUERY, "GET_STATUS")}
OTHERS = {
    f"{OUT}Robot/command": COMMAND_TYPE,
    f"{OUT}Console/command_reply": REPLY_TYPE,
    f"{OUT}Question": QUERY,
    f"{OUT}Strain": "igtl_msgs/msg/Sensor",
    f"{OUT}AsItIs": "igtl_msgs/msg/RawMessage",
    "/tf": TF,
}
ADVERTISED = {one.topic: one.ros_type for one in OUTGOING} | OTHERS


def test_every_row_of_the_table_to_igtl_has_a_case() -> None:
    rows = {(row.message.TYPE, row.igtl_type) for row in TO_IGTL}
    assert {(one.ros_type, one.type) for one in OUTGOING} | SPECIAL == rows


# ── the world ──────────────────────────────────────────────────────────────────────────────────────────────────────


@dataclass
class World:
    """Everybody who is connected: ``talker`` sends only, ``listener`` and ``cpp`` (if there is one) receive."""

    bridge: Bridge
    ros: RosClient
    talker: RawPeer
    listener: RawPeer
    slicer: RawPeer
    cpp: ReferencePeer | None

    def link(self, peer: RawPeer) -> int:
        """The number of a peer's link. A port may be that of a peer that has left."""

        def wanted(event: Event) -> bool:
            gone = [one["links"] for one in list(self.bridge.events) if one.get("code") == "link_down"]
            return event.get("code") == "link_up" and event["data"]["peer"] == peer.name and event["links"] not in gone

        (event,) = self.bridge.wait_events(wanted, f"link {peer.name}")
        (number,) = event["links"]
        return int(number)


def rows_of_the_command_line() -> list[str]:
    """What asks for the rows that are not used by themselves."""
    asked = {row.kind for row in TO_ROS if row.role is Role.ON_REQUEST}
    words = []
    for case in CASES:
        words += [word for kind in asked & case.heard.keys() for word in ("--kinds", f"{case.device}=+{kind}")]
    for one in OUTGOING:
        row = row_to_igtl(one.ros_type)
        if row is None or row.igtl_type != one.type:
            words += ["--send", f"{one.topic}={one.device}:{one.type}"]
    return words


@pytest.fixture(scope="module")
def world() -> Iterator[World]:
    port = free_port()
    there = (
        "--listen",
        f"127.0.0.1:{port}",
        "--peer",
        f"127.0.0.1:{port}=slicer",
        *("--tf-out", "tool:base", "--tf-out", "Base:Room"),
    )
    with RosClient("types", subscribe=SUBSCRIBED, advertise=ADVERTISED) as ros:
        ros.subscribe(LINKS_TOPIC, "igtl_msgs/msg/LinkStatusList", latched=True)
        ros.advertise("/tf_static", TF, latched=True)
        bridge = Bridge("--no-cautious", *rows_of_the_command_line(), *there)
        try:
            with RawPeer(bridge.port) as talker, RawPeer(bridge.port) as listener, RawPeer(port) as slicer:
                cpp = None if reference.available() else ReferencePeer.client("127.0.0.1", bridge.port)
                try:
                    bridge.wait_code("link_up", 4 if cpp else 3)
                    ros.wait_readers(*ADVERTISED.keys() - {"/tf"}, "/tf_static")
                    ros.wait_readers("/tf", count=2)  # the node itself subscribes, too
                    yield World(bridge, ros, talker, listener, slicer, cpp)
                finally:
                    if cpp:
                        cpp.close()
        finally:
            told = bridge.end()
            bridge.close()
    assert (told.code, told.err) == (0, "")
    assert not [event for event in bridge.events if event.get("code") == "internal_error"]
    assert bridge.events[-1]["event"] == "stopped"


# ── the tests: contents ────────────────────────────────────────────────────────────────────────────────────────────


def heard(world: World, topic: str, wanted: Json) -> Json:
    """The next message of that topic; on /tf the next with the wanted frames."""
    while True:
        got: Json = world.ros.receive(topic)
        if topic != "/tf" or children(got) == children(wanted):
            return got


def children(message: Json) -> list[str]:
    return [transform["child_frame_id"] for transform in message["transforms"]]


@pytest.mark.parametrize("case", CASES, ids=str)
def test_what_a_peer_sends_is_what_the_node_hears(world: World, case: Case) -> None:
    world.talker.send(packed(case.type, case.device, case.content, case.metadata))
    for kind, (_, wanted) in case.heard.items():
        assert heard(world, case.topic(kind), wanted) == wanted


def test_the_second_slice_comes_behind_the_first(world: World) -> None:
    (case,) = (case for case in CASES if case.device == "CT")
    second = picture(2, 1, "mono8", b"cd")
    world.talker.send(packed(case.type, case.device, case.content))
    while world.ros.receive(case.topic("slices")) != second:
        pass


def test_children_of_a_bind_go_their_own_ways(world: World) -> None:
    world.talker.send(packed("BIND", "Both", BOUND))
    assert world.ros.receive(f"{IN}BoundText/string") == {"data": "child"}
    wanted = frame("Base", "Bound", xyz(0.1, -0.2, 0.3005), TURN)
    assert world.ros.receive(f"{IN}BoundToBase/transform") == wanted


@pytest.mark.parametrize("prefix", QUERIES)
def test_queries_are_heard(world: World, prefix: str) -> None:
    number, names = QUERIES[prefix]
    link = world.link(world.talker)
    for name in names:
        content, told = CONTENTS.get(f"{prefix}_{name}", (b"", {}))
        world.talker.send(packed(f"{prefix}_{name}", "Asker", content))
        nothing = {"resolution": 0, "coordinate_name": "", "codec": "", "status": 0}
        assert world.ros.receive(QUERY_TOPIC) == {
            "header": head(),
            "kind": number,
            "type": SHORT_NAMES.get(name, name),
            "device_name": "Asker",
            **(nothing | told),
            "link": link,
            "metadata": [],
        }


def test_metadata_of_a_standard_message_is_heard_beside_it(world: World) -> None:
    content = struct.pack(">HH5s", 3, 5, b"hello")
    world.talker.send(packed("STRING", "Note", content, {"operator": "A. B.", "ros.frame_id": "room"}))
    assert world.ros.receive(f"{IN}Note/metadata") == {
        "header": head("room"),
        "type": "STRING",
        "device_name": "Note",
        "message_id": 0,
        "items": [item("operator", "A. B.")],
    }


def test_a_type_that_nobody_knows_is_heard_as_it_is(world: World) -> None:
    data = packed("MYTYPE", "Odd", b"\0\1payload")
    world.talker.send(data)
    got = world.ros.receive(f"{IN}Odd/raw")
    assert got.pop("stamp")["sec"] > SEC
    assert got == {
        "source_stamp": STAMP,
        "source_ticks": TICKS,
        "direction": 0,
        "links": [world.link(world.talker)],
        "type": "MYTYPE",
        "device_name": "Odd",
        "data": hexed(data),
    }


def test_who_is_connected_is_heard(world: World) -> None:
    def told(name: str) -> list[Json]:
        links: list[Json] = world.ros.receive(LINKS_TOPIC)["links"]
        return [link for link in links if link["peer"] == name]

    greeting = struct.pack(">Hq20s", 1, 0, b"") + b"\0"
    with RawPeer(world.bridge.port) as guest:
        number = world.link(guest)
        while not (shown := told(guest.name)):
            pass
        common = {"link": number, "connected": True, "peer": guest.name, "role": "server"}
        assert shown == [{**common, "profile": "default", "header_version": 0}]
        guest.send(packed("STATUS", "", greeting, {"dummy": "dummy"}))
        while (shown := told(guest.name)) == [{**common, "profile": "default", "header_version": 0}]:
            pass
        assert shown == [{**common, "profile": "slicer", "header_version": 2}]
    while told(guest.name):
        pass


def rounded(value: Any) -> Any:
    """Numbers to six digits: what float32 keeps of them."""
    if isinstance(value, float):
        return float(f"{value:.6g}") or 0.0
    if isinstance(value, dict):
        return {key: rounded(one) for key, one in value.items()}
    return [rounded(one) for one in value] if isinstance(value, list) else value


def check(told: Json, wanted: Json) -> None:
    assert rounded(only(told, wanted)) == rounded(only(wanted, told)) == rounded(wanted)


@table("one", OUTGOING, ids=str)
def test_what_the_node_publishes_is_what_peers_get(world: World, one: Sent) -> None:
    world.ros.publish(one.topic, one.fields)
    got = world.listener.receive(one.device, one.type)
    assert (got.version, got.crc_ok) == (1, True)
    message = decode(got.data)
    check(describe_content(message.content), one.content)
    if one.stamped:
        assert message.ticks == TICKS
    else:
        assert message.ticks > TICKS  # the publisher's time, which is now
    if world.cpp and one.type in reference.ENCODERS:
        told = world.cpp.receive(one.type, one.device)
        assert told["crc_ok"]
        check(told["content"], one.content)


def test_frames_of_a_video_tell_the_size_of_their_key_frame(world: World) -> None:
    for data, frame_type in ((KEY_FRAME, 1), (DELTA_FRAME, 3)):
        world.ros.publish(f"{OUT}Foxglove", {"format": "h264", "data": hexed(data)})
        content = decode(world.listener.receive("Foxglove", "VIDEO").data).content.describe()
        check(content, {"frame_type": frame_type, "size": [64, 48, 1], "data_size": len(data)})


def test_queries_of_the_node_reach_peers(world: World) -> None:
    fields = {"kind": 2, "type": "TDATA", "device_name": "Polaris", "resolution": 50, "coordinate_name": "Room"}
    world.ros.publish(f"{OUT}Question", fields)
    got = world.listener.receive(type_name="STT_TDATA")
    assert (got.device, got.body) == ("Polaris", struct.pack(">i32s", 50, b"Room"))
    with RawPeer(world.bridge.port) as other:
        for link in (world.link(other), 0):  # first for the other one only
            world.ros.publish(
                f"{OUT}Question", {"kind": 1, "type": "CAPABILITY", "link": link, "device_name": f"{link}"}
            )
            assert other.receive(type_name="GET_CAPABIL").device == f"{link}"
        assert world.listener.receive(type_name="GET_CAPABIL").device == "0"


def test_raw_messages_of_the_node_go_out_as_they_are(world: World) -> None:
    data = packed("MYTYPE", "Verbatim", b"\0\1payload")
    world.ros.publish(f"{OUT}AsItIs", {"data": hexed(data)})
    assert world.listener.receive("Verbatim").data == data


def test_metadata_goes_out_to_who_has_shown_header_version_2(world: World) -> None:
    with RawPeer(world.bridge.port) as modern:
        modern.send(packed("STRING", "Note", struct.pack(">HH", 3, 0), {"key": "value"}))
        world.ros.receive(f"{IN}Note/metadata")
        fields = {"header": head("flange"), "values": [1.0], "metadata": [item("operator", "A. B.")]}
        world.ros.publish(f"{OUT}Strain", fields)
        got = modern.receive("Strain")
    content, metadata = unextended(got.body)
    assert (got.version, got.crc_ok) == (2, True)
    assert content == struct.pack(">BBQd", 1, 0, 0, 1.0)
    assert metadata == {
        "operator": "A. B.",
        "ros.frame_id": "flange",
        "ros.stamp": str(SEC * 1_000_000_000 + NANOSEC),
    }


# ── the tests: conversations ───────────────────────────────────────────────────────────────────────────────────────


def until_status(peer: RawPeer) -> list[Wire]:
    """What came before the answer to a GET_STATUS that is sent now."""
    peer.send(packed("GET_STATUS", "End", b""))
    found: list[Wire] = []
    while (got := peer.receive()).type != "STATUS" or got.device != "End":
        found.append(got)
    return found


@pytest.fixture
def peer(world: World) -> Iterator[RawPeer]:
    """One that has asked for nothing yet, and has got what every late peer gets: plans and surfaces."""
    with RawPeer(world.bridge.port) as fresh:
        assert until_status(fresh) == [], "who asks reads the answer first"
        until_status(fresh)
        yield fresh


def test_status_and_capability_are_answered(peer: RawPeer) -> None:
    peer.send(packed("GET_STATUS", "Any", b""))
    status = peer.receive()
    assert (status.type, status.device) == ("STATUS", "Any")
    assert struct.unpack_from(">Hq", status.body) == (1, 0)
    peer.send(packed("GET_CAPABIL", "", b""))
    skills = peer.receive()
    assert skills.type == "CAPABILITY"
    names = {name.rstrip(b"\0").decode() for (name,) in struct.iter_unpack(">12s", skills.body)}
    sent_here = {case.type for case in CASES} - {"QTRANS", "COLORTABLE", "CAPABIL"}  # other names of the same
    assert sent_here <= names


#: What stands behind GET_ → a message that such a query is answered with.
ANSWERS = {
    name: one for name in ASKED for one in OUTGOING if name != "TRANSFOR" and one.type == SHORT_NAMES.get(name, name)
}


@pytest.mark.parametrize("name", ANSWERS)
def test_the_latest_state_is_told_to_who_asks(world: World, peer: RawPeer, name: str) -> None:
    one = ANSWERS[name]
    world.ros.publish(one.topic, one.fields)
    sent = world.listener.receive(one.device, one.type)
    until_status(peer)  # it got that one as everybody did
    peer.send(packed(f"GET_{name}", one.device, b""))
    got = peer.receive()
    assert (got.type, got.device) == (one.type, one.device)
    if one.type not in ("STATUS", "CAPABILITY"):  # which are the gateway's own
        assert got.data == sent.data


def track(world: World, count: int) -> None:
    """Send this number of messages of the tracker; wait for them at a peer that has not requested anything."""
    for number in range(1, count + 1):
        world.ros.publish(f"{OUT}Tools", TOOLS | {"header": {"stamp": {"sec": number}, "frame_id": "Base"}})
        while decode(world.listener.receive("Tools", "TDATA").data).ticks >> 32 != number:
            pass


def test_tracking_is_paced_and_stopped(world: World, peer: RawPeer) -> None:
    """An hour between two messages: one comes.  None between two: all come.  After the end: none."""
    for resolution, expected in ((3_600_000, 1), (0, 4)):
        peer.send(packed("STT_TDATA", "Tools", struct.pack(">i32s", resolution, b"")))
        (reply,) = until_status(peer)
        assert (reply.type, reply.device, reply.body) == ("RTS_TDATA", "Tools", b"\0")
        track(world, 4)
        assert [(got.type, got.device) for got in until_status(peer)] == [("TDATA", "Tools")] * expected
    peer.send(packed("STP_TDATA", "Tools", b""))
    (reply,) = until_status(peer)
    assert (reply.type, reply.body) == ("RTS_TDATA", b"\0")
    track(world, 2)
    assert not until_status(peer)


def test_the_pace_is_the_wanted_one(world: World, peer: RawPeer) -> None:
    peer.send(packed("STT_TDATA", "Tools", struct.pack(">i32s", 20, b"")))
    until_status(peer)
    began = time.monotonic()
    track(world, 30)
    most = (time.monotonic() - began) / 0.020 + 1
    assert 1 <= len(until_status(peer)) <= most


def test_tracking_is_told_in_the_wanted_frame(world: World, peer: RawPeer) -> None:
    """Base lies turned in the room, a metre above its origin."""
    place = {"translation": xyz(0, 0, 1), "rotation": TURN}
    base = {"header": head("Room"), "child_frame_id": "Base", "transform": place}
    world.ros.publish("/tf", {"transforms": [base]})
    world.listener.receive("BaseToRoom", "TRANSFORM")  # by then the frame is known
    peer.send(packed("STT_TDATA", "Tools", struct.pack(">i32s", 0, b"Room")))
    assert until_status(peer)[-1].body == b"\0"
    track(world, 1)
    (got,) = until_status(peer)
    twice = [[0, 1, 0, 1125], [0, 0, 1, 400], [1, 0, 0, 750], [0, 0, 0, 1]]
    check(decode(got.data).content.describe(), elements({"name": "Tip", "type": 3, "matrix": twice}))


def test_tracking_in_a_frame_that_nobody_knows_is_refused(peer: RawPeer) -> None:
    peer.send(packed("STT_TDATA", "Tools", struct.pack(">i32s", 0, b"Atlantis")))
    (reply,) = until_status(peer)
    assert (reply.type, reply.body) == ("RTS_TDATA", b"\1")


def test_frames_go_out_with_their_chain_composed(world: World) -> None:
    """base ← arm by /tf_static, arm ← tool by /tf: a third of a turn, then a step along the turned x axis (y)."""
    arm = {"header": head("base"), "child_frame_id": "arm", "transform": TRANSFORMED}
    step = {"translation": xyz(0.5, 0.0, 0.0), "rotation": quaternion(0.0, 0.0, 0.0, 1.0)}
    world.ros.publish("/tf_static", {"transforms": [arm]})
    world.ros.publish("/tf", {"transforms": [{"header": head("arm"), "child_frame_id": "tool", "transform": step}]})
    got = world.listener.receive("toolTobase", "TRANSFORM")
    assert decode(got.data).ticks == TICKS
    numbers = struct.unpack(">12f", got.body)
    assert numbers == pytest.approx((*TURNED, 400, 250, 1125), abs=1e-4)


def asked(got: Wire) -> tuple[int, str, str]:
    """Id, name and text of a COMMAND or RTS_COMMAND of either header version."""
    content = unextended(got.body)[0] if got.version > 1 else got.body
    number, name, encoding, size = struct.unpack_from(">I128sHI", content)
    assert (encoding, size) == (3, len(content) - 138)
    return number, name.rstrip(b"\0").decode(), content[138:].decode()


def call(world: World, link: int, timeout: float) -> None:
    fields = {"device_name": "Robot", "name": "Move", "content": "<To x='1'/>", "link": link, "timeout": timeout}
    world.ros.call(SERVICE, "igtl_msgs/srv/SendCommand", fields)


@pytest.mark.parametrize(
    ("metadata", "status", "why"),
    [({"Status": "SUCCESS"}, 1, ""), ({"Status": "FAIL", "ErrorMessage": "no power"}, 2, "no power"), (None, 1, "")],
    ids=["success", "failure", "version 1"],
)
def test_the_service_sends_a_command_and_tells_its_reply(
    world: World, peer: RawPeer, metadata: dict[str, str] | None, status: int, why: str
) -> None:
    link = world.link(peer)
    call(world, link, 15.0)
    got = peer.receive("Robot", "COMMAND")
    number, *rest = asked(got)
    assert rest == ["Move", "<To x='1'/>"]
    peer.send(packed("RTS_COMMAND", "Robot", command(number, "Move", "<Done/>"), metadata))
    assert world.ros.receive(SERVICE) == {
        "status": status,
        "error_message": why,
        "content": "<Done/>",
        "metadata": [item(key, value) for key, value in (metadata or {}).items()],
        "link": link,
    }
    told = world.ros.receive(f"{IN}Robot/command_reply")
    assert (told["header"], told["id"], told["name"], told["status"]) == (head(), number, "Move", status)


@pytest.mark.parametrize(("known", "status"), [(True, 3), (False, 4)], ids=["silent", "not there"])
def test_a_command_that_nobody_answers_is_given_up(world: World, peer: RawPeer, known: bool, status: int) -> None:
    call(world, world.link(peer) if known else 4711, 0.1)
    assert world.ros.receive(SERVICE)["status"] == status
    assert world.ros.receive(f"{IN}Robot/command_reply")["status"] == status


def test_a_command_of_the_node_by_topic(world: World, peer: RawPeer) -> None:
    fields = {"device_name": "Robot", "name": "Stop", "content": "now", "link": world.link(peer)}
    world.ros.publish(f"{OUT}Robot/command", fields)
    number, *rest = asked(peer.receive("Robot", "COMMAND"))
    assert number != 0
    assert rest == ["Stop", "now"]
    peer.send(packed("RTS_COMMAND", "Robot", command(number, "Stop", "stopped")))
    assert world.ros.receive(f"{IN}Robot/command_reply") == {
        "header": head(),
        "device_name": "Robot",
        "id": number,
        "name": "Stop",
        "status": 1,
        "error_message": "",
        "encoding": 3,
        "content": "stopped",
        "metadata": [],
        "link": world.link(peer),
    }


@pytest.mark.parametrize("version", [1, 2])
def test_a_command_of_a_peer_is_answered_by_a_node(world: World, peer: RawPeer, version: int) -> None:
    metadata = {"priority": "high"} if version > 1 else None
    peer.send(packed("COMMAND", "Console", command(77, "Freeze", "<Now/>"), metadata))
    link = world.link(peer)
    assert world.ros.receive(f"{IN}Console/command") == {
        "header": head(),
        "device_name": "Console",
        "id": 77,
        "name": "Freeze",
        "encoding": 3,
        "content": "<Now/>",
        "metadata": [item("priority", "high")] if metadata else [],
        "link": link,
        "timeout": 0.0,
    }
    fields = {"id": 77, "link": link, "status": 2, "error_message": "no power", "content": "<Sorry/>"}
    world.ros.publish(f"{OUT}Console/command_reply", fields)
    got = peer.receive("Console", "RTS_COMMAND")
    assert (got.version, got.crc_ok) == (version, True)
    failure = '<CommandReply Name="Freeze" Status="FAIL" Message="no power: &lt;Sorry/&gt;" />'
    assert asked(got) == (77, "Freeze", "<Sorry/>" if version > 1 else failure)
    if version > 1:
        assert unextended(got.body)[1] == {"Status": "FAIL", "ErrorMessage": "no power"}


# ── 3D Slicer, which ends at the wrong query or reply ──────────────────────────────────────────────────────────────


def test_slicer_is_asked_nothing(world: World) -> None:
    """By its port; everybody else gets the query."""
    for kind in (1, 2, 3, 4):
        world.ros.publish(f"{OUT}Question", {"kind": kind, "type": "TDATA", "device_name": f"Turn{kind}"})
        world.listener.receive(f"Turn{kind}")
    kinds = [got.type for got in until_status(world.slicer)]
    assert [kind for kind in kinds if kind.startswith(("GET_", "STT_", "STP_", "RTS_"))] == ["RTS_TDATA"]


def test_slicer_gets_no_reply_but_that_of_tracking() -> None:
    bridge = Bridge("--no-ros", "--profile", "slicer")
    try:
        with RawPeer(bridge.port) as slicer:
            for prefix in ("GET", "STT", "STP"):
                for name in QUERIES[prefix][1]:
                    query = f"{prefix}_{name}"
                    slicer.send(packed(query, "Any", CONTENTS.get(query, (b"", {}))[0]))
            answers = [got.type for got in until_status(slicer)]
    finally:
        told = bridge.end()
        bridge.close()
    assert {name for name in answers if "_" in name} == {"RTS_TDATA"}
    assert answers.count("RTS_TDATA") == 2  # of STT_ and of STP_
    assert {"TRANSFORM", "IMAGE"} <= set(answers) and "CAPABILITY" not in answers  # "there is none", of what it reads
    assert (told.code, told.err) == (0, "")


def test_floats_are_compared_to_six_digits() -> None:
    """``check`` itself: it must see what is missing, too much, or different."""
    check({"a": [1.0000001, 2], "more": 3}, {"a": [1.0, 2]})
    for wrong in ({"a": [1.0]}, {"a": [1.0, 2.1]}, {"b": 1}, {"a": [1.0, 2], "b": 0}):
        with pytest.raises(AssertionError):
            check({"a": [1.0, 2]}, wrong)
