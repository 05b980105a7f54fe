"""The messages of the package ``igtl_msgs`` as values; ``ros2/igtl_msgs/msg`` has the definitions.

The fields have the order of the definitions; a test compares both.  Lengths are in metres, stamps in UTC ns (0 =
unset), poses are (x, y, z, qx, qy, qz, qw).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated, Any, ClassVar, Self

import numpy as np
import numpy.typing as npt

from igtl_gateway.base.buffers import Buffer
from igtl_gateway.convert.cdr import CdrReader, CdrWriter
from igtl_gateway.convert.rosmsg import Header
from igtl_gateway.convert.structs import (
    BOOL,
    FLOAT64,
    INT16,
    OCTETS,
    POINT,
    POINTS,
    POSE,
    STRING,
    TIME,
    UINT8,
    UINT16,
    UINT32,
    UINT64,
    CdrType,
    Struct,
    fixed_array,
    number_sequence,
    sequence_of,
)

HEADER = CdrType("std_msgs/Header", lambda out, header: header.write(out), Header.read)
_SIZE = fixed_array("uint16", 3)
_RGBA = fixed_array("uint8", 4)

Array = npt.NDArray[Any]
Point = tuple[float, float, float]
Pose = tuple[float, float, float, float, float, float, float]
Size = tuple[int, int, int]
Rgba = tuple[int, int, int, int]

IDENTITY = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)


@dataclass(frozen=True, slots=True)
class MetadataItem(Struct):
    """igtl_msgs/msg/MetadataItem; encoding 0: the gateway chooses one."""

    TYPE: ClassVar[str] = "igtl_msgs/msg/MetadataItem"
    key: Annotated[str, STRING]
    encoding: Annotated[int, UINT16]
    value: Annotated[str, STRING]


Items = tuple[MetadataItem, ...]
_ITEMS = sequence_of(MetadataItem)


@dataclass(frozen=True, slots=True)
class Metadata(Struct):
    """igtl_msgs/msg/Metadata."""

    TYPE: ClassVar[str] = "igtl_msgs/msg/Metadata"
    header: Annotated[Header, HEADER]
    type: Annotated[str, STRING]
    device_name: Annotated[str, STRING]
    message_id: Annotated[int, UINT32]
    items: Annotated[Items, _ITEMS]


@dataclass(frozen=True, slots=True)
class TrackedTool(Struct):
    """igtl_msgs/msg/TrackedTool."""

    TYPE: ClassVar[str] = "igtl_msgs/msg/TrackedTool"
    name: Annotated[str, STRING]
    type: Annotated[int, UINT8]
    pose: Annotated[Pose, POSE]


@dataclass(frozen=True, slots=True)
class TrackingData(Struct):
    """igtl_msgs/msg/TrackingData."""

    TYPE: ClassVar[str] = "igtl_msgs/msg/TrackingData"
    header: Annotated[Header, HEADER]
    tools: Annotated[tuple[TrackedTool, ...], sequence_of(TrackedTool)]
    metadata: Annotated[Items, _ITEMS] = ()


@dataclass(frozen=True, slots=True)
class Trajectory(Struct):
    """igtl_msgs/msg/Trajectory."""

    TYPE: ClassVar[str] = "igtl_msgs/msg/Trajectory"
    name: Annotated[str, STRING]
    group: Annotated[str, STRING]
    type: Annotated[int, UINT8]
    rgba: Annotated[Rgba, _RGBA]
    entry: Annotated[Point, POINT]
    target: Annotated[Point, POINT]
    diameter: Annotated[float, FLOAT64]
    owner: Annotated[str, STRING]


@dataclass(frozen=True, slots=True)
class TrajectoryList(Struct):
    """igtl_msgs/msg/TrajectoryList."""

    TYPE: ClassVar[str] = "igtl_msgs/msg/TrajectoryList"
    header: Annotated[Header, HEADER]
    trajectories: Annotated[tuple[Trajectory, ...], sequence_of(Trajectory)]
    metadata: Annotated[Items, _ITEMS] = ()


@dataclass(frozen=True, slots=True)
class LabeledPoint(Struct):
    """igtl_msgs/msg/LabeledPoint."""

    TYPE: ClassVar[str] = "igtl_msgs/msg/LabeledPoint"
    name: Annotated[str, STRING]
    group: Annotated[str, STRING]
    rgba: Annotated[Rgba, _RGBA]
    position: Annotated[Point, POINT]
    diameter: Annotated[float, FLOAT64]
    owner: Annotated[str, STRING]

    def write(self, out: CdrWriter) -> None:
        """Append the fields; written by hand, like ``read``, because digitised surfaces have thousands of points."""
        out.string(self.name)
        out.string(self.group)
        _RGBA.write(out, self.rgba)
        out.f64s(*self.position, self.diameter)
        out.string(self.owner)

    @classmethod
    def read(cls, cdr: CdrReader) -> Self:
        name, group, rgba = cdr.string(), cdr.string(), cdr.unpack("4B", 1)
        x, y, z, diameter = cdr.unpack("4d", 8)
        return cls(name, group, rgba, (x, y, z), diameter, cdr.string())


@dataclass(frozen=True, slots=True)
class PointList(Struct):
    """igtl_msgs/msg/PointList."""

    TYPE: ClassVar[str] = "igtl_msgs/msg/PointList"
    header: Annotated[Header, HEADER]
    points: Annotated[tuple[LabeledPoint, ...], sequence_of(LabeledPoint)]
    metadata: Annotated[Items, _ITEMS] = ()


@dataclass(frozen=True, slots=True)
class Sensor(Struct):
    """igtl_msgs/msg/Sensor: values (n,) float64."""

    TYPE: ClassVar[str] = "igtl_msgs/msg/Sensor"
    header: Annotated[Header, HEADER]
    status: Annotated[int, UINT8]
    unit: Annotated[int, UINT64]
    unit_text: Annotated[str, STRING]
    values: Annotated[Array, number_sequence("float64")]
    metadata: Annotated[Items, _ITEMS] = ()


@dataclass(frozen=True, slots=True)
class NdArray(Struct):
    """igtl_msgs/msg/NdArray."""

    TYPE: ClassVar[str] = "igtl_msgs/msg/NdArray"
    header: Annotated[Header, HEADER]
    scalar_type: Annotated[int, UINT8]
    size: Annotated[Array, number_sequence("uint16")]
    is_bigendian: Annotated[bool, BOOL]
    data: Annotated[Buffer, OCTETS]
    metadata: Annotated[Items, _ITEMS] = ()


@dataclass(frozen=True, slots=True)
class ColorTable(Struct):
    """igtl_msgs/msg/ColorTable."""

    TYPE: ClassVar[str] = "igtl_msgs/msg/ColorTable"
    header: Annotated[Header, HEADER]
    index_type: Annotated[int, UINT8]
    map_type: Annotated[int, UINT8]
    is_bigendian: Annotated[bool, BOOL]
    table: Annotated[Buffer, OCTETS]
    metadata: Annotated[Items, _ITEMS] = ()


@dataclass(frozen=True, slots=True)
class ImageMeta(Struct):
    """igtl_msgs/msg/ImageMeta."""

    TYPE: ClassVar[str] = "igtl_msgs/msg/ImageMeta"
    name: Annotated[str, STRING]
    device_name: Annotated[str, STRING]
    modality: Annotated[str, STRING]
    patient_name: Annotated[str, STRING]
    patient_id: Annotated[str, STRING]
    scan_time_ns: Annotated[int, TIME]
    size: Annotated[Size, _SIZE]
    scalar_type: Annotated[int, UINT8]


@dataclass(frozen=True, slots=True)
class ImageMetaList(Struct):
    """igtl_msgs/msg/ImageMetaList."""

    TYPE: ClassVar[str] = "igtl_msgs/msg/ImageMetaList"
    header: Annotated[Header, HEADER]
    images: Annotated[tuple[ImageMeta, ...], sequence_of(ImageMeta)]
    metadata: Annotated[Items, _ITEMS] = ()


@dataclass(frozen=True, slots=True)
class LabelMeta(Struct):
    """igtl_msgs/msg/LabelMeta."""

    TYPE: ClassVar[str] = "igtl_msgs/msg/LabelMeta"
    name: Annotated[str, STRING]
    device_name: Annotated[str, STRING]
    label: Annotated[int, UINT8]
    rgba: Annotated[Rgba, _RGBA]
    size: Annotated[Size, _SIZE]
    owner: Annotated[str, STRING]


@dataclass(frozen=True, slots=True)
class LabelMetaList(Struct):
    """igtl_msgs/msg/LabelMetaList."""

    TYPE: ClassVar[str] = "igtl_msgs/msg/LabelMetaList"
    header: Annotated[Header, HEADER]
    labels: Annotated[tuple[LabelMeta, ...], sequence_of(LabelMeta)]
    metadata: Annotated[Items, _ITEMS] = ()


@dataclass(frozen=True, slots=True)
class VideoMeta(Struct):
    """igtl_msgs/msg/VideoMeta; direction column by column."""

    TYPE: ClassVar[str] = "igtl_msgs/msg/VideoMeta"
    name: Annotated[str, STRING]
    device_name: Annotated[str, STRING]
    patient_name: Annotated[str, STRING]
    patient_id: Annotated[str, STRING]
    zoom_level: Annotated[int, INT16]
    focal_length: Annotated[float, FLOAT64]
    size: Annotated[Size, _SIZE]
    direction: Annotated[tuple[float, ...], fixed_array("float64", 9)]
    spacing: Annotated[Point, fixed_array("float64", 3)]
    center: Annotated[Point, POINT]
    scalar_type: Annotated[int, UINT8]


@dataclass(frozen=True, slots=True)
class VideoMetaList(Struct):
    """igtl_msgs/msg/VideoMetaList."""

    TYPE: ClassVar[str] = "igtl_msgs/msg/VideoMetaList"
    header: Annotated[Header, HEADER]
    videos: Annotated[tuple[VideoMeta, ...], sequence_of(VideoMeta)]
    metadata: Annotated[Items, _ITEMS] = ()


@dataclass(frozen=True, slots=True)
class Capability(Struct):
    """igtl_msgs/msg/Capability."""

    TYPE: ClassVar[str] = "igtl_msgs/msg/Capability"
    header: Annotated[Header, HEADER]
    types: Annotated[tuple[str, ...], sequence_of(STRING)]
    metadata: Annotated[Items, _ITEMS] = ()


@dataclass(frozen=True, slots=True)
class BoundMessage(Struct):
    """igtl_msgs/msg/BoundMessage."""

    TYPE: ClassVar[str] = "igtl_msgs/msg/BoundMessage"
    type: Annotated[str, STRING]
    name: Annotated[str, STRING]
    content: Annotated[Buffer, OCTETS]


@dataclass(frozen=True, slots=True)
class Bind(Struct):
    """igtl_msgs/msg/Bind."""

    TYPE: ClassVar[str] = "igtl_msgs/msg/Bind"
    header: Annotated[Header, HEADER]
    children: Annotated[tuple[BoundMessage, ...], sequence_of(BoundMessage)]
    metadata: Annotated[Items, _ITEMS] = ()


@dataclass(frozen=True, slots=True)
class Command(Struct):
    """igtl_msgs/msg/Command; timeout in seconds."""

    TYPE: ClassVar[str] = "igtl_msgs/msg/Command"
    header: Annotated[Header, HEADER]
    device_name: Annotated[str, STRING]
    id: Annotated[int, UINT32]
    name: Annotated[str, STRING]
    encoding: Annotated[int, UINT16]
    content: Annotated[str, STRING]
    metadata: Annotated[Items, _ITEMS] = ()
    link: Annotated[int, UINT32] = 0
    timeout: Annotated[float, FLOAT64] = 0.0


@dataclass(frozen=True, slots=True)
class CommandReply(Struct):
    """igtl_msgs/msg/CommandReply."""

    TYPE: ClassVar[str] = "igtl_msgs/msg/CommandReply"
    SUCCESS: ClassVar[int] = 1
    FAIL: ClassVar[int] = 2
    TIMEOUT: ClassVar[int] = 3
    NO_PEER: ClassVar[int] = 4
    header: Annotated[Header, HEADER]
    device_name: Annotated[str, STRING]
    id: Annotated[int, UINT32]
    name: Annotated[str, STRING]
    status: Annotated[int, UINT8]
    error_message: Annotated[str, STRING] = ""
    encoding: Annotated[int, UINT16] = 0
    content: Annotated[str, STRING] = ""
    metadata: Annotated[Items, _ITEMS] = ()
    link: Annotated[int, UINT32] = 0


@dataclass(frozen=True, slots=True)
class Volume(Struct):
    """igtl_msgs/msg/Volume; direction column by column."""

    TYPE: ClassVar[str] = "igtl_msgs/msg/Volume"
    header: Annotated[Header, HEADER]
    size: Annotated[Size, _SIZE]
    scalar_type: Annotated[int, UINT8]
    components: Annotated[int, UINT8]
    is_bigendian: Annotated[bool, BOOL]
    coordinate_system: Annotated[int, UINT8]
    direction: Annotated[tuple[float, ...], fixed_array("float64", 9)]
    spacing: Annotated[Point, fixed_array("float64", 3)]
    origin: Annotated[Point, POINT]
    data: Annotated[Buffer, OCTETS]
    metadata: Annotated[Items, _ITEMS] = ()


@dataclass(frozen=True, slots=True)
class PolyDataAttribute(Struct):
    """igtl_msgs/msg/PolyDataAttribute: values (n,) float32."""

    TYPE: ClassVar[str] = "igtl_msgs/msg/PolyDataAttribute"
    name: Annotated[str, STRING]
    type: Annotated[int, UINT8]
    components: Annotated[int, UINT8]
    values: Annotated[Array, number_sequence("float32")]


@dataclass(frozen=True, slots=True)
class PolyData(Struct):
    """igtl_msgs/msg/PolyData: points (n, 3) float64, cell arrays (m,) uint32 of counts and indices."""

    TYPE: ClassVar[str] = "igtl_msgs/msg/PolyData"
    header: Annotated[Header, HEADER]
    points: Annotated[Array, POINTS]
    vertices: Annotated[Array, number_sequence("uint32")] = field(default_factory=lambda: np.empty(0, np.uint32))
    lines: Annotated[Array, number_sequence("uint32")] = field(default_factory=lambda: np.empty(0, np.uint32))
    polygons: Annotated[Array, number_sequence("uint32")] = field(default_factory=lambda: np.empty(0, np.uint32))
    triangle_strips: Annotated[Array, number_sequence("uint32")] = field(default_factory=lambda: np.empty(0, np.uint32))
    attributes: Annotated[tuple[PolyDataAttribute, ...], sequence_of(PolyDataAttribute)] = ()
    metadata: Annotated[Items, _ITEMS] = ()


@dataclass(frozen=True, slots=True)
class VideoFrame(Struct):
    """igtl_msgs/msg/VideoFrame; direction column by column."""

    TYPE: ClassVar[str] = "igtl_msgs/msg/VideoFrame"
    header: Annotated[Header, HEADER]
    codec: Annotated[str, STRING]
    frame_type: Annotated[int, UINT16]
    is_bigendian: Annotated[bool, BOOL]
    size: Annotated[Size, _SIZE]
    offset: Annotated[Size, _SIZE]
    part_size: Annotated[Size, _SIZE]
    coordinate_system: Annotated[int, UINT8]
    direction: Annotated[tuple[float, ...], fixed_array("float64", 9)]
    spacing: Annotated[Point, fixed_array("float64", 3)]
    center: Annotated[Point, POINT]
    data: Annotated[Buffer, OCTETS]
    metadata: Annotated[Items, _ITEMS] = ()


@dataclass(frozen=True, slots=True)
class Query(Struct):
    """igtl_msgs/msg/Query; resolution in milliseconds."""

    TYPE: ClassVar[str] = "igtl_msgs/msg/Query"
    GET: ClassVar[int] = 1
    START: ClassVar[int] = 2
    STOP: ClassVar[int] = 3
    REPLY: ClassVar[int] = 4
    header: Annotated[Header, HEADER]
    kind: Annotated[int, UINT8]
    type: Annotated[str, STRING]
    device_name: Annotated[str, STRING] = ""
    resolution: Annotated[int, UINT32] = 0
    coordinate_name: Annotated[str, STRING] = ""
    codec: Annotated[str, STRING] = ""
    status: Annotated[int, UINT8] = 0
    link: Annotated[int, UINT32] = 0
    metadata: Annotated[Items, _ITEMS] = ()


@dataclass(frozen=True, slots=True)
class LinkStatus(Struct):
    """igtl_msgs/msg/LinkStatus."""

    TYPE: ClassVar[str] = "igtl_msgs/msg/LinkStatus"
    link: Annotated[int, UINT32]
    connected: Annotated[bool, BOOL]
    peer: Annotated[str, STRING]
    role: Annotated[str, STRING]
    profile: Annotated[str, STRING]
    header_version: Annotated[int, UINT8]


@dataclass(frozen=True, slots=True)
class LinkStatusList(Struct):
    """igtl_msgs/msg/LinkStatusList."""

    TYPE: ClassVar[str] = "igtl_msgs/msg/LinkStatusList"
    header: Annotated[Header, HEADER]
    links: Annotated[tuple[LinkStatus, ...], sequence_of(LinkStatus)]


@dataclass(frozen=True, slots=True)
class RawMessage(Struct):
    """igtl_msgs/msg/RawMessage: one whole OpenIGTLink message."""

    TYPE: ClassVar[str] = "igtl_msgs/msg/RawMessage"
    DIRECTION_IN: ClassVar[int] = 0
    DIRECTION_OUT: ClassVar[int] = 1
    stamp_ns: Annotated[int, TIME]
    source_stamp_ns: Annotated[int, TIME]
    source_ticks: Annotated[int, UINT64]
    direction: Annotated[int, UINT8]
    links: Annotated[Array, number_sequence("uint32")]
    type: Annotated[str, STRING]
    device_name: Annotated[str, STRING]
    data: Annotated[Buffer, OCTETS]
