"""The bound on the messages of a peer in a second: a peer above it is read more slowly, and loses nothing."""

from __future__ import annotations

from igtl_gateway.base.stamp import NS_PER_S
from igtl_gateway.edges.tcp.link_parts import LinkContext, LinkLife
from igtl_gateway.edges.tcp.reporter import NOTE_EVERY_S
from igtl_gateway.gateway.log.note import Level, Note

_BURST_S = 1.0  # a peer that was silent for this long may send the messages of this time at once


class RateLimit:
    """A token bucket for the messages of one link; of the I/O thread alone.

    What a peer sends while it ``is_pausing`` stays in the kernel, and TCP makes the peer wait.
    """

    def __init__(self, link: LinkLife, context: LinkContext, now_ns: int) -> None:
        self.is_pausing = False
        self._link = link
        self._context = context
        self._tokens = context.limits.messages_per_s * _BURST_S  # messages that may arrive at once
        self._counted_ns = now_ns
        self._pauses = 0
        self._noted_ns = 0

    def room(self, now_ns: int) -> int:
        """Return the number of messages that may arrive at once: at least one."""
        self._refill(now_ns)
        return max(1, int(self._tokens))

    def take_over(self, room: float, now_ns: int) -> None:
        """The native passage has read, by the same rule, and leaves room for this number of messages."""
        self._tokens, self._counted_ns = room, now_ns

    def pause_s(self, messages: int, now_ns: int) -> float:
        """Count messages; how long (s) to read no more from the link, 0.0 for no pause.  A pause is noted."""
        rate = self._context.limits.messages_per_s
        self._refill(now_ns)
        self._tokens -= messages
        if self._tokens >= 0 or not self._link.is_open:
            return 0.0
        self.is_pausing = True
        self._pauses += 1
        if self._pauses == 1 or now_ns - self._noted_ns >= NOTE_EVERY_S * NS_PER_S:
            self._noted_ns = now_ns
            text = f"{self._link.peer} sends more than {rate:,} messages per second and is read at this rate"
            data = {"peer": self._link.peer, "limit": rate, "rests": self._pauses}
            self._context.reporter.note(self._link.number, Note(Level.WARN, "rate_limited", text, data=data))
        return -self._tokens / rate

    def _refill(self, now_ns: int) -> None:
        rate = self._context.limits.messages_per_s
        self._tokens = min(rate * _BURST_S, self._tokens + (now_ns - self._counted_ns) * rate / NS_PER_S)
        self._counted_ns = now_ns
