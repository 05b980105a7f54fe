"""Common parts of the compilers: the parts of the session that they need, and the layout of strings in CDR."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple, Protocol

from igtl_gateway.base.buffers import Buffer
from igtl_gateway.base.qos import Qos
from igtl_gateway.config.configuration import Config
from igtl_gateway.gateway.log.ledger import Ledger

#: Offsets of the stamp and of the frame id in CDR that begins with a std_msgs/Header.
STAMP_AT, NAMES_AT = 4, 12

#: Key of a stream: link, names in the header and metadata of the message (`to_ros_key`); topic and ROS type.
ToRosKey = tuple[int, bytes]
ToIgtlKey = tuple[str, str]
Key = ToRosKey | ToIgtlKey


class NativeStreams(Protocol):
    """The native passage as the fast path sees it: it has a copy of some compiled streams.

    All methods are called with the sequence lock.
    """

    def collect(self, key: Key, stream: Any) -> None:
        """Take over what the passage has counted of a stream: Python is about to handle its next message."""

    def collect_all(self) -> None:
        """Take over what the passage has counted: Python is about to take the full path, which depends on it."""

    def handled(self, key: Key, stream: Any) -> None:
        """Python has handled a message of a compiled stream by the fast path."""

    def handled_in_full(self) -> None:
        """Python has handled an input by the full path."""

    def drop(self, key: Key) -> None:
        """The stream is no longer compiled."""

    def replace(self, key: Key, stream: Any) -> None:
        """The stream was compiled again; None: it could not be."""

    def drop_all(self) -> None:
        """No stream is compiled any more."""


class CompileContext(NamedTuple):
    """The parts of a session that streams are compiled from.

    Attributes:
        config, ledger: configuration and ledger of the session.
        qos, advertise: return and set the QoS of a published topic.
        waiting: latched topic without a subscriber → its last message.
    """

    config: Config
    ledger: Ledger
    qos: Callable[[str], Qos | None]
    advertise: Callable[[str, Qos], None]
    waiting: dict[str, Any]


def end_of_name(cdr: Buffer, at: int) -> int:
    """Return the offset after a string in CDR whose length is at ``at``."""
    return at + 4 + int.from_bytes(cdr[at : at + 4], "little")
