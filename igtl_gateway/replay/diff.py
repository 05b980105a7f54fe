"""Compares two recordings: which messages are in one of them only, and how the others differ.

Messages are paired by stream and by their order in it.  If two messages do not match, the next messages of both streams
are searched for a match (equal bytes, or equal size and equal source stamp).  Unmatched messages before it are missing
on the other side.  Both files are read once, in step; at most a window of messages per stream waits for a match.

Both sides are rows of arrays (``rows``).  Runs of messages with equal bytes are found and counted at once; where
two messages differ, and until their streams are in step again, messages are paired one by one.  The result does not
depend on how many rows come at a time.

Times are compared separately from values.  Gateway times of two recordings always differ, so their offset and jitter
are reported but are not a difference.  Stamps inside messages may all be later by one constant, as in a session that
was replayed with shifted stamps.  A stamp that deviates from the most frequent offset is a difference.
"""

from __future__ import annotations

import math
from bisect import bisect_left, bisect_right
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from functools import cached_property
from types import SimpleNamespace
from typing import Any

import numpy as np
import numpy.typing as npt

from igtl_gateway.base.quantities import counted
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.record.sessionfile.chunk_columns import equal_ranges
from igtl_gateway.record.sessionfile.columns import EntryColumns
from igtl_gateway.replay.compare import EXACT, Delta, LeafDecoder, Tolerance, Undecodable, compare_values, first_byte
from igtl_gateway.replay.rows import Array, Heads, Rows, rows_of_columns, rows_of_entries
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
#: Equal pairs one by one after which the next ones are compared at once; how many of them at first.
_IN_STEP, _RUN = 8, 32
#: Buffers with messages that wait, before these are copied together.
_MAX_BUFFERS = 16
#: Numbers below it have 16 bits: numpy sorts these in one pass.
_FEW = 1 << 15
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
        columns: its entries in columns, which are then taken in place of ``entries``.
    """

    entries: Iterable[Entry]
    decoder: LeafDecoder
    columns: Iterable[EntryColumns] | None = None


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
    groups: dict[Key, int] = {}

    def group_of(kind: Kind, channel: str) -> int:
        key = _key(kind, channel, globs, foreign)
        return -1 if key is None else groups.setdefault(key, len(groups))

    heads = Heads(group_of)
    pairing = _Pairing(heads, groups, (one.decoder, other.decoder), tolerance)
    for rows in _in_step(_rows(one, heads), _rows(other, heads)):
        pairing.take(*rows)
    return pairing.end()


def _rows(side: DiffInput, heads: Heads) -> Iterator[Rows]:
    if side.columns is None:
        return rows_of_entries(side.entries, heads)
    return rows_of_columns(side.columns, heads)


class _Reading:
    """The rows of one side that have been read and not yet taken."""

    def __init__(self, blocks: Iterator[Rows]) -> None:
        self._blocks = blocks
        self._start: int | None = None
        self._last: Any = None
        self.ended = False
        self.rows = Rows.none()
        self.ages: Array = self.rows.times

    def fill(self) -> None:
        """Read more if all rows are taken."""
        while not self.ended and not len(self.rows):
            block = next(self._blocks, None)
            if block is None:
                self.ended = True
                return
            self.rows = block
            if not len(block):
                continue
            if self._start is None:
                self._start = int(block.times[0])
            # a time before that of an earlier entry does not wait for the other side
            self.ages = np.maximum.accumulate(block.times - self._start)
            if self._last is not None:
                self.ages = np.maximum(self.ages, self._last)
            self._last = self.ages[-1]

    def take(self, count: int) -> tuple[Rows, Array]:
        """Take rows with their times since the start."""
        rows, ages = self.rows.where(slice(count)), self.ages[:count]
        self.rows, self.ages = self.rows.where(slice(count, None)), self.ages[count:]
        return rows, ages


def _in_step(one: Iterator[Rows], other: Iterator[Rows]) -> Iterator[tuple[Rows, Array, Rows, Array]]:
    """Yield rows of both in the order of their time since the start, at equal times those of the first one before.

    Yields rows and their places in this order, from 0 on in each step.
    """
    ours, theirs = _Reading(one), _Reading(other)
    while True:
        ours.fill()
        theirs.fill()
        if ours.ended and theirs.ended:
            return
        if ours.ended or theirs.ended:
            counts = len(ours.rows), len(theirs.rows)
        elif ours.ages[-1] <= theirs.ages[-1]:
            # the next rows of the first one may have the same time as the last of these
            counts = len(ours.rows), int(np.searchsorted(theirs.ages, ours.ages[-1], "left"))
        else:
            counts = int(np.searchsorted(ours.ages, theirs.ages[-1], "right")), len(theirs.rows)
        rows, ages = ours.take(counts[0])
        others, other_ages = theirs.take(counts[1])
        places = np.arange(len(rows)) + np.searchsorted(other_ages, ages, "left")
        other_places = np.arange(len(others)) + np.searchsorted(ages, other_ages, "right")
        yield rows, places, others, other_places


def _key(kind: Kind, channel: str, globs: Sequence[str], foreign: bool) -> Key | None:
    """Return the stream of entries; None if they are not compared."""
    ros = kind in (Kind.ROS_IN, Kind.ROS_OUT)
    if foreign and not ros:
        return None
    named = matches_any(channel, globs) or (kind in _IGTL and matches_any(channel.partition("/")[2], globs))
    if globs and not (channel and named):
        return None
    return (_ROS if foreign else kind.value, channel)


@dataclass(slots=True)
class _Times:
    """Mean and standard deviation of times, exact by integer sums."""

    number: int = 0
    total: int = 0
    squares: int = 0

    def add(self, number: int, total: int, squares: int) -> None:
        self.number += number
        self.total += total
        self.squares += squares

    @property
    def mean(self) -> float:
        return self.total / self.number if self.number else 0.0

    @property
    def deviation(self) -> float:
        spread = self.number * self.squares - self.total * self.total
        return math.sqrt(spread) / self.number if self.number else 0.0


class _WaitingMessages:
    """The messages of one stream on one side, in order; those from ``at`` up to ``end`` wait for a match.

    Args:
        rows: the side's rows.
        chosen: (n,) those of the stream.
        places: (n,) their places in the common order of both sides.
        waiting: how many of the first ones wait already.
    """

    def __init__(self, rows: Rows, chosen: Array, places: Array, waiting: int) -> None:
        self.rows, self.chosen = rows, chosen
        self.at, self.end = 0, waiting
        self.order = places
        self.sums = np.concatenate(([0], np.cumsum((rows.ends - rows.begins)[chosen])))
        self._digests: dict[int, int] = {}

    # lists, where messages are taken one by one

    @cached_property
    def places(self) -> list[int]:
        found: list[int] = self.order.tolist()
        return found

    @cached_property
    def before(self) -> list[int]:
        """Bytes of the messages before each."""
        found: list[int] = self.sums.tolist()
        return found

    @cached_property
    def _stamps(self) -> list[int]:
        found: list[int] = self.rows.stamps[self.chosen].tolist()
        return found

    def __len__(self) -> int:
        return self.end - self.at

    @property
    def next_place(self) -> float:
        """The place of the next message that does not wait yet; infinity without one."""
        return int(self.order[self.end]) if self.end < len(self.order) else math.inf

    def advance(self, before: float, other: _WaitingMessages) -> None:
        """Let the next message wait, and those behind it that come before a place and that nothing follows from."""
        if other and (not self or len(other) >= AHEAD):
            self.end += 1
            return
        last = bisect_left(self.places, before, self.end)
        room = min(last, self.at + WINDOW)
        if self.before[room] - self.before[self.at] > WINDOW_BYTES:
            room = bisect_right(self.before, self.before[self.at] + WINDOW_BYTES, self.at, room) - 1
        self.end = max(room, self.end + 1)

    def pop(self) -> int:
        """Take the next message; returns its row."""
        self.at += 1
        return int(self.chosen[self.at - 1])

    def payload(self, at: int) -> memoryview:
        return self.rows.payload(int(self.chosen[self.at + at]))

    def digest(self, at: int) -> int:
        found = self._digests.get(self.at + at)
        if found is None:
            found = self._digests[self.at + at] = hash(bytes(self.payload(at)))
        return found

    def stamp(self, at: int) -> tuple[int, int] | None:
        """A message with a changed value usually has the same size and source stamp."""
        at += self.at
        return (self._stamps[at], self.before[at + 1] - self.before[at]) if self._stamps[at] else None

    @property
    def full(self) -> bool:
        size = self.before[self.end] - self.before[self.at]
        return len(self) > WINDOW or (size > WINDOW_BYTES and len(self) > 1)

    def same(self, at: int, other: _WaitingMessages, there: int) -> bool:
        """Return whether two messages match."""
        stamp = self.stamp(at)
        return (stamp is not None and stamp == other.stamp(there)) or self.digest(at) == other.digest(there)

    def find_first_of(self, other: _WaitingMessages) -> int | None:
        """Return the position of the match of the other side's next message; None if it is not in the window."""
        digest, stamp = other.digest(0), other.stamp(0)
        for at in range(len(self)):
            if self.digest(at) == digest:
                return at
        if stamp is not None:
            for at in range(len(self)):
                if self.stamp(at) == stamp:
                    return at
        return None


@dataclass(slots=True)
class _StreamPairing:
    diff: SimpleNamespace  # the values of a StreamDiff, until the end
    times: _Times = field(default_factory=_Times)
    #: Offset of stamps → number of messages with this offset.
    offsets: Counter[int] = field(default_factory=Counter)
    first_at: dict[int, DiffLocation] = field(default_factory=dict)
    index: int = 0

    def count_offset(self, offset: int, number: int, place: Callable[[], DiffLocation]) -> None:
        """Count an offset of stamps; ``place`` returns where it is first."""
        # a stream with this many offsets has no constant one
        known = offset in self.offsets or len(self.offsets) < _MAX_OFFSETS
        self.offsets[offset if known else max(self.offsets)] += number
        if known and offset not in self.first_at:
            self.first_at[offset] = place()


class _Side:
    """Rows of one side by group: those that wait from before, and new ones behind them.

    Attributes:
        rows: of all groups that are compared.
        places: in the common order of both sides; -1: waits from before.
        order: rows, those of a group in a row.
        counts, waiting, starts: by group: its rows, those that wait from before, its first place in ``order``.
        new_buffers: the first buffer of new rows.
    """

    def __init__(self, waiting: Rows, new: Rows, places: Array, heads: Heads) -> None:
        kept = heads.groups[new.heads] >= 0
        if not kept.all():
            new, places = new.where(kept), places[kept]
        self.rows = waiting.with_others(new)
        self.new_buffers = len(self.rows.buffers) - len(new.buffers)
        self.places = np.concatenate((np.full(len(waiting), -1), places))
        groups = heads.groups[self.rows.heads].astype(np.int16 if len(heads.known) < _FEW else np.int32)
        self.order = np.argsort(groups, kind="stable")
        self.groups = int(groups.max()) + 1 if len(groups) else 0
        self.counts = np.bincount(groups, minlength=self.groups)
        self.waiting = np.bincount(groups[: len(waiting)], minlength=self.groups)
        self._sizes = np.concatenate(([0], np.cumsum((self.rows.ends - self.rows.begins)[self.order])))

    def fit(self, groups: int) -> None:
        """Set the number of groups of both sides."""
        more = (0, groups - self.groups)
        self.counts, self.waiting = np.pad(self.counts, more), np.pad(self.waiting, more)
        self.starts = np.cumsum(self.counts) - self.counts

    @property
    def large(self) -> Array:
        """Which groups have more messages, or bytes, than can wait."""
        sizes = self._sizes[self.starts + self.counts] - self._sizes[self.starts]
        return (self.counts > WINDOW) | (sizes > WINDOW_BYTES)

    def queue(self, group: int) -> _WaitingMessages:
        """The messages of a group, in order."""
        first = int(self.starts[group])
        chosen = self.order[first : first + int(self.counts[group])]
        return _WaitingMessages(self.rows, chosen, self.places[chosen], int(self.waiting[group]))

    def first(self, numbers: Array) -> Array:
        """Rows of the first messages of each group, as many as ``numbers`` has."""
        return self._rows(self.starts, numbers)

    def left(self, taken: Array) -> Rows:
        """The messages that go on waiting."""
        left = self.counts - taken
        if not left.any():
            return Rows.none()
        return self.rows.where(self._rows(self.starts + taken, left)).compact(self.new_buffers, _MAX_BUFFERS)

    def _rows(self, starts: Array, numbers: Array) -> Array:
        within = np.arange(int(numbers.sum())) - np.repeat(np.cumsum(numbers) - numbers, numbers)
        found: Array = self.order[np.repeat(starts, numbers) + within]
        return found


class _Pairing:
    def __init__(
        self, heads: Heads, groups: Mapping[Key, int], decoders: tuple[LeafDecoder, LeafDecoder], tolerance: Tolerance
    ) -> None:
        self._heads, self._groups = heads, groups
        self._decoders, self._tolerance = decoders, tolerance
        self._streams: dict[int, _StreamPairing] = {}  # by group, in the order of their first messages
        self._waiting = Rows.none(), Rows.none()
        self._all = _Times()
        self._equal_pairs = 0  # since it was last set to 0

    def take(self, rows: Rows, places: Array, others: Rows, other_places: Array, *, last: bool = False) -> None:
        """Take the next rows of both sides; ``places`` are those in their common order.

        Args:
            last: both recordings have ended, and no message waits any longer.
        """
        one = _Side(self._waiting[0], rows, places, self._heads)
        other = _Side(self._waiting[1], others, other_places, self._heads)
        groups = max(one.groups, other.groups)
        one.fit(groups)
        other.fit(groups)
        self._meet(one, other)
        # pairs of messages at the same place of their stream
        unsettled = (one.waiting > 0) & (other.waiting > 0)
        pairs = np.where(unsettled, 0, np.minimum(one.counts, other.counts))
        mine, theirs = one.first(pairs), other.first(pairs)
        alike = self._alike(one.rows, mine, other.rows, theirs)
        by_one = unsettled | one.large | other.large | last
        by_one[self._heads.groups[one.rows.heads[mine[~alike]]]] = True
        at_once = ~by_one & (pairs > 0)
        if at_once.any():
            chosen = np.repeat(at_once, pairs)
            self._pair_equal(one.rows, mine[chosen], other.rows, theirs[chosen], pairs[at_once])
        taken, other_taken, ends = pairs.copy(), pairs.copy(), np.cumsum(pairs)
        for group in np.flatnonzero(by_one & (one.counts + other.counts > 0)).tolist():
            ours, its = one.queue(group), other.queue(group)
            these = alike[int(ends[group] - pairs[group]) : int(ends[group])]
            self._walk(self._streams[group], ours, its, these, last=last)
            taken[group], other_taken[group] = ours.at, its.at
        self._waiting = one.left(taken), other.left(other_taken)

    def end(self) -> DiffReport:
        """Return the report, at the end of both recordings."""
        nothing = np.zeros(0, np.int64)
        self.take(Rows.none(), nothing, Rows.none(), nothing, last=True)
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
        keys = {group: key for key, group in self._groups.items()}
        streams = [
            StreamDiff(**vars(stream.diff))
            for _, stream in sorted(self._streams.items(), key=lambda item: keys[item[0]])
        ]
        return DiffReport(streams, offset_ns, self._all.mean)

    def _commonest_offset(self) -> int:
        offsets: Counter[int] = Counter()
        for stream in self._streams.values():
            offsets.update(stream.offsets)
        return min(offsets, key=lambda offset: (-offsets[offset], abs(offset)), default=0)

    def _meet(self, one: _Side, other: _Side) -> None:
        """Count the new messages of each stream; begin streams in the order of their first messages."""
        first: dict[int, int] = {}
        for side in (one, other):
            for group in np.flatnonzero(side.counts).tolist():
                if group not in self._streams:
                    place = int(side.places[side.order[side.starts[group]]])
                    first[group] = min(place, first.get(group, place))
        keys = list(self._groups)
        for group in sorted(first, key=lambda each: first[each]):
            self._streams[group] = _StreamPairing(SimpleNamespace(**asdict(StreamDiff(*keys[group]))))
        for side, name in ((one, "messages"), (other, "other_messages")):
            new = side.counts - side.waiting
            for group in np.flatnonzero(new).tolist():
                values = self._streams[group].diff
                setattr(values, name, getattr(values, name) + int(new[group]))

    def _alike(self, one: Rows, mine: Array, other: Rows, theirs: Array) -> npt.NDArray[np.bool_]:
        """Which pairs have the same type, links and bytes."""
        alike = np.zeros(len(mine), np.bool_)
        if len(mine):
            equal_ranges(
                one.buffers, one.which[mine], one.begins[mine], one.ends[mine],
                other.buffers, other.which[theirs], other.begins[theirs], other.ends[theirs], alike,
            )  # fmt: skip
            forms = self._heads.forms
            alike &= forms[one.heads[mine]] == forms[other.heads[theirs]]
        return alike

    def _pair_equal(self, one: Rows, mine: Array, other: Rows, theirs: Array, counts: Array) -> None:
        """Pair messages that are alike, of some streams, of each as many as ``counts`` has."""
        offsets = other.times[theirs] - one.times[mine]
        stamped = (one.stamps[mine] != 0) & (other.stamps[theirs] != 0)
        end = 0
        for count in counts.tolist():
            begin, end = end, end + count
            stream = self._streams[int(self._heads.groups[one.heads[mine[begin]]])]
            sums = _sums(offsets[begin:end])
            stream.times.add(*sums)
            self._all.add(*sums)
            if number := int(np.count_nonzero(stamped[begin:end])):
                at = begin + int(np.argmax(stamped[begin:end]))

                def place(stream: _StreamPairing = stream, row: int = at, first: int = begin) -> DiffLocation:
                    numbers = int(one.numbers[mine[row]]), int(other.numbers[theirs[row]])
                    return DiffLocation(stream.index + 1 + row - first, *numbers, Delta(stamps_ns=[0]))

                stream.count_offset(0, number, place)
            stream.index += count

    def _walk(
        self, stream: _StreamPairing, one: _WaitingMessages, other: _WaitingMessages, alike: Array, *, last: bool
    ) -> None:
        """Let the messages of a stream arrive in their order, and pair them.

        Args:
            alike: whether the messages at the same place of the stream are alike; empty if these are not known to be
                pairs.
        """
        self._pair_run(stream, one, other, alike)
        equal = 0  # pairs in a row
        while one.next_place < math.inf or other.next_place < math.inf:
            if one.next_place < other.next_place:
                one.advance(other.next_place, other)
            else:
                other.advance(one.next_place, one)
            before = one.at
            self._equal_pairs = 0
            self._pair_waiting(stream, one, other, full=lambda: one.full or other.full)
            if one.at > before:
                equal = equal + self._equal_pairs if one.at - before == self._equal_pairs else 0
            count = _RUN
            while equal >= _IN_STEP and not (one and other):
                count = min(2 * count, len(one.chosen) - one.at, len(other.chosen) - other.at)
                mine, theirs = (side.chosen[side.at : side.at + count] for side in (one, other))
                if (
                    self._pair_run(stream, one, other, self._alike(one.rows, mine, other.rows, theirs)) < count
                    or not count
                ):
                    equal = 0
        if last:
            self._pair_waiting(stream, one, other, full=lambda: True)

    def _pair_run(self, stream: _StreamPairing, one: _WaitingMessages, other: _WaitingMessages, alike: Array) -> int:
        """Pair the next messages at once while they are alike, and the window is not full before they meet.

        Returns how many.
        """
        count = len(alike) if alike.all() else int(np.argmin(alike))
        count = min(count, _in_window(one, other, count), _in_window(other, one, count))
        if not count:
            return 0
        mine, theirs = (side.chosen[side.at : side.at + count] for side in (one, other))
        self._pair_equal(one.rows, mine, other.rows, theirs, np.array([count]))
        for side in (one, other):
            side.at += count
            side.end = max(side.end, side.at)
        return count

    def _pair_waiting(
        self, stream: _StreamPairing, one: _WaitingMessages, other: _WaitingMessages, full: Callable[[], bool]
    ) -> None:
        """Pair messages while possible; while ``full()`` is true, also without waiting for better matches."""
        while one or other:
            if one and other and one.same(0, other, 0):
                self._pair(stream, one, other)
                continue
            if min(len(one), len(other)) < AHEAD and not full():
                return
            skipped = _together(one, other)
            if skipped is None and one and other:
                self._pair(stream, one, other)
                continue
            ours, theirs = skipped or (len(one), len(other))
            for _ in range(min(ours, theirs)):
                self._pair(stream, one, other)
            for _ in range(ours - theirs):
                self._missing(stream, one)
            for _ in range(theirs - ours):
                self._extra(stream, other)

    def _missing(self, stream: _StreamPairing, one: _WaitingMessages) -> None:
        row = one.pop()
        stream.index += 1
        stream.diff.missing += 1
        stream.diff.first_missing = stream.diff.first_missing or int(one.rows.numbers[row])

    def _extra(self, stream: _StreamPairing, other: _WaitingMessages) -> None:
        row = other.pop()
        stream.diff.extra += 1
        stream.diff.first_extra = stream.diff.first_extra or int(other.rows.numbers[row])

    def _pair(self, stream: _StreamPairing, ours: _WaitingMessages, theirs: _WaitingMessages) -> None:
        one, other = ours.pop(), theirs.pop()
        stream.index += 1
        offset_ns = int(theirs.rows.times[other]) - int(ours.rows.times[one])
        for times in (stream.times, self._all):
            times.add(1, offset_ns, offset_ns * offset_ns)
        diff_so_far, delta = stream.diff, self._delta(ours.rows, one, theirs.rows, other)
        place = DiffLocation(stream.index, int(ours.rows.numbers[one]), int(theirs.rows.numbers[other]), delta)
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
            stream.count_offset(offset, 1, lambda: place)

    def _delta(self, ours: Rows, one: int, theirs: Rows, other: int) -> Delta:
        head, another = self._heads.known[ours.heads[one]], self._heads.known[theirs.heads[other]]
        if head.type != another.type:
            return Delta("type", head.type, another.type)
        if head.links != another.links:
            return Delta("links", list(head.links), list(another.links))
        if ours.payload(one) == theirs.payload(other):
            self._equal_pairs += 1
            return Delta(stamps_ns=[0] if ours.stamps[one] and theirs.stamps[other] else [])
        entries = ours.entry(one, self._heads), theirs.entry(other, self._heads)
        try:
            leaves = (decoder.leaves(entry) for decoder, entry in zip(self._decoders, entries, strict=True))
            return compare_values(next(leaves), next(leaves), self._tolerance)
        except Undecodable:
            return Delta(*first_byte(entries[0].data(), entries[1].data()))


def _sums(offsets: Array) -> tuple[int, int, int]:
    """The number of some times, their sum, and that of their squares, exact."""
    count, first = len(offsets), int(offsets[0])
    if int(offsets.max()) - int(offsets.min()) >= math.isqrt((1 << 63) // count):
        values = offsets.tolist()
        return count, sum(values), sum(value * value for value in values)
    rest = (offsets - first).astype(np.int64)
    total, squares = int(rest.sum()), int(np.dot(rest, rest))
    return count, count * first + total, count * first * first + 2 * first * total + squares


def _in_window(one: _WaitingMessages, other: _WaitingMessages, count: int) -> int:
    """How many pairs of the next ``count`` are complete before the window of ``one`` is full.

    The window is full when a message arrives while too many, or too large ones, wait before it.
    """
    first = one.at + np.arange(count)
    # those of ``one`` that are there when the partner of each arrives
    there = np.searchsorted(one.order, other.order[other.at : other.at + count], "left")
    there = np.maximum(np.maximum(there, one.end), first)
    waiting = there - first
    size = one.sums[there] - one.sums[first]
    full = (waiting > WINDOW) | ((size > WINDOW_BYTES) & (waiting > 1))
    return int(np.argmax(full)) if full.any() else count


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
    return text if len(text) <= 100 else f"{text[:80]}… ({counted(len(text), 'character')})"
