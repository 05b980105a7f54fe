"""The state of a bridge as JSON values, for programs that monitor it.

A thread of the bridge takes samples; requests return the last sample.  So requests do not delay the bridge, however
frequent they are, and all values of an answer are of one time.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Protocol

from igtl_gateway.app.bridge import Bridge
from igtl_gateway.base.clock import Clock
from igtl_gateway.base.quantities import clock_text
from igtl_gateway.base.stamp import NS_PER_S, utc_text
from igtl_gateway.base.version import __version__
from igtl_gateway.gateway import Core
from igtl_gateway.gateway.log.entry import Kind
from igtl_gateway.gateway.log.rates import Rates


class EntryCounter(Protocol):
    """Counts the entries of a session, by kind, and the notes of level error."""

    @property
    def counts(self) -> Mapping[Kind, int]: ...
    @property
    def refused(self) -> int: ...


class BridgeStatus:
    """The last sample of a bridge.

    Attributes:
        facts: the sample as JSON values; empty before the first `sample`.  It is replaced, never changed.
        failure: why the last attempt failed, or ``""``; after a failure ``facts`` has the values of the sample before.
    """

    def __init__(self, bridge: Bridge, watcher: EntryCounter, clock: Clock) -> None:
        self.facts: Mapping[str, Any] = {}
        self.failure = ""
        self._bridge = bridge
        self._watcher = watcher
        self._clock = clock
        self._begun_ns = clock.monotonic_ns()
        self._rates = Rates()

    def sample(self) -> None:
        """Take a sample; call this from one thread only.  Never raises: monitoring must not stop the bridge."""
        try:
            self.facts = self._take_sample()
            self.failure = ""
        except Exception as error:  # a defect here must not stop the bridge
            self.failure = f"{type(error).__name__}: {error}"
            self.facts = {**self.facts, "failure": self.failure}

    def _take_sample(self) -> dict[str, Any]:
        bridge, now_ns = self._bridge, self._clock.monotonic_ns()
        ledger = bridge.ledger()
        entries = {kind.value: self._watcher.counts[kind] for kind in Kind}
        seconds, rates = self._rates.take(now_ns, {"entries": entries} | bridge.gateway.ledger.totals())
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
                {
                    "link": link.number,
                    "peer": link.peer,
                    "role": link.role,
                    "connected": link.connected,
                    "profile": bridge.gateway.profile_of(link.number),
                    "clock": clock_of(bridge.gateway, link.number, bridge.hub.now_ns()),
                }
                for link in bridge.tcp.links()
            ],
            "watched": self._watched(),
            "missing": [each.text for each in bridge.awaited.missing],
            "sources": [each.to_dict() for each in bridge.awaited.missing],
            "queues": {
                str(number): {"messages": count.queued_messages, "bytes": count.queued_bytes}
                for number, count in counters.items()
                if number
            },
            "ledger": ledger,
            "native_times": bridge.native_times(),
            "upload": bridge.uploads and bridge.uploads.counters(),
            "recorder": recorder and recorder.facts() | {"path": str(bridge.options.record)},
        }

    def _watched(self) -> list[dict[str, Any]]:
        """Return what the guard knows of each stream, by the clock of its sender; times in ns.

        ``ahead_ns``: that clock is ahead by at least this, or behind by at most its opposite.
        """
        return [
            {
                "link": link,
                "stream": stream,
                "age_ns": one.age_ns,
                "ahead_ns": one.timing.ahead_ns,
                "jitter_ns": one.timing.jitter_ns if one.timing.stamped else None,
                "stamped": one.timing.stamped,
                "unset": one.timing.unset,
                "stale": one.stale,
                "episodes": sorted(one.episodes),
            }
            for (link, stream), one in self._bridge.gateway.guard.items()
        ]


def clock_of(gateway: Core, link: int, now_ns: int) -> dict[str, Any] | None:
    """Return the offset of a peer's clock as JSON values; None: nothing shows it.

    Without answers there is a lower bound only, from the stamps of its streams: they are made before they arrive.
    """
    known = gateway.questions.clocks.offset(link, now_ns) if gateway.questions else None
    if known:
        return known.to_dict() | {"text": known.text}
    least = [one.timing.ahead_ns for (of_link, _), one in gateway.guard.items() if of_link == link and link]
    bounds = [ns for ns in least if ns is not None]
    if not bounds:
        return None
    unknown = dict.fromkeys(("high_ns", "drift_low_ppm", "drift_high_ppm", "answers", "age_s"))
    text = f"clock ahead by ≥ {clock_text(max(bounds))}, by its stamps"
    return {"method": "one-way", "low_ns": max(bounds), **unknown, "text": text}
