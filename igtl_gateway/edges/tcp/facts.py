"""What the edge is told about peers, and what it tells: limits, links, counts."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from typing import Literal

from igtl_gateway.errors import ConfigError
from igtl_gateway.wire.framer import DEFAULT_MAX_BODY

Role = Literal["server", "client"]


@dataclass(frozen=True, slots=True)
class Limits:
    """What a peer can cost.  Raises ConfigError for a limit that is not positive.

    Attributes:
        max_clients: links at once that peers opened; the paper's setups have a handful, 32 shows a runaway.
        queue_bytes: what waits for one link; ten images in full HD, a second or two at a frame rate.
        queue_messages: the same in messages; four seconds of transforms at 1 kHz.
        stall_s: longest silence inside a message; TCP itself recovers from a lost packet well within it.
        max_body: longest body of a message received, in bytes; see ``DEFAULT_MAX_BODY``.
    """

    max_clients: int = 32
    queue_bytes: int = 64 * 2**20
    queue_messages: int = 4096
    stall_s: float = 10.0
    max_body: int = DEFAULT_MAX_BODY

    def __post_init__(self) -> None:
        for name in self.__slots__:
            if not getattr(self, name) > 0:
                raise ConfigError(f"limit {name}: found {getattr(self, name)}, expected more than 0")


@dataclass(frozen=True, slots=True)
class LinkInfo:
    """One peer, or one that ``connect`` is trying to reach (number 0, not connected)."""

    number: int
    peer: str
    role: Role
    connected: bool


@dataclass(frozen=True, slots=True)
class LinkCounters:
    """What went over one link so far.

    ``sent`` means handed to the kernel.  ``dropped`` counts per stream the messages that were taken and could not
    be sent: pushed out of the full queue, or left in it when the link closed.  ``ignored`` counts per stream the
    messages that were not taken: for links that were gone already, or that this very message made close.
    """

    sent_messages: int = 0
    sent_bytes: int = 0
    received_messages: int = 0
    received_bytes: int = 0
    queued_messages: int = 0
    queued_bytes: int = 0
    dropped: dict[str, int] = field(default_factory=dict)
    ignored: dict[str, int] = field(default_factory=dict)

    def __add__(self, other: LinkCounters) -> LinkCounters:
        """Both together, stream by stream."""
        return LinkCounters(
            self.sent_messages + other.sent_messages,
            self.sent_bytes + other.sent_bytes,
            self.received_messages + other.received_messages,
            self.received_bytes + other.received_bytes,
            self.queued_messages + other.queued_messages,
            self.queued_bytes + other.queued_bytes,
            dict(Counter(self.dropped) + Counter(other.dropped)),
            dict(Counter(self.ignored) + Counter(other.ignored)),
        )
