"""Type names and the codecs of their contents.  The content of a type that is not here is carried as ``Raw``."""

from __future__ import annotations

from typing import Any

from igtl_gateway.base.errors import WireError
from igtl_gateway.wire.bind import Bind, BindChild
from igtl_gateway.wire.body import Body, Raw
from igtl_gateway.wire.capability import Capability
from igtl_gateway.wire.client_info import ClientInfo
from igtl_gateway.wire.colort import ColorTable
from igtl_gateway.wire.command import Command
from igtl_gateway.wire.fields import visible
from igtl_gateway.wire.image import Image
from igtl_gateway.wire.metalists import ImageMetaList, LabelMetaList, VideoMetaList
from igtl_gateway.wire.ndarray import NdArray
from igtl_gateway.wire.point import Points
from igtl_gateway.wire.polydata import PolyData
from igtl_gateway.wire.query import QUERIES, QUERY_ALIASES
from igtl_gateway.wire.sensor import Sensor
from igtl_gateway.wire.text import Status, String
from igtl_gateway.wire.tracking import QuaternionTrackingData, TrackingData
from igtl_gateway.wire.traits import traits_of
from igtl_gateway.wire.trajectory import Trajectories
from igtl_gateway.wire.transform import Position, Transform
from igtl_gateway.wire.video import Video

BODIES: dict[str, type[Body]] = {
    "TRANSFORM": Transform,
    "POSITION": Position,
    "QTRANS": Position,
    "STRING": String,
    "STATUS": Status,
    "POINT": Points,
    "POLYDATA": PolyData,
    "IMAGE": Image,
    "TDATA": TrackingData,
    "QTDATA": QuaternionTrackingData,
    "TRAJ": Trajectories,
    "IMGMETA": ImageMetaList,
    "LBMETA": LabelMetaList,
    "VIDEOMETA": VideoMetaList,
    "SENSOR": Sensor,
    "NDARRAY": NdArray,
    "COLORT": ColorTable,
    "COLORTABLE": ColorTable,
    "CAPABILITY": Capability,
    "CAPABIL": Capability,
    "VIDEO": Video,
    "BIND": Bind,
    "CLIENTINFO": ClientInfo,
    "COMMAND": Command,
    "RTS_COMMAND": Command,
    **QUERIES,
}

#: Names that are accepted and never sent → the type that they mean.
ALIASES = {
    "QTRANS": "POSITION",  # the documents' new name
    "COLORTABLE": "COLORT",  # in a test of the C library
    "CAPABIL": "CAPABILITY",  # the tail of the query's name
    **QUERY_ALIASES,
}

#: Types whose content is pixels, points or cells.
BULKY = frozenset(name for name, content in BODIES.items() if traits_of(content).is_bulky)


def read_content(type_name: str, content: memoryview) -> Body:
    """Decode the content of a message of a type.  Raises TruncatedMessage or MalformedBody."""
    codec = BODIES.get(visible(type_name), Raw)  # C++ readers stop at the first NUL, too
    if not content.nbytes and not getattr(codec, "MAY_BE_EMPTY", False):
        codec = Raw  # peers send an empty body where they have no data (BrainLab images, refused queries)
    return codec.unpack(content)


def read_child(child: BindChild) -> Body:
    """Decode the content of a child, which may be a BIND.  Raises TruncatedMessage or MalformedBody."""
    return read_content(child.type, memoryview(child.content))


def describe_content(content: Body) -> dict[str, Any]:
    """Return a content as JSON values; of a BIND with the contents of its children, or their errors."""
    shown = content.describe()
    if isinstance(content, Bind):
        for child, row in zip(content.children, shown["children"], strict=True):
            try:
                row["content"] = describe_content(read_child(child))
            except WireError as error:
                row["error"] = {"code": error.code, "text": str(error)}
    return shown
