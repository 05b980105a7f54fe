"""Metadata of header version 2: what the gateway writes, and how it reads that back.

Four keys belong to the gateway.  All others belong to the users and are forwarded unchanged.
"""

from __future__ import annotations

from collections.abc import Iterable

from igtl_gateway.base.untrusted.numbers import whole_number
from igtl_gateway.base.values import value
from igtl_gateway.config.configuration import NAMING
from igtl_gateway.convert.igtl_msgs import MetadataItem
from igtl_gateway.convert.names import AS_PLUS, MAX_DEVICE_NAME, short_device_name
from igtl_gateway.wire import Item, Message
from igtl_gateway.wire.fields import decode_text, visible
from igtl_gateway.wire.message import sorted_items
from igtl_gateway.wire.text import CODECS, US_ASCII, UTF_8

#: Full device name, if it does not fit into the 20 bytes of the header.
FULL_NAME = "DeviceName"
#: Name of the node in 3D Slicer, which cuts the device name to 20 bytes; see ``openigtlink-reference`` §10.2.
NODE_NAME = "MRMLNodeName"
#: Name of a pose of PLUS, which cuts the device name to 20 bytes (``vtkPlusIgtlMessageCommon`` of PlusLib 112a7f3).
PLUS_NAME = "IGTL_DEVICE_NAME"
#: Stamp of the ROS header, integer UTC nanoseconds: also forwarded by programs that leave the header's stamp at 0.
#: To programs that show no other stamp, that of the message if ROS has none.
STAMP = "ros.stamp"
FRAME_ID = "ros.frame_id"
CHILD_FRAME_ID = "ros.child_frame_id"

OURS = frozenset({FULL_NAME, STAMP, FRAME_ID, CHILD_FRAME_ID})

#: UTC ns in the year 2106, where the time stamps of OpenIGTLink end.
_MAX_STAMP_NS = (1 << 32) * 1_000_000_000


@value(frozen=True, slots=True)
class RestoredMetadata:
    """The contents of the metadata of a received message.

    Attributes:
        device_name: full device name of the stream.
        stamp_ns: UTC ns; 0 if there is none.
        frame_id, child_frame_id: "" if there are none.
        items: the items of the user.
        states_name: whether its sender states the full name where it has cut it: a gateway, 3D Slicer or PLUS.
    """

    device_name: str
    stamp_ns: int = 0
    frame_id: str = ""
    child_frame_id: str = ""
    items: tuple[MetadataItem, ...] = ()
    states_name: bool = False


def restore_metadata(message: Message, naming: int = NAMING) -> RestoredMetadata:
    """Read the metadata of a message; items that the gateway would write differently count as the user's.

    Args:
        message: the message.
        naming: rules of names; from 1 on, names that 3D Slicer has cut are read from its metadata, from 2 on those of
            PLUS.
    """
    name = visible(message.device_name)
    if not message.metadata:
        return RestoredMetadata(name)
    ours: dict[str, str] = {}
    items = []
    for item in message.metadata:
        if item.key in OURS and item.key not in ours and _is_valid(item, message.device_name):
            ours[item.key] = item.text
        else:
            items.append(_decoded_value(item))
    keys = (NODE_NAME, PLUS_NAME) if naming >= AS_PLUS else (NODE_NAME,) if naming else ()
    whole = _whole_name(message, keys)
    return RestoredMetadata(
        ours.get(FULL_NAME) or whole or name,
        int(ours.get(STAMP, "0")),
        ours.get(FRAME_ID, ""),
        ours.get(CHILD_FRAME_ID, ""),
        tuple(items),
        bool(ours or whole),
    )


def _whole_name(message: Message, keys: tuple[str, ...]) -> str:
    """Return the name that 3D Slicer or PLUS has under a key if the device name is its first 20 bytes, else ""."""
    device = message.device_name.encode("utf-8", "surrogateescape")
    if len(device) < MAX_DEVICE_NAME:
        return ""
    names = (item.value.rstrip(b"\0") for item in message.metadata if item.key in keys)
    return next((visible(decode_text(name)) for name in names if name[:MAX_DEVICE_NAME] == device), "")


def _is_valid(item: Item, device_name: str) -> bool:
    if item.key == FULL_NAME:
        return short_device_name(item.text) == device_name
    if item.key == STAMP:
        return whole_number(item.text, _MAX_STAMP_NS - 1) is not None
    return bool(item.text)


def _decoded_value(item: Item) -> MetadataItem:
    """Return an item with its value decoded by its named encoding; undecodable bytes are replaced."""
    codec = CODECS.get(item.encoding, "utf-8")
    value = item.value.decode("utf-8" if item.encoding == US_ASCII else codec, "replace")
    return MetadataItem(visible(item.key), item.encoding, value.replace("\x00", "\ufffd"))


def compose_metadata(
    device_name: str,
    full_name: str,
    stamp_ns: int,
    frame_id: str,
    child_frame_id: str,
    users: Iterable[MetadataItem],
) -> tuple[Item, ...]:
    """Return the metadata of an outgoing message: the user's and the gateway's, one value per key, sorted."""
    items = [_encoded_value(item) for item in users]
    if device_name != full_name:
        items.append(Item.of(FULL_NAME, full_name))
    if stamp_ns:
        items.append(Item.of(STAMP, str(stamp_ns)))
    if frame_id:
        items.append(Item.of(FRAME_ID, frame_id))
    if child_frame_id:
        items.append(Item.of(CHILD_FRAME_ID, child_frame_id))
    return sorted_items(items)


def _encoded_value(item: MetadataItem) -> Item:
    """Return an item with its value encoded as the item names, else as US-ASCII or UTF-8 by content."""
    codec = CODECS.get(item.encoding)
    if codec is None or item.encoding in (US_ASCII, UTF_8):
        return Item.of(item.key, item.value)
    try:
        return Item(item.key, item.value.encode(codec), item.encoding)
    except UnicodeEncodeError:
        return Item.of(item.key, item.value)
