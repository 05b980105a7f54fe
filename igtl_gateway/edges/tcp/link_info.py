"""Limits for peers, facts about links, and their counts."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from typing import Literal

from igtl_gateway.base.errors import ConfigError
from igtl_gateway.wire.header import DEFAULT_MAX_BODY
from igtl_gateway.wire.registry import BODIES
from igtl_gateway.wire.traits import LIST, SHORT, traits_of

Role = Literal["server", "client"]

#: Maximum body sizes of the types that never reach ``max_body``, in bytes: a peer that announces more has lost its
#: place in the stream, or attacks.  A type (a glob of types) that is not here may be as long as ``max_body``.
MAX_BODIES: tuple[tuple[str, int], ...] = (
    *((name, most) for name, body in BODIES.items() if (most := traits_of(body).most_bytes) is not None),
    *((f"{prefix}_*", SHORT) for prefix in ("GET", "STT", "STP")),
    ("RTS_*", LIST),
)


@dataclass(frozen=True, slots=True)
class PeerLimits:
    """What a peer may cost.  Raises ConfigError for a limit that is not positive.

    Attributes:
        max_clients: links that peers opened, and the same number in the TLS handshake; the paper's setups have a
            handful, 32 shows a runaway.
        queue_bytes: size of the send queue of one link; ten images in full HD, a second or two at a frame rate.
        queue_messages: messages in that queue; four seconds of transforms at 1 kHz.
        stall_s: longest pause inside a message; TCP itself recovers from a lost packet well within it.
        min_rate: lowest transfer rate of a message, in bytes per second: if n bytes have arrived, it must not be older
            than ``stall_s + n / min_rate``.  So a header is complete within ``stall_s``, and a volume of 250 MiB
            may take hours as long as it moves.  The default is one ISDN channel, slower than any line that images are
            sent over.  The rate also holds for the messages that are still queued when a link ends.
        idle_s: longest time without traffic in either direction; 0: no limit, because a viewer that waits for a scan
            to begin is silent for minutes.
        handshake_s: longest TLS handshake, which is two round trips.
        max_body: maximum body size of a received message, in bytes; see ``DEFAULT_MAX_BODY``.
        bodies: maximum body sizes of single types (globs), the first that matches; other types have those of
            ``MAX_BODIES``, or ``max_body``.
        messages_per_s: messages per second of one link; a peer that sends more is read more slowly, and TCP makes it
            wait.  Far above what a session has, and below what would delay the other links.
    """

    max_clients: int = 32
    queue_bytes: int = 64 * 2**20
    queue_messages: int = 4096
    stall_s: float = 10.0
    min_rate: int = 8 * 2**10
    idle_s: float = 0.0
    handshake_s: float = 10.0
    max_body: int = DEFAULT_MAX_BODY
    bodies: tuple[tuple[str, int], ...] = ()
    messages_per_s: int = 100_000

    def __post_init__(self) -> None:
        for name in set(self.__slots__) - {"bodies", "idle_s"}:
            if not getattr(self, name) > 0:
                raise ConfigError(f"limit {name}: found {getattr(self, name)}, expected more than 0")
        if not self.idle_s >= 0:
            raise ConfigError(f"limit idle_s: found {self.idle_s}, expected 0 (none) or more")
        for glob, size in self.bodies:
            if not size > 0:
                raise ConfigError(f"limit bodies, {glob}: found {size}, expected more than 0")

    def body_rows(self) -> tuple[tuple[str, int], ...]:
        """Types and their maximum body sizes, for the framer."""
        return self.bodies + tuple((glob, min(size, self.max_body)) for glob, size in MAX_BODIES)


@dataclass(frozen=True, slots=True)
class LinkInfo:
    """One peer, or one that ``connect`` is trying to reach (number 0, not connected)."""

    number: int
    peer: str
    role: Role
    connected: bool


@dataclass(frozen=True, slots=True)
class LinkCounters:
    """The traffic of one link so far.

    ``sent`` means handed to the kernel.  ``dropped`` counts per stream the messages that were accepted and not
    sent: pushed out of the full queue, or left in it when the link closed.  ``ignored`` counts per stream the messages
    that were not accepted: for links that had closed already, or that this message made close.  ``unconfirmed_bytes``
    were sent, and the peer's system has not confirmed them: it has no room for more, if they stay.
    """

    sent_messages: int = 0
    sent_bytes: int = 0
    received_messages: int = 0
    received_bytes: int = 0
    queued_messages: int = 0
    queued_bytes: int = 0
    dropped: dict[str, int] = field(default_factory=dict)
    ignored: dict[str, int] = field(default_factory=dict)
    unconfirmed_bytes: int = 0

    def __add__(self, other: LinkCounters) -> LinkCounters:
        """The sum of both, stream by stream."""
        return LinkCounters(
            self.sent_messages + other.sent_messages,
            self.sent_bytes + other.sent_bytes,
            self.received_messages + other.received_messages,
            self.received_bytes + other.received_bytes,
            self.queued_messages + other.queued_messages,
            self.queued_bytes + other.queued_bytes,
            dict(Counter(self.dropped) + Counter(other.dropped)),
            dict(Counter(self.ignored) + Counter(other.ignored)),
            self.unconfirmed_bytes + other.unconfirmed_bytes,
        )
