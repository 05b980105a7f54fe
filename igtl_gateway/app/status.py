"""What a bridge is doing, as plain values for programs that watch it.

The bridge's own thread takes a sample now and then; whoever asks gets the last one.  So a question costs the bridge
nothing, however often it is asked, and what is told is of one moment.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from typing import Any, Protocol

from igtl_gateway import __version__
from igtl_gateway.app.bridge import Bridge
from igtl_gateway.clock import Clock
from igtl_gateway.session.entry import Kind
from igtl_gateway.stamp import NS_PER_S, utc_text

#: Rates are means over so many seconds.
RATES_OVER_S = 5.0

#: What the ledger calls the messages that came, whatever became of them.
_CAME = ("received", "sent", "published")

#: (direction, stream) → messages.
_Totals = dict[tuple[str, str], int]


class EntryCounter(Protocol):
    """Whoever counts the entries of a session."""

    @property
    def counts(self) -> Mapping[Kind, int]: ...
    @property
    def refused(self) -> int: ...


class BridgeStatus:
    """The last sample of a bridge.

    Attributes:
        facts: what it tells, as JSON values; empty before the first `sample`.  Never changed, only replaced.
        failure: why the last sample could not be taken, or ``""``; ``facts`` are those of the one before.
    """

    def __init__(self, bridge: Bridge, watcher: EntryCounter, clock: Clock) -> None:
        self.facts: Mapping[str, Any] = {}
        self.failure = ""
        self._bridge = bridge
        self._watcher = watcher
        self._clock = clock
        self._begun_ns = clock.monotonic_ns()
        self._past: deque[tuple[int, _Totals]] = deque()

    def sample(self) -> None:
        """Look at the bridge; of one thread.  Never raises: a bridge must not end because it is watched."""
        try:
            self.facts = self._take_sample()
            self.failure = ""
        except Exception as error:  # a defect of ours
            self.failure = f"{type(error).__name__}: {error}"
            self.facts = {**self.facts, "failure": self.failure}

    def _take_sample(self) -> dict[str, Any]:
        bridge, now_ns = self._bridge, self._clock.monotonic_ns()
        ledger = bridge.ledger()
        entries = {kind.value: self._watcher.counts[kind] for kind in Kind}
        seconds, rates = self._rates(now_ns, _totals(entries, ledger["streams"]))
        counters = bridge.tcp.counters()
        recorder = bridge.recorder
        return {
            "version": __version__,
            "time": utc_text(self._clock.utc_ns()),
            "uptime_s": (now_ns - self._begun_ns) / NS_PER_S,
            "relay": bridge.gateway.config.relay,
            "ros": bridge.ros is not None,
            "entries": entries,
            "refused": self._watcher.refused,
            "rates": {"over_s": seconds} | rates,
            "peers": [
                {"link": link.number, "peer": link.peer, "role": link.role, "connected": link.connected}
                for link in bridge.tcp.links()
            ],
            "queues": {
                str(number): {"messages": count.queued_messages, "bytes": count.queued_bytes}
                for number, count in counters.items()
                if number
            },
            "ledger": ledger,
            "recorder": recorder
            and recorder.counters() | {"path": str(bridge.options.record), "paused": recorder.paused},
        }

    def _rates(self, now_ns: int, totals: _Totals) -> tuple[float, dict[str, dict[str, float]]]:
        """Over how many seconds, and messages a second: direction → stream → rate; "entries" → kind → rate."""
        past = self._past
        past.append((now_ns, totals))
        while len(past) > 2 and now_ns - past[1][0] >= RATES_OVER_S * NS_PER_S:  # the oldest reaches that far back
            past.popleft()
        then_ns, before = past[0]
        seconds = (now_ns - then_ns) / NS_PER_S
        rates: dict[str, dict[str, float]] = {}
        for (direction, stream), total in totals.items():
            rate = (total - before.get((direction, stream), 0)) / seconds if seconds else 0.0
            rates.setdefault(direction, {})[stream] = round(rate, 3)
        return seconds, rates


def _totals(entries: Mapping[str, int], streams: Mapping[str, Any]) -> _Totals:
    totals = {("entries", kind): number for kind, number in entries.items()}
    for direction, books in streams.items():
        for stream, fates in books.items():
            if came := next((fates[fate] for fate in _CAME if fate in fates), 0):
                totals[direction, stream] = came
    return totals
