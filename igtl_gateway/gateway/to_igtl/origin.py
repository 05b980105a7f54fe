"""What the fast path can compile the next message of a ROS topic from."""

from __future__ import annotations

from typing import NamedTuple

from igtl_gateway.gateway.guard import GuardedStream
from igtl_gateway.gateway.streams import ToIgtlStream
from igtl_gateway.gateway.to_igtl.sender import OutboundMessage


class IgtlOrigin(NamedTuple):
    """The stream of a message that has gone out, the message, and what the guard knows of the stream."""

    stream: ToIgtlStream
    out: OutboundMessage
    watched: GuardedStream | None
