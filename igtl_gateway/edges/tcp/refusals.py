"""Connections that are refused: closed, counted by reason, and noted."""

from __future__ import annotations

from collections import Counter
from contextlib import suppress
from typing import Protocol

from igtl_gateway.edges.tcp.reporter import Reporter
from igtl_gateway.gateway.log.note import Level, Note


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
        self.counts[reason] += 1
        with suppress(OSError):
            sock.close()

        def make(count: int) -> Note:
            data = {"peer": peer, "reason": reason, "count": count} | ({"detail": detail} if detail else {})
            text = f"connection of {peer} refused: {reason}" + (f" ({detail})" if detail else "")
            return Note(Level.WARN, "refused", text, data=data)

        self._reporter.note_rate_limited(f"refused: {reason}", make)
