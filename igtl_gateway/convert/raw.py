"""Whole OpenIGTLink messages ⇄ igtl_msgs/RawMessage: the way of every type that has no conversion.

Nothing is interpreted but the header, and nothing is changed: what comes out is what went in.
"""

from __future__ import annotations

import numpy as np

from igtl_gateway.buffers import Buffer
from igtl_gateway.convert.igtl_msgs import RawMessage
from igtl_gateway.errors import ConversionError, WireError
from igtl_gateway.stamp import ticks_to_ns
from igtl_gateway.wire import Header, decode
from igtl_gateway.wire.fields import visible


def raw_message(data: Buffer, stamp_ns: int, link: int) -> RawMessage:
    """The message that came from ``link`` at ``stamp_ns`` (UTC ns).  Raises TruncatedMessage below a whole header."""
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
    """The bytes to be sent, unchanged; what the other fields say of them is not looked at.

    Raises ConversionError where they are not exactly one message that we would accept ourselves: a wrong length or
    CRC would cost the peer everything that follows.
    """
    try:
        decode(raw.data)
    except WireError as error:
        raise ConversionError(f"{raw.TYPE}: data is not an OpenIGTLink message: {error}") from None
    return raw.data
