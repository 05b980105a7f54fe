"""Messages that differ from one of their stream, which the rules have changed, only in numbers and stamps.

The rules change names, text and times; numbers they keep.  So of poses in a row only the first is decoded: of the next
ones, whatever is not a number or a stamp is compared with it, byte by byte, and put out as it was put out then.  All
other messages go through the rules.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from struct import Struct, error, unpack_from
from typing import Any

import numpy as np
import numpy.typing as npt

from igtl_gateway.addon import NS_PER_S, ConversionError, ns_to_ros, ros_to_ns
from igtl_gateway.addon.igtl import HEADER_SIZE, Position, Transform, crc64
from igtl_gateway.addon.messages import header_names
from igtl_gateway.addon.reading import Entry, Heads, Kind, Rows, gathered
from igtl_gateway.addon.streams import crcs
from igtl_gateway.addons.deidentify.context import Context
from igtl_gateway.addons.deidentify.pseudonyms import TimeShift

Bytes = npt.NDArray[np.uint8]
Mask = npt.NDArray[np.bool_]

#: Messages of a stream from which on they are changed at once.
_FEW = 8
#: Streams of which a message is kept; more are invented by a peer.
_MOST_STREAMS = 1_000
#: Places in an OpenIGTLink header, and of the message number in the extended header behind it.
_VERSION, _TICKS_AT, _SIZE_AT, _CRC_AT = Struct(">H"), 34, 42, 50
_NUMBER_AT = HEADER_SIZE + 8
_U64 = Struct(">Q")
#: Type → bytes of its numbers, which are 32 bits each.
_NUMBERS = {"TRANSFORM": 4 * 12, "POSITION": 4 * 7}
_NUMBER_CLASSES = (Transform, Position)
_STAMP = Struct("<iI")
#: Type and message of ROS → offsets of its stamps, and of its first number; None for what has another layout.
Places = Callable[[str, bytes], tuple[list[int], int] | None]


@dataclass(frozen=True, slots=True)
class _Ros:
    """A message of ROS, and what the rules made of it."""

    given: bytes
    made: bytes
    given_stamps: Sequence[int]
    made_stamps: Sequence[int]
    given_numbers: int
    made_numbers: int

    def apply(self, data: bytes, context: Context) -> bytes | None:
        if len(data) != len(self.given):
            return None
        at, times_ns = 0, []
        for place in self.given_stamps:
            if data[at:place] != self.given[at:place]:
                return None
            try:
                times_ns.append(ros_to_ns(*_STAMP.unpack_from(data, place)))
            except (ConversionError, ValueError):
                return None
            at = place + _STAMP.size
        if data[at : self.given_numbers] != self.given[at : self.given_numbers]:
            return None
        made = bytearray(self.made)
        for place, time_ns in zip(self.made_stamps, times_ns, strict=True):
            _STAMP.pack_into(made, place, *ns_to_ros(context.times.ns(time_ns)))
        made[self.made_numbers :] = data[self.given_numbers :]
        return bytes(made)

    def apply_rows(self, rows: Bytes, times: TimeShift) -> tuple[Mask, Bytes, npt.NDArray[np.int64]]:
        """As `apply` for messages (n, size): which of them it changes, the new ones, and how many stamps are moved."""
        made = np.tile(np.frombuffer(self.made, np.uint8), (len(rows), 1))
        good, moved, begin = np.ones(len(rows), np.bool_), np.zeros(len(rows), np.int64), 0
        for place, new_place in zip(self.given_stamps, self.made_stamps, strict=True):
            good &= _are_equal(rows, self.given, begin, place)
            begin = place + _STAMP.size
            words = np.ascontiguousarray(rows[:, place:begin])
            given = words.view("<i4")[:, 0].astype(np.int64) * NS_PER_S + words.view("<u4")[:, 1]
            new, are_moved, fits = times.rows(given)
            good &= fits
            moved += are_moved
            seconds, rest = np.divmod(new, NS_PER_S)
            stamps = np.stack((seconds.astype(np.int32).view(np.uint32), rest.astype(np.uint32)), axis=1)
            made[:, new_place : new_place + _STAMP.size] = stamps.astype("<u4").view(np.uint8)
        good &= _are_equal(rows, self.given, begin, self.given_numbers)
        made[:, self.made_numbers :] = rows[:, self.given_numbers :]
        return good, made, moved


@dataclass(frozen=True, slots=True)
class _Igtl:
    """A message of OpenIGTLink, and what the rules made of it; ``content`` is where its numbers begin and end."""

    given: bytes
    made: bytes
    given_content: tuple[int, int]
    made_content: tuple[int, int]

    def apply(self, data: bytes, context: Context) -> bytes | None:
        given, (begin, end) = self.given, self.given_content
        if (
            len(data) != len(given)
            or data[:_TICKS_AT] != given[:_TICKS_AT]
            or data[_SIZE_AT:_CRC_AT] != given[_SIZE_AT:_CRC_AT]
            or data[HEADER_SIZE : min(begin, _NUMBER_AT)] != given[HEADER_SIZE : min(begin, _NUMBER_AT)]
            or data[_NUMBER_AT + 4 : begin] != given[_NUMBER_AT + 4 : begin]
            or data[end:] != given[end:]
        ):
            return None
        body = memoryview(data)[HEADER_SIZE:]
        # NaN may lose bits in the codec
        if crc64(body) != _U64.unpack_from(data, _CRC_AT)[0] or not math.isfinite(
            sum(unpack_from(f">{(end - begin) // 4}f", data, begin))
        ):
            return None
        made = bytearray(self.made)
        if begin > HEADER_SIZE:
            made[_NUMBER_AT : _NUMBER_AT + 4] = data[_NUMBER_AT : _NUMBER_AT + 4]
        made[slice(*self.made_content)] = data[begin:end]
        _U64.pack_into(made, _TICKS_AT, context.times.ticks(_U64.unpack_from(data, _TICKS_AT)[0]))
        _U64.pack_into(made, _CRC_AT, crc64(memoryview(made)[HEADER_SIZE:]))
        return bytes(made)

    def apply_rows(self, rows: Bytes, times: TimeShift) -> tuple[Mask, Bytes, npt.NDArray[np.int64]]:
        """As of `_Ros`."""
        given, (begin, end) = self.given, self.given_content
        good = _are_equal(rows, given, 0, _TICKS_AT) & _are_equal(rows, given, _SIZE_AT, _CRC_AT)
        good &= _are_equal(rows, given, HEADER_SIZE, min(begin, _NUMBER_AT))
        good &= _are_equal(rows, given, _NUMBER_AT + 4, begin) & _are_equal(rows, given, end, len(given))
        good &= crcs(rows[:, HEADER_SIZE:]) == _words(rows, _CRC_AT)
        content = np.ascontiguousarray(rows[:, begin:end])
        good &= np.isfinite(content.view(">f4")).all(axis=1)
        made = np.tile(np.frombuffer(self.made, np.uint8), (len(rows), 1))
        if begin > HEADER_SIZE:
            made[:, _NUMBER_AT : _NUMBER_AT + 4] = rows[:, _NUMBER_AT : _NUMBER_AT + 4]
        made[:, slice(*self.made_content)] = content
        ticks = _words(rows, _TICKS_AT)
        new, moved, fits = times.rows((ticks >> np.uint64(32)).astype(np.int64) * NS_PER_S)
        fraction = ticks & np.uint64(0xFFFFFFFF)
        _put_words(made, _TICKS_AT, (new // NS_PER_S).astype(np.uint64) << np.uint64(32) | fraction)
        _put_words(made, _CRC_AT, crcs(made[:, HEADER_SIZE:]))
        return good & fits, made, moved.astype(np.int64)


def _are_equal(rows: Bytes, sample: bytes, begin: int, end: int) -> Mask:
    """Which messages (n, size) have the bytes of a sample from ``begin`` to ``end``."""
    if begin >= end:
        return np.ones(len(rows), np.bool_)
    return np.asarray((rows[:, begin:end] == np.frombuffer(sample, np.uint8)[begin:end]).all(axis=1))


def _words(rows: Bytes, at: int) -> npt.NDArray[np.uint64]:
    return np.ascontiguousarray(rows[:, at : at + 8]).view(">u8")[:, 0].astype(np.uint64)


def _put_words(rows: Bytes, at: int, words: npt.NDArray[np.uint64]) -> None:
    rows[:, at : at + 8] = words.astype(">u8").view(np.uint8).reshape(-1, 8)


@dataclass(frozen=True, slots=True)
class _Known:
    """A message of a stream, and what the rules counted: without times, which are counted again."""

    message: _Ros | _Igtl
    channel: str
    rules: Counter[str]


@dataclass(slots=True)
class _Group:
    """Messages of a stream that were changed at once; ``moved``: of each, the number of times that are moved."""

    known: _Known
    current: Callable[[], _Known | None]
    entries: list[Any]
    moved: list[int]
    used: Counter[int] = field(default_factory=Counter)


class RepeatedRows:
    """Messages in rows that were changed at once, if none before them is another one of their stream."""

    def __init__(self, count: int) -> None:
        self._of = np.full(count, -1, np.int64)
        self._place = np.zeros(count, np.int64)
        self._groups: list[_Group] = []

    def add(self, rows: npt.NDArray[np.int64], group: _Group) -> None:
        """Add the rows of some messages."""
        self._of[rows], self._place[rows] = len(self._groups), np.arange(len(rows))
        self._groups.append(group)

    def __iter__(self) -> Iterator[Entry | None]:
        """Yield the new entry of each row; None for those that are to be changed one by one."""
        for of, place in zip(self._of.tolist(), self._place.tolist(), strict=True):
            if of < 0 or (group := self._groups[of]).known is not group.current():
                yield None
                continue
            group.used[group.moved[place]] += 1
            yield Entry(*group.entries[place])

    def count(self, context: Context) -> None:
        """Count what was taken."""
        report = context.report
        for group in self._groups:
            rules, total = group.known.rules, group.used.total()
            report.rules.update({rule: number * total for rule, number in rules.items() if total})
            times = sum(moved * number for moved, number in group.used.items())
            report.rules["time"] += times
            changed = Counter(dict.fromkeys(rules, total))
            changed.update({"time": total - group.used[0]} if times else {})
            if changed := +changed:
                report.streams.setdefault(group.known.channel or "notes", Counter()).update(changed)


class Repeated:
    """The messages of the streams of one session.

    Args:
        context: the rules.
        places: in messages of ROS.
    """

    def __init__(self, context: Context, places: Places) -> None:
        self._context, self._places = context, places
        self._known: dict[tuple[Kind, str, str, int], _Known] = {}

    def apply(self, entry: Entry) -> Entry | None:
        """Return the new entry of a message that repeats one of its stream, and count it; None for any other."""
        known = self._known.get((entry.kind, entry.channel, entry.type, entry.size))
        if known is None:
            return None
        context, report = self._context, self._context.report
        moved = report.rules["time"]
        data = known.message.apply(entry.data(), context)
        if data is None:
            return None
        stamp_ns = context.times.ns(entry.stamp_ns)
        if entry.kind is Kind.IGTL_IN:
            _, _, source_ns = header_names(data)
        else:
            source_ns = context.times.ns(entry.source_ns)
        report.rules.update(known.rules)
        changed = [*known.rules, *(["time"] if report.rules["time"] > moved else [])]
        if changed:
            report.streams.setdefault(known.channel or "notes", Counter()).update(changed)
        return Entry(entry.seq, stamp_ns, entry.kind, known.channel, entry.type, (data,), entry.links, source_ns)

    def rows(self, rows: Rows, heads: Heads) -> RepeatedRows:
        """Change the messages in rows that repeat one of their stream, as `apply` does; counted when taken."""
        found = RepeatedRows(len(rows))
        if rows.times.dtype != np.int64 or rows.stamps.dtype != np.int64:
            return found
        sizes = rows.ends - rows.begins
        pairs, which, counts = np.unique(
            np.stack((rows.heads.astype(np.int64), sizes)), axis=1, return_inverse=True, return_counts=True
        )
        for pair, count in enumerate(counts.tolist()):
            head, size = heads.known[int(pairs[0, pair])], int(pairs[1, pair])
            key = head.kind, head.channel, head.type, size
            places = np.flatnonzero(which.reshape(-1) == pair)
            if count >= _FEW and key in self._known and (rows.which[places] == rows.which[places[0]]).all():
                self._add(found, rows.where(places), places, key, head.links)
        return found

    def _add(
        self,
        found: RepeatedRows,
        rows: Rows,
        places: npt.NDArray[np.int64],
        key: tuple[Kind, str, str, int],
        links: tuple[int, ...],
    ) -> None:
        """Change messages of one stream and size."""
        known, times, (kind, _, type_name, size) = self._known[key], self._context.times, key
        data = np.frombuffer(rows.buffers[rows.which[0]], np.uint8)
        good, made, moved = known.message.apply_rows(gathered(data, rows.begins, size), times)
        stamps, are_moved, fits = times.rows(rows.times)
        good, moved = good & fits, moved + are_moved
        sources = rows.stamps
        if kind is Kind.ROS_IN:
            sources, are_moved, fits = times.rows(rows.stamps)
            good, moved = good & fits, moved + are_moved
        chosen = np.flatnonzero(good)
        step = made.shape[1]
        octets = made[chosen].tobytes()
        messages = [octets[at : at + step] for at in range(0, len(octets), step)]
        if kind is Kind.IGTL_IN:
            of_sender = [header_names(message)[2] for message in messages]
        else:
            of_sender = sources[chosen].tolist()
        columns = (rows.numbers[chosen].tolist(), stamps[chosen].tolist(), messages, of_sender)
        entries = [
            (number, stamp_ns, kind, known.channel, type_name, (message,), links, source_ns)
            for number, stamp_ns, message, source_ns in zip(*columns, strict=True)
        ]
        found.add(places[chosen], _Group(known, lambda: self._known.get(key), entries, moved[chosen].tolist()))

    def learn(self, entry: Entry, made: Entry, rules: Counter[str]) -> None:
        """Keep what the rules have made of an entry; ``rules``: what they counted."""
        message: _Ros | _Igtl | None = None
        if entry.kind is Kind.ROS_IN:
            message = self._ros(entry.type, entry.data(), made.data())
        elif entry.kind is Kind.IGTL_IN and entry.type in _NUMBERS and made.type == entry.type:
            message = _igtl(entry.data(), made.data(), _NUMBERS[entry.type])
        if message is None:
            return
        if len(self._known) >= _MOST_STREAMS:
            self._known.clear()
        own = Counter({rule: number for rule, number in rules.items() if rule not in ("time", "kept type")})
        self._known[entry.kind, entry.channel, entry.type, entry.size] = _Known(message, made.channel, own)

    def _ros(self, ros_type: str, given: bytes, made: bytes) -> _Ros | None:
        places, others = self._places(ros_type, given), self._places(ros_type, made)
        if places is None or others is None or given[places[1] :] != made[others[1] :]:
            return None
        return _Ros(given, made, places[0], others[0], places[1], others[1])


def _igtl(given: bytes, made: bytes, size: int) -> _Igtl | None:
    try:
        begin, other = _content_at(given), _content_at(made)
    except error:
        return None
    if given[begin : begin + size] != made[other : other + size] or len(given) < begin + size:
        return None
    if begin > HEADER_SIZE and given[_NUMBER_AT : _NUMBER_AT + 4] != made[_NUMBER_AT : _NUMBER_AT + 4]:
        return None
    return _Igtl(given, made, (begin, begin + size), (other, other + size))


def _content_at(data: bytes) -> int:
    """Where the content begins: behind the extended header, which version 1 does not have."""
    if _VERSION.unpack_from(data)[0] == 1:
        return HEADER_SIZE
    return HEADER_SIZE + int(_VERSION.unpack_from(data, HEADER_SIZE)[0])
