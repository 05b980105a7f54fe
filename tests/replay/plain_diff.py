"""The comparison of two recordings entry by entry, for tests of ``replay/diff``, which has to find the same.

Messages are paired by stream and by their order in it.  If two messages do not match, the next messages of both streams
are searched for a match (equal bytes, or equal size and equal source stamp).  Unmatched messages before it are missing
on the other side.  Both files are read once, in step; at most a window of messages per stream waits for a match.

Times are compared separately from values.  Gateway times of two recordings always differ, so their offset and jitter
are reported but are not a difference.  Stamps inside messages may all be later by one constant, as in a session that
was replayed with shifted stamps.  A stamp that deviates from the most frequent offset is a difference.
"""

from __future__ import annotations

import math
from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass, field
from types import SimpleNamespace
from typing import Any

from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.replay.compare import EXACT, Delta, LeafDecoder, Tolerance, Undecodable, compare_values, first_byte
from igtl_gateway.replay.source import matches_any

#: Maximum number of messages of a stream that wait for a match, and their maximum size in bytes.
WINDOW = 1024
WINDOW_BYTES = 32 << 20
#: Number of messages on both sides that are searched for the nearest match.  Messages that wait longer are searched
#: only for the match of the next message.
AHEAD = 16
#: Maximum rounding of a stamp by the 32.32 fixed-point format.
STAMP_NS = 1_000

_MAX_OFFSETS = 10_000
_ROS = "ros"
_IGTL = frozenset({Kind.IGTL_IN, Kind.IGTL_OUT})

Key = tuple[str, str]


@dataclass(frozen=True, slots=True)
class DiffLocation:
    """The position of a difference in a stream.

    Attributes:
        index: number of the message in the stream of the first recording, from 1.
        seq, other_seq: entry numbers; 0 = none.
        delta: difference of the messages.
    """

    index: int
    seq: int
    other_seq: int
    delta: Delta

    def __str__(self) -> str:
        measure = f" ({self.delta.measure})" if self.delta.measure else ""
        return (
            f"message {self.index} (entries {self.seq}, {self.other_seq}): {self.delta.field} "
            f"is {_value_text(self.delta.one)} and {_value_text(self.delta.other)}{measure}"
        )


@dataclass(frozen=True, slots=True)
class StreamDiff:
    """One stream in both recordings.

    Attributes:
        kind: ``igtl_in`` …; ``ros`` if one recording is not of igtl-gateway.
        stream: channel of the stream.
        messages, other_messages: number of messages in each recording.
        missing: number of messages that only the first recording has.
        extra: number of messages that only the other recording has.
        different: number of messages that differ by more than the tolerance.
        restamped: number of messages with a stamp that deviates from the most frequent offset.
        within: number of messages that differ within the tolerance.
        mm, deg: largest distance in millimetres and largest rotation in degrees.
        mm_at, deg_at: positions of these two.
        first: position of the first difference of values.
        first_missing, first_extra: entry numbers of the first missing and extra message; 0 = none.
        offset_ns: mean offset of the gateway times in the other recording.
        jitter_ns: standard deviation of that offset.
    """

    kind: str
    stream: str
    messages: int = 0
    other_messages: int = 0
    missing: int = 0
    extra: int = 0
    different: int = 0
    restamped: int = 0
    within: int = 0
    mm: float = 0.0
    deg: float = 0.0
    mm_at: int = 0
    deg_at: int = 0
    first: DiffLocation | None = None
    first_missing: int = 0
    first_extra: int = 0
    offset_ns: float = 0.0
    jitter_ns: float = 0.0

    @property
    def equal(self) -> bool:
        return not (self.missing or self.extra or self.different or self.restamped)


@dataclass(slots=True)
class DiffReport:
    """The differences of two recordings.

    Attributes:
        streams: differences by kind and stream.
        stamp_offset_ns: most frequent offset of the stamps in the messages of the other recording.
        offset_ns: mean offset of its gateway times.
    """

    streams: list[StreamDiff] = field(default_factory=list)
    stamp_offset_ns: int = 0
    offset_ns: float = 0.0

    @property
    def equal(self) -> bool:
        return all(stream.equal for stream in self.streams)


@dataclass(slots=True)
class DiffInput:
    """One recording to compare.

    Attributes:
        entries: its entries in order.
        decoder: decoder of its messages.
    """

    entries: Iterable[Entry]
    decoder: LeafDecoder


def diff(
    one: DiffInput, other: DiffInput, *, globs: Sequence[str] = (), tolerance: Tolerance = EXACT, foreign: bool = False
) -> DiffReport:
    """Compare two recordings.

    Args:
        one, other: the recordings.
        globs: select streams by topic, ``TYPE/device`` or device; empty = all, with notes.
        tolerance: differences that count as equal.
        foreign: one of them (not both) is of another program: its ROS messages are compared with those of the session
            in both directions.
    """
    pairing = _Pairing(one.decoder, other.decoder, tolerance)
    for entry, first in _in_step(one.entries, other.entries):
        if key := _key(entry, globs, foreign):
            pairing.take(key, entry, first)
    return pairing.end()


def _in_step(one: Iterable[Entry], other: Iterable[Entry]) -> Iterator[tuple[Entry, bool]]:
    """Yield the entries of both in the order of their time since the start, and whether of the first one."""
    sides = iter(one), iter(other)
    heads = [next(side, None) for side in sides]
    starts = [head.stamp_ns if head else 0 for head in heads]
    while any(head is not None for head in heads):
        ages = [head.stamp_ns - start if head else math.inf for head, start in zip(heads, starts, strict=True)]
        at = 0 if ages[0] <= ages[1] else 1
        head = heads[at]
        assert head is not None
        yield head, at == 0
        heads[at] = next(sides[at], None)


def _key(entry: Entry, globs: Sequence[str], foreign: bool) -> Key | None:
    """Return the stream of an entry; None if it is not compared."""
    ros = entry.kind in (Kind.ROS_IN, Kind.ROS_OUT)
    if foreign and not ros:
        return None
    named = matches_any(entry.channel, globs) or (
        entry.kind in _IGTL and matches_any(entry.channel.partition("/")[2], globs)
    )
    if globs and not (entry.channel and named):
        return None
    return (_ROS if foreign else entry.kind.value, entry.channel)


@dataclass(slots=True)
class _Times:
    """Mean and standard deviation of times, exact by integer sums."""

    number: int = 0
    total: int = 0
    squares: int = 0

    def add(self, value: int) -> None:
        self.number += 1
        self.total += value
        self.squares += value * value

    @property
    def mean(self) -> float:
        return self.total / self.number if self.number else 0.0

    @property
    def deviation(self) -> float:
        spread = self.number * self.squares - self.total * self.total
        return math.sqrt(spread) / self.number if self.number else 0.0


class _WaitingMessages:
    """Messages of one side that wait for a match."""

    def __init__(self) -> None:
        self._entries: deque[Entry] = deque()
        self._digests: deque[int] = deque()
        self._stamps: deque[tuple[int, int] | None] = deque()
        self._size = 0

    def __len__(self) -> int:
        return len(self._entries)

    def push(self, entry: Entry) -> None:
        self._entries.append(entry)
        self._digests.append(hash(entry.data()))
        # a message with a changed value usually has the same size and source stamp
        self._stamps.append((entry.source_ns, entry.size) if entry.source_ns else None)
        self._size += entry.size

    def pop(self) -> Entry:
        entry = self._entries.popleft()
        self._digests.popleft()
        self._stamps.popleft()
        self._size -= entry.size
        return entry

    @property
    def full(self) -> bool:
        return len(self) > WINDOW or (self._size > WINDOW_BYTES and len(self) > 1)

    def same(self, at: int, other: _WaitingMessages, there: int) -> bool:
        """Return whether two messages match."""
        if self._digests[at] == other._digests[there]:
            return True
        return self._stamps[at] is not None and self._stamps[at] == other._stamps[there]

    def find_first_of(self, other: _WaitingMessages) -> int | None:
        """Return the position of the match of the other side's next message; None if it is not in the window."""
        for mine, wanted in ((self._digests, other._digests[0]), (self._stamps, other._stamps[0])):
            if wanted is not None and wanted in mine:
                return mine.index(wanted)  # type: ignore[arg-type]
        return None


@dataclass(slots=True)
class _StreamPairing:
    diff: SimpleNamespace  # the values of a StreamDiff, until the end
    one: _WaitingMessages = field(default_factory=_WaitingMessages)
    other: _WaitingMessages = field(default_factory=_WaitingMessages)
    times: _Times = field(default_factory=_Times)
    #: Offset of stamps → number of messages with this offset.
    offsets: Counter[int] = field(default_factory=Counter)
    first_at: dict[int, DiffLocation] = field(default_factory=dict)
    index: int = 0


class _Pairing:
    def __init__(self, one: LeafDecoder, other: LeafDecoder, tolerance: Tolerance) -> None:
        self._decoders = one, other
        self._tolerance = tolerance
        self._streams: dict[Key, _StreamPairing] = {}
        self._all = _Times()

    def take(self, key: Key, entry: Entry, first: bool) -> None:
        """Take the next entry of one side."""
        stream = self._streams.get(key)
        if stream is None:
            stream = self._streams[key] = _StreamPairing(SimpleNamespace(**asdict(StreamDiff(*key))))
        if first:
            stream.diff.messages += 1
            stream.one.push(entry)
        else:
            stream.diff.other_messages += 1
            stream.other.push(entry)
        self._pair_waiting(stream, lambda: stream.one.full or stream.other.full)

    def end(self) -> DiffReport:
        """Return the report, at the end of both recordings."""
        for stream in self._streams.values():
            self._pair_waiting(stream, lambda: True)
        offset_ns = self._commonest_offset()
        for stream in self._streams.values():
            diff_so_far = stream.diff
            wrong = [offset for offset in stream.offsets if abs(offset - offset_ns) > STAMP_NS]
            diff_so_far.restamped = sum(stream.offsets[offset] for offset in wrong)
            if wrong and diff_so_far.first is None:
                first = min(wrong, key=lambda offset: stream.first_at[offset].index)
                diff_so_far.first = stream.first_at[first]
                diff_so_far.first.delta.differ(
                    "stamp", f"{offset_ns:+,} ns (most stamps)", f"{first:+,} ns (this stamp)"
                )
            diff_so_far.offset_ns, diff_so_far.jitter_ns = stream.times.mean, stream.times.deviation
        streams = [StreamDiff(**vars(stream.diff)) for _, stream in sorted(self._streams.items())]
        return DiffReport(streams, offset_ns, self._all.mean)

    def _commonest_offset(self) -> int:
        offsets: Counter[int] = Counter()
        for stream in self._streams.values():
            offsets.update(stream.offsets)
        return min(offsets, key=lambda offset: (-offsets[offset], abs(offset)), default=0)

    def _pair_waiting(self, stream: _StreamPairing, full: Callable[[], bool]) -> None:
        """Pair messages while possible; while ``full()`` is true, also without waiting for better matches."""
        one, other = stream.one, stream.other
        while one or other:
            if one and other and one.same(0, other, 0):
                self._pair(stream)
                continue
            if min(len(one), len(other)) < AHEAD and not full():
                return
            skipped = _together(one, other)
            if skipped is None and one and other:
                self._pair(stream)
                continue
            ours, theirs = skipped or (len(one), len(other))
            for _ in range(min(ours, theirs)):
                self._pair(stream)
            for _ in range(ours - theirs):
                self._missing(stream)
            for _ in range(theirs - ours):
                self._extra(stream)

    def _missing(self, stream: _StreamPairing) -> None:
        entry = stream.one.pop()
        stream.index += 1
        stream.diff.missing += 1
        stream.diff.first_missing = stream.diff.first_missing or entry.seq

    def _extra(self, stream: _StreamPairing) -> None:
        entry = stream.other.pop()
        stream.diff.extra += 1
        stream.diff.first_extra = stream.diff.first_extra or entry.seq

    def _pair(self, stream: _StreamPairing) -> None:
        one, other = stream.one.pop(), stream.other.pop()
        stream.index += 1
        stream.times.add(other.stamp_ns - one.stamp_ns)
        self._all.add(other.stamp_ns - one.stamp_ns)
        diff_so_far, delta = stream.diff, self._delta(one, other)
        place = DiffLocation(stream.index, one.seq, other.seq, delta)
        if delta.field:
            diff_so_far.different += 1
            diff_so_far.first = diff_so_far.first or place
        elif delta.mm or delta.deg:
            diff_so_far.within += 1
        if delta.mm > diff_so_far.mm:
            diff_so_far.mm, diff_so_far.mm_at = delta.mm, stream.index
        if delta.deg > diff_so_far.deg:
            diff_so_far.deg, diff_so_far.deg_at = delta.deg, stream.index
        for offset in set(delta.stamps_ns):
            # a stream with this many offsets has no constant one
            known = offset in stream.offsets or len(stream.offsets) < _MAX_OFFSETS
            stream.offsets[offset if known else max(stream.offsets)] += 1
            if known:
                stream.first_at.setdefault(offset, place)

    def _delta(self, one: Entry, other: Entry) -> Delta:
        if one.type != other.type:
            return Delta("type", one.type, other.type)
        if one.links != other.links:
            return Delta("links", list(one.links), list(other.links))
        ours, theirs = one.data(), other.data()
        if ours == theirs:
            return Delta(stamps_ns=[0] if one.source_ns and other.source_ns else [])
        try:
            leaves = (decoder.leaves(entry) for decoder, entry in zip(self._decoders, (one, other), strict=True))
            return compare_values(next(leaves), next(leaves), self._tolerance)
        except Undecodable:
            return Delta(*first_byte(ours, theirs))


def _together(one: _WaitingMessages, other: _WaitingMessages) -> tuple[int, int] | None:
    """Return the number of messages on each side before the nearest match."""
    ours, theirs = min(AHEAD, len(one)), min(AHEAD, len(other))
    for distance in range(1, ours + theirs - 1):
        for i in range(max(0, distance - theirs + 1), min(distance, ours - 1) + 1):
            if one.same(i, other, distance - i):
                return i, distance - i
    if not one or not other:
        return None
    if (at := one.find_first_of(other)) is not None:
        return at, 0
    at = other.find_first_of(one)
    return None if at is None else (0, at)


def _value_text(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 100 else f"{text[:80]}… ({len(text)} characters)"
