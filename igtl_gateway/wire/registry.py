"""Which type name has which content codec.  A type that is not here is carried as ``Raw``."""

from __future__ import annotations

from igtl_gateway.wire.body import Body
from igtl_gateway.wire.image import Image
from igtl_gateway.wire.point import Points
from igtl_gateway.wire.polydata import PolyData
from igtl_gateway.wire.text import Status, String
from igtl_gateway.wire.transform import Position, Transform

BODIES: dict[str, type[Body]] = {
    "TRANSFORM": Transform,
    "POSITION": Position,
    "QTRANS": Position,  # the documents' new name of POSITION; accepted, never sent
    "STRING": String,
    "STATUS": Status,
    "POINT": Points,
    "POLYDATA": PolyData,
    "IMAGE": Image,
}
