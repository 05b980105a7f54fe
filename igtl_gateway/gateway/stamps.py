"""Changes the stamps in the bytes of an OpenIGTLink message.

These are the time stamp in the header, which no checksum covers, and the ROS stamp in the metadata if there is one,
which needs a new checksum of the body.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

from igtl_gateway.base.errors import GatewayError
from igtl_gateway.base.stamp import ns_to_ticks, ticks_to_ns
from igtl_gateway.base.untrusted.numbers import whole_number
from igtl_gateway.gateway.metadata import STAMP
from igtl_gateway.wire import decode, encode
from igtl_gateway.wire.header import BODY_SIZE_AT, HEADER_SIZE, TICKS_AT, U64
from igtl_gateway.wire.message import Item


def restamped(data: bytes, new: Callable[[int], int]) -> bytes:
    """Apply ``new`` to each stamp of a message (UTC ns, 0: unset); shorter data than a header stays unchanged."""
    if len(data) < HEADER_SIZE:
        return data
    (ticks,) = U64.unpack_from(data, TICKS_AT)
    word = U64.pack(ns_to_ticks(new(ticks_to_ns(ticks))))
    body = _restamped_metadata(data, new) or data
    return b"".join((body[:TICKS_AT], word, body[BODY_SIZE_AT:]))


def moved(data: bytes, by_ns: int) -> bytes:
    """Shift all stamps of a message; unset stamps stay unset, and no stamp becomes unset."""
    return restamped(data, lambda stamp_ns: max(stamp_ns + by_ns, 1) if stamp_ns else 0)


def _restamped_metadata(data: bytes, new: Callable[[int], int]) -> bytes | None:
    """Change the ROS stamp in the metadata; None if there is none, or if the message is damaged."""
    if STAMP.encode() not in data:
        return None
    try:
        message = decode(data)
        items = tuple(_item(item, new) for item in message.metadata)
        return b"".join(encode(dataclasses.replace(message, metadata=items))) if items != message.metadata else None
    except GatewayError:
        return None


def _item(item: Item, new: Callable[[int], int]) -> Item:
    stamp_ns = whole_number(item.text) if item.key == STAMP else None
    return item if stamp_ns is None else Item.of(STAMP, str(new(stamp_ns)))
