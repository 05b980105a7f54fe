"""visualization_msgs/msg/MarkerArray: only the drawn fields are read."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from igtl_gateway.addon import Self
from igtl_gateway.addon.messages import CdrReader
from igtl_gateway.addon.reading import Buffer
from igtl_gateway.addon.ros import Marker


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
    """Read the next marker of several, including what comes after its text."""
    marker = Marker.read(read)
    read.string()  # mesh_resource, then mesh_file
    read.string()
    read.octets()
    read.bool()  # mesh_use_embedded_materials
    return marker
