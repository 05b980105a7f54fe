"""A long recording is verified in segments, which need each other's results only at their ends.

A segment begins with the state that a few inputs from before it give: links, notes and what caused them, the first and
the last messages of each stream, those at which its guard looked last.  Whether that is the state which all inputs
before give, the segment before shows at its end: both digests are equal (`gateway.state`), or there is no result.  So
equal segments, each with the state at the end of the one before, are a verified recording; anything else is decided by
a verification of the whole.

Which inputs these are follows from the indexes of the chunks, without a look into a chunk.  Nothing depends on whether
an index is right: segments are times, their entries are counted, and their numbers have to follow each other.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, fields, replace
from itertools import pairwise
from typing import Any

import numpy as np
import numpy.typing as npt

from igtl_gateway.config.configuration import Config
from igtl_gateway.gateway import LINK_DOWN
from igtl_gateway.gateway.guarded_stream import LOOK_NS, STILL_LOOKS
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.gateway.log.note import Note
from igtl_gateway.gateway.state import NoDigest, state_digest
from igtl_gateway.record.sessionfile.columns import END_NS, EntryColumns, Stream, Unfit, table_of
from igtl_gateway.record.sessionfile.reader import SessionFile
from igtl_gateway.replay.compare import LeafDecoder
from igtl_gateway.replay.recheck import Checker
from igtl_gateway.replay.verify import DeclaredLosses, Verifier, VerifyReport

#: Entries below which a segment costs more than it saves.
LEAST_ENTRIES = 50_000
#: First messages of a stream after each link: in 64 of them, programs such as PLUS are recognised.
_FIRST = 66
#: Inputs that may make a state: more are as long as the segment.
_MOST_INPUTS = 5_000
#: Rounds, after which the whole recording is verified as one.
_ROUNDS = 3
#: Looks of a guard that show its state.
_LOOKS = STILL_LOOKS + 2

_Times = npt.NDArray[Any]
#: Of an input: number of the window that it lies in, and its time (UTC ns).
_Place = tuple[int, int]


@dataclass(frozen=True, slots=True)
class Window:
    """Times (UTC ns) in which inputs are looked up: those of a chunk, and of the inputs."""

    start_ns: int
    end_ns: int
    times: tuple[int, ...]


@dataclass(frozen=True, slots=True)
class Segment:
    """A segment of a recording.

    Attributes:
        start_ns, end_ns: its times, UTC ns; the end is not included.
        left: topic in the file → messages from its start to the end of the recording.
        state: where the inputs are that its state follows from.
    """

    start_ns: int
    end_ns: int
    left: Mapping[str, int]
    state: tuple[Window, ...] = ()

    def to_dict(self) -> dict[str, Any]:
        """It as JSON values."""
        return asdict(self)

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> Segment:
        """As `to_dict` made them."""
        state = tuple(Window(one["start_ns"], one["end_ns"], tuple(one["times"])) for one in values["state"])
        return cls(values["start_ns"], values["end_ns"], dict(values["left"]), state)


@dataclass(frozen=True, slots=True)
class SegmentResult:
    """What a segment has shown.

    Attributes:
        good: no output differs.
        counts: as in a report.
        first, last: numbers of its first and its last entry; 0: there is none.
        before, after: digests of the state at its start and at its end; ``""``: there is none.
    """

    good: bool
    counts: Mapping[str, int]
    first: int
    last: int
    before: str
    after: str

    def to_dict(self) -> dict[str, Any]:
        """It as JSON values."""
        return asdict(self)


#: Verifies segments, in any order; None: one could not be verified.
Run = Callable[[Sequence[Segment]], Sequence[SegmentResult | None]]

_COUNTS = tuple(each.name for each in fields(VerifyReport) if each.type in ("int", int))


def plan(file: SessionFile, losses: DeclaredLosses, most: int) -> list[Segment]:
    """Up to ``most`` segments of about as many entries; none where the recording has to be verified as a whole.

    Raises as `SessionFile.times`.
    """
    most = min(most, file.entry_count // LEAST_ENTRIES)
    # what one segment lacks may be what the recording declares for another
    if most < 2 or losses.entries or losses.uncounted or file.missing_parts:
        return []
    planner = _Planner(file, most)
    try:
        for streams, channels, times in file.times():
            planner.take(streams, channels, times)
    except (Unfit, _TooMuch):
        return []
    return planner.segments()


class _TooMuch(Exception):
    """A state follows from too many inputs."""


class _Followed:
    """The inputs of a channel, as far as the state follows from them."""

    def __init__(self) -> None:
        self.first: list[_Place] = []
        self.looks: deque[_Place] = deque(maxlen=_LOOKS)
        self.last: _Place | None = None
        self.sent: _Place | None = None
        self._wanted = _FIRST
        self._look_ns = 0

    def begin_again(self, *, looks: bool) -> None:
        """A link came or went; its streams may begin again, and their guards, too."""
        self._wanted = _FIRST
        if looks:
            self._look_ns = 0

    def take(self, window: int, times: _Times) -> None:
        wanted = times[: self._wanted].tolist()
        self.first += ((window, time) for time in wanted)
        self._wanted -= len(wanted)
        last_ns = int(times[-1])
        while self._look_ns <= last_ns:
            look_ns = int(times[np.searchsorted(times, self._look_ns)])
            self.looks.append((window, look_ns))
            self._look_ns = look_ns + LOOK_NS
        self.last = window, last_ns

    def places(self) -> Iterator[_Place]:
        yield from self.first
        yield from self.looks
        if self.last:
            yield self.last
        if self.sent:
            yield self.sent


class _Planner:
    """Follows the times of all messages."""

    def __init__(self, file: SessionFile, most: int) -> None:
        self._file = file
        self._each = -(-file.entry_count // most)
        self._left = Counter[str]()
        for channel in file.channels:
            self._left[channel.topic] += channel.count
        self._streams: Mapping[int, Stream] = {}  # of the file that is read, and which of their channels are inputs
        self._known = self._inputs = table_of(())
        self._seen = 0
        self._windows: list[tuple[int, int]] = []
        self._followed: dict[Stream, _Followed] = {}
        self._facts: set[_Place] = set()  # links and notes, and inputs that caused notes
        self._cause: _Place | None = None  # the last input
        self._open: set[tuple[int, ...]] = set()  # links
        self._begun: list[Segment] = [Segment(0, END_NS, dict(self._left))]

    def segments(self) -> list[Segment]:
        """All of them."""
        ends = [each.start_ns for each in self._begun[1:]]
        return [
            Segment(each.start_ns, end_ns, each.left, each.state)
            for each, end_ns in zip(self._begun, [*ends, END_NS], strict=True)
        ]

    def take(self, streams: Mapping[int, Stream], channels: _Times, times: _Times) -> None:
        """The messages of the next chunk."""
        if streams is not self._streams:
            self._streams, self._known = streams, table_of(streams)
            self._inputs = table_of(number for number, stream in streams.items() if stream.kind.is_input)
        known = self._known[channels]
        channels, times = channels[known], times[known].astype(np.int64)
        if not len(times):
            return
        if int(times.min()) < 0:  # after 2262
            raise _TooMuch
        self._windows.append((int(times[0]), int(times[-1]) + 1))
        inputs = self._inputs[channels]
        if self._seen >= self._each * len(self._begun) and inputs.any():
            first = int(np.argmax(inputs))
            self._follow(streams, channels[:first], times[:first], inputs[:first])
            self._begin(int(times[first]))
            channels, times, inputs = channels[first:], times[first:], inputs[first:]
        self._follow(streams, channels, times, inputs)

    def _begin(self, start_ns: int) -> None:
        """A segment begins."""
        places = {*self._facts, *(place for each in self._followed.values() for place in each.places())}
        if len(places) > _MOST_INPUTS:
            raise _TooMuch
        windows: dict[int, list[int]] = {}
        for window, time_ns in sorted(places):
            windows.setdefault(window, []).append(time_ns)
        state = tuple(Window(*self._windows[number], tuple(found)) for number, found in windows.items())
        self._begun.append(Segment(start_ns, END_NS, dict(self._left), state))

    def _follow(self, streams: Mapping[int, Stream], channels: _Times, times: _Times, inputs: _Times) -> None:
        window, count = len(self._windows) - 1, len(times)
        if not count:
            return
        self._seen += count
        causes = np.maximum.accumulate(np.where(inputs, np.arange(count), -1))
        with_output = np.flatnonzero(inputs[:-1] & ~inputs[1:])
        for number in np.flatnonzero(np.bincount(channels)).tolist():
            stream, mine = streams[number], np.flatnonzero(channels == number)
            self._left[stream.topic] -= len(mine)
            if stream.kind is Kind.NOTE:
                self._add((window, int(times[at])) if at >= 0 else self._cause for at in causes[mine].tolist())
            elif stream.kind in (Kind.LINK, Kind.EDGE_NOTE):
                self._add((window, time_ns) for time_ns in times[mine].tolist())
                if stream.kind is Kind.LINK:
                    self._follow_links(times[mine].tolist())
            elif stream.kind.is_input:
                followed = self._followed.setdefault(stream, _Followed())
                followed.take(window, times[mine])
                sent = with_output[channels[with_output] == number]
                if len(sent):
                    followed.sent = window, int(times[sent[-1]])
        if causes[-1] >= 0:
            self._cause = window, int(times[causes[-1]])

    def _add(self, places: Iterable[_Place | None]) -> None:
        self._facts.update(place for place in places if place)
        if len(self._facts) > _MOST_INPUTS:
            raise _TooMuch

    def _follow_links(self, times: Sequence[int]) -> None:
        """Links came and went; a guard looks at a stream from the first message on that comes after its link."""
        for time_ns in times:
            for entry in _entries(self._file, Window(time_ns, time_ns + 1, (time_ns,))):
                if entry.kind is Kind.LINK:
                    is_down = Note.of(entry.data()).code == LINK_DOWN
                    (self._open.discard if is_down else self._open.add)(entry.links)
        for stream, followed in self._followed.items():
            followed.begin_again(looks=stream.kind is Kind.IGTL_IN and not self._open)


def verify_segment(
    file: SessionFile,
    segment: Segment,
    config: Config,
    losses: DeclaredLosses,
    decoder: LeafDecoder | None = None,
    *,
    compiles: bool,
    on_entries: Callable[[int], None] = lambda _: None,
) -> SegmentResult:
    """Verify a segment; ``compiles``: by compiled conversions as far as possible, see `recheck`.

    ``on_entries`` is called with each number of entries that are done.

    Raises as `SessionFile.columns`.
    """
    verifier = Verifier(config, losses, decoder, compiles=compiles)
    checker = Checker(verifier, segment.left) if compiles else None
    try:
        state = [*file.prologue(), *_state(file, segment)]
        verifier.before(state)
        if checker:
            checker.offer(state)
        before = _digest(verifier, checker)
        first = last = 0
        for columns in file.columns(segment.start_ns, segment.end_ns, computed=False):
            if not first:
                first = int(columns.numbers[0])
                if segment.start_ns:
                    verifier.go_on(first)
            last = int(columns.numbers[-1])
            if checker:
                checker.take(columns)
            else:
                for entry in columns.entries():
                    verifier.take(entry)
            on_entries(len(columns))
        report = verifier.end()
        counts = {name: getattr(report, name) for name in _COUNTS}
        return SegmentResult(report.good, counts, first, last, before, _digest(verifier, checker))
    finally:
        if checker:
            checker.close()


def verify_in_segments(segments: Sequence[Segment], run: Run, entry_count: int) -> VerifyReport | None:
    """The result of a recording whose segments ``run`` verifies; None: they do not show that it is verified.

    Where the state at an end is not that of the next start, both segments are verified as one, in the next round.
    """
    known: dict[tuple[int, int], SegmentResult | None] = {}
    for _ in range(_ROUNDS):
        todo = [each for each in segments if _key(each) not in known]
        known.update(zip(map(_key, todo), run(todo), strict=True))
        results = [known[_key(each)] for each in segments]
        joints = [one and two and one.after and one.after == two.before for one, two in pairwise(results)]
        if all(joints):
            return _joined([each for each in results if each], entry_count)
        if None in results or not any(joints):
            return None
        segments = _with_joints(segments, joints)
    return None


def _key(segment: Segment) -> tuple[int, int]:
    return segment.start_ns, segment.end_ns


def _with_joints(segments: Sequence[Segment], joints: Sequence[object]) -> list[Segment]:
    """The segments, joined where there is no joint."""
    found = [segments[0]]
    for each, is_joint in zip(segments[1:], joints, strict=True):
        if is_joint:
            found.append(each)
        else:
            found[-1] = replace(found[-1], end_ns=each.end_ns)
    return found


def _joined(found: Sequence[SegmentResult], entry_count: int) -> VerifyReport | None:
    """The result of segments that follow each other; None: something differs, or entries are missing."""
    counts = Counter[str]()
    for each in found:
        counts.update(each.counts)
    follows = all(one.last + 1 == two.first for one, two in pairwise(found))
    whole = follows and counts["inputs"] + counts["outputs"] == entry_count
    if not whole or not all(each.good and each.first for each in found):
        return None
    report = VerifyReport()
    for name, number in counts.items():
        setattr(report, name, number)
    return report


def _digest(verifier: Verifier, checker: Checker | None) -> str:
    if checker:
        checker.collect()
    try:
        return state_digest(verifier.core)
    except NoDigest:
        return ""


def _state(file: SessionFile, segment: Segment) -> Iterator[Entry]:
    """The inputs that the state of a segment follows from, with their outputs."""
    for window in segment.state:
        yield from _entries(file, window)


def _entries(file: SessionFile, window: Window) -> Iterator[Entry]:
    """The inputs at the times of a window, and the outputs behind them."""
    for columns in file.columns(window.start_ns, window.end_ns, computed=False):
        yield from _with_outputs(columns, np.isin(columns.times, np.array(window.times, columns.times.dtype)))


def _with_outputs(columns: EntryColumns, chosen: npt.NDArray[np.bool_]) -> Iterator[Entry]:
    inputs = columns.of(lambda stream: stream.kind.is_input)
    causes = np.maximum.accumulate(np.where(inputs, np.arange(len(columns)), -1))
    wanted = (causes >= 0) & (chosen & inputs)[causes]
    return columns.where(wanted).entries()
