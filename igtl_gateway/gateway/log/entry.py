"""The Entry: one thing that crossed the gateway's border, or that the gateway reports.

The session is the ordered list of entries.  Inputs (``*_IN``, ``LINK``, edge ``NOTE``) are numbered and
stamped where they arrive; the outputs that an input causes follow it directly, with the next numbers and
the next nanoseconds.  So the order of the numbers is the order of the stamps, no two entries share either,
and the cause of an output is the last input before it.
"""

from __future__ import annotations

from collections.abc import Sequence
from enum import Enum

from igtl_gateway.base.buffers import MANY_BYTES, Buffer, join, total_size
from igtl_gateway.base.values import value
from igtl_gateway.native.joining import join_parts


class Kind(Enum):
    """What an entry is.  The value is its name in the recording."""

    __hash__ = object.__hash__  # that of Enum is written in Python, and every message asks for it

    IGTL_IN = "igtl_in"  #: one whole OpenIGTLink message from a peer, before any check
    IGTL_OUT = "igtl_out"  #: one whole OpenIGTLink message to the peers in ``links``
    ROS_IN = "ros_in"  #: one CDR message from a ROS topic
    ROS_OUT = "ros_out"  #: one CDR message to a ROS topic
    LINK = "link"  #: a peer came or went (input); payload is a note
    EDGE_NOTE = "edge_note"  #: an edge reports a fact, such as a drop (input); payload is a note
    NOTE = "note"  #: the gateway reports a fact (output); payload is a note

    @property
    def is_input(self) -> bool:
        """Whether the gateway is fed with it (and replay and verification feed it again)."""
        return self in _INPUTS


#: What is a message of a peer or of ROS, in either direction.
MESSAGES = frozenset({Kind.IGTL_IN, Kind.IGTL_OUT, Kind.ROS_IN, Kind.ROS_OUT})
_INPUTS = frozenset({Kind.IGTL_IN, Kind.ROS_IN, Kind.LINK, Kind.EDGE_NOTE})


@value(frozen=True, slots=True)
class Entry:
    """One line of the session log.

    Attributes:
        seq: entry number, from 1, strictly increasing: the total order of the session.
        stamp_ns: gateway time in UTC nanoseconds, strictly increasing.
        kind: what it is.
        channel: ROS topic; for OpenIGTLink the stream ``"TYPE/device name"``; for the rest ``""``.
        type: ROS type (``"std_msgs/msg/String"``) or OpenIGTLink type name.
        payload: the bytes, as buffers to be sent one after the other (scatter-gather).
        links: for OpenIGTLink and link entries the numbers of the links concerned.
        source_ns: the sender's own stamp in UTC nanoseconds; 0 = unset.
    """

    seq: int
    stamp_ns: int
    kind: Kind
    channel: str = ""
    type: str = ""
    payload: Sequence[Buffer] = ()
    links: tuple[int, ...] = ()
    source_ns: int = 0

    def data(self) -> bytes:
        """The payload as one ``bytes`` object (no copy where it is one already)."""
        if join_parts and len(self.payload) > 1 and self.size >= MANY_BYTES:
            return join_parts(list(self.payload))
        return join(self.payload)

    @property
    def size(self) -> int:
        """Payload length in bytes."""
        return total_size(self.payload)
