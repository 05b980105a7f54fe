"""Methods of generated message classes that are written by hand, because these messages are many.

``tools/messages.py`` names the class in the row of its message.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from igtl_gateway.base.stamp import ns_to_ros
from igtl_gateway.base.versions import Self
from igtl_gateway.convert.cdr import CdrReader, CdrWriter, stamped_pose
from igtl_gateway.convert.rosmsg import Header
from igtl_gateway.convert.structs import Point, Pose, Rgba, Struct, fixed_array

_RGBA = fixed_array("uint8", 4)
_ONE = (1).to_bytes(4, "little")  # a sequence of one element


class PointMethods(Struct):
    """Of LabeledPoint: digitised surfaces have thousands of points."""

    __slots__ = ()
    if TYPE_CHECKING:
        name: str
        group: str
        rgba: Rgba
        position: Point
        diameter: float
        owner: str

    def write(self, out: CdrWriter) -> None:
        out.string(self.name)
        out.string(self.group)
        _RGBA.write(out, self.rgba)
        out.f64s(*self.position, self.diameter)
        out.string(self.owner)

    @classmethod
    def read(cls, cdr: CdrReader) -> Self:
        name, group, rgba = cdr.string(), cdr.string(), cdr.unpack("4B", 1)
        x, y, z, diameter = cdr.unpack("4d", 8)
        return cls(name, group, rgba, (x, y, z), diameter, cdr.string())  # type: ignore[call-arg]


class TransformMethods(Struct):
    """Of FrameTransform: trackers send poses at high rates."""

    __slots__ = ()
    if TYPE_CHECKING:
        header: Header
        child_frame_id: str
        pose: Pose

    def write(self, out: CdrWriter) -> None:
        self.header.write(out)
        out.string(self.child_frame_id)
        out.f64s(*self.pose)


class TfMethods(Struct):
    """Of TFMessage, which has one transform almost always."""

    __slots__ = ()
    if TYPE_CHECKING:
        transforms: tuple[TransformMethods, ...]

    def pack(self) -> bytes:
        if len(self.transforms) != 1:
            return Struct.pack(self)
        (one,) = self.transforms
        stamp = ns_to_ros(one.header.stamp_ns)
        return stamped_pose(_ONE, stamp, one.header.frame_id, one.child_frame_id, one.pose)
