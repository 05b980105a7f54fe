"""One session of several recorders: the offsets of their clocks, and the file with the messages of all."""

from __future__ import annotations

import hashlib
import math
from array import array
from collections import Counter
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from itertools import chain, combinations
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from igtl_gateway.addon import NS_PER_S, ConfigError, DamagedRecording, GatewayError, UnsupportedRecording, one_of
from igtl_gateway.addon.igtl import HEADER_SIZE
from igtl_gateway.addon.messages import topic_token
from igtl_gateway.addon.reading import (
    CLOCK_ANSWERS,
    CLOCK_QUESTIONS,
    Entry,
    EntryColumns,
    Kind,
    Level,
    Mark,
    Note,
    RecordedClocks,
    SessionFile,
    StreamName,
    StreamNumbers,
    StreamRows,
    Unfit,
    added_marks,
    carry_marks,
    notes_before,
    only_of_kinds,
    stated_seals,
)
from igtl_gateway.addon.untrusted import files, is_same
from igtl_gateway.addon.writing import Method, written
from igtl_gateway.addons.merge.clock_graph import Clock, clocks_of, latency_facts
from igtl_gateway.addons.merge.crossings import (
    Crossing,
    Passed,
    find_crossings,
    pooled,
    with_questions,
    without_coincidences,
)
from igtl_gateway.addons.merge.offsets import ClockOffset, Contradiction, Piece, measure_offset
from igtl_gateway.addons.merge.writer import MergedPart, write_merged

Array = npt.NDArray[Any]

_OUTPUTS = {Kind.IGTL_OUT: b"igtl", Kind.ROS_OUT: b"ros"}
_INPUTS = {Kind.IGTL_IN: b"igtl", Kind.ROS_IN: b"ros"}
#: Smaller ROS messages, and OpenIGTLink messages without a body, are equal by coincidence.
_LEAST_ROS_BYTES = 24
_READ_BYTES = 1 << 20
_ROS = (Kind.ROS_IN, Kind.ROS_OUT)
_U64 = (1 << 64) - 1
#: Code of the note about a stream of several peers, with the topics that were made of it.
_NAME_SHARED = "name_shared"
#: Warnings of a part that the merged session states: a peer may cause any number of them.
_MOST_WARNINGS = 100
#: Times are 64-bit numbers with a sign when they are compared.
_MAX_STAMP_NS = 1 << 63


@dataclass(frozen=True, slots=True)
class Source:
    """A recording to merge: its name in the merged session (``""``: that of the file), and its path."""

    name: str
    path: Path


@dataclass(frozen=True, slots=True)
class _Recorder:
    """A recording that is open.

    Attributes:
        name: of the part.
        path: of the file, as it was given.
        file: the recording; of a merged session one of its parts.
        facts: what the merged file states of it.
        clock: of a part of a merged session: its clock there ...
        reference: ... relative to that of this part.
    """

    name: str
    path: Path
    file: SessionFile
    facts: dict[str, Any]
    clock: Clock | None = None
    reference: str = ""

    @property
    def middle_ns(self) -> int:
        return (self.file.start_ns + self.file.end_ns) // 2


@dataclass(frozen=True, slots=True)
class _Link:
    """Streams that cross between two recorders: from the first to the second, back, and those that contradict."""

    there: list[Crossing]
    back: list[Crossing]
    left_out: list[Crossing]


def merge(
    sources: Sequence[Source], out: Path, *, given: Mapping[str, ClockOffset], overwrite: bool = False
) -> dict[str, Any]:
    """Write one session of several recordings; return what it states: offsets, their intervals, latencies.

    The first recording has the reference clock.

    Args:
        sources: the recordings; a merged session stands for its parts.
        out: the file to write.
        given: offsets relative to the reference, by name of the part; the others are measured.
        overwrite: replace an existing file.

    Raises:
        ConfigError: names or offsets do not fit, or a recording is given twice.
        GatewayError: nothing crosses between the recordings, or no clock fits what crosses.
        UnsupportedRecording, DamagedRecording: a recording cannot be read.
        RecordingError: the file cannot be written.
    """
    with ExitStack() as stack:
        recorders = list(_opened(sources, stack))
        names = [each.name for each in recorders]
        _check(recorders, out, given)
        edges = _known(recorders, given)
        links = _links(recorders)
        for (one, two), link in links.items():
            try:
                for pair, there, back in (((two, one), link.there, link.back), ((one, two), link.back, link.there)):
                    if pair not in edges and not given.keys() & pair:
                        edges[pair] = Clock((measure_offset(pooled(there), pooled(back)),))
            except Contradiction as error:
                raise GatewayError(f"{one}, {two}: {error}; state the offset: --offset {two}=SECONDS") from None
        clocks = clocks_of(names, edges)
        if alone := next((name for name in names if name not in clocks), None):
            raise GatewayError(
                f"{alone}: found no message that crosses between it and {', '.join(clocks)}, expected one; "
                f"state the offset of its clock: --offset {alone}=SECONDS, or --sync STREAM STREAM"
            )
        facts: dict[str, Any] = {
            "reference": names[0],
            "latencies": [row for pair, link in links.items() for row in _latencies(pair, link, clocks, edges)],
            "left_out": [
                f"{one}, {two}: {each.sent_as}" for (one, two), link in links.items() for each in link.left_out
            ],
        }
        warned = [_warned(each) for each in recorders]
        facts["reported"] = [line for lines, _ in warned for line in lines]
        facts["shared_topics"] = {topic: stream for _, topics in warned for topic, stream in topics.items()}
        parts = [
            MergedPart(
                each.name,
                each.file,
                clocks[each.name].to_reference,
                clocks[each.name].exactly_to_reference,
                {**each.facts, "messages": each.file.entry_count, "clock": clocks[each.name].facts(each.middle_ns)},
            )
            for each in recorders
        ]
        added = [
            _moved(mark, clocks[each.name])
            for each in recorders
            for mark in added_marks(each.file.path, each.file.start_ns, each.file.end_ns)
        ]
        with written(out, overwrite=overwrite) as path:
            count = write_merged(path, parts, facts)
        carry_marks(out, added)
        return {
            "file": str(out),
            "messages": count,
            **facts,
            "parts": [{"name": part.name, **part.facts} for part in parts],
        }


def _warned(recorder: _Recorder) -> tuple[list[str], dict[str, str]]:
    """What the gateway of a part warned about, with the number of times, and topic → stream of what peers share."""
    counts: Counter[tuple[str, str]] = Counter()
    texts: dict[tuple[str, str], str] = {}
    shared: dict[str, str] = {}
    for entry in chain(notes_before(recorder.file), only_of_kinds(recorder.file, {Kind.NOTE})):
        note = Note.of(entry.data()) if entry.kind is Kind.NOTE else None
        if note is None or note.level < Level.WARN:
            continue
        counts[note.stream, note.code] += 1
        texts.setdefault((note.stream, note.code), note.text)
        topics = note.data.get("topics", ()) if note.code == _NAME_SHARED else ()
        shared |= {
            f"/{recorder.name}{topic}": f"/{recorder.name}/{note.stream}" for topic in topics if isinstance(topic, str)
        }
    lines = []
    for key, number in counts.most_common(_MOST_WARNINGS):
        times = f", {number:,} times" if number > 1 else ""
        topics = [topic for topic, stream in shared.items() if key == (stream.split("/", 2)[2], _NAME_SHARED)]
        lines.append(f"{recorder.name}: {key[0] or key[1]}{times}: {texts[key]}{''.join(f', {one}' for one in topics)}")
    if len(counts) > _MOST_WARNINGS:
        lines.append(f"{recorder.name}: {len(counts) - _MOST_WARNINGS:,} more, as `info` of the part states them")
    return lines, shared


def _moved(mark: Mark, clock: Clock) -> Mark:
    """Return a mark at its time by the clock of the reference."""
    until_ns = None if mark.end_ns is None else clock.to_reference(mark.end_ns)
    return replace(mark, time_ns=clock.to_reference(mark.time_ns), end_ns=until_ns)


def _opened(sources: Sequence[Source], stack: ExitStack) -> Iterator[_Recorder]:
    """The recordings, and the parts of those that are merged sessions."""
    taken: set[str] = set()

    def named(wanted: str) -> str:
        token = name = topic_token(wanted)
        number = 1
        while name.lower() in taken:
            number += 1
            name = f"{token}_{number}"
        taken.add(name.lower())
        return name

    for source in sources:
        file = stack.enter_context(SessionFile.open(source.path))
        if file.merge is None:
            if file.foreign:
                raise UnsupportedRecording(
                    f"{source.path}: found an MCAP file of another program, expected a session of igtl-gateway"
                )
            yield _Recorder(named(source.name or source.path.stem), source.path, file, _facts_of(source.path))
            continue
        here = {name: named(f"{source.name}_{name}" if source.name else name) for name in file.merge.names}
        for part in file.merge.facts["parts"]:
            opened = stack.enter_context(SessionFile.open(source.path / part["name"]))
            facts = {key: part[key] for key in ("file", "bytes", "sha256", "sealed_by") if key in part}
            clock = _recorded_clock(part, source.path)
            reference = here.get(str(file.merge.facts.get("reference")), "")
            yield _Recorder(here[part["name"]], source.path, opened, facts, clock, reference)


def _recorded_clock(part: Mapping[str, Any], path: Path) -> Clock:
    """The clock that a merged session states of a part.  Raises DamagedRecording."""
    try:
        facts = part["clock"]
        chain = [tuple(Piece(int(at), int(ns), float(slope)) for at, ns, slope in pieces) for pieces in facts["chain"]]
        low, high = (
            math.inf if facts[key] is None else NS_PER_S * abs(facts[key] - facts["offset_s"])
            for key in ("low_s", "high_s")
        )
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise DamagedRecording(f"{path}: part {part['name']}: found a clock without {error}") from None
    if not all(chain):
        raise DamagedRecording(f"{path}: part {part['name']}: found a clock without offset, expected one")
    intervals = [(low, high), *[(0.0, 0.0)] * len(chain)]
    return Clock(tuple(map(_given, chain, intervals)))


def _given(pieces: tuple[Piece, ...], interval_ns: tuple[float, float]) -> ClockOffset:
    return ClockOffset(Method.GIVEN, pieces, *interval_ns)


def _facts_of(path: Path) -> dict[str, Any]:
    """Name, size and SHA-256 of a file, or of the files of a split recording one after the other; keys of its seals."""
    digest, size, keys = hashlib.sha256(), 0, set[str]()
    for each in sorted(path.glob("*.mcap")) if path.is_dir() else [path]:
        with files.open_file(each) as stream:
            while data := stream.read(_READ_BYTES):
                digest.update(data)
                size += len(data)
        seals = stated_seals(each)
        keys |= set(seals.keys) if seals else set()
    return {"file": path.name, "bytes": size, "sha256": digest.hexdigest(), "sealed_by": sorted(keys)}


def _check(recorders: Sequence[_Recorder], out: Path, given: Mapping[str, ClockOffset]) -> None:
    if len(recorders) < 2:
        raise ConfigError(f"found {len(recorders)} recording, expected two or more")
    seen: dict[str, _Recorder] = {}
    for each in recorders:
        if is_same(out, each.path):
            raise ConfigError(f"{out}: found a recording that is merged, expected another file to write to")
        before = seen.setdefault(each.facts["sha256"], each)
        if before is not each and each.file.entry_count:
            raise ConfigError(f"{each.path}: found the same recording as {before.path}, expected another recorder's")
    others = [each.name for each in recorders[1:]]
    if unknown := sorted(given.keys() - set(others)):
        raise ConfigError(f"offset of {unknown[0]!r}: found no such part, expected {one_of(unknown[0], others)}")


def _known(recorders: Sequence[_Recorder], given: Mapping[str, ClockOffset]) -> dict[tuple[str, str], Clock]:
    """Offsets that need no measurement: those given, and those of merged sessions, in both directions."""
    names = [each.name for each in recorders]
    edges = {(name, names[0]): Clock((offset,)) for name, offset in given.items()}
    for each in recorders:
        if each.clock and each.clock.chain and each.reference in names and each.name not in given:
            edges.setdefault((each.name, each.reference), each.clock)
    return edges


def _links(recorders: Sequence[_Recorder]) -> dict[tuple[str, str], _Link]:
    """What crosses between each two recorders."""
    passed = {each.name: _passed_in_columns(each) or _passed_by_entries(each) for each in recorders}
    asked = {each.name: RecordedClocks.of(each.file).exchanges for each in recorders}
    links = {}
    for one, two in combinations(passed, 2):
        (sent_one, received_one), (sent_two, received_two) = passed[one], passed[two]
        there = find_crossings(sent_one, received_two, received_one, _is_pair)
        back = find_crossings(sent_two, received_one, received_two, _is_pair)
        there += with_questions(there, back, asked[one], CLOCK_QUESTIONS, CLOCK_ANSWERS)
        back += with_questions(back, there, asked[two], CLOCK_QUESTIONS, CLOCK_ANSWERS)
        if there or back:
            links[one, two] = _Link(*without_coincidences(there, back))
    return links


def _passed_in_columns(recorder: _Recorder) -> tuple[Passed, Passed] | None:
    """The outputs and the inputs; None where only entries can be read, or have a time that is not compared."""
    names: list[StreamName] = []
    seeds: list[int] = []

    def number(kind: Kind, channel: str, type_name: str, links: tuple[int, ...]) -> int:
        group = (_OUTPUTS | _INPUTS).get(kind, b"")
        about = type_name if kind in _ROS else ""
        names.append((kind, channel, type_name, links))
        seeds.append(hash((group, about)) & _U64)
        return len(names) - 1

    try:
        found = recorder.file.columns()
    except Unfit:
        return None
    numbered = StreamNumbers(number)
    passed = [_Columns(kinds) for kinds in (_OUTPUTS, _INPUTS)]
    for columns in found:
        if columns.times.dtype != np.int64:
            return None
        rows = numbered.of(columns)
        for each in passed:
            each.add(columns, rows, names, np.array(seeds, np.uint64))
    outputs, inputs = passed
    return outputs.passed(), inputs.passed()


class _Columns:
    """The messages of some kinds, with a hash of each that is equal for equal messages."""

    def __init__(self, kinds: Collection[Kind]) -> None:
        self._kinds = kinds
        self._keys: list[Array] = [np.zeros(0, np.uint64)]
        self._times: list[Array] = [np.zeros(0, np.int64)]
        self._streams: list[Array] = [np.zeros(0, np.int64)]
        self._names: dict[str, int] = {}

    def add(self, columns: EntryColumns, found: StreamRows, names: Sequence[StreamName], seeds: Array) -> None:
        least = [
            (_LEAST_ROS_BYTES if kind in _ROS else HEADER_SIZE + 1) if kind in self._kinds else _MAX_STAMP_NS - 1
            for kind, *_ in names
        ]
        # the last element is that of notes
        sizes = found.ends - found.begins
        rows = np.flatnonzero(sizes >= np.array([*least, _MAX_STAMP_NS - 1], np.int64)[found.idents])
        idents = found.idents[rows]
        first = {ident: int(np.argmax(idents == ident)) for ident in np.flatnonzero(np.bincount(idents)).tolist()}
        streams = np.zeros(len(names) + 1, np.int64)
        for ident in sorted(first, key=first.__getitem__):
            streams[ident] = self._names.setdefault(names[ident][1], len(self._names))
        data = columns.data
        places = zip(found.begins[rows].tolist(), found.ends[rows].tolist(), strict=True)
        hashes = np.array([hash(data[begin:end]) for begin, end in places], np.int64)
        self._keys.append(hashes.view(np.uint64) ^ seeds[idents] if len(rows) else hashes.view(np.uint64))
        self._times.append(columns.times[rows].astype(np.int64))
        self._streams.append(streams[idents])

    def passed(self) -> Passed:
        keys, times, streams = map(np.concatenate, (self._keys, self._times, self._streams))
        return Passed(keys, times, streams, tuple(self._names))


def _passed_by_entries(recorder: _Recorder) -> tuple[Passed, Passed]:
    """The outputs and the inputs."""
    return _passed(recorder, _OUTPUTS), _passed(recorder, _INPUTS)


def _passed(recorder: _Recorder, kinds: Mapping[Kind, bytes]) -> Passed:
    keys, times, streams = array("Q"), array("q"), array("q")
    names: dict[str, int] = {}
    for entry in recorder.file.entries_of_kinds(kinds):
        if entry.kind in kinds and _is_distinct(entry):
            digest = hashlib.blake2b(kinds[entry.kind], digest_size=8)
            if entry.kind in _ROS:
                digest.update(entry.type.encode())
            for part in entry.payload:
                digest.update(part)
            if entry.stamp_ns >= _MAX_STAMP_NS:
                found = f"entry {entry.seq:,} with the stamp {entry.stamp_ns} ns"
                raise UnsupportedRecording(f"{recorder.name}: found {found}, expected one below {_MAX_STAMP_NS}")
            keys.append(int.from_bytes(digest.digest(), "little"))
            times.append(entry.stamp_ns)
            streams.append(names.setdefault(entry.channel, len(names)))
    return Passed.of(keys, times, streams, names)


def _is_distinct(entry: Entry) -> bool:
    if entry.kind in _ROS:
        return entry.size >= _LEAST_ROS_BYTES
    return entry.size > HEADER_SIZE


def _is_pair(sent: str, received: str) -> bool:
    """Whether a stream of one recorder may be that of another: topics may be in a namespace there."""
    if sent.startswith("/") and received.startswith("/"):
        return sent.endswith(received) or received.endswith(sent)
    return sent == received


def _latencies(
    pair: tuple[str, str], link: _Link, clocks: Mapping[str, Clock], edges: Mapping[tuple[str, str], Clock]
) -> Iterator[dict[str, Any]]:
    """Latency of each stream that crosses, and how far it may be wrong."""
    for (sender, receiver), crossings in ((pair, link.there), (pair[::-1], link.back)):
        for each in crossings:
            times = clocks[receiver].all_to_reference(each.received) - clocks[sender].all_to_reference(each.sent)
            yield {
                "from": sender,
                "to": receiver,
                "stream": each.sent_as,
                "received_as": each.received_as,
                **latency_facts(times[each.once]),
                **_error(receiver, sender, clocks, edges),
            }


def _error(
    one: str, two: str, clocks: Mapping[str, Clock], edges: Mapping[tuple[str, str], Clock]
) -> dict[str, float | None]:
    """How far the offset between two parts may be wrong, ms."""
    for name, other in ((one, two), (two, one)):
        edge = edges.get((name, other))
        if edge and clocks[name].chain[: len(edge.chain)] == edge.chain:
            found = max(edge.interval_ns)
            break
    else:
        found = max(clocks[one].interval_ns) + max(clocks[two].interval_ns)
    return {"error_ms": found / 1e6 if math.isfinite(found) else None}
