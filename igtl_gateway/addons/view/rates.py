"""Rates, latencies and silences of the streams of a session, as plots over time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from igtl_gateway.addon import NS_PER_S
from igtl_gateway.addon.reading import Entry, Kind
from igtl_gateway.addon.streams import StreamTimes, one_clock
from igtl_gateway.addon.terminal import duration_text
from igtl_gateway.addons.view.colours import line_colour
from igtl_gateway.addons.view.columns import Rows
from igtl_gateway.addons.view.contents import LATENCIES, RATES, path_of
from igtl_gateway.addons.view.pen import LAST_NS, SENDER_TIME, Pen

Array = npt.NDArray[Any]
Key = tuple[Kind, str]

#: A gap in a stream, as in ``info``: a pause of more than this many mean intervals and of more than a second.
_GAP_FACTOR, _RHYTHM = 10, 20
_NS_PER_MS = 1e6
#: Maximum number of streams with plots of rate and latency, in case a peer invents names.
_MAX_PLOTS = 300
#: Letters of a name in a legend.
_LEGEND = 26


@dataclass(slots=True)
class _StreamRate:
    """Times of the messages of a stream, UTC ns of the gateway."""

    path: str
    first_ns: int = 0
    last_ns: int = 0
    messages: int = 0
    this_second: int = 0
    stamped: int = 0
    least_ns: int = 0

    def age(self, least_ns: int, count: int) -> None:
        """Take the least age of some messages."""
        self.least_ns = min(self.least_ns, least_ns) if self.stamped else least_ns
        self.stamped += count


def _short(name: str) -> str:
    """A name as a legend has room for it: its beginning and its end."""
    return name if len(name) <= _LEGEND else f"{name[: _LEGEND // 3]}…{name[_LEGEND // 3 + 1 - _LEGEND :]}"


class Rates:
    """Counts the messages of all streams and draws what they show.

    Args:
        pen: to draw with.
    """

    def __init__(self, pen: Pen) -> None:
        self._pen = pen
        self._streams: dict[Key, _StreamRate] = {}
        self._begin_ns = self._second = 0

    def clocks(self) -> tuple[str, ...]:
        """Return sentences on streams whose stamps are of another clock than those of the others."""
        stamped = [(channel, rate) for (_, channel), rate in self._streams.items() if rate.stamped]
        streams = []
        for channel, rate in stamped:
            # as many messages as make its least age count, each with this age
            stamps = np.full(min(rate.stamped, 3), LAST_NS // 2, np.int64)
            streams.append(StreamTimes(channel, stamps + rate.least_ns, stamps))
        found = one_clock(streams)
        return tuple(
            f"on the time line {SENDER_TIME}, {stream.name} is {duration_text(shift_ns)} "
            f"{'before' if shift_ns > 0 else 'after'} the others: its stamps are of another clock"
            for stream, shift_ns in zip(streams, found.shifts, strict=True)
            if shift_ns
        )

    def count(self, entry: Entry) -> str:
        """Count the message whose times the pen has; return a sentence if its stream was silent before, else ""."""
        now_ns, source_ns, silence = self._pen.stamp_ns, self._pen.source_ns, ""
        if not now_ns:
            return ""
        key = (entry.kind, entry.channel)
        rate = self._streams.get(key)
        if rate is None:
            if len(self._streams) >= _MAX_PLOTS:
                return ""
            rate = self._streams[key] = _StreamRate(path_of(entry.channel), now_ns, now_ns)
            self._name(entry, rate.path)
        self._begin_ns = self._begin_ns or now_ns
        second = (now_ns - self._begin_ns) // NS_PER_S
        if second > self._second:
            self._rates(second)
        if entry.kind.is_input:
            if source_ns:
                rate.age(now_ns - source_ns, 1)
                self._pen.numbers(f"{LATENCIES}/{rate.path}", [(now_ns - source_ns) / _NS_PER_MS])
            pause = now_ns - rate.last_ns
            if rate.messages >= _RHYTHM and pause > NS_PER_S:
                mean = (rate.last_ns - rate.first_ns) / (rate.messages - 1)
                if pause > _GAP_FACTOR * mean:
                    silence = f"{entry.channel}: silent for {duration_text(pause)}"
        rate.last_ns = now_ns
        rate.messages += 1
        rate.this_second += 1
        return silence

    def _name(self, entry: Entry, path: str) -> None:
        """Name the curves of a stream; inputs, which the plots show, have colours in turn."""
        number = sum(kind.is_input == entry.kind.is_input for kind, _ in self._streams) - 1
        name, colour = _short(entry.channel), line_colour(number)
        self._pen.curve(f"{RATES}/{entry.kind.value}/{path}", name, colour)
        if entry.kind.is_input:
            self._pen.curve(f"{LATENCIES}/{path}", name, colour)

    def alone(self, key: Key, stamps: Array) -> Array:
        """Mask of the messages (n,) of a stream that ``count`` counts: a new stream, an input that was silent."""
        rate = self._streams.get(key)
        found = np.zeros(len(stamps), np.bool_)
        if rate is None:
            found[0] = len(self._streams) < _MAX_PLOTS
        if key[0].is_input:
            found |= np.diff(stamps, prepend=stamps[0] if rate is None else rate.last_ns) > NS_PER_S
        return found

    def count_rows(self, rows: Rows, streams: Sequence[tuple[Key, Array]]) -> None:
        """Count messages, none of which is ``alone``.

        Args:
            rows: times, ascending.
            streams: of each stream its messages among them, ascending.
        """
        known = [(rate, key[0].is_input, of) for key, of in streams if len(of) and (rate := self._streams.get(key))]
        counted = np.zeros(len(rows), np.bool_)
        for _, _, of in known:
            counted[of] = True
        messages = np.flatnonzero(counted)
        seconds = (rows.stamps[messages] - self._begin_ns) // NS_PER_S
        turns = np.flatnonzero(np.diff(seconds, prepend=self._second) > 0)
        places = messages[turns]
        before = [of.searchsorted(places) for _, _, of in known]
        for turn, (place, second) in enumerate(zip(places.tolist(), seconds[turns].tolist(), strict=True)):
            for (rate, _, _), counts in zip(known, before, strict=True):
                rate.this_second += int(counts[turn] - (counts[turn - 1] if turn else 0))
            self._pen.at_row(rows, place)
            self._rates(second)
        for (rate, is_input, of), counts in zip(known, before, strict=True):
            rate.this_second += len(of) - (int(counts[-1]) if len(counts) else 0)
            rate.messages += len(of)
            rate.last_ns = int(rows.stamps[of[-1]])
            stamped = of[rows.sources[of] != 0] if is_input else of[:0]
            if len(stamped):
                these = rows.where(stamped)
                ages = these.stamps - these.sources
                rate.age(int(ages.min()), len(ages))
                self._pen.at_rows(these)
                self._pen.numbers(f"{LATENCIES}/{rate.path}", [ages / _NS_PER_MS])

    def _rates(self, second: int) -> None:
        """Draw the number of messages of the past second at its end, and zeros at both ends of a longer pause.

        Seconds start at the first message, so that the first second is complete.
        """
        now = (self._pen.number, self._pen.stamp_ns, self._pen.source_ns)
        pause = [self._second + 1, second - 1] if second - self._second > 1 else []
        for at, counted in ((self._second, True), *((each, False) for each in dict.fromkeys(pause))):
            end_ns = self._begin_ns + (at + 1) * NS_PER_S - 1
            self._pen.number, self._pen.stamp_ns, self._pen.source_ns = now[0] - 1, end_ns, 0
            for (kind, _), rate in self._streams.items():
                value = float(rate.this_second) if counted else 0.0
                self._pen.numbers(f"{RATES}/{kind.value}/{rate.path}", [value], is_dense=True)
        for rate in self._streams.values():
            rate.this_second = 0
        self._pen.number, self._pen.stamp_ns, self._pen.source_ns = now
        self._second = second
