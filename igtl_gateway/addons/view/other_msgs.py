"""Messages that the gateway does not convert but the viewer draws: only the drawn fields are read."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, Self

import numpy.typing as npt

from igtl_gateway.addon import Buffer
from igtl_gateway.convert.cdr import CdrReader
from igtl_gateway.convert.common_msgs import PoseStamped
from igtl_gateway.convert.igtl_msgs import HEADER
from igtl_gateway.convert.rosmsg import Header, Marker
from igtl_gateway.convert.structs import (
    FLOAT64,
    STRING,
    TIME,
    UINT8,
    UINT32,
    Struct,
    fixed_array,
    number_sequence,
    sequence_of,
)

Array = npt.NDArray[Any]


@dataclass(frozen=True, slots=True)
class Path(Struct):
    """nav_msgs/msg/Path."""

    TYPE: ClassVar[str] = "nav_msgs/msg/Path"
    header: Annotated[Header, HEADER]
    poses: Annotated[tuple[PoseStamped, ...], sequence_of(PoseStamped)]


@dataclass(frozen=True, slots=True)
class Float64(Struct):
    """std_msgs/msg/Float64."""

    TYPE: ClassVar[str] = "std_msgs/msg/Float64"
    data: Annotated[float, FLOAT64]


@dataclass(frozen=True, slots=True)
class Log(Struct):
    """rcl_interfaces/msg/Log, the log messages of nodes on /rosout; file, function and line are not read."""

    TYPE: ClassVar[str] = "rcl_interfaces/msg/Log"
    stamp_ns: Annotated[int, TIME]
    level: Annotated[int, UINT8]
    name: Annotated[str, STRING]
    msg: Annotated[str, STRING]


@dataclass(frozen=True, slots=True)
class CameraInfo(Struct):
    """sensor_msgs/msg/CameraInfo; binning and region of interest are not read."""

    TYPE: ClassVar[str] = "sensor_msgs/msg/CameraInfo"
    header: Annotated[Header, HEADER]
    height: Annotated[int, UINT32]
    width: Annotated[int, UINT32]
    distortion_model: Annotated[str, STRING]
    d: Annotated[Array, number_sequence("float64")]
    k: Annotated[tuple[float, ...], fixed_array("float64", 9)]


@dataclass(frozen=True, slots=True)
class MarkerArray:
    """visualization_msgs/msg/MarkerArray."""

    TYPE: ClassVar[str] = "visualization_msgs/msg/MarkerArray"
    markers: tuple[Marker, ...]

    @classmethod
    def unpack(cls, cdr: Buffer) -> Self:
        """Unpack CDR bytes.  Raises ConversionError."""
        read = CdrReader(cdr, cls.TYPE)
        return cls(tuple(_marker(read) for _ in range(read.count())))


def _marker(read: CdrReader) -> Marker:
    """Read the next marker of several: as ``Marker.unpack``, but including the fields that are not drawn."""
    header, ns = Header.read(read), read.string()
    marker_id, kind, action = read.unpack("iii", 4)
    pose, color = read.unpack("10d", 8), read.unpack("4f", 4)
    read.unpack("iI", 4)  # lifetime
    read.bool()  # frame_locked
    points = read.sequence("f8", 3, 8).reshape(-1, 3)
    colors = read.sequence("f4", 4, 4).reshape(-1, 4)
    read.string()  # texture_resource, then the texture itself
    Header.read(read)
    read.string()
    read.octets()
    read.sequence("f4", 2, 4)  # uv_coordinates
    text = read.string()
    read.string()  # mesh_resource, then mesh_file
    read.string()
    read.octets()
    read.bool()  # mesh_use_embedded_materials
    return Marker(header, ns, marker_id, kind, action, pose[:3], pose[3:7], pose[7:], color, points, colors, text)
