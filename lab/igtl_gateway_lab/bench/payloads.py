"""The messages that are measured with, as bytes of both sides, and where their sequence number is.

The number has to survive the conversion and must not cost anything.  Messages with a stamp carry it in the seconds of
the stamp: the gateway keeps source stamps, the place is fixed on both sides, and the OpenIGTLink header is outside the
CRC, so that one number in one buffer changes from message to message.  Two have no stamp in ROS: a string begins with
it, and of a mesh it is the first coordinate, in millimetres.

For bridges that keep no stamps, some kinds have a twin without, and the number is in the content: of a transform the
first coordinate of its translation, of points that of the first, both in millimetres, and the first bytes of a picture.
"""

from __future__ import annotations

import ctypes
import math
import struct
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from igtl_gateway.base.buffers import Buffer, join
from igtl_gateway.base.stamp import NS_PER_S
from igtl_gateway.convert import rosmsg
from igtl_gateway.convert.igtl_msgs import TrackedTool, TrackingData
from igtl_gateway.convert.poses import rotation_matrix
from igtl_gateway.convert.rosmsg import PointCloud2
from igtl_gateway.wire import Item, Message, encode
from igtl_gateway.wire.body import Body
from igtl_gateway.wire.header import HEADER_SIZE, TICKS_AT
from igtl_gateway.wire.image import HEAD_SIZE as IMAGE_HEAD
from igtl_gateway.wire.image import Image
from igtl_gateway.wire.message import EXTENDED_SIZE, MESSAGE_ID_AT
from igtl_gateway.wire.point import Points
from igtl_gateway.wire.polydata import Cells, PolyData
from igtl_gateway.wire.text import String
from igtl_gateway.wire.tracking import TOOL_6D, TRACKING_DTYPE
from igtl_gateway.wire.tracking import TrackingData as Tracked
from igtl_gateway.wire.transform import Transform

#: Seconds of the stamp of message 0: a time long ago, which no program takes for "unset".
EPOCH_S = 1_000_000_000

#: The header of ROS messages without a stamp.
_UNSET = rosmsg.Header(0, "Base")

_DIGITS = 10
_CDR_AT = 4  # behind the encapsulation
_MESH_HEAD = 40  # of POLYDATA, before its points
_TRANSLATION_AT = 36  # of TRANSFORM, behind its rotation
_POINT_AT = 100  # of POINT, before the coordinates of the first: its name, group and colour

#: Of messages of header version 2.
ID_AT = HEADER_SIZE + MESSAGE_ID_AT

#: So much is sent at once in a flood of small messages.
_BATCH_BYTES = 16 << 10

#: Makes the message of a sequence number.
Make = Callable[[int], Buffer]
#: Makes a number of messages from a sequence number on, one after the other.
Batch = Callable[[int, int], Buffer]
#: The sequence number of a message.
Number = Callable[[Buffer], int]
Bytes = npt.NDArray[np.uint8]
Numbers = npt.NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class Form:
    """How a number is written, and where.

    Attributes:
        at, size: its bytes in the message; ``at`` below 0 counts from the end.
        layout: of ``struct``, "text", or "cloud": float32 in metres at the first point of a PointCloud2.
        write: those bytes.
        number: of a message.
        numbers: of many: from an array with a row of those bytes for each.
        has_id: the message has an id, which is the number, too.
    """

    at: int
    size: int
    layout: str
    write: Callable[[int], bytes]
    number: Number
    numbers: Callable[[Bytes], Numbers]
    has_id: bool = False

    def place(self, message: Buffer) -> int:
        """Return the offset of the number in a message."""
        if self.layout == "cloud":
            return _first_point(message)
        return self.at if self.at >= 0 else len(message) + self.at

    @property
    def is_in_body(self) -> bool:
        """Whether the number is in the body of an OpenIGTLink message: its CRC changes with it."""
        return self.at < 0 or self.at >= HEADER_SIZE


def _first_point(cdr: Buffer) -> int:
    """Return the offset of the first point of a PointCloud2 in CDR."""
    data = PointCloud2.unpack(cdr).data
    return len(cdr) - memoryview(data).nbytes - 1  # behind the data: whether it is dense


def _of_cloud() -> Form:
    packing = struct.Struct("<f")
    return Form(
        0,
        packing.size,
        "cloud",
        lambda number: packing.pack(number * 1e-3),
        lambda message: round(packing.unpack_from(message, _first_point(message))[0] * 1e3),
        lambda rows: np.rint(rows.view("<f4")[:, 0].astype(np.float64) * 1e3).astype(np.int64),
    )


def _of_struct(at: int, layout: str, start: int = 0, unit: float = 1) -> Form:
    packing, column = struct.Struct(layout), np.dtype(layout)
    return Form(
        at,
        packing.size,
        layout,
        lambda number: packing.pack(start + number * unit),
        lambda message: round((packing.unpack_from(message, at)[0] - start) / unit),
        lambda rows: np.rint((rows.view(column)[:, 0].astype(np.float64) - start) / unit).astype(np.int64),
    )


def _of_text(at: int) -> Form:
    return Form(
        at,
        _DIGITS,
        "text",
        lambda number: b"%010d" % number,
        lambda message: int(bytes(message[at : at + _DIGITS])),
        lambda rows: rows.view(f"S{_DIGITS}")[:, 0].astype(np.int64),
    )


_STAMPS = (_of_struct(_CDR_AT, "<i", EPOCH_S), _of_struct(TICKS_AT, ">I", EPOCH_S))
# behind the length of the text; behind its encoding and length
_TEXTS = (_of_text(_CDR_AT + 4), _of_text(HEADER_SIZE + 4))


@dataclass(frozen=True, slots=True)
class Payload:
    """What one kind of message is on both sides.

    Attributes:
        ros_type: ``"pkg/msg/Name"``.
        kind: last token of the topic that the gateway publishes it on.
        igtl_type: type name on the wire.
        ros: makes a ROS message.
        content: makes the content of the OpenIGTLink message of a number.
        forms: where the number is in ROS and in OpenIGTLink.
        metadata: of the OpenIGTLink message, which has header version 2 then, and the number as its id.
    """

    ros_type: str
    kind: str
    igtl_type: str
    ros: Callable[[rosmsg.Header], rosmsg.RosMessage]
    content: Callable[[int], Body]
    forms: tuple[Form, Form] = _STAMPS
    metadata: tuple[Item, ...] = ()

    def ros_maker(self) -> Callable[[int], bytes]:
        """Makes ROS messages: the same bytes again and again with another number, so each is to be sent before the
        next is made."""
        form, _ = self.forms
        cdr = self.ros(rosmsg.Header(EPOCH_S * NS_PER_S, "Base")).pack()
        # rclpy takes nothing but bytes.  A copy of an image for each number would cost as much as sending it, so the
        # number is written into the one object, which has no other owner: rclpy has copied it when ``publish`` returns.
        address = ctypes.cast(ctypes.c_char_p(cdr), ctypes.c_void_p).value
        assert address is not None
        place = address + form.place(cdr)

        def make(number: int) -> bytes:
            ctypes.memmove(place, form.write(number), form.size)
            return cdr

        return make

    def igtl_maker(self, device: str) -> Make:
        """Makes OpenIGTLink messages, as ``ros_maker`` does."""
        _, form = self.forms
        if form.is_in_body:  # the CRC is another one each time
            return lambda number: self._igtl(device, number)
        data = bytearray(self._igtl(device, 0))

        def make(number: int) -> Buffer:
            data[form.at : form.at + form.size] = form.write(number)
            return data

        return make

    def _igtl(self, device: str, number: int) -> bytes:
        version = 2 if self.metadata else 1
        content, items = self.content(number), self.metadata
        return join(encode(Message(self.igtl_type, device, content, 0, version, number if items else 0, items)))

    def igtl_batch(self, device: str) -> tuple[int, Batch]:
        """Makes several OpenIGTLink messages at once; and how many at most."""
        _, form = self.forms
        make = self.igtl_maker(device)
        one = np.frombuffer(bytes(make(0)), np.uint8)
        most = max(1, _BATCH_BYTES // len(one))
        if most == 1 or form.is_in_body:
            return most, lambda first, count: b"".join(make(first + more) for more in range(count))
        block = np.tile(one, (most, 1))

        def batch(first: int, count: int) -> Buffer:
            written = b"".join(map(form.write, range(first, first + count)))
            block[:count, form.at : form.at + form.size] = np.frombuffer(written, np.uint8).reshape(count, form.size)
            return block[:count].data.cast("B")

        return most, batch

    @property
    def size(self) -> int:
        """Bytes of the ROS message."""
        return len(self.ros_maker()(0))


def transform(*, stamped: bool = True) -> Payload:
    """A pose that is not the identity."""
    cos, sin = math.cos(0.3), math.sin(0.3)
    half = (0.0, 0.0, math.sin(0.15), math.cos(0.15))
    if not stamped:
        # far from the origin: the guard would take a coordinate that grows a hundredfold for another unit
        return Payload(
            rosmsg.TransformStamped.TYPE,
            "transform",
            "TRANSFORM",
            lambda _header: rosmsg.TransformStamped(_UNSET, "Tool", (0.0, -2.0, 3.05), half),
            lambda number: Transform.from_rows(
                [[cos, -sin, 0.0, number], [sin, cos, 0.0, -2000.0], [0.0, 0.0, 1.0, 3050.0]]
            ),
            (_of_struct(-56, "<d", unit=1e-3), _of_struct(-12, ">f")),  # both end with it
        )
    rows = [[cos, -sin, 0.0, 10.0], [sin, cos, 0.0, -20.0], [0.0, 0.0, 1.0, 30.5]]
    return Payload(
        rosmsg.TransformStamped.TYPE,
        "transform",
        "TRANSFORM",
        lambda header: rosmsg.TransformStamped(header, "Tool", (0.01, -0.02, 0.0305), half),
        lambda _number: Transform.from_rows(rows),
    )


def tracking(count: int) -> Payload:
    """The tools of a tracker: TDATA, 70 bytes each."""
    half, places = (0.0, 0.0, math.sin(0.15), math.cos(0.15)), _positions(count)
    rotation = [number for column in np.array(rotation_matrix(half)).T for number in column]
    elements = np.zeros(count, TRACKING_DTYPE)
    for number, (element, place) in enumerate(zip(elements, places, strict=True)):
        element["name"], element["type"], element["matrix"] = b"Tool%d" % number, TOOL_6D, (*rotation, *place)
    return Payload(
        TrackingData.TYPE,
        "tracking",
        "TDATA",
        lambda header: TrackingData(
            header,
            tuple(
                TrackedTool(f"Tool{number}", TOOL_6D, (x / 1000, y / 1000, z / 1000, *half))
                for number, (x, y, z) in enumerate(places.tolist())
            ),
        ),
        lambda _number: Tracked(elements),
    )


def string(length: int) -> Payload:
    """A string with ``length`` bytes."""
    rest = "." * (length - _DIGITS)
    return Payload(
        rosmsg.String.TYPE,
        "string",
        "STRING",
        lambda _header: rosmsg.String("0" * _DIGITS + rest),
        lambda number: String(f"{number:0{_DIGITS}}{rest}".encode()),
        _TEXTS,
    )


def points(count: int, *, stamped: bool = True) -> Payload:
    """Landmarks: POINT, 136 bytes each; a cloud on the side of ROS."""
    xyz = _positions(count)
    if not stamped:
        return Payload(
            rosmsg.PointCloud2.TYPE,
            "points",
            "POINT",
            lambda _header: _cloud(_UNSET, np.vstack([[0.0, 0.0, 0.0], xyz[1:] / 1000])),
            lambda number: Points.of(np.vstack([[float(number), 0.0, 0.0], xyz[1:]])),
            (_of_cloud(), _of_struct(HEADER_SIZE + _POINT_AT, ">f")),
        )
    return Payload(
        rosmsg.PointCloud2.TYPE,
        "points",
        "POINT",
        lambda header: _cloud(header, xyz / 1000),
        lambda _number: Points.of(xyz),
    )


def cloud(count: int, *, stamped: bool = True) -> Payload:
    """A cloud of float32 coordinates: PointCloud2 and, as one cell of all its vertices, POLYDATA."""
    xyz = _positions(count)
    vertices = Cells(1, np.array([count, *range(count)], ">u4"))
    if not stamped:
        return Payload(
            rosmsg.PointCloud2.TYPE,
            "points",
            "POLYDATA",
            lambda _header: _cloud(_UNSET, np.vstack([[0.0, 0.0, 0.0], xyz[1:] / 1000])),
            lambda number: PolyData(np.vstack([[float(number), 0.0, 0.0], xyz[1:]]).astype(">f4"), vertices),
            (_of_cloud(), _of_struct(HEADER_SIZE + _MESH_HEAD, ">f")),
        )
    return Payload(
        rosmsg.PointCloud2.TYPE,
        "points",
        "POLYDATA",
        lambda header: _cloud(header, xyz / 1000),
        lambda _number: PolyData(xyz.astype(">f4"), vertices),
    )


def surface(count: int, triangles: int) -> Payload:
    """A surface with ``count`` points: shape_msgs/Mesh (float64) and POLYDATA (float32)."""
    corners = (np.arange(3 * triangles, dtype=np.uint32) % np.uint32(count)).reshape(-1, 3)
    vertices = _positions(count) / 1000
    xyz = _positions(count).astype(">f4")
    cells = Cells.of(corners)
    # the number of triangles, those, the number of vertices, and what aligns these
    first = -(-(4 + corners.nbytes + 4) // 8) * 8

    def content(number: int) -> PolyData:
        xyz[0, 0] = number
        return PolyData(xyz, polygons=cells)

    return Payload(
        rosmsg.Mesh.TYPE,
        "mesh",
        "POLYDATA",
        lambda _header: rosmsg.Mesh(corners, vertices),
        content,
        (_of_struct(_CDR_AT + first, "<d", unit=1e-3), _of_struct(HEADER_SIZE + _MESH_HEAD, ">f")),
    )


def image(width: int, height: int, *, stamped: bool = True) -> Payload:
    """An RGB picture of noise."""
    pixels = (np.arange(width * height * 3, dtype=np.uint32) * np.uint32(2_654_435_761) >> np.uint32(24)).astype("u1")
    data = pixels.tobytes()
    if not stamped:
        number_at = _of_struct(-len(data), "<I")
        return Payload(
            rosmsg.Image.TYPE,
            "image",
            "IMAGE",
            lambda _header: rosmsg.Image(_UNSET, height, width, "rgb8", 0, 3 * width, bytes(4) + data[4:]),
            lambda number: Image((width, height, 1), 3, number.to_bytes(4, "little") + data[4:], 3),
            (number_at, number_at),
        )
    return Payload(
        rosmsg.Image.TYPE,
        "image",
        "IMAGE",
        lambda header: rosmsg.Image(header, height, width, "rgb8", 0, 3 * width, data),
        lambda _number: Image((width, height, 1), 3, data, 3),
    )


def from_slicer(made: Payload) -> Payload:
    """The same as 3D Slicer sends it: without a stamp, with an id and the metadata of a node.

    A picture has its centre, points have names.
    """
    ros, _ = made.forms
    form = replace(_IN_VERSION_2[made.igtl_type], has_id=True)
    return replace(made, content=lambda number: _of_node(made.content(number)), forms=(ros, form), metadata=_NODE)


#: The number in messages without a stamp of header version 2.
_CONTENT_AT = HEADER_SIZE + EXTENDED_SIZE
_IN_VERSION_2 = {
    "TRANSFORM": _of_struct(_CONTENT_AT + _TRANSLATION_AT, ">f"),
    "STRING": _of_text(_CONTENT_AT + 4),
    "POINT": _of_struct(_CONTENT_AT + _POINT_AT, ">f"),
    "IMAGE": _of_struct(_CONTENT_AT + IMAGE_HEAD, "<I"),
}
_NODE = tuple(
    Item(key, value)
    for key, value in (
        ("MRMLNodeName", b"Probe"),
        ("STREAM_ID_FROM", b"unknown"),
        ("STREAM_ID_TO", b"unknown"),
        ("TransformStatus", b"OK"),
    )
)


def _of_node(content: Body) -> Body:
    """Return what a node of 3D Slicer has of a content."""
    if isinstance(content, Image):
        columns, rows, slices = content.dimensions
        centre = ((columns - 1) / 2, (rows - 1) / 2, (slices - 1) / 2)
        return replace(content, wire_matrix=(*Image.IDENTITY[:9], *centre))
    if isinstance(content, Points):
        elements = content.elements.copy()
        elements["name"] = [b"F-%d" % number for number in range(1, len(elements) + 1)]
        return Points(elements)
    return content


def _cloud(header: rosmsg.Header, xyz: npt.NDArray[np.float64]) -> rosmsg.PointCloud2:
    fields = tuple(rosmsg.PointField(name, 4 * axis, 7, 1) for axis, name in enumerate("xyz"))
    data = xyz.astype("<f4").tobytes()
    return rosmsg.PointCloud2(header, 1, len(xyz), fields, False, 12, len(data), data, True)


def _positions(count: int) -> npt.NDArray[np.float64]:
    """A helix of ``count`` points, in millimetres."""
    at = np.arange(count)
    return np.stack([30 * np.cos(at / 16), 30 * np.sin(at / 16), at / 20], axis=1)
