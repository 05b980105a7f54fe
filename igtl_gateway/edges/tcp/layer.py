"""What may lie between a link and its socket: TLS, WebSocket, or one on the other.

A layer has the methods of a socket that a link uses, under the same names.  Bytes may wait in it in both directions:
such as it has taken and the kernel has not (``pending``), and such as it has received and the link has not (``more``).
"""

from __future__ import annotations

import socket
import sys
from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Any

from igtl_gateway.edges.tcp.outbox import Part

#: As much is joined to one packet where the system sends only one buffer at a time.
_JOINED_BYTES = 64 << 10


class LayerError(OSError):
    """A layer has failed: ``reason`` comes from a small fixed set, ``detail`` has what differs from peer to peer.

    Attributes:
        code: of the note about a link that it ends.
        what: what the peer has sent, of which this is an error.
    """

    code = ""
    what = ""

    def __init__(self, reason: str, detail: str = "") -> None:
        super().__init__(f"{reason} ({detail})" if detail else reason)
        self.reason = reason
        self.detail = detail


class Layer(ABC):
    """A connected non-blocking socket with a protocol on it.

    Attributes:
        NAME: of the protocol.
        PINGS: the protocol can ask whether the peer is there.
        more: there might be received bytes that no system call reports; only ``recv_into`` returns them.
        begun: anything was received.
        shaken: our part of the handshake is complete, and the peer's verdict on it may follow.
        received_bytes: number of bytes that came over the wire behind the handshake, control frames included.
        has_left: the peer has announced that it neither sends nor reads any more.
        is_ending: what ends the conversation waits to be sent, with ``close`` at the latest.
        is_framed: a whole message needs no more than a frame of WebSocket before it, so the native passage can send.
        manner: how the peer is connected, behind the words "connected to PLACE".
    """

    NAME = ""
    PINGS = False
    is_framed = False
    manner = ""

    def __init__(self, sock: AnySocket) -> None:
        self._sock = sock
        self.more = False
        self.begun = False
        self.shaken = False
        self.received_bytes = 0
        self.has_left = False
        self.is_ending = False

    @property
    @abstractmethod
    def pending(self) -> int:
        """Bytes that this layer has taken, and the kernel has not yet."""

    @abstractmethod
    def facts(self) -> dict[str, str]:
        """What is known of the connection, for the note about the link."""

    @abstractmethod
    def do_handshake(self) -> bool:
        """Do as much of the handshake as is possible now; True when it is complete.  Raises OSError."""

    def send(self, part: Part) -> int:
        """Like a socket's ``send``."""
        return self.sendmsg((part,))

    @abstractmethod
    def sendmsg(self, parts: Sequence[Part]) -> int:
        """Like a socket's ``sendmsg``; bytes that count as sent might wait here, see ``pending`` and ``flush``."""

    def take_over(self, message: bytes, sent: int) -> int:
        """The native passage has sent the first bytes of a framed message; return how many of it count as sent."""
        return sent

    @abstractmethod
    def flush(self) -> bool:
        """Send what is pending; whether nothing is left.  Raises OSError."""

    @abstractmethod
    def recv_into(self, room: memoryview) -> int:
        """Like a socket's ``recv_into``: at most one system call, and none while there is ``more``."""

    @abstractmethod
    def ping(self) -> None:
        """Ask the peer for a sign of life."""

    @abstractmethod
    def farewell(self, reason: str) -> None:
        """Have ``close`` send the reason: the code of a note, or free text."""

    @abstractmethod
    def shutdown(self, how: int) -> None:
        """Like a socket's ``shutdown``, behind an end that shows the peer that it is deliberate."""

    @abstractmethod
    def close(self) -> None:
        """Like a socket's ``close``, behind such an end if there was none."""

    def getsockname(self) -> Any:
        return self._sock.getsockname()

    def getsockopt(self, level: int, option: int, size: int) -> bytes:
        return self._sock.getsockopt(level, option, size)

    def fileno(self) -> int:
        return self._sock.fileno()


AnySocket = socket.socket | Layer

if sys.platform == "win32":

    def send_parts(sock: AnySocket, parts: Sequence[Part]) -> int:
        """Send what follows each other; return the number of bytes that the system took.

        Windows gives no ``sendmsg``: small parts are joined, so that they do not become packets of their own.
        """
        if isinstance(sock, Layer):
            return sock.sendmsg(parts)
        size = 0
        for count, part in enumerate(parts):
            size += len(part)
            if size > _JOINED_BYTES:
                return sock.send(b"".join(parts[:count]) if count else part)
        return sock.send(b"".join(parts))

else:

    def send_parts(sock: AnySocket, parts: Sequence[Part]) -> int:
        """Send what follows each other; return the number of bytes that the system took."""
        return sock.sendmsg(parts)
