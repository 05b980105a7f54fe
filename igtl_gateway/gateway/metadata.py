"""What travels as metadata of header version 2, and how it is restored on the way back.

Four keys are ours; the rest belongs to the users and is passed on as it is.
"""

from __future__ import annotations

from collections.abc import Iterable

from igtl_gateway.convert.igtl_msgs import MetadataItem
from igtl_gateway.convert.names import short_device_name
from igtl_gateway.values import value
from igtl_gateway.wire import Item, Message
from igtl_gateway.wire.fields import visible
from igtl_gateway.wire.message import sorted_items
from igtl_gateway.wire.text import CODECS, US_ASCII, UTF_8

#: Device name that was too long for its 20 bytes.
FULL_NAME = "DeviceName"
#: Stamp of the ROS header, integer UTC nanoseconds: programs that leave the header's stamp at 0 pass it on.
STAMP = "ros.stamp"
FRAME_ID = "ros.frame_id"
CHILD_FRAME_ID = "ros.child_frame_id"

OURS = frozenset({FULL_NAME, STAMP, FRAME_ID, CHILD_FRAME_ID})

#: UTC ns of the year 2106, where the tick word of OpenIGTLink ends.
_MAX_STAMP_NS = (1 << 32) * 1_000_000_000


@value(frozen=True, slots=True)
class RestoredMetadata:
    """What the metadata of a received message says.

    Attributes:
        device_name: the full name of the stream.
        stamp_ns: UTC ns, 0 where there is none.
        frame_id, child_frame_id: "" where there are none.
        items: what is not ours.
    """

    device_name: str
    stamp_ns: int = 0
    frame_id: str = ""
    child_frame_id: str = ""
    items: tuple[MetadataItem, ...] = ()


def restore_metadata(message: Message) -> RestoredMetadata:
    """Read the metadata of a message; what is not as we write it is taken for the user's."""
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
    return RestoredMetadata(
        ours.get(FULL_NAME, name),
        int(ours.get(STAMP, "0")),
        ours.get(FRAME_ID, ""),
        ours.get(CHILD_FRAME_ID, ""),
        tuple(items),
    )


def _is_valid(item: Item, device_name: str) -> bool:
    if item.key == FULL_NAME:
        return short_device_name(item.text) == device_name
    if item.key == STAMP:
        return item.text.isascii() and item.text.isdigit() and len(item.text) < 20 and int(item.text) < _MAX_STAMP_NS
    return bool(item.text)


def _decoded_value(item: Item) -> MetadataItem:
    """The value in its named encoding; undecodable bytes are replaced."""
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
    """The metadata of an outgoing message: the user's, then ours, one value for each key, sorted."""
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
    """In the encoding that the item names where that can hold it, else as US-ASCII or UTF-8 by content."""
    codec = CODECS.get(item.encoding)
    if codec is None or item.encoding in (US_ASCII, UTF_8):
        return Item.of(item.key, item.value)
    try:
        return Item(item.key, item.value.encode(codec), item.encoding)
    except UnicodeEncodeError:
        return Item.of(item.key, item.value)
