"""What ``info`` and ``cohort`` count of a recording: streams with rates, gaps and ages, clocks of peers, notes."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from igtl_gateway.base.quantities import duration_text
from igtl_gateway.base.stamp import NS_PER_S
from igtl_gateway.gateway.log.clock_offset import Offset
from igtl_gateway.gateway.log.clocksteps import ClockStep, without_jump
from igtl_gateway.gateway.log.entry import MESSAGES, Entry, Kind
from igtl_gateway.gateway.log.note import Level, Note
from igtl_gateway.gateway.log.timing import StampTiming, age_text, best

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt

    Numbers = npt.NDArray[np.int64]

#: A gap is a pause of more than this number of mean intervals, and of more than a second.
_GAP_FACTOR = 10
_GAP_MIN_NS = NS_PER_S
#: Messages that make a stream with a rhythm; fewer are events.
_RHYTHM = 20
#: Ages that vary by less are equal.
_LEAST_SHOWN_NS = 1_000
_NS_PER_MS = 1_000_000

#: Number of messages whose age is stored; a longer session must not cost memory.
_MAX_AGES = 100_000


@dataclass(slots=True)
class StreamSummary:
    """The summary of one stream; times in UTC ns of the gateway.

    Attributes:
        restores: messages of before a slice, which restore the state: they are in ``messages``, not in the times.
        links: of OpenIGTLink: those that its messages came from or went to.
        stated_age_ns: median of the ages, and the largest less the smallest, where a recorder has stated them.
    """

    kind: Kind
    channel: str
    type: str
    messages: int = 0
    restores: int = 0
    bytes: int = 0
    first_ns: int = 0
    last_ns: int = 0
    longest_pause_ns: int = 0
    unstamped: int = 0
    ages_ns: list[int] = field(default_factory=list)  # of the first _MAX_AGES messages
    links: set[int] = field(default_factory=set)
    stated_age_ns: tuple[int, int] | None = None

    def add(self, entry: Entry, ahead_ns: int, *, restores: bool = False) -> None:
        if restores:
            self.restores += 1
        else:
            self._add_time(entry.stamp_ns)
        self.messages += 1
        self.bytes += entry.size
        if entry.links:
            self.links.update(entry.links)
        if entry.kind.is_input:
            if not entry.source_ns:
                self.unstamped += 1
            elif len(self.ages_ns) < _MAX_AGES:
                self.ages_ns.append(entry.stamp_ns - ahead_ns - entry.source_ns)

    def add_columns(self, times: Numbers, sizes: Numbers, sources: Numbers, ahead_ns: int, begin_ns: int) -> None:
        """As `add`, of messages in order, at least one, without their links; those before ``begin_ns`` restore."""
        timed = times[times >= begin_ns] if begin_ns else times
        if len(timed):
            if not self._timed:
                self.first_ns = self.last_ns = int(timed[0])
            pauses = [int(timed[0]) - self.last_ns, int((timed[1:] - timed[:-1]).max(initial=0))]
            self.longest_pause_ns = max(self.longest_pause_ns, *pauses)
            self.last_ns = int(timed[-1])
        self.restores += len(times) - len(timed)
        self.messages += len(times)
        self.bytes += int(sizes.sum())
        if self.kind.is_input:
            stamped = sources != 0
            self.unstamped += len(times) - int(stamped.sum())
            if (room := _MAX_AGES - len(self.ages_ns)) > 0:
                self.ages_ns += (times[stamped][:room] - ahead_ns - sources[stamped][:room]).tolist()

    def _add_time(self, stamp_ns: int) -> None:
        if self._timed:
            self.longest_pause_ns = max(self.longest_pause_ns, stamp_ns - self.last_ns)
        else:
            self.first_ns = stamp_ns
        self.last_ns = stamp_ns

    @property
    def _timed(self) -> int:
        return self.messages - self.restores

    @property
    def rate_hz(self) -> float:
        """Mean rate between the first and the last message; 0 where all are of one moment."""
        span_ns = self.last_ns - self.first_ns
        return (self._timed - 1) * NS_PER_S / span_ns if span_ns >= _NS_PER_MS else 0.0

    @property
    def has_gap(self) -> bool:
        span_ns = self.last_ns - self.first_ns
        mean_ns = span_ns / (self._timed - 1) if self._timed >= _RHYTHM else 0
        return bool(mean_ns) and self.longest_pause_ns > max(_GAP_FACTOR * mean_ns, _GAP_MIN_NS)

    @property
    def age_ms(self) -> tuple[float, float] | None:
        """Median of the ages of an input stream's messages when they arrive, and the largest less the smallest."""
        found = self.stated_age_ns
        if self.ages_ns:
            ages = sorted(self.ages_ns)
            found = ages[len(ages) // 2], ages[-1] - ages[0]
        return (found[0] / _NS_PER_MS, found[1] / _NS_PER_MS) if found else None

    @property
    def stamps(self) -> str:
        """Quality of the senders' stamps of an input stream: how old the messages are when they arrive."""
        if not self.kind.is_input:
            return ""
        if self.age_ms is None:
            return "unstamped"
        median_ms, range_ms = self.age_ms
        age = age_text(median_ms * _NS_PER_MS, "median age {}")
        varies = range_ms * _NS_PER_MS
        text = age + (f", varies by {duration_text(varies)}" if varies >= _LEAST_SHOWN_NS else "")
        return text + (f", {self.unstamped:,} unstamped" if self.unstamped else "")

    def to_dict(self) -> dict[str, Any]:
        median_ms, range_ms = self.age_ms or (None, None)
        return {
            "direction": self.kind.value,
            "stream": self.channel,
            "type": self.type,
            "messages": self.messages,
            "restores": self.restores,
            "bytes": self.bytes,
            "rate_hz": round(self.rate_hz, 3),
            "longest_pause_s": self.longest_pause_ns / NS_PER_S,
            "gap": self.has_gap,
            "stamps": self.stamps,
            "age_median_ms": median_ms,
            "age_max_minus_min_ms": range_ms,
        }


@dataclass(slots=True)
class ContentSummary:
    """The summary of all entries.

    Attributes:
        begin_ns: where a slice begins, UTC ns; inputs of before restore the state.
    """

    begin_ns: int = 0

    streams: dict[tuple[Kind, str, str], StreamSummary] = field(default_factory=dict)
    notes: list[tuple[int, Kind, Note]] = field(default_factory=list)
    problems: Counter[str] = field(default_factory=Counter)
    clocks: dict[int, dict[str, StampTiming]] = field(default_factory=dict)  # link (0: ROS) → stream → its stamps
    offsets: dict[int, Offset] = field(default_factory=dict)  # link → the last offset that answers have shown
    addresses: dict[int, str] = field(default_factory=dict)
    entries: int = 0
    steps: list[ClockStep] = field(default_factory=list)

    @property
    def ahead_ns(self) -> int:
        """By how much gateway time is ahead of the host's clock."""
        return self.steps[-1].ahead_ns if self.steps else 0

    @classmethod
    def of(cls, entries: Iterable[Entry], begin_ns: int = 0) -> ContentSummary:
        """Read all entries; ``begin_ns`` as the attribute."""
        content = cls(begin_ns)
        for entry in entries:
            content.add(entry)
        return content

    def add(self, entry: Entry) -> None:
        """Add the next entry."""
        self.entries += 1
        if entry.kind in MESSAGES:
            key = (entry.kind, entry.channel, entry.type)
            stream = self.streams.get(key)
            if stream is None:
                stream = self.streams[key] = StreamSummary(*key)
            stream.add(entry, self.ahead_ns, restores=entry.stamp_ns < self.begin_ns)
            if entry.kind.is_input:
                self.add_stamp(entry)
        else:
            note = Note.of(entry.data())
            if entry.kind is Kind.LINK and "peer" in note.data:
                self.addresses.update(dict.fromkeys(entry.links, str(note.data["peer"])))
            if note.level >= Level.WARN:
                self.problems[note.code] += 1
            self.notes.append((entry.stamp_ns, entry.kind, note))
            if step := ClockStep.of(entry):
                self.apply_clock_step(step)

    def apply_clock_step(self, step: ClockStep) -> None:
        """Apply a step of the host's clock: it is not a pause, and the estimates of other clocks restart."""
        self.steps.append(step)
        for stream in self.streams.values():
            without_jump(stream, step)
        for streams in self.clocks.values():
            for timing in streams.values():
                timing.reset()

    def add_stamp(self, entry: Entry) -> None:
        """Add the stamp of an input to the estimate of its sender's clock."""
        streams = self.clocks.setdefault(entry.links[0] if entry.links else 0, {})
        timing = streams.get(entry.channel)
        if timing is None:
            timing = streams[entry.channel] = StampTiming()
        timing.add(entry.source_ns, entry.stamp_ns - self.ahead_ns)

    def clock_summaries(self) -> list[dict[str, Any]]:
        """Return the clock of each peer, from its best stream; ROS counts as a peer."""
        summary = []
        for link, streams in sorted(self.clocks.items()):
            timing = best(streams.values())
            if timing:
                stream = next(name for name, one in streams.items() if one is timing)
                peer = self.addresses.get(link, "ROS" if link == 0 else "")
                row = {"link": link, "peer": peer, "stream": stream, "text": str(timing)} | timing.to_dict()
                if offset := self.offsets.get(link):
                    row["offset"] = offset.to_dict() | {"text": offset.text}
                summary.append(row)
        return summary
