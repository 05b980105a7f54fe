"""Messages that differ from one of their stream, which the rules have changed, only in numbers and stamps.

The rules change names, text and times; numbers they keep.  So of poses in a row only the first is decoded: of the next
ones, whatever is not a number or a stamp is compared with it, byte by byte, and put out as it was put out then.  All
other messages go through the rules.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from struct import Struct, error, unpack_from

from igtl_gateway.addon import ConversionError, ns_to_ros, ros_to_ns
from igtl_gateway.addon.igtl import HEADER_SIZE, Position, Transform, crc64
from igtl_gateway.addon.messages import header_names
from igtl_gateway.addon.reading import Entry, Kind
from igtl_gateway.addons.deidentify.context import Context

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


@dataclass(frozen=True, slots=True)
class _Known:
    """A message of a stream, and what the rules counted: without times, which are counted again."""

    message: _Ros | _Igtl
    channel: str
    rules: Counter[str]


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
