"""Messages of the common ROS packages as values; ``rosmsg`` has those that are written by hand for speed.

The fields have the order of the definitions of ROS 2 Jazzy.  Lengths are in metres, stamps in UTC ns, poses are
(x, y, z, qx, qy, qz, qw).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated, Any, ClassVar

import numpy as np
import numpy.typing as npt

from igtl_gateway.base.buffers import Buffer
from igtl_gateway.base.stamp import ns_to_ros
from igtl_gateway.convert.cdr import CdrReader, CdrWriter, stamped_pose
from igtl_gateway.convert.igtl_msgs import HEADER, Pose
from igtl_gateway.convert.rosmsg import DiagnosticStatus, Header
from igtl_gateway.convert.structs import (
    BOOL,
    OCTETS,
    POSE,
    STRING,
    TIME,
    UINT32,
    CdrType,
    Struct,
    fixed_array,
    number_sequence,
    sequence_of,
    struct_of,
)

Array = npt.NDArray[Any]

_ONE = (1).to_bytes(4, "little")  # a sequence of one element


def _nothing() -> Array:
    return np.empty(0)


@dataclass(frozen=True, slots=True)
class PoseStamped(Struct):
    """geometry_msgs/msg/PoseStamped."""

    TYPE: ClassVar[str] = "geometry_msgs/msg/PoseStamped"
    header: Annotated[Header, HEADER]
    pose: Annotated[Pose, POSE]


@dataclass(frozen=True, slots=True)
class PoseArray(Struct):
    """geometry_msgs/msg/PoseArray: poses (n, 7) float64."""

    TYPE: ClassVar[str] = "geometry_msgs/msg/PoseArray"
    header: Annotated[Header, HEADER]
    poses: Annotated[Array, number_sequence("float64", 7, as_name="geometry_msgs/Pose[]")]


@dataclass(frozen=True, slots=True)
class FrameTransform(Struct):
    """geometry_msgs/msg/TransformStamped inside a TFMessage; the transform is the pose of the child in the parent."""

    TYPE: ClassVar[str] = "geometry_msgs/msg/TransformStamped"
    header: Annotated[Header, HEADER]
    child_frame_id: Annotated[str, STRING]
    pose: Annotated[Pose, POSE]

    def write(self, out: CdrWriter) -> None:
        """Append the fields; written by hand, because trackers send poses at high rates."""
        self.header.write(out)
        out.string(self.child_frame_id)
        out.f64s(*self.pose)


@dataclass(frozen=True, slots=True)
class TFMessage(Struct):
    """tf2_msgs/msg/TFMessage: the type of /tf and /tf_static."""

    TYPE: ClassVar[str] = "tf2_msgs/msg/TFMessage"
    transforms: Annotated[tuple[FrameTransform, ...], sequence_of(FrameTransform)]

    def pack(self) -> bytes:
        if len(self.transforms) != 1:
            return Struct.pack(self)
        (one,) = self.transforms
        stamp = ns_to_ros(one.header.stamp_ns)
        return stamped_pose(_ONE, stamp, one.header.frame_id, one.child_frame_id, one.pose)


@dataclass(frozen=True, slots=True)
class JointState(Struct):
    """sensor_msgs/msg/JointState: radians or metres, per second, newton metres or newtons."""

    TYPE: ClassVar[str] = "sensor_msgs/msg/JointState"
    header: Annotated[Header, HEADER]
    name: Annotated[tuple[str, ...], sequence_of(STRING)]
    position: Annotated[Array, number_sequence("float64")] = field(default_factory=_nothing)
    velocity: Annotated[Array, number_sequence("float64")] = field(default_factory=_nothing)
    effort: Annotated[Array, number_sequence("float64")] = field(default_factory=_nothing)


@dataclass(frozen=True, slots=True)
class RegionOfInterest(Struct):
    """sensor_msgs/msg/RegionOfInterest: pixels; all 0 = the whole image."""

    TYPE: ClassVar[str] = "sensor_msgs/msg/RegionOfInterest"
    x_offset: Annotated[int, UINT32] = 0
    y_offset: Annotated[int, UINT32] = 0
    height: Annotated[int, UINT32] = 0
    width: Annotated[int, UINT32] = 0
    do_rectify: Annotated[bool, BOOL] = False


@dataclass(frozen=True, slots=True)
class CameraInfo(Struct):
    """sensor_msgs/msg/CameraInfo: distortion d, intrinsics k (3 x 3), rectification r (3 x 3), projection p (3 x 4)."""

    TYPE: ClassVar[str] = "sensor_msgs/msg/CameraInfo"
    header: Annotated[Header, HEADER]
    height: Annotated[int, UINT32]
    width: Annotated[int, UINT32]
    distortion_model: Annotated[str, STRING]
    d: Annotated[Array, number_sequence("float64")]
    k: Annotated[tuple[float, ...], fixed_array("float64", 9)]
    r: Annotated[tuple[float, ...], fixed_array("float64", 9)]
    p: Annotated[tuple[float, ...], fixed_array("float64", 12)]
    binning_x: Annotated[int, UINT32] = 0
    binning_y: Annotated[int, UINT32] = 0
    roi: Annotated[RegionOfInterest, struct_of(RegionOfInterest)] = RegionOfInterest()


@dataclass(frozen=True, slots=True)
class CompressedImage(Struct):
    """sensor_msgs/msg/CompressedImage."""

    TYPE: ClassVar[str] = "sensor_msgs/msg/CompressedImage"
    header: Annotated[Header, HEADER]
    format: Annotated[str, STRING]
    data: Annotated[Buffer, OCTETS]


@dataclass(frozen=True, slots=True)
class CompressedVideo(Struct):
    """foxglove_msgs/msg/CompressedVideo: one frame; format h264, h265, vp9 or av1."""

    TYPE: ClassVar[str] = "foxglove_msgs/msg/CompressedVideo"
    timestamp_ns: Annotated[int, TIME]
    frame_id: Annotated[str, STRING]
    data: Annotated[Buffer, OCTETS]
    format: Annotated[str, STRING]


@dataclass(frozen=True, slots=True)
class MultiArrayDimension(Struct):
    """std_msgs/msg/MultiArrayDimension: stride counts elements from this dimension inwards."""

    TYPE: ClassVar[str] = "std_msgs/msg/MultiArrayDimension"
    label: Annotated[str, STRING]
    size: Annotated[int, UINT32]
    stride: Annotated[int, UINT32]


@dataclass(frozen=True, slots=True)
class MultiArrayLayout(Struct):
    """std_msgs/msg/MultiArrayLayout: outermost dimension first."""

    TYPE: ClassVar[str] = "std_msgs/msg/MultiArrayLayout"
    dim: Annotated[tuple[MultiArrayDimension, ...], sequence_of(MultiArrayDimension)] = ()
    data_offset: Annotated[int, UINT32] = 0


@dataclass(frozen=True, slots=True)
class MultiArray(Struct):
    """Base of the classes in ``MULTI_ARRAYS``."""

    layout: MultiArrayLayout
    data: Array


def _multi_array(name: str, number: str) -> type[MultiArray]:
    kind = type(name, (MultiArray,), {"__slots__": (), "__doc__": f"std_msgs/msg/{name}: data (n,) {number}."})
    kind.TYPE = f"std_msgs/msg/{name}"  # type: ignore[attr-defined]
    kind.FIELDS = (struct_of(MultiArrayLayout), number_sequence(number))  # type: ignore[attr-defined]
    return kind


#: numpy type → class of std_msgs that holds such an array: Int8MultiArray … Float64MultiArray.
MULTI_ARRAYS: dict[str, type[MultiArray]] = {
    np.dtype(number).str[1:]: _multi_array(f"{name}MultiArray", number)
    for name, number in (
        *(("Int8", "int8"), ("UInt8", "uint8"), ("Int16", "int16"), ("UInt16", "uint16")),
        *(("Int32", "int32"), ("UInt32", "uint32"), ("Float32", "float32"), ("Float64", "float64")),
    )
}


def _write_status(out: CdrWriter, status: DiagnosticStatus) -> None:
    out.u8(status.level)
    for text in (status.name, status.message, status.hardware_id):
        out.string(text)
    out.u32(len(status.values))
    for pair in status.values:
        for text in pair:
            out.string(text)


def _read_status(read: CdrReader) -> DiagnosticStatus:
    level, name, message, hardware = read.u8(), read.string(), read.string(), read.string()
    return DiagnosticStatus(
        level, name, message, hardware, tuple((read.string(), read.string()) for _ in range(read.count()))
    )


@dataclass(frozen=True, slots=True)
class DiagnosticArray(Struct):
    """diagnostic_msgs/msg/DiagnosticArray."""

    TYPE: ClassVar[str] = "diagnostic_msgs/msg/DiagnosticArray"
    header: Annotated[Header, HEADER]
    status: Annotated[
        tuple[DiagnosticStatus, ...],
        sequence_of(CdrType("diagnostic_msgs/DiagnosticStatus", _write_status, _read_status)),
    ]
