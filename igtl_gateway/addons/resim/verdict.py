"""The verdict on runs: whether all are equal, and whether they are what a recording or a baseline has.

Runs are compared by stream and session time: a message of one run and that of another belong together if they have the
same time.  Messages with different bytes are decoded, so that bytes between fields do not count.  Nothing may differ
between runs.  The outputs of a baseline, which an earlier run has written, are compared in the same way, with a
tolerance.  In a live recording the times are those of its day: its messages are paired by their order and contents
(`igtl_gateway.replay.diff`), and stamps within them are reported but do not count.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path
from typing import Any

from igtl_gateway.addon import Entry, Kind, SessionFile, matches
from igtl_gateway.addons.resim.engine import Run, RunResult
from igtl_gateway.addons.resim.outputs import OF_EVERY_NODE
from igtl_gateway.replay.compare import EXACT, Delta, LeafDecoder, Tolerance, Undecodable, compare_values, first_byte
from igtl_gateway.replay.diff import DiffInput, StreamDiff, diff

#: Key of the session metadata of a run's outputs.
_RESIM_KEY = "resim_of"
#: Messages that are looked at for a late one.
_AHEAD = 16


@dataclass(frozen=True, slots=True)
class Difference:
    """Where two recordings of one stream differ.

    Attributes:
        stream: the topic.
        number: of the message in the stream of the first one, from 1.
        time_ns: session time of the first one, UTC ns.
        what: "differs", "missing" (the other one does not have it), "extra" (only it has it), "late" or "early".
        late_ns: how much later the other one is.
        delta: the difference of values.
    """

    stream: str
    number: int
    time_ns: int
    what: str
    late_ns: int = 0
    delta: Delta = field(default_factory=Delta)

    def text(self, start_ns: int) -> str:
        """One line for a person; ``start_ns``: start of the session."""
        place = f"{self.stream}, message {self.number} at {(self.time_ns - start_ns) / 1e9:.6f} s"
        match self.what:
            case "missing":
                return f"{place}: missing"
            case "extra":
                return f"{place}: one more"
            case "late" | "early":
                return f"{place}: {abs(self.late_ns) / 1e6:.3f} ms {self.what}"
        measure = f" ({self.delta.measure})" if self.delta.measure else ""
        return f"{place}: {self.delta.field} is {_short(self.delta.one)} and {_short(self.delta.other)}{measure}"


@dataclass(slots=True)
class StreamVerdict:
    """One stream in two recordings; numbers of messages.

    Attributes:
        stream: the topic.
        messages, other_messages: of both.
        different, missing, extra, late: that differ in values, that only one side has, that come at another time.
        within: that differ within the tolerance.
        mm, deg: largest distance in millimetres and largest rotation in degrees.
        restamped: against a live recording: whose stamps deviate from the most frequent offset; they do not count.
        first: the first difference that counts.
    """

    stream: str
    messages: int = 0
    other_messages: int = 0
    different: int = 0
    missing: int = 0
    extra: int = 0
    late: int = 0
    within: int = 0
    mm: float = 0.0
    deg: float = 0.0
    restamped: int = 0
    first: Difference | None = None

    @property
    def is_equal(self) -> bool:
        return not (self.different or self.missing or self.extra or self.late)

    def note(self, found: Difference) -> None:
        self.first = self.first or found


@dataclass(slots=True)
class Verdict:
    """The result.

    Attributes:
        runs: runs that came to the end of the session.
        start_ns: start of the session, UTC ns.
        fault: why the programs could not be judged; ``""`` if they could.
        unequal_run: number of the first run that differs from the first one; 0 = none.
        between_runs: the streams of that run in which it differs.
        reference: what the outputs were compared with; None = nothing.
        streams: the streams in the reference and in the first run.
    """

    runs: int
    start_ns: int
    fault: str = ""
    unequal_run: int = 0
    between_runs: list[StreamVerdict] = field(default_factory=list)
    reference: Path | None = None
    streams: list[StreamVerdict] = field(default_factory=list)

    @property
    def is_deterministic(self) -> bool:
        return not self.fault and not self.unequal_run

    @property
    def is_as_reference(self) -> bool:
        return all(stream.is_equal for stream in self.streams)

    @property
    def exit_code(self) -> int:
        """0: equal; 1: not deterministic, or not as the reference; 2: the programs could not be judged."""
        return 2 if self.fault else 0 if self.is_deterministic and self.is_as_reference else 1

    @property
    def first(self) -> Difference | None:
        """The difference that comes first in session time: between runs, or else against the reference."""
        found = [each.first for each in self.between_runs or self.streams if each.first]
        return min(found, key=lambda each: (each.time_ns, each.stream), default=None)

    def line(self) -> str:
        """One line for a person."""
        if self.fault:
            return f"CANNOT BE JUDGED: {self.fault}"
        first = self.first
        if self.unequal_run and first:
            return f"NOT DETERMINISTIC: run {self.unequal_run} differs from run 1: {first.text(self.start_ns)}"
        same = f"deterministic: {self.runs} of {self.runs} runs equal" if self.runs > 1 else "1 run"
        if not self.reference or not self.streams:
            return same
        if first:
            wrong = sum(not each.is_equal for each in self.streams)
            what = f"{wrong} of {len(self.streams)} streams"
            return f"DIFFERENT from {self.reference.name} in {what} ({same}): {first.text(self.start_ns)}"
        within = sum(each.within for each in self.streams)
        how = f"equal to {self.reference.name}" + (f" within the tolerance ({within:,} messages)" if within else "")
        return f"{same}; {how}"


def compare(
    result: RunResult, *, reference: Path | None = None, tolerance: Tolerance = EXACT, outputs: Sequence[str] = ()
) -> Verdict:
    """Judge the runs.

    Args:
        result: of ``engine.run``.
        reference: a recording with the same topics, or the outputs of an earlier run; None: only the runs.
        tolerance: that the reference allows.
        outputs: globs of topics that are judged although every node has them.
    """
    good = [one for one in result.runs if not one.fault]
    verdict = Verdict(len(good), result.runs[0].start_ns if result.runs else 0, result.fault, reference=reference)
    if verdict.fault or not good:
        return verdict
    first = good[0]
    for other in good[1:]:
        names = [
            name
            for name in sorted({*first.streams, *other.streams})
            if is_judged(name, outputs) and _digest(first, name) != _digest(other, name)
        ]
        found = [each for each in _strictly(first.outputs, other.outputs, names, EXACT) if not each.is_equal]
        if found:
            verdict.unequal_run, verdict.between_runs = other.number, found
            return verdict
    if reference is not None:
        with SessionFile.open(reference) as file:
            is_resim = _RESIM_KEY in file.session
            recorded = {each.topic for each in file.channels if each.kind is Kind.ROS_IN and each.count}
        names = [name for name in sorted({*first.streams, *(recorded if is_resim else ())}) if is_judged(name, outputs)]
        names = [name for name in names if is_resim or name in recorded]
        verdict.streams = (
            _strictly(reference, first.outputs, names, tolerance)
            if is_resim
            else _loosely(reference, first.outputs, names, tolerance)
        )
    return verdict


def is_judged(topic: str, outputs: Sequence[str] = ()) -> bool:
    """Return whether a topic is part of the verdict: all are but those of every node, unless they are named."""
    return topic not in OF_EVERY_NODE or any(matches(glob, topic) for glob in outputs)


def _digest(one: Run, name: str) -> str:
    return one.streams[name].digest if name in one.streams else ""


class _Side:
    """The messages of one topic at their session times, of which the next ones can be looked at."""

    def __init__(self, file: SessionFile, topic: str) -> None:
        self._decoder = LeafDecoder(file.definitions)
        self._coming = _messages(file, topic)
        self.ahead: deque[Entry] = deque()
        self.taken = 0

    def fill(self) -> bool:
        """Look ahead; whether there is a next message."""
        self.ahead.extend(islice(self._coming, _AHEAD - len(self.ahead)))
        return bool(self.ahead)

    def pop(self) -> Entry:
        self.taken += 1
        return self.ahead.popleft()

    def leaves(self, entry: Entry) -> Iterator[tuple[str, Any]]:
        return self._decoder.leaves(entry)


def _messages(file: SessionFile, topic: str) -> Iterator[Entry]:
    """The messages of a topic; their stamp is the session time at which they were published."""
    for channel in file.channels:
        if channel.topic == topic and channel.kind is Kind.ROS_IN:
            for block in file.blocks(channel):
                for index in range(len(block)):
                    time_ns = int(block.source_times[index]) or int(block.times[index])
                    data = (bytes(block.payload(index)),)
                    yield Entry(0, time_ns, channel.kind, topic, channel.entry_type, data, (), time_ns)


def _strictly(one: Path, other: Path, names: Sequence[str], tolerance: Tolerance) -> list[StreamVerdict]:
    """Compare streams of two runs, by session time."""
    if not names:
        return []
    with SessionFile.open(one) as first, SessionFile.open(other) as second:
        return [_compare_stream(name, _Side(first, name), _Side(second, name), tolerance) for name in names]


def _compare_stream(name: str, one: _Side, other: _Side, tolerance: Tolerance) -> StreamVerdict:
    verdict = StreamVerdict(name)
    while one.fill() | other.fill():
        left = one.ahead[0] if one.ahead else None
        right = other.ahead[0] if other.ahead else None
        if left and right and left.stamp_ns == right.stamp_ns:
            _compare_pair(verdict, one, other, tolerance)
        elif left and (right is None or left.stamp_ns < right.stamp_ns):
            at = _late(left, other, one)
            if at is None:
                verdict.missing += 1
                verdict.note(Difference(name, one.taken + 1, left.stamp_ns, "missing"))
            else:
                verdict.late += 1
                verdict.note(Difference(name, one.taken + 1, left.stamp_ns, "late", at - left.stamp_ns))
                other.pop()
            one.pop()
        elif right:
            at = _late(right, one, other)
            if at is None:
                verdict.extra += 1
                verdict.note(Difference(name, one.taken + 1, right.stamp_ns, "extra"))
            else:
                verdict.late += 1
                verdict.note(Difference(name, one.taken + 1, at, "early", right.stamp_ns - at))
                one.pop()
            other.pop()
    verdict.messages, verdict.other_messages = one.taken, other.taken
    return verdict


def _late(message: Entry, there: _Side, here: _Side) -> int | None:
    """The time at which the other side has the same message as its next one; None if that is another message."""
    if not there.ahead or there.ahead[0].data() != message.data():
        return None
    time_ns = there.ahead[0].stamp_ns
    return None if any(each.stamp_ns == time_ns for each in here.ahead) else time_ns


def _compare_pair(verdict: StreamVerdict, one: _Side, other: _Side, tolerance: Tolerance) -> None:
    """Compare two messages of one time."""
    left, right = one.pop(), other.pop()
    if left.data() == right.data():
        return
    try:
        delta = compare_values(one.leaves(left), other.leaves(right), tolerance)
    except Undecodable:
        delta = Delta()
        delta.differ(*first_byte(left.data(), right.data()))
    for late_ns in delta.stamps_ns:
        if late_ns:
            delta.differ("stamp", "0 ns", f"{late_ns:+,} ns")
    verdict.mm, verdict.deg = max(verdict.mm, delta.mm), max(verdict.deg, delta.deg)
    if delta.field:
        verdict.different += 1
        verdict.note(Difference(verdict.stream, one.taken, left.stamp_ns, "differs", 0, delta))
    elif delta.mm or delta.deg or delta.elements or delta.largest:
        verdict.within += 1


def _loosely(one: Path, other: Path, names: Sequence[str], tolerance: Tolerance) -> list[StreamVerdict]:
    """Compare a live recording with a run: by the order and the contents of messages."""
    found = []
    with SessionFile.open(one) as first, SessionFile.open(other) as second:
        for name in names:
            sides = [DiffInput(_messages(file, name), LeafDecoder(file.definitions)) for file in (first, second)]
            for stream in diff(sides[0], sides[1], tolerance=tolerance).streams:
                found.append(_of_diff(first, name, stream))
    return found


def _of_diff(file: SessionFile, name: str, stream: StreamDiff) -> StreamVerdict:
    verdict = StreamVerdict(
        name, stream.messages, stream.other_messages, stream.different, stream.missing, stream.extra,
        within=stream.within, mm=stream.mm, deg=stream.deg, restamped=stream.restamped,
    )  # fmt: skip
    if stream.first and stream.different:
        at = next(islice(_messages(file, name), stream.first.index - 1, None))
        verdict.first = Difference(name, stream.first.index, at.stamp_ns, "differs", 0, stream.first.delta)
    elif stream.missing or stream.extra:
        at = next(_messages(file, name), None)
        what = "missing" if stream.missing else "extra"
        verdict.first = Difference(name, stream.messages, at.stamp_ns if at else file.end_ns, what)
    return verdict


def _short(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 80 else f"{text[:77]}..."
