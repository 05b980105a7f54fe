"""What the fast path needs to compile the stream of a ROS topic."""

from __future__ import annotations

from typing import NamedTuple

from igtl_gateway.gateway.guard import GuardedStream
from igtl_gateway.gateway.streams import ToIgtlStream
from igtl_gateway.gateway.to_igtl.sender import OutboundMessage


class IgtlOrigin(NamedTuple):
    """A sent message, its stream, and its guarded stream."""

    stream: ToIgtlStream
    out: OutboundMessage
    watched: GuardedStream | None
