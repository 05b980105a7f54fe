"""The verdict on runs: whether all are equal, and whether they are what a recording or a baseline has.

Runs are compared by stream and session time: a message of one run and that of another belong together if they have the
same time.  Messages with different bytes are decoded, so that bytes between fields do not count.  Nothing may differ
between runs.  The outputs of a baseline, which an earlier run has written, are compared in the same way, with a
tolerance.  In a live recording the times are those of its day: its messages are paired by their order and contents
(`igtl_gateway.replay.diff`), and stamps within them are reported but do not count.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable, Iterator, Sequence, Set
from dataclasses import dataclass, field, replace
from itertools import islice
from math import inf, isfinite, isnan
from pathlib import Path
from typing import Any

import numpy as np

from igtl_gateway.addon import matches
from igtl_gateway.addon.checking import (
    EXACT,
    Delta,
    DiffInput,
    LeafDecoder,
    StreamDiff,
    Tolerance,
    Undecodable,
    compare_values,
    diff,
    first_byte,
)
from igtl_gateway.addon.reading import Entry, Kind, Qos, SessionFile, recorded_units
from igtl_gateway.addon.terminal import count_text, counted, duration_text
from igtl_gateway.addons.resim.coordinator import Roles
from igtl_gateway.addons.resim.engine import Run, RunResult
from igtl_gateway.addons.resim.frames import NEVER
from igtl_gateway.addons.resim.goals import numbering
from igtl_gateway.addons.resim.outputs import OF_EVERY_NODE
from igtl_gateway.addons.resim.unread import Digest, unread_streams

#: Key of the session metadata of a run's outputs.
_RESIM_KEY = "resim_of"
#: Names of the numbers of a position, of a rotation, and of a pose with both.
_PARTS = {3: ("x", "y", "z"), 4: ("x", "y", "z", "w"), 7: ("x", "y", "z", "qx", "qy", "qz", "qw")}
#: Why other runs may differ: with a tie, and without.
_TIE = "a timer and an input at the same time, whose order is chosen"
_PHASE = "a timer that races the topic, or the time since the start"
#: Field and first value of a difference of stamps, whose second value is how much later the other one's is.
_STAMP = "stamp", "0 ns"
#: Messages that are looked at for a late one.
_AHEAD = 16
#: Topics that a line names.
_NAMED = 5


@dataclass(frozen=True, slots=True)
class Difference:
    """Where two recordings of one stream differ.

    Attributes:
        stream: the topic.
        number: of the message in the stream of the first one, from 1.
        time_ns: session time of the first one, UTC ns.
        what: "differs", "missing" (the other one does not have it), "extra" (only it has it), "late", "early",
            "unread" (a message of the stream differs, from the first one on, whose type is not read), "silent" (the
            other one has no message of the stream), or "qos" (its publisher offers another QoS).
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
            case "silent":
                return f"{self.stream}: no program published a message of it"
            case "qos":
                return f"{self.stream}: its QoS is {self.delta.one} and {self.delta.other}"
            case "unread":
                return f"{self.stream}: bytes of its messages differ, and their type cannot be read"
            case "late" | "early":
                return f"{place}: {duration_text(self.late_ns)} {self.what}"
        delta = self.delta
        is_measured = delta.measure and isfinite(delta.mm) and isfinite(delta.deg)  # not those of a NaN
        if (delta.field, delta.one) == _STAMP:  # not a field of that name with another type
            return f"{place}: its stamp is later by {delta.other}"
        path, one, other = _first_part(delta.field, delta.one, delta.other)
        return f"{place}: {path} is {_short(one)} and {_short(other)}" + f" ({delta.measure})" * bool(is_measured)


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
        requalified: whether the QoS of its publisher is another one.
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
    requalified: bool = False
    first: Difference | None = None

    @property
    def is_equal(self) -> bool:
        return not (self.different or self.missing or self.extra or self.late or self.requalified)

    def note(self, found: Difference) -> None:
        self.first = self.first or found


@dataclass(frozen=True, slots=True)
class Race:
    """An output that depends on when a timer ticks (``races.find_race``).

    Attributes:
        difference: the first one from the run that shows it.
        topic: of the input; ``""`` if none has that time.
        earlier_ns: how much earlier that run started; 0: it had timers before inputs of the same time.
        is_sample: whether a timer publishes the output, which samples an input; else an input causes it.
        streams: all outputs that depend on when the programs start.
    """

    difference: Difference
    topic: str
    earlier_ns: int = 0
    is_sample: bool = False
    streams: frozenset[str] = frozenset()

    def text(self, start_ns: int) -> str:
        """One line for a person; ``start_ns``: start of the session."""
        difference, topic = self.difference.text(start_ns), self.topic or "an input"
        if not self.earlier_ns:
            return f"a timer races {topic}: {difference} if the timer is first"
        early = f"if the programs start {duration_text(self.earlier_ns)} earlier"
        if self.is_sample:
            return f"sampled by a timer: {difference} {early}"
        return f"an output at {topic} depends on when the programs start: {difference} {early}"

    @property
    def cause(self) -> str:
        """Why other runs may differ."""
        return _PHASE if self.earlier_ns else _TIE


@dataclass(slots=True)
class Verdict:
    """The result.

    Attributes:
        runs: runs that came to the end of the session.
        start_ns: start of the session, UTC ns.
        fault: why the programs could not be judged; ``""`` if they could.
        unequal_run: number of the first run that differs from the first one; 0 = none.
        cause: what probably makes it differ (``causes.likely_cause``); ``""`` if that was not looked for.
        between_runs: the streams of that run in which it differs.
        race: what depends on timers, although the runs are equal; None: nothing, or not looked for.
        permits_races: whether a timer may race an input.
        wants_any_start: whether outputs must not depend on when the programs start.
        reference: what the outputs were compared with; None = nothing.
        is_live: whether that is a recording of the programs, and no outputs of an earlier run.
        streams: the streams in the reference and in the first run.
        uncompared: streams of both that are not compared, as their type is not read and the reference has no digest.
        unpublished: recorded topics of others that no program publishes or asks for: outputs that these had, perhaps.
    """

    runs: int
    start_ns: int
    fault: str = ""
    unequal_run: int = 0
    cause: str = ""
    between_runs: list[StreamVerdict] = field(default_factory=list)
    race: Race | None = None
    permits_races: bool = False
    wants_any_start: bool = False
    reference: Path | None = None
    is_live: bool = False
    streams: list[StreamVerdict] = field(default_factory=list)
    uncompared: list[str] = field(default_factory=list)
    unpublished: list[str] = field(default_factory=list)

    @property
    def is_racing(self) -> bool:
        """Whether a timer races an input, and may not; or outputs depend on the start, and must not."""
        if self.race is None:
            return False
        return self.wants_any_start if self.race.earlier_ns else not self.permits_races

    @property
    def is_deterministic(self) -> bool:
        return not (self.fault or self.unequal_run or self.is_racing)

    @property
    def is_as_reference(self) -> bool:
        return all(stream.is_equal for stream in self.streams)

    @property
    def is_sampled(self) -> bool:
        """Whether it differs from a live recording only in outputs that depend on when a timer of it began."""
        if not (self.race and self.race.earlier_ns and self.is_live and self.is_deterministic):
            return False
        return not self.is_as_reference and all(
            each.is_equal or each.stream in self.race.streams for each in self.streams
        )

    @property
    def exit_code(self) -> int:
        """0: equal; 1: not deterministic, or not as the reference; 2: the programs could not be judged."""
        return 2 if self.fault else 0 if self.is_deterministic and self.is_as_reference else 1

    @property
    def first(self) -> Difference | None:
        """The difference that comes first in session time: between runs, of a race, or else against the reference."""
        if self.race and self.is_racing:
            return self.race.difference
        found = [each.first for each in self.between_runs or self.streams if each.first]
        if self.race and self.race.earlier_ns and self.is_live and not self.is_sampled:
            # what a timer samples differs, too, and explains nothing
            found = [each for each in found if each.stream not in self.race.streams] or found
        return min(found, key=lambda each: (each.time_ns, each.stream), default=None)

    @property
    def word(self) -> str:
        """The verdict in a word or two, for a table."""
        if self.fault:
            return "cannot be judged"
        if not self.is_deterministic:
            return "not deterministic"
        if self.is_sampled:
            return "sampled by a timer"
        if not self.is_as_reference:
            return "different"
        return "equal" if self.streams else "deterministic"

    def line(self) -> str:
        """One line for a person."""
        if self.fault:
            return f"CANNOT BE JUDGED: {self.fault}"
        first = self.first
        if self.unequal_run and first:
            likely = f"; likely cause: {self.cause}" if self.cause else ""
            return f"NOT DETERMINISTIC: run {self.unequal_run} differs from run 1: {first.text(self.start_ns)}{likely}"
        if self.race and self.is_racing:
            return f"NOT DETERMINISTIC: {self.race.text(self.start_ns)}; likely cause: {self.race.cause}"
        same = f"deterministic: {self.runs} of {counted(self.runs, 'run')} equal" if self.runs > 1 else "1 run"
        if self.is_sampled and self.race and self.reference and first:
            differing = sorted(each.stream for each in self.streams if not each.is_equal)
            shown = ", ".join(differing[:_NAMED]) + (" …" if len(differing) > _NAMED else "")
            return (
                f"SAMPLED BY A TIMER: {shown}: the timer began at another moment in {self.reference.name}, so its "
                f"messages are others ({same}); compare with a baseline: {first.text(self.start_ns)}"
            )
        if self.race and not self.race.is_sample:
            same += f", but {self.race.text(self.start_ns)}"
        if self.reference and first:
            wrong = sum(not each.is_equal for each in self.streams)
            what = f"{wrong} of {counted(len(self.streams), 'stream')}"
            return f"DIFFERENT from {self.reference.name} in {what} ({same}): {first.text(self.start_ns)}"
        if self.race and self.race.is_sample and not self.permits_races:
            same += f" ({self.race.text(self.start_ns)})"
        if not self.reference:
            return same
        left = f"; not compared, as their type cannot be read: {', '.join(self.uncompared)}" if self.uncompared else ""
        if self.unpublished:
            names = ", ".join(self.unpublished[:_NAMED]) + (" …" if len(self.unpublished) > _NAMED else "")
            left += f"; recorded, but published by no program: {names}"
        if not self.streams:
            return f"{same}; {self.reference.name} has none of the outputs to compare with{left}"
        within = sum(each.within for each in self.streams)
        how = f"equal to {self.reference.name}" + (
            f" within the tolerance ({count_text(within, 'message')})" if within else ""
        )
        return f"{same}; {how}{left}"


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
    start_ns = result.zero_ns or (result.runs[0].start_ns if result.runs else 0)
    verdict = Verdict(len(good), start_ns, result.fault, reference=reference)
    if verdict.fault or not good:
        return verdict
    first = good[0]
    for other in good[1:]:
        names = [
            name
            for name in sorted({*first.streams, *other.streams})
            if is_judged(name, outputs) and _digest(first, name) != _digest(other, name)
        ]
        verdicts = _strictly(first.outputs, other.outputs, names, EXACT)
        for each in verdicts:
            _note_unread(each, first)
        same = [name for name in first.streams if name in other.streams and name not in names]
        verdicts += _requalified(first, other, [name for name in sorted(same) if is_judged(name, outputs)])
        found = [each for each in verdicts if not each.is_equal]
        if found:
            verdict.unequal_run, verdict.between_runs = other.number, found
            return verdict
    is_resim = False
    if reference is not None:
        with SessionFile.open(reference) as file:
            is_resim = _RESIM_KEY in file.session
            verdict.is_live = not is_resim
            recorded = {_name(each.kind, each.topic, each.stream) for each in file.channels if each.count} - {""}
            unread = unread_streams(file)
            offered = _offered(file)
            from_links = _names_from_links(file, result.links) if not is_resim else set()
        with SessionFile.open(first.outputs) as file:
            ours = unread_streams(file).keys()
        driven = result.roles.inputs.keys() if result.roles and reference == result.recording else ()
        if is_resim:
            expected = recorded - {*driven}
        else:
            roles = result.roles
            published = {*(roles.expected if reference == result.recording else roles.outputs)} if roles else set()
            expected = (published & recorded) | from_links
        if result.roles and reference == result.recording:
            verdict.unpublished = [name for name in _unpublished(result.roles) if name in recorded]
            verdict.unpublished = [name for name in verdict.unpublished if is_judged(name, outputs)]
        names = [name for name in sorted({*first.streams, *expected}) if is_judged(name, outputs)]
        names = [name for name in names if (is_resim or name in recorded) and name not in {*unread, *ours}]
        verdict.streams = (
            _strictly(reference, first.outputs, names, tolerance, result.window)
            if is_resim
            else _loosely(reference, first.outputs, names, tolerance, result.links, result.window)
        )
        for compared in verdict.streams:
            _note_silence(compared, first)
            _note_qos(compared, offered.get(compared.stream), first, is_whole=is_resim)
        for name in sorted(name for name in {*unread, *ours} - {*driven} if is_judged(name, outputs)):
            stream = first.streams[name].summary if name in first.streams else None
            is_part = result.window != (0, NEVER)  # a digest is of the whole
            is_known = name not in recorded and (name not in unread or unread[name].digest) and not is_part
            if stream and not is_known:
                verdict.uncompared.append(name)
            elif is_resim and not is_part:
                verdict.streams.append(_of_unread(name, unread.get(name), stream))
        if not verdict.streams and not verdict.uncompared and reference != result.recording:
            verdict.fault = f"{reference.name} has none of the outputs to compare with"
    if (not verdict.streams or not is_resim) and not any(is_judged(name, outputs) for name in first.streams):
        verdict.fault = "no program published a message"
    return verdict


def is_judged(topic: str, outputs: Sequence[str] = ()) -> bool:
    """Return whether a topic is part of the verdict: all are but those of every node, unless they are named."""
    return topic not in OF_EVERY_NODE or any(matches(glob, topic) for glob in outputs)


def _unpublished(roles: Roles) -> list[str]:
    """The ROS topics that no program publishes or asks for; none of programs that have nothing of ROS."""
    has_ros = any(name.startswith("/") for name in (*roles.inputs, *roles.outputs))
    return [name for name in roles.unused if name.startswith("/")] if has_ros else []


def _offered(file: SessionFile) -> dict[str, Qos]:
    """The QoS of the publishers of topics, as far as the file has it."""
    return {
        each.topic: each.qos
        for each in file.channels
        if each.kind is Kind.ROS_IN and each.count and each.qos is not None
    }


def _names_from_links(file: SessionFile, links: Set[int]) -> set[str]:
    """The OpenIGTLink streams that came by one of these links."""
    if not links:
        return set()
    names = {each.stream for each in file.channels if each.kind is Kind.IGTL_IN and each.count}
    return {name for name in names if next(_messages(file, name, links), None)}


def _requalified(one: Run, other: Run, names: Sequence[str]) -> list[StreamVerdict]:
    """Compare the QoS of the publishers of streams of two runs."""
    found = []
    for name in names:
        verdict = StreamVerdict(name, one.streams[name].messages, other.streams[name].messages)
        _note_qos(verdict, one.streams[name].qos, other, is_whole=True)
        found.append(verdict)
    return found


def _note_silence(verdict: StreamVerdict, run: Run) -> None:
    """Have a stream without a message in the run state this: it has no first message that differs."""
    if verdict.first and not verdict.other_messages and verdict.stream not in run.streams:
        verdict.first = replace(verdict.first, what="silent")


def _note_qos(verdict: StreamVerdict, expected: Qos | None, run: Run, *, is_whole: bool) -> None:
    """Note another QoS of the publisher of a stream; of a live recording, which has that of a subscription, in part."""
    stream = run.streams.get(verdict.stream)
    if expected is None or stream is None or stream.kind is not Kind.ROS_IN:
        return
    one, other = (_qos_text(each, is_whole) for each in (expected, stream.qos))
    if one != other:
        verdict.requalified = True
        delta = Delta()
        delta.differ("qos", one, other)
        verdict.note(Difference(verdict.stream, 1, stream.first_ns, "qos", 0, delta))


def _qos_text(qos: Qos, is_whole: bool) -> str:
    parts = ["reliable" if qos.reliable else "best effort", "transient local" if qos.latched else "volatile"]
    return ", ".join(parts + [f"depth {qos.depth}"] * is_whole)


def _note_unread(verdict: StreamVerdict, one: Run) -> None:
    """Note that messages, whose bytes differ, have a type that readers skip: nothing else compares them."""
    stream = one.streams.get(verdict.stream)
    if stream and verdict.messages < stream.messages:
        verdict.different += 1
        verdict.note(Difference(verdict.stream, 1, stream.first_ns, "unread"))


def _of_unread(name: str, one: Digest | None, other: Digest | None) -> StreamVerdict:
    """Compare the digests of a stream of two runs; None: it is not there."""
    verdict = StreamVerdict(name, one.messages if one else 0, other.messages if other else 0)
    verdict.missing, verdict.extra = int(other is None), int(one is None)
    verdict.different = int(bool(one and other and one.digest != other.digest))
    if not verdict.is_equal:
        what = "missing" if other is None else "extra" if one is None else "unread"
        verdict.first = Difference(name, 1, min(each.first_ns for each in (one, other) if each), what)
    return verdict


def _digest(one: Run, name: str) -> str:
    return one.streams[name].digest if name in one.streams else ""


class _Side:
    """The messages of one topic at their session times, of which the next ones can be looked at."""

    def __init__(self, file: SessionFile, topic: str, window: tuple[int, int] = (0, NEVER)) -> None:
        self._decoder = LeafDecoder(file.definitions, recorded_units(file))
        self._coming = _messages(file, topic, window=window)
        self.ahead: deque[Entry] = deque()
        self.taken = 0

    def fill(self) -> bool:
        """Look ahead; whether there is a next message."""
        self.ahead.extend(islice(self._coming, _AHEAD - len(self.ahead)))
        return bool(self.ahead)

    def take(self, index: int = 0) -> Entry:
        """Remove one of the messages ahead."""
        self.taken += 1
        found = self.ahead[index]
        del self.ahead[index]
        return found

    def take_moment(self) -> list[tuple[int, Entry]]:
        """Remove the messages ahead that have the time of the first one; with their numbers."""
        time_ns, found = self.ahead[0].stamp_ns, []
        while self.ahead and self.ahead[0].stamp_ns == time_ns:
            found.append((self.taken + 1, self.take()))
        return found

    def count(self, message: Entry) -> int:
        """How many of the messages ahead have the time and the bytes of this one."""
        return sum(each.stamp_ns == message.stamp_ns and each.data() == message.data() for each in self.ahead)

    def leaves(self, entry: Entry) -> Iterator[tuple[str, Any]]:
        return self._decoder.leaves(entry)


def _name(kind: Kind, topic: str, stream: str) -> str:
    """The name of an output: its ROS topic or OpenIGTLink stream; ``""`` for anything else."""
    return {Kind.ROS_IN: topic, Kind.IGTL_IN: stream}.get(kind, "")


def _messages(
    file: SessionFile, topic: str, links: Set[int] = frozenset(), window: tuple[int, int] = (0, NEVER)
) -> Iterator[Entry]:
    """The messages of a topic, with numbers for goal ids; their stamp is the session time at which they were published.

    Of an OpenIGTLink stream of a live recording, only those that came by one of ``links``; of all, those in a window.
    """
    if links and not topic.startswith("/"):
        for entry in file.entries_of_kinds({Kind.IGTL_IN}):
            is_in = window[0] <= entry.stamp_ns < window[1]
            if entry.kind is Kind.IGTL_IN and entry.channel == topic and is_in and not links.isdisjoint(entry.links):
                yield Entry(entry.seq, entry.stamp_ns, entry.kind, topic, entry.type, entry.payload)
        return
    numbered = numbering(topic)
    for channel in file.channels:
        if _name(channel.kind, channel.topic, channel.stream) == topic:
            for block in file.blocks(channel):
                for index in np.flatnonzero((block.times >= window[0]) & (block.times < window[1])).tolist():
                    time_ns = int(block.source_times[index]) or int(block.times[index])
                    data = (numbered(bytes(block.payload(index))),)
                    seq = int(block.numbers[index])
                    yield Entry(seq, time_ns, channel.kind, topic, channel.entry_type, data, (), time_ns)


def _strictly(
    one: Path, other: Path, names: Sequence[str], tolerance: Tolerance, window: tuple[int, int] = (0, NEVER)
) -> list[StreamVerdict]:
    """Compare streams of two runs, by session time; of the first one, what is in the window of the other."""
    if not names:
        return []
    with SessionFile.open(one) as first, SessionFile.open(other) as second:
        return [_compare_stream(name, _Side(first, name, window), _Side(second, name), tolerance) for name in names]


def first_at_one_time(
    one: Path,
    other: Path,
    names: Sequence[str],
    counts: Callable[[str, int], bool] = lambda name, time_ns: True,
    earlier_ns: int = 0,
) -> Difference | None:
    """Return the first message whose values differ from those of the other run at that time, in the order of time.

    Messages of a time that only one run has do not count, nor does their order at one time.

    Args:
        one, other: outputs of both runs.
        names: their streams.
        counts: whether the messages of a stream at a time do.
        earlier_ns: how much earlier the messages of the other run are; stamps may be, too.
    """
    found = []
    with SessionFile.open(one) as first, SessionFile.open(other) as second:
        for name in names:
            verdict, left, right = StreamVerdict(name), _Side(first, name), _Side(second, name)
            while left.fill() and right.fill() and not verdict.first:
                later_ns = right.ahead[0].stamp_ns + earlier_ns - left.ahead[0].stamp_ns
                if later_ns:
                    (left if later_ns > 0 else right).take()
                    continue
                time_ns = left.ahead[0].stamp_ns
                ours, theirs = left.take_moment(), right.take_moment()
                if counts(name, time_ns):
                    mine, other_ones = _not_in(ours, theirs), _not_in(theirs, ours)
                    for (number, message), (_, another) in zip(mine, other_ones, strict=False):
                        _compare_messages(verdict, number, (left, message), (right, another), EXACT, -earlier_ns)
            found += [verdict.first] if verdict.first else []
    return min(found, key=lambda each: each.time_ns, default=None)


def _compare_stream(name: str, one: _Side, other: _Side, tolerance: Tolerance) -> StreamVerdict:
    verdict = StreamVerdict(name)
    while one.fill() | other.fill():
        left = one.ahead[0] if one.ahead else None
        right = other.ahead[0] if other.ahead else None
        if left and right and left.stamp_ns == right.stamp_ns:
            _compare_pair(verdict, one, other, tolerance)
        elif left and (right is None or left.stamp_ns < right.stamp_ns):
            at = _elsewhere(left, other, one)
            if at is None:
                verdict.missing += 1
                verdict.note(Difference(name, one.taken + 1, left.stamp_ns, "missing"))
            else:
                verdict.late += 1
                late_ns = other.take(at).stamp_ns - left.stamp_ns
                verdict.note(Difference(name, one.taken + 1, left.stamp_ns, "late", late_ns))
            one.take()
        elif right:
            at = _elsewhere(right, one, other)
            if at is None:
                verdict.extra += 1
                verdict.note(Difference(name, one.taken + 1, right.stamp_ns, "extra"))
            else:
                verdict.late += 1
                number = one.taken + 1 + at
                time_ns = one.take(at).stamp_ns
                verdict.note(Difference(name, number, time_ns, "early", right.stamp_ns - time_ns))
            other.take()
    verdict.messages, verdict.other_messages = one.taken, other.taken
    return verdict


def _elsewhere(message: Entry, there: _Side, here: _Side) -> int | None:
    """Where among its next messages the other side has the same one at another time; None if it has it nowhere.

    A message that this side has at that time, too, is not the one.
    """
    data = message.data()
    is_end = len(here.ahead) < _AHEAD
    for index, each in enumerate(there.ahead):
        if not is_end and each.stamp_ns > here.ahead[-1].stamp_ns:
            break
        if each.data() == data and there.count(each) > here.count(each):
            return index
    return None


def _compare_pair(verdict: StreamVerdict, one: _Side, other: _Side, tolerance: Tolerance) -> None:
    """Compare two messages of one time."""
    _compare_messages(verdict, one.taken + 1, (one, one.take()), (other, other.take()), tolerance)


def _not_in(messages: list[tuple[int, Entry]], others: list[tuple[int, Entry]]) -> list[tuple[int, Entry]]:
    """The messages whose bytes none of the others has; each of these stands for one."""
    there = Counter(other.data() for _, other in others)
    found = []
    for number, message in messages:
        if there[message.data()] > 0:
            there[message.data()] -= 1
        else:
            found.append((number, message))
    return found


def _compare_messages(
    verdict: StreamVerdict,
    number: int,
    one: tuple[_Side, Entry],
    other: tuple[_Side, Entry],
    tolerance: Tolerance,
    late_ns: int = 0,
) -> None:
    """Compare two messages; ``number``: of the first one in its stream; ``late_ns``: what its stamps may be later."""
    (here, left), (there, right) = one, other
    if left.data() == right.data():
        return
    try:
        delta = compare_values(here.leaves(left), there.leaves(right), tolerance)
    except Undecodable:
        delta = Delta()
        delta.differ(*first_byte(left.data(), right.data()))
    for stamp_ns in delta.stamps_ns:
        if stamp_ns not in (0, late_ns):
            delta.differ(*_STAMP, f"{stamp_ns:,} ns")
    verdict.mm, verdict.deg = max(verdict.mm, delta.mm), max(verdict.deg, delta.deg)
    if delta.field:
        verdict.different += 1
        verdict.note(Difference(verdict.stream, number, left.stamp_ns, "differs", 0, delta))
    elif delta.mm or delta.deg or delta.elements or delta.largest:
        verdict.within += 1


def _loosely(
    one: Path,
    other: Path,
    names: Sequence[str],
    tolerance: Tolerance,
    links: Set[int],
    window: tuple[int, int],
) -> list[StreamVerdict]:
    """Compare a live recording with a run: by the order and the contents of messages; ``links``: which of it count."""
    found = []
    with SessionFile.open(one) as first, SessionFile.open(other) as second:
        for name in names:
            sides = [
                DiffInput(_messages(file, name, chosen, part), LeafDecoder(file.definitions, recorded_units(file)))
                for file, chosen, part in ((first, links, window), (second, frozenset(), (0, NEVER)))
            ]
            for stream in diff(sides[0], sides[1], tolerance=tolerance).streams:
                found.append(_of_diff(first, second, name, stream, links, window))
    return found


def _place(
    file: SessionFile, name: str, seq: int, links: Set[int], window: tuple[int, int] = (0, NEVER)
) -> tuple[int, int]:
    """Number and time of the message of a stream with an entry number."""
    for number, entry in enumerate(_messages(file, name, links, window), 1):
        if entry.seq == seq:
            return number, entry.stamp_ns
    return 0, file.end_ns


def _of_diff(
    file: SessionFile, run: SessionFile, name: str, stream: StreamDiff, links: Set[int], window: tuple[int, int]
) -> StreamVerdict:
    verdict = StreamVerdict(
        name, stream.messages, stream.other_messages, stream.different, stream.missing, stream.extra,
        within=stream.within, mm=stream.mm, deg=stream.deg, restamped=stream.restamped,
    )  # fmt: skip
    if stream.first and stream.different:
        place = stream.first
        time_ns = next(islice(_messages(file, name, links, window), place.index - 1, None)).stamp_ns
        verdict.first = Difference(name, place.index, time_ns, "differs", 0, place.delta)
    elif stream.missing or stream.extra:
        first, what = (stream.first_missing, "missing") if stream.missing else (stream.first_extra, "extra")
        place_of = _place(file, name, first, links, window) if stream.missing else _place(run, name, first, frozenset())
        verdict.first = Difference(name, *place_of, what)
    return verdict


def _first_part(path: str, one: Any, other: Any) -> tuple[str, Any, Any]:
    """Of two lists of numbers, such as a pose, the number that differs most: its path and its values."""
    if not (isinstance(one, list) and isinstance(other, list) and 0 < len(one) == len(other)):
        return path, one, other
    by = [abs(left - right) for left, right in zip(one, other, strict=True)]
    at = max(range(len(by)), key=lambda index: inf if isnan(by[index]) else by[index])
    names = _PARTS.get(len(one))
    return (f"{path}.{names[at]}" if names else f"{path}[{at}]"), one[at], other[at]


def _short(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 80 else f"{text[:77]}..."
