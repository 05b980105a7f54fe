"""Other stamps for an OpenIGTLink message, in its bytes as they are.

There is the tick word of the header, which no checksum covers, and where there is one the ROS stamp in the metadata,
with the checksum of the body.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

from igtl_gateway.errors import GatewayError
from igtl_gateway.gateway.metadata import STAMP
from igtl_gateway.stamp import ns_to_ticks, ticks_to_ns
from igtl_gateway.wire import decode, encode
from igtl_gateway.wire.header import BODY_SIZE_AT, HEADER_SIZE, TICKS_AT, U64
from igtl_gateway.wire.message import Item


def restamped(data: bytes, new: Callable[[int], int]) -> bytes:
    """The message with ``new`` of each stamp (UTC ns, 0: unset); what is shorter than a header stays as it is."""
    if len(data) < HEADER_SIZE:
        return data
    (ticks,) = U64.unpack_from(data, TICKS_AT)
    word = U64.pack(ns_to_ticks(new(ticks_to_ns(ticks))))
    body = _restamped_metadata(data, new) or data
    return b"".join((body[:TICKS_AT], word, body[BODY_SIZE_AT:]))


def moved(data: bytes, by_ns: int) -> bytes:
    """The message with all stamps moved; those that are unset stay so, and none becomes unset."""
    return restamped(data, lambda stamp_ns: max(stamp_ns + by_ns, 1) if stamp_ns else 0)


def _restamped_metadata(data: bytes, new: Callable[[int], int]) -> bytes | None:
    """The message with the ROS stamp in its metadata changed; None where there is none, or the message is damaged."""
    if STAMP.encode() not in data:
        return None
    try:
        message = decode(data)
        items = tuple(_item(item, new) for item in message.metadata)
        return b"".join(encode(dataclasses.replace(message, metadata=items))) if items != message.metadata else None
    except GatewayError:
        return None


def _item(item: Item, new: Callable[[int], int]) -> Item:
    if item.key != STAMP or not (item.text.isascii() and item.text.isdigit()):
        return item
    return Item.of(STAMP, str(new(int(item.text))))
