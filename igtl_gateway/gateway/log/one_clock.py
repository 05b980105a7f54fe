"""One clock for streams that are joined: the senders' stamps where these are of one clock, otherwise what they show.

A stamp is the time of a measurement, so it is the better clock: a picture that an encoder delays by 100 ms belongs to
the pose of 100 ms ago.  But stamps of two senders are of one clock only if the session shows it.  What it shows is the
age of a message on arrival: the offset of the sender's clock plus the latency, and the least age of a stream is the
offset plus the least latency (``timing``).  An age below zero is not a latency, nor is one of seconds in practice.  So

* streams whose least ages are those of latencies have one clock, that of the gateway;
* streams of another clock, alone, have one clock, too: theirs;
* streams of several clocks are moved to gateway time, each clock by its least age, and this is reported;
* where a message has no stamp, or the ages of a stream wander, all streams have their times of receipt, and this is
  reported;
* stamps without any age are times of receipt, which the gateway sets in topics of a sender without stamps: how late
  the messages were is not known, and this is reported.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from igtl_gateway.base.errors import ConfigError
from igtl_gateway.base.quantities import count_text, duration_text, offset_text
from igtl_gateway.base.stamp import NS_PER_MS, NS_PER_S

Times = npt.NDArray[np.int64]

SOURCE, GATEWAY, AUTO = "source", "gateway", "auto"
CLOCKS = (AUTO, SOURCE, GATEWAY)

#: A least age below this is another clock: those that NTP keeps on one network are nearer.
_AHEAD_NS = -20 * NS_PER_MS
#: A least age above this is another clock: no message of a stream that moves waits so long.
_LATE_NS = NS_PER_S
#: The least ages of the parts of a session may differ by this; more is a clock that was set, or one that does not run.
_STEADY_NS = 250 * NS_PER_MS
#: Parts of a session whose least ages are compared: at least this long, at most this many.
_PART_NS, _PARTS = 2 * NS_PER_S, 64
#: Messages from which on a stream, or a part of it, shows a least age.
_ENOUGH = 3
#: Least ages that differ by more are reported: it is a latency, or an offset of clocks.
_SAID_NS = 20 * NS_PER_MS
#: With an age up to this, the stamp is the time of receipt, which the gateway sets where the sender has set none.
#: Its outputs are numbered by the nanosecond; no message of a peer or of DDS arrives so fast.
_NO_AGE_NS = 100
#: A stream in which at least this part of the messages has no age has times of receipt as stamps; clocks that agree by
#: chance have it in less.
_OFTEN = 0.05
#: Streams that a note names: a reader looks for its own among them.
_NAMED = 12


@dataclass(frozen=True, slots=True, eq=False)
class StreamTimes:
    """The times of a stream that is joined.

    Attributes:
        name: of the stream, for the notes.
        times: (N,) int64, gateway time, UTC ns.
        stamps: (N,) int64, the sender's stamps, UTC ns; 0 = unset.
        sender: streams of one sender have one clock; ``""``: it is not known.
        behind: the stream whose lag was subtracted from the stamps: they have its clock, or that of the gateway if it
            has a message without a stamp.
        is_clock: the times are those of the gateway's clock itself, and not of messages.
    """

    name: str
    times: Times
    stamps: Times
    sender: str = ""
    behind: StreamTimes | None = None
    is_clock: bool = False

    @property
    def is_stamped(self) -> bool:
        """Whether every message has a stamp."""
        return bool(np.all(self.stamps > 0))

    @property
    def is_of_receipt(self) -> bool:
        """Whether its stamps are times of receipt: those of a topic whose sender has set none."""
        if self.is_clock or self.behind is not None or not len(self.times):
            return False
        ages = self.times - self.stamps
        return bool(np.mean((ages >= 0) & (ages <= _NO_AGE_NS)) >= _OFTEN)

    def ages(self) -> Times:
        """Return the ages on arrival of the clock of the stamps, ns; of the gateway's clock 0."""
        if self.behind is None:
            return self.times - self.stamps
        return self.behind.ages() if self.behind.is_stamped else np.zeros(1, np.int64)


@dataclass(frozen=True, slots=True)
class OneClock:
    """The clock of streams that are joined.

    Attributes:
        name: ``source``: the senders' stamps; ``gateway``: times of receipt.
        shifts: of each stream what is added to its stamps, ns.
        notes: sentences for the user: what was corrected, and what is not known.
        is_chosen: whether the user has chosen times of receipt.
    """

    name: str
    shifts: tuple[int, ...]
    notes: tuple[str, ...] = ()
    is_chosen: bool = False

    def times(self, stream: StreamTimes, index: int) -> Times:
        """Return the times (N,) of the stream ``index`` on this clock, UTC ns."""
        if self.name == SOURCE:
            return stream.stamps + self.shifts[index]
        if self.is_chosen or stream.behind is None or not stream.is_stamped or not len(stream.behind.times):
            return stream.times
        # of a stream whose lag is known, gateway times are those of its stamps
        return stream.stamps + int(stream.ages().min())


def one_clock(streams: Sequence[StreamTimes], wanted: str = AUTO) -> OneClock:
    """Return the clock on which streams are joined.

    Args:
        streams: all that are joined; those without a message count for nothing.
        wanted: ``auto``; ``gateway``: times of receipt; ``source``: stamps, also where the ages of a stream wander.

    Raises:
        ConfigError: ``source``, and a message has no stamp.
    """
    nothing = (0,) * len(streams)
    if wanted == GATEWAY:
        return OneClock(GATEWAY, nothing, is_chosen=True)
    without = next((each for each in streams if not each.is_stamped), None)
    if without is not None:
        number = int(np.sum(without.stamps <= 0))
        found = f"{number:,} of {count_text(len(without.times), 'message')} of {without.name} without a stamp"
        if wanted == SOURCE:
            raise ConfigError(f"clock: found {found}, expected none for the clock source")
        is_mixed = any(np.any(each.stamps > 0) and not _is_behind(each, without) for each in streams)
        notes = [f"clock: gateway: found {found}, so all streams have their times of receipt"] if is_mixed else []
        return OneClock(GATEWAY, nothing, tuple(notes))
    received = [index for index, each in enumerate(streams) if each.is_of_receipt]
    if (
        received
        and wanted == AUTO
        and len(received) == sum(len(each.times) > 0 and not each.is_clock for each in streams)
    ):
        return OneClock(SOURCE, nothing)  # nothing is mixed, and an imported file has its own times as stamps
    notes = []
    if received:
        notes.append(
            f"clock: the stamps of {_names(streams, received)} are times of receipt: the sender sends messages without "
            "a stamp, so how late they were is not known"
        )
    wandering = [name for each in streams if (name := _wandering(each))]
    if wandering:
        reason = f"the ages of {'; '.join(wandering)}: the clock was set, or the stamps do not run with it"
        if wanted == SOURCE:
            return OneClock(SOURCE, nothing, (f"clock: source: {reason}", *notes))
        return OneClock(GATEWAY, nothing, (f"clock: gateway: {reason}; all streams have their times of receipt",))
    least = [int(each.ages().min()) if len(each.times) and len(each.ages()) else 0 for each in streams]
    joined = _joined(streams, least)
    return replace(joined, notes=(*joined.notes, *notes))


def _is_behind(stream: StreamTimes, other: StreamTimes) -> bool:
    """Whether the stamps of a stream are on the clock of another one, which has no stamps: on gateway time."""
    return stream.behind is not None and (stream.behind.name == other.name or not stream.behind.is_stamped)


def _wandering(stream: StreamTimes) -> str:
    """Return the stream and its least ages if they differ from part to part of the session, else ``""``."""
    if stream.behind is not None:
        return _wandering(stream.behind) if stream.behind.is_stamped else ""
    ages = stream.times - stream.stamps
    if len(ages) < 2 * _ENOUGH:
        return ""
    span_ns = int(stream.times[-1] - stream.times[0])
    count = min(span_ns // _PART_NS, _PARTS, len(ages) // _ENOUGH)
    if count < 2:
        return ""
    parts = np.minimum((stream.times - stream.times[0]) // (span_ns // count + 1), count - 1)
    least = np.full(count, np.iinfo(np.int64).max)
    np.minimum.at(least, parts, ages)
    least = least[np.bincount(parts, minlength=count) >= _ENOUGH]
    if len(least) < 2 or int(least.max() - least.min()) <= _STEADY_NS:
        return ""
    return f"{stream.name} go from {_ms(int(least.min()))} to {_ms(int(least.max()))}"


def _joined(streams: Sequence[StreamTimes], least: Sequence[int]) -> OneClock:
    """The clock of streams of which every message has a stamp; ``least``: their least ages, ns."""
    used = [index for index, each in enumerate(streams) if len(each.times)]
    clocks = _clocks(streams, least, used)
    notes = []
    if len(clocks) == 1:
        shifts = [0] * len(streams)
    else:
        shifts = [-_offset(clocks, index) for index in range(len(streams))]
        for offset_ns, members in clocks.items():
            if offset_ns:
                way = "ahead of" if offset_ns > 0 else "behind"
                notes.append(
                    f"clock: the stamps of {_names(streams, members)} are {_ms(abs(offset_ns))} {way} gateway time and "
                    f"not of the clock of the others: corrected by {_ms(-offset_ns, sign=True)}, "
                    "the offset plus the least latency"
                )
    if used:
        # also across clocks: what a correction leaves of an age is compared with the ages of the others
        left = {index: least[index] - shifts[index] for index in used}
        first, last = (extreme(used, key=left.__getitem__) for extreme in (min, max))
        if left[last] - left[first] > _SAID_NS:
            late = [index for index in used if left[index] - left[first] > _SAID_NS]
            notes.append(
                f"clock: one clock is assumed: the stamps of {_names(streams, late)} are up to "
                f"{_ms(left[last] - left[first])} older on receipt than those of {streams[first].name}, "
                "which is latency, or an offset of their clocks: `igtl-gateway sync` measures it"
            )
    return OneClock(SOURCE, tuple(shifts), tuple(notes))


def _offset(clocks: dict[int, list[int]], index: int) -> int:
    return next((offset_ns for offset_ns, members in clocks.items() if index in members), 0)


def _clocks(streams: Sequence[StreamTimes], least: Sequence[int], used: Sequence[int]) -> dict[int, list[int]]:
    """Offset of a clock ahead of the gateway's (0: that of the gateway itself) → indices of its streams."""
    is_judged = {index: len(streams[index].times) >= _ENOUGH for index in used}
    others: list[list[int]] = []
    for index in sorted(used, key=lambda each: least[each]):
        is_latency = _AHEAD_NS <= least[index] <= _LATE_NS
        if is_latency or not (is_judged[index] or least[index] < _AHEAD_NS):
            continue
        if others and least[index] - least[others[-1][0]] <= _LATE_NS:
            others[-1].append(index)
        else:
            others.append([index])
    for index in used:
        if any(index in members for members in others):
            continue
        for members in others:
            is_same = {streams[each].sender for each in members} & {streams[index].sender} - {""}
            away_ns = least[index] - least[members[0]]
            if 0 <= away_ns <= _LATE_NS and (is_same or not is_judged[index]):
                members.append(index)
                break
    found = {-least[members[0]]: members for members in others}
    if own := [index for index in used if not any(index in members for members in others)]:
        found[0] = own
    return found


def _names(streams: Sequence[StreamTimes], members: Sequence[int]) -> str:
    names = [streams[index].name for index in members]
    return ", ".join(names[:_NAMED]) + (f" and {len(names) - _NAMED} more" if len(names) > _NAMED else "")


def _ms(value_ns: int, *, sign: bool = False) -> str:
    return offset_text(value_ns) if sign else duration_text(value_ns)
