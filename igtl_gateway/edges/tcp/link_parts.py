"""What the parts of a link (sender, receiver, liveness) share, and what they need of the link itself."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from typing import NamedTuple, Protocol

from igtl_gateway.base.buffers import Buffer
from igtl_gateway.edges.tcp.aside import Aside
from igtl_gateway.edges.tcp.link_info import PeerLimits
from igtl_gateway.edges.tcp.loop import Loop
from igtl_gateway.edges.tcp.reporter import Reporter
from igtl_gateway.edges.tcp.turns import InvalidTime, Turn
from igtl_gateway.gateway.log.note import Level, Note
from igtl_gateway.native.passage import Link as NativeLink
from igtl_gateway.native.passage import Lock, Passage


class _Closable(Protocol):
    def close(self) -> None: ...


class Refusals:
    """The refused connections of an edge; ``counts`` is for any thread, the rest is of the I/O thread alone.

    Reasons come from a small fixed set; ``detail`` has what differs from peer to peer.
    """

    def __init__(self, reporter: Reporter) -> None:
        self.counts: Counter[str] = Counter()
        self._reporter = reporter

    def refuse(self, sock: _Closable, peer: str, reason: str, detail: str = "") -> None:
        """Close the connection of a peer, and note why: now, and while it repeats once a second with the count."""
        self.refuse_all((sock,), peer, reason, detail)

    def refuse_all(self, socks: Sequence[_Closable], peer: str, reason: str, detail: str = "") -> None:
        """Do the same for several; ``peer``: one of them."""
        self.counts[reason] += len(socks)
        for sock in socks:
            with suppress(OSError):
                sock.close()

        def make(count: int) -> Note:
            data = {"peer": peer, "reason": reason, "count": count} | ({"detail": detail} if detail else {})
            text = f"connection of {peer} refused: {reason}" + (f" ({detail})" if detail else "")
            return Note(Level.WARN, "refused", text, data=data)

        self._reporter.note_rate_limited(f"refused: {reason}", make, len(socks))


class Admission(Protocol):
    """When large messages pass; for any thread."""

    def admit(self, size: int) -> bool:
        """Whether a message of this size passes now; if so, ``leave`` must follow."""
        ...

    def enter(self, size: int) -> None:
        """Let a message pass in any case; ``leave`` must follow."""
        ...

    def leave(self, size: int) -> None:
        """A message has passed."""
        ...


class OpenAdmission:
    """Everything passes."""

    def admit(self, size: int) -> bool:
        return True

    def enter(self, size: int) -> None: ...

    def leave(self, size: int) -> None: ...


@dataclass(frozen=True, slots=True)
class LinkContext:
    """What all links of an edge share.

    Attributes:
        loop: the I/O thread.
        reporter: calls back and notes.
        refusals: counts refused connections.
        limits: what a peer may cost.
        bodies: maximum body sizes of single types, from the limits.
        faults: number of links that a fault ended, or that ended inside a message, by the code of the note.
        on_frame: the edge's callback for a message; it returns True where that has no valid content.
        drained: called when a send queue has become empty.
        passage: the native passage, which reads and sends natively where it can; None: there is none.
        wait_large: waits until large messages of a link, which the passage has read, are handled.
        admission: when large messages pass.
        aside: handles messages that take long.
        invalid: the time of large messages without valid content.
    """

    loop: Loop
    reporter: Reporter
    refusals: Refusals
    limits: PeerLimits
    bodies: Sequence[tuple[str, int]]
    faults: Counter[str]
    on_frame: Callable[[int, Buffer], object]
    drained: Callable[[], None]
    passage: Passage | None
    wait_large: Callable[[NativeLink], None]
    admission: Admission
    aside: Aside
    invalid: InvalidTime = field(default_factory=InvalidTime)


class NativeEnds(NamedTuple):
    """A link in the native passage, and the lock of its sender, which both sides take."""

    link: NativeLink
    lock: Lock


class LinkLife(Protocol):
    """The link as its parts see it; the methods are for the I/O thread alone.

    Attributes:
        number: the link number.
        peer: ``host:port`` of the peer.
        is_open: whether the socket is open.
        turn: its turns in the I/O thread.
    """

    number: int
    peer: str
    is_open: bool
    turn: Turn

    def watch(self) -> None:
        """Wait for the socket events that the sender and the receiver need."""
        ...

    def peer_ended(self) -> None:
        """The peer has closed its direction."""
        ...

    def broken(self, cause: str) -> None:
        """The connection broke: close for the reason that is already known, or for this one."""
        ...

    def fault(self, level: Level, code: str, text: str) -> None:
        """Note a fault, and close."""
        ...

    def close(self, reason: str = "") -> None:
        """Close for this reason, or for the one that is already known."""
        ...

    def failed(self, exc: Exception) -> None:
        """Note an unexpected error of our own code."""
        ...
