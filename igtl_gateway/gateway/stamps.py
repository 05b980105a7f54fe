"""Changes the stamps in the bytes of an OpenIGTLink message.

These are the time stamp in the header, which no checksum covers, and the ROS stamp in the metadata if there is one,
which needs a new checksum of the body.  A wrong checksum stays as it is: a message is accepted or rejected as before.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

from igtl_gateway.base.errors import GatewayError
from igtl_gateway.base.stamp import ns_to_ticks, ticks_as_read, ticks_to_ns
from igtl_gateway.base.untrusted.numbers import whole_number
from igtl_gateway.gateway.acceptance import DEFAULT_ACCEPTANCE, Acceptance
from igtl_gateway.gateway.metadata import STAMP
from igtl_gateway.wire import encode
from igtl_gateway.wire.header import BODY_SIZE_AT, CRC_AT, HEADER_SIZE, TICKS_AT, U64, crc64
from igtl_gateway.wire.message import Item


def restamped(
    data: bytes, new: Callable[[int], int], acceptance: Acceptance = DEFAULT_ACCEPTANCE, source_ns: int = 0
) -> bytes:
    """Apply ``new`` to each stamp of a message (UTC ns, 0: unset); shorter data than a header stays unchanged.

    ``source_ns`` of its entry shows how the session has read the stamp in the header.  Of what the session rejects
    (``acceptance``), only that stamp changes.
    """
    if len(data) < HEADER_SIZE:
        return data
    (ticks,) = U64.unpack_from(data, TICKS_AT)
    word = U64.pack(ns_to_ticks(new(ticks_to_ns(ticks_as_read(ticks, source_ns)))))
    body = _restamped_metadata(data, new, acceptance) or data
    return b"".join((body[:TICKS_AT], word, body[BODY_SIZE_AT:]))


def moved(data: bytes, by_ns: int, acceptance: Acceptance = DEFAULT_ACCEPTANCE) -> bytes:
    """Shift all stamps of a message; unset stamps stay unset, and no stamp becomes unset."""
    return restamped(data, lambda stamp_ns: max(stamp_ns + by_ns, 1) if stamp_ns else 0, acceptance)


def _restamped_metadata(data: bytes, new: Callable[[int], int], acceptance: Acceptance) -> bytes | None:
    """Change the ROS stamp in the metadata; None if there is none, or if the message is damaged."""
    if STAMP.encode() not in data:
        return None
    try:
        message = acceptance.message(data)
        items = tuple(_item(item, new) for item in message.metadata)
        if items == message.metadata:
            return None
        return with_crc_of(data, b"".join(encode(dataclasses.replace(message, metadata=items))))
    except GatewayError:
        return None


def with_crc_of(data: bytes, changed: bytes) -> bytes:
    """Return ``changed``, a message that was made of ``data``, with the checksum of ``data`` if that is wrong there."""
    recorded = data[CRC_AT:HEADER_SIZE]
    if recorded == U64.pack(crc64(data[HEADER_SIZE:])):
        return changed
    return changed[:CRC_AT] + recorded + changed[HEADER_SIZE:]


def with_right_crc(data: bytes) -> bytes:
    """Return a message with the checksum of its body; the same object if it has that."""
    right = U64.pack(crc64(memoryview(data)[HEADER_SIZE:]))
    return data if data[CRC_AT:HEADER_SIZE] == right else data[:CRC_AT] + right + data[HEADER_SIZE:]


def _item(item: Item, new: Callable[[int], int]) -> Item:
    stamp_ns = whole_number(item.text) if item.key == STAMP else None
    return item if stamp_ns is None else Item.of(STAMP, str(new(stamp_ns)))
