"""A client that stops reading for a while: what the other one notices, and what it gets itself afterwards."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from igtl_gateway_lab.bench.cases import BenchStream, Direction, payload
from igtl_gateway_lab.bench.figures import Transmission, latency
from igtl_gateway_lab.bench.processes import Program
from igtl_gateway_lab.programs import Event

#: Client numbers of the two.
OTHER, STALLED = 0, 1
NAMES = {OTHER: "other", STALLED: "stalled"}

#: It reads for a tenth of the time, then not for half of it.
_BEFORE, _STALL = 0.1, 0.5


@dataclass
class Stall:
    """What happened.

    Attributes:
        resumed_ns: when it read again, monotonic.
        dropped: what the gateway dropped, by link and stream.
    """

    resumed_ns: int = 0
    dropped: dict[tuple[int, str], int] = field(default_factory=dict)

    def run(self, client: Program, seconds: float, rest: Callable[[float], Any], now: Callable[[], int]) -> None:
        """Have the client stop, and go on."""
        rest(_BEFORE * seconds)
        client.order("stall")
        rest(_STALL * seconds)
        client.order("resume")
        self.resumed_ns = now()

    def note(self, event: Event) -> None:
        """Handle an event of the gateway: some have the number of messages dropped so far, by link or recorder."""
        for link in event.get("links", ()):
            dropped = event["data"].get("dropped", {})
            self.dropped |= {(link, stream): number for stream, number in dropped.items()}

    def to_row(self, what: BenchStream, passage: Transmission) -> dict[str, Any]:
        """Of one stream to the client that stopped: what was sent after it went on, and what of that arrived."""
        after = int((passage.sent <= self.resumed_ns).sum())
        late = latency([Transmission(passage.sent, passage.numbers, passage.received, after)])
        channel = f"{payload(what.kind).igtl_type}/{what.device(Direction.ROS_TO_IGTL)}"
        return {
            "sent_after_resume": late["sent"],
            "delivered_after_resume": late["delivered"],
            "gateway_dropped": sum(number for (_, stream), number in self.dropped.items() if stream == channel),
        }
