"""The most frequent ROS 2 messages as frozen values with ``pack`` (to CDR) and ``unpack`` (from CDR).

``pack`` and ``unpack`` process the fields in the order of the message definitions of ROS 2 Jazzy.  Arrays are numpy
views on the received bytes.  The module uses neither rclpy nor rosbags, so equal messages always give equal bytes.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any, ClassVar, Protocol

import numpy as np
import numpy.typing as npt

from igtl_gateway.base.buffers import Buffer
from igtl_gateway.base.stamp import ns_to_ros, ros_to_ns
from igtl_gateway.base.versions import Self
from igtl_gateway.convert.cdr import CdrReader, CdrWriter, stamped_pose

Array = npt.NDArray[Any]

_STAMP = struct.Struct("<iI")
_SIZE = struct.Struct("<II")
_ENCAPSULATION_SIZE = 4


class RosMessage(Protocol):
    """The interface of all ROS message classes."""

    TYPE: ClassVar[str]

    def pack(self) -> bytes: ...

    @classmethod
    def unpack(cls, cdr: Buffer) -> Self: ...


@dataclass(frozen=True, slots=True)
class Header:
    """std_msgs/msg/Header: stamp in UTC ns (0 = unset) and frame id."""

    stamp_ns: int = 0
    frame_id: str = ""

    def write(self, out: CdrWriter) -> None:
        out.pack(_STAMP, 4, *ns_to_ros(self.stamp_ns))
        out.string(self.frame_id)

    @classmethod
    def read(cls, cdr: CdrReader) -> Header:
        return cls(ros_to_ns(*cdr.unpack("iI", 4)), cdr.string())


@dataclass(frozen=True, slots=True)
class String:
    """std_msgs/msg/String."""

    TYPE: ClassVar[str] = "std_msgs/msg/String"
    data: str

    def pack(self) -> bytes:
        out = CdrWriter()
        out.string(self.data)
        return out.finish()

    @classmethod
    def unpack(cls, cdr: Buffer) -> Self:
        return cls(CdrReader(cdr, cls.TYPE).string())


@dataclass(frozen=True, slots=True)
class TransformStamped:
    """geometry_msgs/msg/TransformStamped: translation in metres, rotation as quaternion x, y, z, w."""

    TYPE: ClassVar[str] = "geometry_msgs/msg/TransformStamped"
    header: Header
    child_frame_id: str
    translation: tuple[float, float, float]
    rotation: tuple[float, float, float, float]

    def pack(self) -> bytes:
        header = self.header
        pose = (*self.translation, *self.rotation)
        return stamped_pose(b"", ns_to_ros(header.stamp_ns), header.frame_id, self.child_frame_id, pose)

    @classmethod
    def unpack(cls, cdr: Buffer) -> Self:
        return cls.read(CdrReader(cdr, cls.TYPE))

    @classmethod
    def read(cls, read: CdrReader) -> Self:
        """Read all fields."""
        header, child = Header.read(read), read.string()
        values = read.unpack("7d", 8)
        return cls(header, child, values[:3], values[3:])


@dataclass(frozen=True, slots=True)
class PointStamped:
    """geometry_msgs/msg/PointStamped: metres."""

    TYPE: ClassVar[str] = "geometry_msgs/msg/PointStamped"
    header: Header
    point: tuple[float, float, float]

    def pack(self) -> bytes:
        out = CdrWriter()
        self.header.write(out)
        out.f64s(*self.point)
        return out.finish()

    @classmethod
    def unpack(cls, cdr: Buffer) -> Self:
        read = CdrReader(cdr, cls.TYPE)
        header = Header.read(read)
        return cls(header, read.unpack("3d", 8))


@dataclass(frozen=True, slots=True)
class Image:
    """sensor_msgs/msg/Image: ``step`` is the size of a row in bytes, ``data`` has step · height bytes."""

    TYPE: ClassVar[str] = "sensor_msgs/msg/Image"
    header: Header
    height: int
    width: int
    encoding: str
    is_bigendian: int
    step: int
    data: Buffer

    def pack(self) -> bytes:
        out = CdrWriter()
        self.header.write(out)
        out.pack(_SIZE, 4, self.height, self.width)
        out.string(self.encoding)
        out.u8(self.is_bigendian)
        out.u32(self.step)
        out.octets(self.data)
        return out.finish()

    @classmethod
    def unpack(cls, cdr: Buffer) -> Self:
        read = CdrReader(cdr, cls.TYPE)
        header = Header.read(read)
        height, width = read.unpack("II", 4)
        return cls(header, height, width, read.string(), read.u8(), read.u32(), read.octets())


#: sensor_msgs/msg/PointField datatype → numpy type without byte order.
POINT_FIELD_DTYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}


@dataclass(frozen=True, slots=True)
class PointField:
    """sensor_msgs/msg/PointField: offset in bytes, datatype as in POINT_FIELD_DTYPES."""

    name: str
    offset: int
    datatype: int
    count: int = 1


@dataclass(frozen=True, slots=True)
class PointCloud2:
    """sensor_msgs/msg/PointCloud2: height · width points of ``point_step`` bytes, rows of ``row_step`` bytes."""

    TYPE: ClassVar[str] = "sensor_msgs/msg/PointCloud2"
    header: Header
    height: int
    width: int
    fields: tuple[PointField, ...]
    is_bigendian: bool
    point_step: int
    row_step: int
    data: Buffer
    is_dense: bool

    def pack(self) -> bytes:
        out = CdrWriter()
        self.header.write(out)
        layout, described = _described(self.fields, self.is_bigendian, self.point_step)
        out.pack(layout, 4, self.height, self.width, described, self.row_step)
        out.octets(self.data)
        out.bool(self.is_dense)
        return out.finish()

    @classmethod
    def unpack(cls, cdr: Buffer) -> Self:
        read = CdrReader(cdr, cls.TYPE)
        header = Header.read(read)
        height, width = read.unpack("II", 4)
        fields = tuple([_field(bytes(read.octets()), *read.unpack("IB3xI", 4)) for _ in range(read.count())])
        is_bigendian, point_step, row_step = read.unpack("?3xII", 4)
        return cls(header, height, width, fields, is_bigendian, point_step, row_step, read.octets(), read.bool())


@lru_cache(maxsize=256)
def _field(name: bytes, offset: int, datatype: int, count: int) -> PointField:
    """Return a field of a cloud; cached, because all clouds of a stream have the same fields."""
    return PointField(name.rstrip(b"\x00").decode("utf-8", "surrogateescape"), offset, datatype, count)


@lru_cache(maxsize=64)
def _described(fields: tuple[PointField, ...], is_bigendian: bool, point_step: int) -> tuple[struct.Struct, bytes]:
    """Return the layout from height to row_step, and the CDR bytes of fields, is_bigendian and point_step.

    The bytes are for an offset that is a multiple of 4.
    """
    out = CdrWriter()
    out.u32(len(fields))
    for item in fields:
        out.string(item.name)
        out.u32(item.offset)
        out.u8(item.datatype)
        out.u32(item.count)
    out.bool(is_bigendian)
    out.u32(point_step)
    data = out.finish()[_ENCAPSULATION_SIZE:]
    return struct.Struct(f"<II{len(data)}sI"), data


@dataclass(frozen=True, slots=True)
class Mesh:
    """shape_msgs/msg/Mesh: triangles (n, 3) uint32, vertices (m, 3) float64 in metres.  No header."""

    TYPE: ClassVar[str] = "shape_msgs/msg/Mesh"
    triangles: Array
    vertices: Array

    def pack(self) -> bytes:
        out = CdrWriter()
        out.sequence(np.asarray(self.triangles, np.uint32), 4, len(self.triangles))
        out.sequence(np.asarray(self.vertices, np.float64), 8, len(self.vertices))
        return out.finish()

    @classmethod
    def unpack(cls, cdr: Buffer) -> Self:
        read = CdrReader(cdr, cls.TYPE)
        return cls(read.sequence("u4", 3, 4).reshape(-1, 3), read.sequence("f8", 3, 8).reshape(-1, 3))


@dataclass(frozen=True, slots=True)
class Marker:
    """visualization_msgs/msg/Marker: points (n, 3) float64 in metres, colors (0 or n, 4) float32 RGBA 0…1.

    ``unpack`` skips the texture and mesh fields, which the gateway does not use.
    """

    TYPE: ClassVar[str] = "visualization_msgs/msg/Marker"
    LINE_STRIP: ClassVar[int] = 4
    LINE_LIST: ClassVar[int] = 5
    SPHERE_LIST: ClassVar[int] = 7
    POINTS: ClassVar[int] = 8
    TRIANGLE_LIST: ClassVar[int] = 11

    header: Header
    ns: str
    id: int
    type: int
    action: int = 0
    position: tuple[float, float, float] = (0.0, 0.0, 0.0)
    orientation: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 1.0)
    scale: tuple[float, float, float] = (1.0, 1.0, 1.0)
    color: tuple[float, float, float, float] = (1.0, 1.0, 1.0, 1.0)
    points: Array = field(default_factory=lambda: np.empty((0, 3)))
    colors: Array = field(default_factory=lambda: np.empty((0, 4), np.float32))
    text: str = ""

    def pack(self) -> bytes:
        out = CdrWriter()
        self.header.write(out)
        out.string(self.ns)
        out.i32(self.id)
        out.i32(self.type)
        out.i32(self.action)
        out.f64s(*self.position, *self.orientation, *self.scale)
        out.pack(_RGBA, 4, *self.color)
        out.pack(_STAMP, 4, 0, 0)  # lifetime: unlimited
        out.bool(False)  # frame_locked
        out.sequence(np.asarray(self.points, np.float64), 8, len(self.points))
        out.sequence(np.asarray(self.colors, np.float32), 4, len(self.colors))
        out.string("")  # texture_resource
        Header().write(out)  # texture: sensor_msgs/CompressedImage
        out.string("")
        out.octets(b"")
        out.u32(0)  # uv_coordinates
        out.string(self.text)
        out.string("")  # mesh_resource
        out.string("")  # mesh_file: filename, data
        out.octets(b"")
        out.bool(False)  # mesh_use_embedded_materials
        return out.finish()

    @classmethod
    def unpack(cls, cdr: Buffer) -> Self:
        return cls.read(CdrReader(cdr, cls.TYPE))

    @classmethod
    def read(cls, read: CdrReader) -> Self:
        """Read up to ``text``."""
        header, ns = Header.read(read), read.string()
        marker_id, kind, action = read.i32(), read.i32(), read.i32()
        pose = read.unpack("10d", 8)
        color = read.unpack("4f", 4)
        read.unpack("iI", 4)
        read.bool()
        points = read.sequence("f8", 3, 8).reshape(-1, 3)
        colors = read.sequence("f4", 4, 4).reshape(-1, 4)
        read.string()
        Header.read(read)
        read.string()
        read.octets()
        read.sequence("f4", 2, 4)
        text = read.string()
        return cls(header, ns, marker_id, kind, action, pose[:3], pose[3:7], pose[7:], color, points, colors, text)


_RGBA = struct.Struct("<4f")


@dataclass(frozen=True, slots=True)
class DiagnosticStatus:
    """diagnostic_msgs/msg/DiagnosticStatus: level 0 OK, 1 WARN, 2 ERROR, 3 STALE; values are pairs of key and value."""

    TYPE: ClassVar[str] = "diagnostic_msgs/msg/DiagnosticStatus"
    level: int
    name: str
    message: str
    hardware_id: str = ""
    values: tuple[tuple[str, str], ...] = ()

    def write(self, out: CdrWriter) -> None:
        out.u8(self.level)
        out.string(self.name)
        out.string(self.message)
        out.string(self.hardware_id)
        out.u32(len(self.values))
        for key, value in self.values:
            out.string(key)
            out.string(value)

    @classmethod
    def read(cls, cdr: CdrReader) -> Self:
        level, name, message, hardware = cdr.u8(), cdr.string(), cdr.string(), cdr.string()
        return cls(level, name, message, hardware, tuple((cdr.string(), cdr.string()) for _ in range(cdr.count())))

    def pack(self) -> bytes:
        out = CdrWriter()
        self.write(out)
        return out.finish()

    @classmethod
    def unpack(cls, cdr: Buffer) -> Self:
        return cls.read(CdrReader(cdr, cls.TYPE))
