"""The messages of our own package ``igtl_msgs`` as values; ``ros2/igtl_msgs/msg`` has the definitions.

Field by field in the order of the definitions; a test holds both against each other.  Lengths are in metres,
stamps in UTC ns (0 = unset), poses are (x, y, z, qx, qy, qz, qw).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, ClassVar, Self

import numpy as np
import numpy.typing as npt

from igtl_gateway.buffers import Buffer
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
    """igtl_msgs/msg/MetadataItem; encoding 0 is chosen on the way out."""

    TYPE: ClassVar[str] = "igtl_msgs/msg/MetadataItem"
    FIELDS: ClassVar[tuple[CdrType, ...]] = (STRING, UINT16, STRING)
    key: str
    encoding: int
    value: str


Items = tuple[MetadataItem, ...]
_ITEMS = sequence_of(MetadataItem)


@dataclass(frozen=True, slots=True)
class Metadata(Struct):
    """igtl_msgs/msg/Metadata."""

    TYPE: ClassVar[str] = "igtl_msgs/msg/Metadata"
    FIELDS: ClassVar[tuple[CdrType, ...]] = (HEADER, STRING, STRING, UINT32, _ITEMS)
    header: Header
    type: str
    device_name: str
    message_id: int
    items: Items


@dataclass(frozen=True, slots=True)
class TrackedTool(Struct):
    """igtl_msgs/msg/TrackedTool."""

    TYPE: ClassVar[str] = "igtl_msgs/msg/TrackedTool"
    FIELDS: ClassVar[tuple[CdrType, ...]] = (STRING, UINT8, POSE)
    name: str
    type: int
    pose: Pose


@dataclass(frozen=True, slots=True)
class TrackingData(Struct):
    """igtl_msgs/msg/TrackingData."""

    TYPE: ClassVar[str] = "igtl_msgs/msg/TrackingData"
    FIELDS: ClassVar[tuple[CdrType, ...]] = (HEADER, sequence_of(TrackedTool), _ITEMS)
    header: Header
    tools: tuple[TrackedTool, ...]
    metadata: Items = ()


@dataclass(frozen=True, slots=True)
class Trajectory(Struct):
    """igtl_msgs/msg/Trajectory."""

    TYPE: ClassVar[str] = "igtl_msgs/msg/Trajectory"
    FIELDS: ClassVar[tuple[CdrType, ...]] = (STRING, STRING, UINT8, _RGBA, POINT, POINT, FLOAT64, STRING)
    name: str
    group: str
    type: int
    rgba: Rgba
    entry: Point
    target: Point
    diameter: float
    owner: str


@dataclass(frozen=True, slots=True)
class TrajectoryList(Struct):
    """igtl_msgs/msg/TrajectoryList."""

    TYPE: ClassVar[str] = "igtl_msgs/msg/TrajectoryList"
    FIELDS: ClassVar[tuple[CdrType, ...]] = (HEADER, sequence_of(Trajectory), _ITEMS)
    header: Header
    trajectories: tuple[Trajectory, ...]
    metadata: Items = ()


@dataclass(frozen=True, slots=True)
class LabeledPoint(Struct):
    """igtl_msgs/msg/LabeledPoint."""

    TYPE: ClassVar[str] = "igtl_msgs/msg/LabeledPoint"
    FIELDS: ClassVar[tuple[CdrType, ...]] = (STRING, STRING, _RGBA, POINT, FLOAT64, STRING)
    name: str
    group: str
    rgba: Rgba
    position: Point
    diameter: float
    owner: str

    def write(self, out: CdrWriter) -> None:
        """Written out, as ``read``: points come by the thousands where surfaces are digitised."""
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
    FIELDS: ClassVar[tuple[CdrType, ...]] = (HEADER, sequence_of(LabeledPoint), _ITEMS)
    header: Header
    points: tuple[LabeledPoint, ...]
    metadata: Items = ()


@dataclass(frozen=True, slots=True)
class Sensor(Struct):
    """igtl_msgs/msg/Sensor: values (n,) float64."""

    TYPE: ClassVar[str] = "igtl_msgs/msg/Sensor"
    FIELDS: ClassVar[tuple[CdrType, ...]] = (HEADER, UINT8, UINT64, STRING, number_sequence("float64"), _ITEMS)
    header: Header
    status: int
    unit: int
    unit_text: str
    values: Array
    metadata: Items = ()


@dataclass(frozen=True, slots=True)
class NdArray(Struct):
    """igtl_msgs/msg/NdArray."""

    TYPE: ClassVar[str] = "igtl_msgs/msg/NdArray"
    FIELDS: ClassVar[tuple[CdrType, ...]] = (HEADER, UINT8, number_sequence("uint16"), BOOL, OCTETS, _ITEMS)
    header: Header
    scalar_type: int
    size: Array
    is_bigendian: bool
    data: Buffer
    metadata: Items = ()


@dataclass(frozen=True, slots=True)
class ColorTable(Struct):
    """igtl_msgs/msg/ColorTable."""

    TYPE: ClassVar[str] = "igtl_msgs/msg/ColorTable"
    FIELDS: ClassVar[tuple[CdrType, ...]] = (HEADER, UINT8, UINT8, BOOL, OCTETS, _ITEMS)
    header: Header
    index_type: int
    map_type: int
    is_bigendian: bool
    table: Buffer
    metadata: Items = ()


@dataclass(frozen=True, slots=True)
class ImageMeta(Struct):
    """igtl_msgs/msg/ImageMeta."""

    TYPE: ClassVar[str] = "igtl_msgs/msg/ImageMeta"
    FIELDS: ClassVar[tuple[CdrType, ...]] = (STRING, STRING, STRING, STRING, STRING, TIME, _SIZE, UINT8)
    name: str
    device_name: str
    modality: str
    patient_name: str
    patient_id: str
    scan_time_ns: int
    size: Size
    scalar_type: int


@dataclass(frozen=True, slots=True)
class ImageMetaList(Struct):
    """igtl_msgs/msg/ImageMetaList."""

    TYPE: ClassVar[str] = "igtl_msgs/msg/ImageMetaList"
    FIELDS: ClassVar[tuple[CdrType, ...]] = (HEADER, sequence_of(ImageMeta), _ITEMS)
    header: Header
    images: tuple[ImageMeta, ...]
    metadata: Items = ()


@dataclass(frozen=True, slots=True)
class LabelMeta(Struct):
    """igtl_msgs/msg/LabelMeta."""

    TYPE: ClassVar[str] = "igtl_msgs/msg/LabelMeta"
    FIELDS: ClassVar[tuple[CdrType, ...]] = (STRING, STRING, UINT8, _RGBA, _SIZE, STRING)
    name: str
    device_name: str
    label: int
    rgba: Rgba
    size: Size
    owner: str


@dataclass(frozen=True, slots=True)
class LabelMetaList(Struct):
    """igtl_msgs/msg/LabelMetaList."""

    TYPE: ClassVar[str] = "igtl_msgs/msg/LabelMetaList"
    FIELDS: ClassVar[tuple[CdrType, ...]] = (HEADER, sequence_of(LabelMeta), _ITEMS)
    header: Header
    labels: tuple[LabelMeta, ...]
    metadata: Items = ()


@dataclass(frozen=True, slots=True)
class VideoMeta(Struct):
    """igtl_msgs/msg/VideoMeta; direction column by column."""

    TYPE: ClassVar[str] = "igtl_msgs/msg/VideoMeta"
    FIELDS: ClassVar[tuple[CdrType, ...]] = (
        *(STRING, STRING, STRING, STRING, INT16, FLOAT64, _SIZE),
        *(fixed_array("float64", 9), fixed_array("float64", 3), POINT, UINT8),
    )
    name: str
    device_name: str
    patient_name: str
    patient_id: str
    zoom_level: int
    focal_length: float
    size: Size
    direction: tuple[float, ...]
    spacing: Point
    center: Point
    scalar_type: int


@dataclass(frozen=True, slots=True)
class VideoMetaList(Struct):
    """igtl_msgs/msg/VideoMetaList."""

    TYPE: ClassVar[str] = "igtl_msgs/msg/VideoMetaList"
    FIELDS: ClassVar[tuple[CdrType, ...]] = (HEADER, sequence_of(VideoMeta), _ITEMS)
    header: Header
    videos: tuple[VideoMeta, ...]
    metadata: Items = ()


@dataclass(frozen=True, slots=True)
class Capability(Struct):
    """igtl_msgs/msg/Capability."""

    TYPE: ClassVar[str] = "igtl_msgs/msg/Capability"
    FIELDS: ClassVar[tuple[CdrType, ...]] = (HEADER, sequence_of(STRING), _ITEMS)
    header: Header
    types: tuple[str, ...]
    metadata: Items = ()


@dataclass(frozen=True, slots=True)
class BoundMessage(Struct):
    """igtl_msgs/msg/BoundMessage."""

    TYPE: ClassVar[str] = "igtl_msgs/msg/BoundMessage"
    FIELDS: ClassVar[tuple[CdrType, ...]] = (STRING, STRING, OCTETS)
    type: str
    name: str
    content: Buffer


@dataclass(frozen=True, slots=True)
class Bind(Struct):
    """igtl_msgs/msg/Bind."""

    TYPE: ClassVar[str] = "igtl_msgs/msg/Bind"
    FIELDS: ClassVar[tuple[CdrType, ...]] = (HEADER, sequence_of(BoundMessage), _ITEMS)
    header: Header
    children: tuple[BoundMessage, ...]
    metadata: Items = ()


@dataclass(frozen=True, slots=True)
class Command(Struct):
    """igtl_msgs/msg/Command; timeout in seconds."""

    TYPE: ClassVar[str] = "igtl_msgs/msg/Command"
    FIELDS: ClassVar[tuple[CdrType, ...]] = (HEADER, STRING, UINT32, STRING, UINT16, STRING, _ITEMS, UINT32, FLOAT64)
    header: Header
    device_name: str
    id: int
    name: str
    encoding: int
    content: str
    metadata: Items = ()
    link: int = 0
    timeout: float = 0.0


@dataclass(frozen=True, slots=True)
class CommandReply(Struct):
    """igtl_msgs/msg/CommandReply."""

    TYPE: ClassVar[str] = "igtl_msgs/msg/CommandReply"
    FIELDS: ClassVar[tuple[CdrType, ...]] = (
        *(HEADER, STRING, UINT32, STRING, UINT8, STRING, UINT16, STRING, _ITEMS, UINT32),
    )
    SUCCESS: ClassVar[int] = 1
    FAIL: ClassVar[int] = 2
    TIMEOUT: ClassVar[int] = 3
    NO_PEER: ClassVar[int] = 4
    header: Header
    device_name: str
    id: int
    name: str
    status: int
    error_message: str = ""
    encoding: int = 0
    content: str = ""
    metadata: Items = ()
    link: int = 0


@dataclass(frozen=True, slots=True)
class Volume(Struct):
    """igtl_msgs/msg/Volume; direction column by column."""

    TYPE: ClassVar[str] = "igtl_msgs/msg/Volume"
    FIELDS: ClassVar[tuple[CdrType, ...]] = (
        *(HEADER, _SIZE, UINT8, UINT8, BOOL, UINT8),
        *(fixed_array("float64", 9), fixed_array("float64", 3), POINT, OCTETS, _ITEMS),
    )
    header: Header
    size: Size
    scalar_type: int
    components: int
    is_bigendian: bool
    coordinate_system: int
    direction: tuple[float, ...]
    spacing: Point
    origin: Point
    data: Buffer
    metadata: Items = ()


@dataclass(frozen=True, slots=True)
class PolyDataAttribute(Struct):
    """igtl_msgs/msg/PolyDataAttribute: values (n,) float32."""

    TYPE: ClassVar[str] = "igtl_msgs/msg/PolyDataAttribute"
    FIELDS: ClassVar[tuple[CdrType, ...]] = (STRING, UINT8, UINT8, number_sequence("float32"))
    name: str
    type: int
    components: int
    values: Array


@dataclass(frozen=True, slots=True)
class PolyData(Struct):
    """igtl_msgs/msg/PolyData: points (n, 3) float64, cell arrays (m,) uint32 of counts and indices."""

    TYPE: ClassVar[str] = "igtl_msgs/msg/PolyData"
    FIELDS: ClassVar[tuple[CdrType, ...]] = (
        *(
            HEADER,
            POINTS,
            number_sequence("uint32"),
            number_sequence("uint32"),
            number_sequence("uint32"),
            number_sequence("uint32"),
        ),
        *(sequence_of(PolyDataAttribute), _ITEMS),
    )
    header: Header
    points: Array
    vertices: Array = field(default_factory=lambda: np.empty(0, np.uint32))
    lines: Array = field(default_factory=lambda: np.empty(0, np.uint32))
    polygons: Array = field(default_factory=lambda: np.empty(0, np.uint32))
    triangle_strips: Array = field(default_factory=lambda: np.empty(0, np.uint32))
    attributes: tuple[PolyDataAttribute, ...] = ()
    metadata: Items = ()


@dataclass(frozen=True, slots=True)
class VideoFrame(Struct):
    """igtl_msgs/msg/VideoFrame; direction column by column."""

    TYPE: ClassVar[str] = "igtl_msgs/msg/VideoFrame"
    FIELDS: ClassVar[tuple[CdrType, ...]] = (
        *(HEADER, STRING, UINT16, BOOL, _SIZE, _SIZE, _SIZE, UINT8),
        *(fixed_array("float64", 9), fixed_array("float64", 3), POINT, OCTETS, _ITEMS),
    )
    header: Header
    codec: str
    frame_type: int
    is_bigendian: bool
    size: Size
    offset: Size
    part_size: Size
    coordinate_system: int
    direction: tuple[float, ...]
    spacing: Point
    center: Point
    data: Buffer
    metadata: Items = ()


@dataclass(frozen=True, slots=True)
class Query(Struct):
    """igtl_msgs/msg/Query; resolution in milliseconds."""

    TYPE: ClassVar[str] = "igtl_msgs/msg/Query"
    FIELDS: ClassVar[tuple[CdrType, ...]] = (
        *(HEADER, UINT8, STRING, STRING, UINT32, STRING, STRING, UINT8, UINT32, _ITEMS),
    )
    GET: ClassVar[int] = 1
    START: ClassVar[int] = 2
    STOP: ClassVar[int] = 3
    REPLY: ClassVar[int] = 4
    header: Header
    kind: int
    type: str
    device_name: str = ""
    resolution: int = 0
    coordinate_name: str = ""
    codec: str = ""
    status: int = 0
    link: int = 0
    metadata: Items = ()


@dataclass(frozen=True, slots=True)
class LinkStatus(Struct):
    """igtl_msgs/msg/LinkStatus."""

    TYPE: ClassVar[str] = "igtl_msgs/msg/LinkStatus"
    FIELDS: ClassVar[tuple[CdrType, ...]] = (UINT32, BOOL, STRING, STRING, STRING, UINT8)
    link: int
    connected: bool
    peer: str
    role: str
    profile: str
    header_version: int


@dataclass(frozen=True, slots=True)
class LinkStatusList(Struct):
    """igtl_msgs/msg/LinkStatusList."""

    TYPE: ClassVar[str] = "igtl_msgs/msg/LinkStatusList"
    FIELDS: ClassVar[tuple[CdrType, ...]] = (HEADER, sequence_of(LinkStatus))
    header: Header
    links: tuple[LinkStatus, ...]


@dataclass(frozen=True, slots=True)
class RawMessage(Struct):
    """igtl_msgs/msg/RawMessage: one whole OpenIGTLink message."""

    TYPE: ClassVar[str] = "igtl_msgs/msg/RawMessage"
    FIELDS: ClassVar[tuple[CdrType, ...]] = (
        *(TIME, TIME, UINT64, UINT8, number_sequence("uint32"), STRING, STRING, OCTETS),
    )
    DIRECTION_IN: ClassVar[int] = 0
    DIRECTION_OUT: ClassVar[int] = 1
    stamp_ns: int
    source_stamp_ns: int
    source_ticks: int
    direction: int
    links: Array
    type: str
    device_name: str
    data: Buffer
