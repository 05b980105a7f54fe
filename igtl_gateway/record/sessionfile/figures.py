"""The figures of a file: what its recorder counted of the entries, in a metadata record at the end.

So ``info`` does not have to read the entries.  Figures are of one file, and in a part of a split recording also of the
parts up to it.  They follow from the entries only.  A writer that copies messages writes none.

They are not trusted: a reader compares them with the counts and times of the index, and with each other.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from igtl_gateway.base.buffers import Buffer
from igtl_gateway.base.untrusted.text import parse_json
from igtl_gateway.gateway.log.clocksteps import ClockStep
from igtl_gateway.gateway.log.entry import Kind
from igtl_gateway.gateway.log.timing import StampTiming
from igtl_gateway.record.sessionfile import layout
from igtl_gateway.record.sessionfile.entry_counts import MARK, NOTES, UNKNOWN, CountsOfEntries, new_counts
from igtl_gateway.record.sessionfile.large_outputs import DIGEST_BYTES
from igtl_gateway.record.sessionfile.layout import LayoutError
from igtl_gateway.record.sessionfile.messages import unpack_note
from igtl_gateway.record.sessionfile.records import HEAD, MESSAGE_HEAD, MESSAGE_RECORD

VERSION_KEY, VERSION = "version", "1"
#: Items of the record: figures of the file, and of the parts of the recording up to it.
FILE, SO_FAR = "file", "so_far"

_STREAM = tuple(
    "kind channel type messages bytes first_ns last_ns longest_pause_ns unstamped median_age_and_range_ns links".split()
)
_CLOCK = tuple(
    "link channel messages unset future backwards repeated least_age_ns most_age_ns excess_ns steps first_block "
    "last_block".split()
)
#: Characters of the JSON text; a reader takes no record above 8 MiB.
_MOST_TEXT = 2 << 20
_U32, _I64 = 1 << 32, 1 << 63


class Figures:
    """Counts the entries of files as they are written."""

    def __init__(self) -> None:
        self._counts: CountsOfEntries = new_counts()
        self._streams: dict[tuple[Kind, str, str], int] = {}
        self._names: dict[str, int] = {}
        self._bytes: Counter[tuple[Kind, str, str]] = Counter()  # that digests stand for, without their own

    def begin_file(self) -> None:
        """What follows is of the next file."""
        self._counts.begin_file()

    def add_channel(self, number: int, kind: Kind, channel: str, type_name: str) -> None:
        """The entries of a stream are the messages of a channel of the file."""
        if kind in layout.NOTE_KINDS:
            self._counts.set_channel(number, NOTES)
            return
        key = kind, channel, type_name
        stream = self._streams.get(key)
        if stream is None:
            name = self._names.setdefault(channel, len(self._names))
            stream = self._streams[key] = self._counts.add_stream(name, kind.is_input, kind in layout.WIRE_TOPICS)
        self._counts.set_channel(number, stream)

    def add_bytes(self, kind: Kind, channel: str, type_name: str, size: int, digest: bytes) -> None:
        """A message has the digest of a payload of ``size`` bytes in its place; it is counted with its own bytes."""
        counted = DIGEST_BYTES if kind in layout.WIRE_TOPICS else len(digest)
        self._bytes[kind, channel, type_name] += size - counted

    def give_up(self) -> None:
        """Something cannot be counted by its channel: there are no figures."""
        self._counts.give_up()

    def add_chunk(self, chunk: bytearray | bytes, rest: Buffer = b"") -> None:
        """The messages in the records of a chunk; ``rest`` is the end of the last one."""
        at = 0
        while (at := self._counts.add(chunk, at)) >= 0:
            length = HEAD.unpack_from(chunk, at)[1]
            _, _, stamp_ns, _ = MESSAGE_HEAD.unpack_from(chunk, at + HEAD.size)
            begin, at = at + MESSAGE_RECORD.size, at + HEAD.size + length
            data = bytes(chunk[begin:at]) + (bytes(rest) if at > len(chunk) else b"")
            if MARK not in data:
                continue
            try:
                step = ClockStep.of(unpack_note(data, 0, stamp_ns))
            except LayoutError:
                self.give_up()
                return
            if step:
                self._counts.step(step.jump_ns, step.ahead_ns, step.at_ns)

    def text(self) -> str:
        """As JSON; ``""``: there are none."""
        if not self._counts.good:
            return ""
        rows = self._counts.streams()
        streams = [
            [stream[0].value, *stream[1:], rows[number][0], rows[number][1] + self._bytes[stream], *rows[number][2:]]
            for stream, number in self._streams.items()
            if number != UNKNOWN and rows[number][0]
        ]
        names = list(self._names)
        clocks = [[link, names[name], *state] for link, name, *state in self._counts.clocks()]
        found = {"streams": {"columns": _STREAM, "rows": streams}, "clocks": {"columns": _CLOCK, "rows": clocks}}
        text = json.dumps(found, separators=(",", ":"))
        return text if len(text) <= _MOST_TEXT else ""


def record_of(figures: Mapping[str, Figures]) -> dict[str, str]:
    """The items of the metadata record; empty where there are no figures."""
    texts = {name: text for name, each in figures.items() if (text := each.text())}
    return layout.seal({VERSION_KEY: VERSION, **texts}) if texts else {}


# -- reading -----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class StreamFigures:
    """What is stated of a stream; times in UTC ns of the gateway.

    Attributes:
        age_ns: median of the ages of its messages, and the largest less the smallest; None where none has a stamp.
        links: of OpenIGTLink: those that its messages came from or went to.
    """

    kind: Kind
    channel: str
    type: str
    messages: int
    bytes: int
    first_ns: int
    last_ns: int
    longest_pause_ns: int
    unstamped: int
    age_ns: tuple[int, int] | None
    links: frozenset[int]


@dataclass(frozen=True, slots=True)
class StatedFigures:
    """What is stated of a file, or of a recording.

    Attributes:
        clocks: link (0: ROS) and Entry.channel → the stamps of it, in the order of their first messages.
    """

    streams: tuple[StreamFigures, ...]
    clocks: Mapping[tuple[int, str], StampTiming]


def parse_figures(text: str) -> StatedFigures:
    """Figures as `Figures.text` made them.  Raises LayoutError for what no entries have; DamagedRecording."""
    found = parse_json(text, "figures")
    streams = tuple(_stream(row) for row in _rows(found, "streams", _STREAM))
    _check(len({(each.kind, each.channel, each.type) for each in streams}) == len(streams), "a stream twice")
    clocks: dict[tuple[int, str], StampTiming] = {}
    for row in _rows(found, "clocks", _CLOCK):
        link, channel = row[0], row[1]
        _check(_is_count(link) and link < _U32 and isinstance(channel, str), "another clock")
        _check((link, channel) not in clocks, "a clock twice")
        clocks[link, channel] = _clock(row[2:])
    inputs: Counter[str] = Counter()
    stamps: Counter[str] = Counter()
    for each in streams:
        if each.kind.is_input:
            inputs[each.channel] += each.messages
    for (_, channel), clock in clocks.items():
        stamps[channel] += clock.messages
    _check(inputs == stamps, "clocks of other messages than those of the streams")
    return StatedFigures(streams, clocks)


def _rows(found: Any, name: str, columns: Sequence[str]) -> list[list[Any]]:
    table = found.get(name) if isinstance(found, dict) else None
    rows = table.get("rows") if isinstance(table, dict) else None
    _check(
        isinstance(table, dict)
        and table.get("columns") == list(columns)
        and isinstance(rows, list)
        and all(isinstance(row, list) and len(row) == len(columns) for row in rows),
        f"other {name}",
    )
    assert isinstance(rows, list)
    return rows


def _stream(row: list[Any]) -> StreamFigures:
    kind, channel, type_name, *numbers, age, links = row
    kinds = [each.value for each in (*layout.WIRE_TOPICS, *layout.ROS_KINDS)]
    _check(kind in kinds and isinstance(channel, str) and isinstance(type_name, str), "another stream")
    _check(all(map(_is_count, numbers)), f"other counts of {channel!r}")
    messages, size, first_ns, last_ns, pause_ns, unstamped = numbers
    is_input = Kind(kind).is_input
    stamped = messages - unstamped if is_input else 0
    _check(messages > 0 and unstamped <= (messages if is_input else 0), f"other counts of {channel!r}")
    _check(
        first_ns <= last_ns and (messages > 1 or (first_ns, pause_ns) == (last_ns, 0)), f"other times of {channel!r}"
    )
    _check((age is not None) == (stamped > 0), f"other ages of {channel!r}")
    _check(age is None or (_is_pair(age) and age[1] >= 0), f"other ages of {channel!r}")
    is_links = isinstance(links, list) and all(_is_count(link) and link < _U32 for link in links)
    _check(is_links and (not links or Kind(kind) in layout.WIRE_TOPICS), f"other links of {channel!r}")
    ages = None if age is None else (age[0], age[1])
    return StreamFigures(
        Kind(kind), channel, type_name, messages, size, first_ns, last_ns, pause_ns, unstamped, ages, frozenset(links)
    )


def _clock(state: list[Any]) -> StampTiming:
    *counts, least, most, excess, steps, first, last = state
    _check(all(map(_is_count, (*counts, excess, steps))), "other counts of a clock")
    messages, unset = counts[0], counts[1]
    _check(0 < messages and max(unset, *(unset + each for each in counts[2:])) <= messages, "other counts of a clock")
    _check(_is_pair([least, most]) and least <= most, "other ages of a clock")
    _check(steps < 16 and (first is None) == (last is None), "other blocks of a clock")
    _check(first is None or (_is_pair(first) and _is_pair(last) and first[0] <= last[0]), "other blocks of a clock")
    return StampTiming.of_state(state)


def _is_count(value: Any) -> bool:
    return type(value) is int and 0 <= value < _I64


def _is_pair(value: Any) -> bool:
    is_two = isinstance(value, list) and len(value) == 2
    return is_two and all(type(each) is int and -_I64 <= each < 2 * _I64 for each in value)


def _check(is_right: bool, found: str) -> None:
    if not is_right:
        raise LayoutError(f"figures: found {found}")
