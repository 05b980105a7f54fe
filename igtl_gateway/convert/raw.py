"""Whole OpenIGTLink messages ⇄ igtl_msgs/RawMessage, for all types without a conversion.

Only the header is interpreted, and the bytes do not change.
"""

from __future__ import annotations

import numpy as np

from igtl_gateway.base.buffers import Buffer
from igtl_gateway.base.errors import ConversionError, WireError
from igtl_gateway.base.stamp import ticks_to_ns
from igtl_gateway.convert.igtl_msgs import RawMessage
from igtl_gateway.wire import Header, decode
from igtl_gateway.wire.fields import visible


def raw_message(data: Buffer, stamp_ns: int, link: int) -> RawMessage:
    """Return a message from ``link`` at ``stamp_ns`` (UTC ns).  Raises TruncatedMessage for an incomplete header."""
    header = Header.unpack(data)
    return RawMessage(
        stamp_ns,
        ticks_to_ns(header.ticks),
        header.ticks,
        RawMessage.DIRECTION_IN,
        np.array([link], np.uint32),
        visible(header.type),
        visible(header.device_name),
        data,
    )


def message_of(raw: RawMessage) -> Buffer:
    """Return the bytes to send, unchanged; the other fields are ignored.

    Raises ConversionError unless the bytes are exactly one message that the gateway itself accepts: with a wrong length
    the peer would lose all later messages.
    """
    try:
        decode(raw.data)
    except WireError as error:
        raise ConversionError(f"{raw.TYPE}: data is not an OpenIGTLink message: {error}") from None
    return raw.data
