"""What a recorder counts of the messages in its chunks, for the figures at the end of a file (``figures``).

``_figures.c`` has the compiled type; it also exists here, with an equal result.  A message costs some nanoseconds, and
the memory is bounded: where a bound is met, or a number is too large for 64 bits, there are no figures.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Protocol

from igtl_gateway.gateway.log.clocksteps import CLOCK_STEP, ClockStep, without_jump
from igtl_gateway.gateway.log.timing import StampTiming
from igtl_gateway.record.sessionfile.layout import LayoutError
from igtl_gateway.record.sessionfile.messages import unpack_raw
from igtl_gateway.record.sessionfile.records import HEAD, MESSAGE, MESSAGE_HEAD, MESSAGE_RECORD

#: In place of a stream: messages of this channel are notes; there are none of it.
NOTES, UNKNOWN = -2, -1
#: Ages of one stream, and of all together.
MOST_AGES, MOST_AGES_OF_ALL = 100_000, 4 << 20
#: Streams, and clocks; links of one stream.
MOST_STREAMS, MOST_LINKS = 10_000, 1_000
#: Times from here on, and by how much gateway time may be ahead.
_FAR_NS, _FAR_AHEAD_NS = 1 << 62, 1 << 60
#: In the bytes of a note about a step of the clock.
MARK = CLOCK_STEP.encode()
_I64 = 1 << 63


class CountsOfEntries(Protocol):
    """Counts of the messages of files, in order.

    Streams are numbered as they are added; a name is the number of an Entry.channel, which distinguishes clocks.
    """

    @property
    def good(self) -> bool:
        """Whether all could be counted."""

    def begin_file(self) -> None:
        """Another file: its channels are not known yet."""

    def add_stream(self, name: int, is_input: bool, is_wire: bool) -> int:
        """A new stream; returns its number."""

    def set_channel(self, number: int, stream: int) -> None:
        """Which stream the messages of a channel are of, or NOTES."""

    def give_up(self) -> None:
        """Forget all: something cannot be counted."""

    def add(self, chunk: bytearray | bytes, at: int) -> int:
        """Count the messages in the records from ``at`` on; of the last one, the end may be missing.

        Returns the place of a note before which it stops: it may be about a step of the clock, or its end is missing;
        -1 where all was counted.
        """

    def step(self, jump_ns: int, ahead_ns: int, at_ns: int) -> None:
        """Apply a step of the host's clock: as ``ClockStep``."""

    def streams(self) -> list[list[Any]]:
        """Of each stream: messages, bytes of their payloads, first and last time, longest pause, number without a
        stamp; median of the ages and the largest less the smallest (None: none); links.
        """

    def clocks(self) -> list[list[Any]]:
        """Of each clock: link (0: none), name, and ``StampTiming.state``."""


@dataclass(slots=True)
class _Stream:
    name: int
    is_input: bool
    is_wire: bool
    messages: int = 0
    bytes: int = 0
    first_ns: int = 0
    last_ns: int = 0
    longest_pause_ns: int = 0
    unstamped: int = 0
    ages_ns: list[int] = field(default_factory=list)
    links: set[int] = field(default_factory=set)

    def row(self) -> list[Any]:
        ages = sorted(self.ages_ns)
        age = [ages[len(ages) // 2], ages[-1] - ages[0]] if ages else None
        times = self.first_ns, self.last_ns, self.longest_pause_ns
        return [self.messages, self.bytes, *times, self.unstamped, age, sorted(self.links)]


class PlainCounts:
    """The counts in Python."""

    def __init__(self) -> None:
        self.good = True
        self._streams: list[_Stream] = []
        self._clocks: dict[tuple[int, int], StampTiming] = {}
        self._channels: dict[int, int] = {}
        self._ahead_ns = self._ages = 0

    def begin_file(self) -> None:
        self._channels.clear()

    def add_stream(self, name: int, is_input: bool, is_wire: bool) -> int:
        if len(self._streams) >= MOST_STREAMS:
            self.good = False
            return UNKNOWN
        self._streams.append(_Stream(name, is_input, is_wire))
        return len(self._streams) - 1

    def set_channel(self, number: int, stream: int) -> None:
        self._channels[number] = stream

    def give_up(self) -> None:
        self.good = False
        self._streams, self._clocks = [], {}
        self._channels.clear()

    def add(self, chunk: bytearray | bytes, at: int) -> int:
        data = memoryview(chunk)
        while self.good and len(data) - at >= MESSAGE_RECORD.size:
            begin = at
            opcode, length = HEAD.unpack_from(data, at)
            at += HEAD.size + length
            if opcode != MESSAGE:
                continue
            channel, _, time_ns, publish_ns = MESSAGE_HEAD.unpack_from(data, begin + HEAD.size)
            stream = self._channels.get(channel, UNKNOWN)
            payload = data[begin + MESSAGE_RECORD.size : at]
            if stream == UNKNOWN or length < MESSAGE_HEAD.size or max(time_ns, publish_ns) >= _FAR_NS:
                self.good = False
            elif stream == NOTES:
                if at > len(data) or MARK in bytes(payload):
                    return begin
            else:
                whole = length - MESSAGE_HEAD.size
                self.good = self._add(self._streams[stream], payload, whole, time_ns, publish_ns)
        if not self.good:
            self.give_up()
        return -1

    def _add(self, stream: _Stream, payload: memoryview, size: int, time_ns: int, publish_ns: int) -> bool:
        source_ns = 0 if publish_ns == time_ns else publish_ns
        links: tuple[int, ...] = ()
        if stream.is_wire:
            try:  # of a large message, only the head is here
                entry = unpack_raw(bytes(payload) + bytes(size - len(payload)), 0, time_ns, publish_ns)
            except LayoutError:
                return False
            size, source_ns, links = entry.size, entry.source_ns, entry.links
        if stream.messages:
            stream.longest_pause_ns = max(stream.longest_pause_ns, time_ns - stream.last_ns)
        else:
            stream.first_ns = time_ns
        stream.last_ns = time_ns
        stream.messages += 1
        stream.bytes += size
        stream.links.update(links)
        if len(stream.links) > MOST_LINKS:
            return False
        return not stream.is_input or self._add_input(stream, links[0] if links else 0, time_ns, source_ns)

    def _add_input(self, stream: _Stream, link: int, time_ns: int, source_ns: int) -> bool:
        arrival_ns = time_ns - self._ahead_ns
        if not source_ns:
            stream.unstamped += 1
        elif len(stream.ages_ns) < MOST_AGES:
            self._ages += 1
            if self._ages > MOST_AGES_OF_ALL:
                return False
            stream.ages_ns.append(arrival_ns - source_ns)
        clock = self._clocks.get((link, stream.name))
        if clock is None:
            if len(self._clocks) >= MOST_STREAMS:
                return False
            clock = self._clocks[link, stream.name] = StampTiming()
        clock.add(source_ns, arrival_ns)
        return clock.state()[7] < _I64

    def step(self, jump_ns: int, ahead_ns: int, at_ns: int) -> None:
        if not (-_FAR_AHEAD_NS < ahead_ns < _FAR_AHEAD_NS and 0 <= jump_ns < _FAR_AHEAD_NS):
            self.give_up()
            return
        self._ahead_ns = ahead_ns
        for stream in self._streams:
            without_jump(stream, ClockStep(0, jump_ns, ahead_ns, at_ns))
        if jump_ns and any(stream.last_ns >= _FAR_NS for stream in self._streams):
            self.give_up()
        for clock in self._clocks.values():
            clock.reset()

    def streams(self) -> list[list[Any]]:
        return [stream.row() for stream in self._streams]

    def clocks(self) -> list[list[Any]]:
        return [[link, name, *clock.state()] for (link, name), clock in self._clocks.items()]


def new_counts() -> CountsOfEntries:
    """Fresh counts."""
    return Counts()


Counts: type[CountsOfEntries] = PlainCounts

if not TYPE_CHECKING:
    try:
        from igtl_gateway.native._figures import Counts
    except ImportError:  # pragma: no cover - installed without the C part
        pass
