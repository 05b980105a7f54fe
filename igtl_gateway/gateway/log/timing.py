"""The clock of a sender, estimated from its stamps: offset, drift, and the quality of the stamps.

One-way traffic cannot distinguish a clock that is ahead from a short latency: the smallest observed age
(arrival − stamp) is the clock's offset *plus* the least latency of the way, and nothing here separates them.  What
lies above that minimum is jitter: queueing, scheduling, the sender's own pause between stamping and sending.
Pure: stamps and arrivals are arguments, in UTC nanoseconds.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any

from igtl_gateway.base.quantities import ANOTHER_SESSION_NS, duration_text
from igtl_gateway.base.stamp import NS_PER_MS, NS_PER_S

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt

    Numbers = npt.NDArray[np.int64]

#: Steps that clocks and programs round to, coarsest first.
_STEPS = (NS_PER_S, 100 * NS_PER_MS, 10 * NS_PER_MS, NS_PER_MS)
#: A stamp so close to a step lies on it: float64 seconds of today are 240 ns apart.
_ON_STEP_NS = 500
#: Number of stamps from which on rounding can be judged.
_ENOUGH = 10
#: Less is not shown.
_LEAST_SHOWN_NS = 1_000
#: No session is as old: a clock that was not set counts from its start.
_OTHER_EPOCH_NS = 20 * 366 * 86_400 * NS_PER_S
#: Minima are kept of blocks so long: shorter than a clock drifts visibly (100 ppm: 1 ms), long enough to catch a
#: message that did not wait.
_BLOCK_NS = 10 * NS_PER_S
#: Least distance of the first and the last block from which the drift is estimated.
_DRIFT_MIN_NS = 60 * NS_PER_S
#: A time without a message from which on it is kept as a pause; the guard looks at one message in a tenth of a second.
PAUSE_NS = 500 * NS_PER_MS
#: Samples that are further apart have nothing between them, unless the user states another gap: a tracker of 10 Hz has
#: less, and the movement of a hand bends by at most a few millimetres.
GAP_NS = 150_000_000
#: A stamp further ahead than this is in the future: clocks kept by NTP on one network are closer.
FUTURE_NS = 100 * NS_PER_MS


class StampTiming:
    """The estimate from the stamps of one stream; constant memory.

    Attributes:
        messages: how many were looked at.
        unset: of these, how many had no stamp.
        future: how many were stamped more than ``FUTURE_NS`` after their arrival.
        least_ns: the smallest age: clock offset plus least latency; negative where the sender's clock is ahead.
        most_ns: the largest age.
        backwards: stamps before the one before them.
        repeated: stamps equal to the one before them.
        pause: arrival that ended the last time of ``PAUSE_NS`` or more without a message, and its length; 0: none.
    """

    __slots__ = (
        "_arrived_ns",
        "_block_end_ns",
        "_block_least_ns",
        "_excess_ns",
        "_first",
        "_last",
        "_previous_ns",
        "_steps",
        "backwards",
        "future",
        "least_ns",
        "messages",
        "most_ns",
        "pause",
        "repeated",
        "unset",
    )

    def __init__(self) -> None:
        self.messages = self.unset = self.future = self.backwards = self.repeated = 0
        self.least_ns = self.most_ns = 0
        self._previous_ns = self._arrived_ns = 0
        self.pause = (0, 0)
        self._steps: tuple[int, ...] = _STEPS
        self._excess_ns = 0  # sum over the ages of what is above the least of their block, so far
        self._block_end_ns = 0
        self._block_least_ns = 0
        self._first: tuple[int, int] | None = None  # end and minimum of the first whole block
        self._last: tuple[int, int] | None = None

    def add(self, stamp_ns: int, arrival_ns: int) -> None:
        """Look at a message; stamp 0 or below is unset."""
        self.messages += 1
        if arrival_ns - self._arrived_ns >= PAUSE_NS and self._arrived_ns:
            self.pause = arrival_ns, arrival_ns - self._arrived_ns
        self._arrived_ns = arrival_ns
        if stamp_ns <= 0:
            self.unset += 1
            return
        age = arrival_ns - stamp_ns
        self.future += age < -FUTURE_NS
        if self._steps:
            self._steps = tuple(step for step in self._steps if _lies_on(stamp_ns, step))
        self.repeated += stamp_ns == self._previous_ns
        self.backwards += stamp_ns < self._previous_ns
        if not self._previous_ns:
            self.least_ns = self.most_ns = self._block_least_ns = age
            self._block_end_ns = arrival_ns + _BLOCK_NS
        elif arrival_ns >= self._block_end_ns:
            self._last = (self._block_end_ns, self._block_least_ns)
            self._first = self._first or self._last
            self._block_least_ns, self._block_end_ns = age, arrival_ns + _BLOCK_NS
        self._previous_ns = stamp_ns
        self.least_ns, self.most_ns = min(self.least_ns, age), max(self.most_ns, age)
        self._block_least_ns = min(self._block_least_ns, age)
        self._excess_ns += age - self._block_least_ns

    def add_columns(self, stamps: Numbers, arrivals: Numbers) -> None:
        """As `add`, of messages whose arrivals do not decrease, at least one."""
        import numpy as np  # here: live messages come one at a time

        self.messages += len(stamps)
        before = np.concatenate((arrivals[:1], arrivals[:-1]))
        before[0] = self._arrived_ns
        pauses = np.flatnonzero((arrivals - before >= PAUSE_NS) & (before != 0))
        if len(pauses):
            end = int(arrivals[pauses[-1]])
            self.pause = end, end - int(before[pauses[-1]])
        self._arrived_ns = int(arrivals[-1])
        is_set = stamps > 0
        self.unset += len(stamps) - int(is_set.sum())
        stamps, arrivals = stamps[is_set], arrivals[is_set]
        if not len(stamps):
            return
        ages = arrivals - stamps
        self.future += int((ages < -FUTURE_NS).sum())
        if self._steps:
            rests = ((step, stamps % step) for step in self._steps)
            self._steps = tuple(step for step, rest in rests if (np.minimum(rest, step - rest) <= _ON_STEP_NS).all())
        before = np.concatenate((stamps[:1], stamps[:-1]))
        before[0] = self._previous_ns
        self.repeated += int((stamps == before).sum())
        self.backwards += int((stamps < before).sum())
        if not self._previous_ns:
            self.least_ns = self.most_ns = self._block_least_ns = int(ages[0])
            self._block_end_ns = int(arrivals[0]) + _BLOCK_NS
        self._previous_ns = int(stamps[-1])
        self.least_ns, self.most_ns = min(self.least_ns, int(ages.min())), max(self.most_ns, int(ages.max()))
        begin = 0
        while begin < len(ages):
            end = max(begin, int(np.searchsorted(arrivals, self._block_end_ns)))
            if end > begin:
                least = np.minimum.accumulate(np.minimum(ages[begin:end], self._block_least_ns))
                excess = ages[begin:end] - least
                is_small = int(excess.max()) < (1 << 62) // len(excess)
                self._excess_ns += int(excess.sum()) if is_small else sum(excess.tolist())
                self._block_least_ns = int(least[-1])
            if end < len(ages):
                self._last = (self._block_end_ns, self._block_least_ns)
                self._first = self._first or self._last
                self._block_least_ns, self._block_end_ns = int(ages[end]), int(arrivals[end]) + _BLOCK_NS
            begin = end

    def state(self) -> list[Any]:
        """What the estimate is made of, as JSON values, without what only the next message needs.

        ``messages``, ``unset``, ``future``, ``backwards``, ``repeated``, ``least_ns``, ``most_ns``; the sum of what the
        ages are above the least of their block; a bit for each step of ``_STEPS`` that all stamps lie on; end and least
        age of the first and of the last whole block, or None.
        """
        counts = [self.messages, self.unset, self.future, self.backwards, self.repeated, self.least_ns, self.most_ns]
        steps = sum(1 << bit for bit, step in enumerate(_STEPS) if step in self._steps)
        return [*counts, self._excess_ns, steps, *(each and list(each) for each in (self._first, self._last))]

    @classmethod
    def of_state(cls, state: Sequence[Any]) -> StampTiming:
        """An estimate with the figures of a :meth:`state`, for which no other message can be looked at."""
        made = cls()
        (
            made.messages, made.unset, made.future, made.backwards, made.repeated, made.least_ns, made.most_ns,
            made._excess_ns, steps, first, last,
        ) = state  # fmt: skip
        made._steps = tuple(step for bit, step in enumerate(_STEPS) if steps >> bit & 1)
        made._first, made._last = first and (first[0], first[1]), last and (last[0], last[1])
        return made

    def reset(self) -> None:
        """Our own clock was set: what is known of the other one is known no more; counts stay."""
        self._previous_ns = self._arrived_ns = 0
        self._first = self._last = None

    @property
    def stamped(self) -> int:
        """How many messages had a stamp."""
        return self.messages - self.unset

    @property
    def jitter_ns(self) -> int:
        """Mean of what the ages are above the least one of their ten seconds (as far as it was known then)."""
        return self._excess_ns // self.stamped if self.stamped else 0

    @property
    def step_ns(self) -> int:
        """What the stamps are rounded to, 0 where nothing is seen of that (down to a millisecond).

        A sender that stamps its clockwork (every 0.1 s sharp) looks the same.
        """
        return self._steps[0] if self._steps and self.stamped - self.repeated >= _ENOUGH else 0

    @property
    def drift_ppm(self) -> float | None:
        """How much slower the sender's clock runs than ours, in millionths; None if it cannot be determined."""
        if not self._first or not self._last or self._last[0] - self._first[0] < _DRIFT_MIN_NS:
            return None
        return (self._last[1] - self._first[1]) / (self._last[0] - self._first[0]) * 1e6

    @property
    def ahead_ns(self) -> int | None:
        """By how much the sender's clock is ahead of our own at least, ns; None without a stamp.

        Of the last ten to twenty seconds, because clocks drift: a stamp is made before its message arrives.
        """
        if not self._previous_ns:
            return None
        is_recent = self._last is not None and self._block_end_ns - self._last[0] <= 2 * _BLOCK_NS
        return -min(self._block_least_ns, self._last[1] if self._last and is_recent else self._block_least_ns)

    def to_dict(self) -> dict[str, Any]:
        """As JSON values."""
        if not self.stamped:
            return {"messages": self.messages, "unset": self.unset}
        drift = self.drift_ppm
        return {
            "messages": self.messages,
            "unset": self.unset,
            "offset_plus_least_latency_ms": self.least_ns / NS_PER_MS,
            "jitter_ms": self.jitter_ns / NS_PER_MS,
            "spread_ms": (self.most_ns - self.least_ns) / NS_PER_MS,
            "drift_ppm": None if drift is None else round(drift, 1),
            "rounded_to_ms": self.step_ns / NS_PER_MS,
            "future": self.future,
            "backwards": self.backwards,
            "repeated": self.repeated,
        }

    def __str__(self) -> str:
        if not self.stamped:
            return "no stamps"
        parts = [
            age_text(self.least_ns, "received {} after the stamp (latency and clock offset)"),
        ]
        if self.jitter_ns >= _LEAST_SHOWN_NS:
            parts.append(f"jitter {duration_text(self.jitter_ns)}")
        if (drift := self.drift_ppm) is not None:
            parts.append(f"drift {drift:+.1f} ppm")
        if self.step_ns:
            parts.append(f"stamps rounded to {duration_text(self.step_ns)}")
        counted = (
            (self.unset, "unset"),
            (self.future, "in the future"),
            (self.backwards, "backwards"),
            (self.repeated, "repeated"),
        )
        parts += [f"{number:,} of {self.messages:,} {what}" for number, what in counted if number]
        return ", ".join(parts)


def best(timings: Iterable[StampTiming]) -> StampTiming | None:
    """Of the streams of one peer, the best one for estimating its clock: with the least age.

    All of them are stamped by one clock; what is older only waited longer.  None without any message.
    """
    return min(timings, key=lambda timing: (not timing.stamped, timing.least_ns), default=None)


def age_text(age_ns: float, text: str) -> str:
    """Return the age of messages on receipt in words: ``text`` with it, or what its sign or its size shows.

    A stamp of more than a day ago is no latency: the message was recorded in another session, or its clock does not
    count from 1970.  No network is faster than a microsecond: an import has made such times of receipt from the stamps.
    """
    if abs(age_ns) < _LEAST_SHOWN_NS:
        return "received at the stamp"
    if age_ns < 0:
        return f"stamped {duration_text(age_ns)} ahead of this clock"
    if age_ns > ANOTHER_SESSION_NS:
        is_unset = age_ns > _OTHER_EPOCH_NS
        what = "stamped by a clock that does not count from 1970" if is_unset else "recorded in another session"
        return f"{what}: offset {duration_text(age_ns)}"
    return text.format(duration_text(age_ns))


def rounded_to(stamp_ns: int) -> int:
    """The coarsest step that a stamp may be rounded to, as it lies on it, ns; 0: none.  One in a thousand does so."""
    return next((step for step in _STEPS if _lies_on(stamp_ns, step)), 0)


def _lies_on(stamp_ns: int, step_ns: int) -> bool:
    rest = stamp_ns % step_ns
    return min(rest, step_ns - rest) <= _ON_STEP_NS
