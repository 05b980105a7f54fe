"""The messages that are measured with, as bytes of both sides, and where their sequence number is.

The number has to survive the conversion and must not cost anything.  Messages with a stamp carry it in the seconds of
the stamp: the gateway keeps source stamps, the place is fixed on both sides, and the OpenIGTLink header is outside the
CRC, so that one number in one buffer changes from message to message.  Only STRING has no stamp in ROS: its text
begins with the number.
"""

from __future__ import annotations

import ctypes
import math
import struct
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from igtl_gateway.buffers import Buffer, join
from igtl_gateway.convert import igtl_msgs, rosmsg
from igtl_gateway.stamp import NS_PER_S
from igtl_gateway.wire import HEADER_SIZE, Message, encode
from igtl_gateway.wire.body import Body
from igtl_gateway.wire.image import Image
from igtl_gateway.wire.point import Points
from igtl_gateway.wire.polydata import Cells, PolyData
from igtl_gateway.wire.text import String
from igtl_gateway.wire.transform import Transform

#: Seconds of the stamp of message 0: a time long ago, but none that anybody takes for "unset".
EPOCH_S = 1_000_000_000

_DIGITS = 10
_ROS_SECONDS = struct.Struct("<i")  # behind the encapsulation, 4 bytes: the first field of every header
_ROS_TEXT_AT = 8  # encapsulation, length of the text
_IGTL_SECONDS = struct.Struct(">I")
_IGTL_STAMP_AT = 34
_IGTL_TEXT_AT = HEADER_SIZE + 4  # encoding, length of the text
_CDR_AT = 4

#: Makes the message of a sequence number.
Make = Callable[[int], Buffer]
#: The sequence number of a message.
Number = Callable[[Buffer], int]


@dataclass(frozen=True, slots=True)
class Payload:
    """What one kind of message is on both sides.

    Attributes:
        ros_type: ``"pkg/msg/Name"``.
        kind: last token of the topic that the gateway publishes it on.
        igtl_type: type name on the wire.
        ros: makes the ROS message.
        content: makes the content of the OpenIGTLink message.
        text: the number is at the beginning of the text, not in the stamp.
    """

    ros_type: str
    kind: str
    igtl_type: str
    ros: Callable[[rosmsg.Header], rosmsg.RosMessage]
    content: Callable[[], Body]
    text: bool = False

    def ros_maker(self) -> Callable[[int], bytes]:
        """Makes ROS messages: the same bytes again and again with another number, so each is to be sent before the
        next is made."""
        cdr = self.ros(rosmsg.Header(EPOCH_S * NS_PER_S, "Base")).pack()
        if self.text:
            return _patched(cdr, _ROS_TEXT_AT, _digits)
        return _patched(cdr, _CDR_AT, lambda number: _ROS_SECONDS.pack(EPOCH_S + number))

    def igtl_maker(self, device: str) -> Make:
        """Makes OpenIGTLink messages, as ``ros_maker`` does."""
        if self.text:
            rest = _text(self.content())[_DIGITS:]

            def of_text(number: int) -> Buffer:
                return join(encode(Message(self.igtl_type, device, String(_digits(number) + rest))))

            return of_text
        data = bytearray(join(encode(Message(self.igtl_type, device, self.content()))))

        def of_stamp(number: int) -> Buffer:
            _IGTL_SECONDS.pack_into(data, _IGTL_STAMP_AT, EPOCH_S + number)
            return data

        return of_stamp

    def ros_number(self, cdr: Buffer) -> int:
        """The sequence number of a ROS message."""
        if self.text:
            return int(bytes(cdr[_ROS_TEXT_AT : _ROS_TEXT_AT + _DIGITS]))
        return int(_ROS_SECONDS.unpack_from(cdr, _CDR_AT)[0]) - EPOCH_S

    def igtl_number(self, frame: Buffer) -> int:
        """The sequence number of an OpenIGTLink message."""
        if self.text:
            return int(bytes(frame[_IGTL_TEXT_AT : _IGTL_TEXT_AT + _DIGITS]))
        return int(_IGTL_SECONDS.unpack_from(frame, _IGTL_STAMP_AT)[0]) - EPOCH_S


def transform() -> Payload:
    """A pose that is no identity."""
    cos, sin = math.cos(0.3), math.sin(0.3)
    half = (0.0, 0.0, math.sin(0.15), math.cos(0.15))
    rows = [[cos, -sin, 0.0, 10.0], [sin, cos, 0.0, -20.0], [0.0, 0.0, 1.0, 30.5]]
    return Payload(
        rosmsg.TransformStamped.TYPE,
        "transform",
        "TRANSFORM",
        lambda header: rosmsg.TransformStamped(header, "Tool", (0.01, -0.02, 0.0305), half),
        lambda: Transform.from_rows(rows),
    )


def string(length: int) -> Payload:
    """A text of so many bytes."""
    text = "0" * _DIGITS + "." * (length - _DIGITS)
    return Payload(
        rosmsg.String.TYPE,
        "string",
        "STRING",
        lambda _header: rosmsg.String(text),
        lambda: String(text.encode()),
        text=True,
    )


def points(count: int) -> Payload:
    """Landmarks: POINT, 136 bytes each; a cloud on the side of ROS."""
    xyz = _positions(count)
    return Payload(
        rosmsg.PointCloud2.TYPE,
        "points",
        "POINT",
        lambda header: _cloud(header, xyz / 1000),
        lambda: Points.of(xyz),
    )


def cloud(count: int) -> Payload:
    """A cloud of float32 coordinates: PointCloud2 and POLYDATA, 12 bytes a point on both sides."""
    xyz = _positions(count)
    return Payload(
        rosmsg.PointCloud2.TYPE,
        "points",
        "POLYDATA",
        lambda header: _cloud(header, xyz / 1000),
        lambda: PolyData(xyz.astype(">f4")),
    )


def surface(count: int, triangles: int) -> Payload:
    """A surface of so many points: igtl_msgs/PolyData (float64) and POLYDATA (float32)."""
    xyz = _positions(count)
    cells = np.empty((triangles, 4), np.uint32)
    cells[:, 0] = 3
    cells[:, 1:] = np.arange(3 * triangles, dtype=np.uint32).reshape(-1, 3) % count
    return Payload(
        igtl_msgs.PolyData.TYPE,
        "polydata",
        "POLYDATA",
        lambda header: igtl_msgs.PolyData(header, xyz.astype(np.float64) / 1000, polygons=cells.reshape(-1)),
        lambda: PolyData(xyz.astype(">f4"), polygons=Cells(triangles, cells.reshape(-1).astype(">u4"))),
    )


def image(width: int, height: int) -> Payload:
    """An RGB picture of noise."""
    pixels = (np.arange(width * height * 3, dtype=np.uint32) * np.uint32(2_654_435_761) >> np.uint32(24)).astype("u1")
    data = pixels.tobytes()
    return Payload(
        rosmsg.Image.TYPE,
        "image",
        "IMAGE",
        lambda header: rosmsg.Image(header, height, width, "rgb8", 0, 3 * width, data),
        lambda: Image((width, height, 1), 3, data, 3),
    )


def _cloud(header: rosmsg.Header, xyz: npt.NDArray[np.float64]) -> rosmsg.PointCloud2:
    fields = tuple(rosmsg.PointField(name, 4 * axis, 7, 1) for axis, name in enumerate("xyz"))
    data = xyz.astype("<f4").tobytes()
    return rosmsg.PointCloud2(header, 1, len(xyz), fields, False, 12, len(data), data, True)


def _positions(count: int) -> npt.NDArray[np.float64]:
    """A helix of ``count`` points, in millimetres."""
    at = np.arange(count)
    return np.stack([30 * np.cos(at / 16), 30 * np.sin(at / 16), at / 20], axis=1)


def _digits(number: int) -> bytes:
    return b"%010d" % number


def _text(content: Body) -> bytes:
    assert isinstance(content, String)
    return content.data


def _patched(data: bytes, at: int, pack: Callable[[int], bytes]) -> Callable[[int], bytes]:
    # rclpy takes nothing but bytes.  A copy of an image for each number would cost as much as sending it, so the
    # number is written into the one object, which nobody else has: rclpy has copied it when ``publish`` returns.
    address = ctypes.cast(ctypes.c_char_p(data), ctypes.c_void_p).value
    assert address is not None
    place = address + at

    def make(number: int) -> bytes:
        part = pack(number)
        ctypes.memmove(place, part, len(part))
        return data

    return make
