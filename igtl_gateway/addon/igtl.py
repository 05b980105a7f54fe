"""OpenIGTLink messages, for add-ons: bytes ⇄ ``Message``, and a class for each type of content."""

from __future__ import annotations

from igtl_gateway.base.stamp import ns_to_ticks
from igtl_gateway.wire import HEADER_SIZE, Header, Item, Message, Raw, decode, describe, encode
from igtl_gateway.wire.bind import Bind, BindChild
from igtl_gateway.wire.body import Body
from igtl_gateway.wire.capability import Capability
from igtl_gateway.wire.colort import ColorTable
from igtl_gateway.wire.command import NAME_WIDTH as COMMAND_NAME_WIDTH
from igtl_gateway.wire.command import Command
from igtl_gateway.wire.elements import Elements
from igtl_gateway.wire.fields import cut_text, decode_text, visible
from igtl_gateway.wire.framer import Framer
from igtl_gateway.wire.header import DEVICE_NAME_AT, HEADER_VERSIONS, READING, crc64
from igtl_gateway.wire.image import BIG_ENDIAN, LITTLE_ENDIAN, LPS, SCALARS, Image
from igtl_gateway.wire.message import ExtendedHeader, sorted_items
from igtl_gateway.wire.ndarray import NDARRAY_SCALARS, NdArray
from igtl_gateway.wire.point import Points
from igtl_gateway.wire.polydata import CELL, NORMAL, Attribute, Cells, PolyData
from igtl_gateway.wire.query import (
    EmptyQuery,
    GetBind,
    QueryReply,
    StartBind,
    StartPolyData,
    StartTracking,
    StartVideo,
    is_dialogue,
)
from igtl_gateway.wire.registry import BODIES, BULKY, describe_content, read_content
from igtl_gateway.wire.sensor import Sensor, parse_unit
from igtl_gateway.wire.text import Status, String
from igtl_gateway.wire.trajectory import ENTRY_AND_TARGET, ENTRY_ONLY, TARGET_ONLY, Trajectories
from igtl_gateway.wire.transform import Position, Transform
from igtl_gateway.wire.video import Video

__all__ = [
    "BIG_ENDIAN",
    "BODIES",
    "BULKY",
    "CELL",
    "COMMAND_NAME_WIDTH",
    "DEVICE_NAME_AT",
    "ENTRY_AND_TARGET",
    "ENTRY_ONLY",
    "HEADER_SIZE",
    "HEADER_VERSIONS",
    "LITTLE_ENDIAN",
    "LPS",
    "NDARRAY_SCALARS",
    "NORMAL",
    "READING",
    "SCALARS",
    "TARGET_ONLY",
    "Attribute",
    "Bind",
    "BindChild",
    "Body",
    "Capability",
    "Cells",
    "ColorTable",
    "Command",
    "Elements",
    "EmptyQuery",
    "ExtendedHeader",
    "Framer",
    "GetBind",
    "Header",
    "Image",
    "Item",
    "Message",
    "NdArray",
    "Points",
    "PolyData",
    "Position",
    "QueryReply",
    "Raw",
    "Sensor",
    "StartBind",
    "StartPolyData",
    "StartTracking",
    "StartVideo",
    "Status",
    "String",
    "Trajectories",
    "Transform",
    "Video",
    "crc64",
    "cut_text",
    "decode",
    "decode_text",
    "describe",
    "describe_content",
    "encode",
    "is_dialogue",
    "ns_to_ticks",
    "parse_unit",
    "read_content",
    "sorted_items",
    "visible",
]
