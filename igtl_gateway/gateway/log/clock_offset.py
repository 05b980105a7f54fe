"""How far the clock of a peer is ahead of gateway time: an interval that has the truth in it, whatever the delays are.

A question leaves at ``asked``, the peer stamps its answer when it makes it, and the answer is here at ``answered``.  So
the stamp was made between the two, and the offset is in [stamp - answered, stamp - asked], as in NTP; delays that
differ by direction make it wide, not wrong.  Every further answer makes it narrower.  Between answers it grows by
``DRIFT_PPM``, which is more than two clocks drift apart, also while NTP slews one of them.

An answer that contradicts the interval is a clock that was set: one of the two.  It is accepted when a second answer
shows the same, and a new interval begins.  Until then the interval has both.  Clocks that contradict themselves again
and again, and stamps that do not change, give no interval for as long as they do so.

Pure: all times are arguments, gateway time and stamps in UTC nanoseconds.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from ipaddress import ip_address
from typing import Any

from igtl_gateway.base.quantities import clock_text, duration_text
from igtl_gateway.base.stamp import NS_PER_S
from igtl_gateway.gateway.log.timing import rounded_to

#: Device of the questions for a clock, and the streams of questions and answers.
DEVICE = "igtl_clock"
QUESTIONS, ANSWERS = f"GET_STATUS/{DEVICE}", f"STATUS/{DEVICE}"
#: Codes of the notes about a peer's clock: its offset, that it or ours was set, that its stamps are no clock.
PEER_CLOCK, PEER_CLOCK_STEP, PEER_NO_CLOCK = "peer_clock", "peer_clock_step", "peer_no_clock"
#: All of them: they depend on earlier answers, and nothing else depends on these.
CODES = frozenset({PEER_CLOCK, PEER_CLOCK_STEP, PEER_NO_CLOCK})
#: How fast two clocks drift apart at most.  Quartz: 50 ppm each; NTP slews one of them by up to 500 ppm more.
DRIFT_PPM = 1_000
#: A drift is known from answers that are so far apart; older ones than about twice ``_WINDOW_NS`` do not count.
_DRIFT_MIN_NS, _WINDOW_NS = 60 * NS_PER_S, 300 * NS_PER_S
#: Stamps are rounded: seconds as float64 by 240 ns, the ticks of OpenIGTLink by less.
_ROUNDING_NS = 1_000
#: Contradictions within this time, from which on there is no interval; a clock that is set once makes two.
_MANY, _MANY_NS = 7, 60 * NS_PER_S
#: Answers in a row with one stamp, from which on there is no interval.
_STILL = 5
#: After a step of this host's clock, gateway time may stand, and then advances by nanoseconds only.
_QUIET_NS = NS_PER_S // 10
#: Questions without an answer that are remembered of a link.
_MOST_WAITING = 8


@dataclass(frozen=True, slots=True)
class Offset:
    """The offset of a peer's clock, as of a moment.

    Attributes:
        low_ns, high_ns: the clock is ahead of gateway time by at least and at most this (negative: behind).
        age_ns: how long ago the last answer came.
        answers: number of answers that it is from.
        drift_ppm: how much faster than gateway time it runs at least and at most, in millionths; None: not known yet.
    """

    low_ns: int
    high_ns: int
    age_ns: int
    answers: int
    drift_ppm: tuple[float, float] | None

    @property
    def middle_ns(self) -> int:
        """The middle of the interval."""
        return (self.low_ns + self.high_ns) // 2

    @property
    def bound_ns(self) -> int:
        """How far the truth may be from the middle."""
        return self.high_ns - self.middle_ns

    def to_dict(self) -> dict[str, Any]:
        """As JSON values."""
        low, high = self.drift_ppm or (None, None)
        return {
            "method": "two-way",
            "low_ns": self.low_ns,
            "high_ns": self.high_ns,
            "drift_low_ppm": low,
            "drift_high_ppm": high,
            "answers": self.answers,
            "age_s": self.age_ns / NS_PER_S,
        }

    @property
    def drift_text(self) -> str:
        """``+12.3 ± 0.4 ppm``; "" if it is not known."""
        if not self.drift_ppm:
            return ""
        low, high = self.drift_ppm
        return f"{(low + high) / 2:+.1f} ± {(high - low) / 2:.1f} ppm"

    @property
    def text(self) -> str:
        """The offset and the drift in words."""
        drift = f", drift {self.drift_text}" if self.drift_ppm else ""
        return f"clock ahead by {self}, by its answers{drift}"

    def __str__(self) -> str:
        return f"{clock_text(self.middle_ns)} ± {duration_text(self.bound_ns)}"


@dataclass(frozen=True, slots=True)
class ClockStep:
    """A clock was set: the offset has changed by at least ``low_ns`` and at most ``high_ns``."""

    low_ns: int
    high_ns: int


@dataclass(frozen=True, slots=True)
class NoClock:
    """The stamps of answers show no clock; ``stands``: they do not change, else they contradict each other."""

    stands: bool


@dataclass(frozen=True, slots=True)
class _Interval:
    """An offset between two bounds, at a gateway time."""

    low_ns: int
    high_ns: int
    at_ns: int

    def at(self, now_ns: int) -> _Interval:
        """The interval later, as far as clocks drift; earlier than its own time it is as it is."""
        more_ns = _drift(now_ns - self.at_ns)
        return _Interval(self.low_ns - more_ns, self.high_ns + more_ns, max(now_ns, self.at_ns))

    def within(self, other: _Interval) -> _Interval | None:
        """What is in both, which are of one time; None: nothing is."""
        low_ns, high_ns = max(self.low_ns, other.low_ns), min(self.high_ns, other.high_ns)
        return _Interval(low_ns, high_ns, self.at_ns) if low_ns <= high_ns else None


class OffsetEstimate:
    """The offset of one clock; constant memory."""

    def __init__(self) -> None:
        self.restart()

    def restart(self) -> None:
        """Forget everything: one of the two clocks was set."""
        self._interval: _Interval | None = None
        self._rival: _Interval | None = None  # of the answer that contradicts it
        self._anchors: deque[_Interval] = deque(maxlen=2)  # begin of the window of the drift, and of the next one
        self._contradictions: deque[int] = deque(maxlen=_MANY)
        self._is_clock = True
        self._stamp_ns = self._still = self._answers = 0

    def add(self, asked_ns: int, stamp_ns: int, answered_ns: int) -> ClockStep | NoClock | None:
        """Take an answer; return what it shows besides the offset.  A stamp of 0 or below is unset and shows nothing.

        Args:
            asked_ns: gateway time before the question left.
            stamp_ns: the stamp of the answer, by the peer's clock.
            answered_ns: gateway time after the answer came.
        """
        if stamp_ns <= 0 or answered_ns < asked_ns:
            return None
        if stamp_ns == self._stamp_ns:
            self._still += 1
            return self._contradict(answered_ns, stands=True) if self._still >= _STILL else None
        self._stamp_ns, self._still = stamp_ns, 0
        slack_ns = max(_ROUNDING_NS, rounded_to(stamp_ns))
        high_ns = stamp_ns - asked_ns + _drift(answered_ns - asked_ns)
        found = _Interval(stamp_ns - answered_ns - slack_ns, high_ns + slack_ns, answered_ns)
        self._answers += 1
        while self._contradictions and answered_ns - self._contradictions[0] > _MANY_NS:
            self._contradictions.popleft()
        self._is_clock = self._is_clock or not self._contradictions
        before = self._interval and self._interval.at(answered_ns)
        kept = found.within(before) if before else found
        if before is None or kept:
            self._interval, self._rival = kept, None
            self._follow_drift()
            return None
        no_clock = self._contradict(answered_ns)
        if not self._is_clock:
            self._begin(found)
            return no_clock
        confirmed = self._rival.at(answered_ns).within(found) if self._rival else None
        if confirmed is None:
            self._rival = found
            return None
        self._begin(confirmed)
        return ClockStep(confirmed.low_ns - before.high_ns, confirmed.high_ns - before.low_ns)

    def offset(self, now_ns: int) -> Offset | None:
        """The offset at a gateway time; None: it is not known."""
        if self._interval is None or not self._is_clock:
            return None
        known = self._interval.at(now_ns)
        low_ns, high_ns = known.low_ns, known.high_ns
        if self._rival:
            rival = self._rival.at(now_ns)
            low_ns, high_ns = min(low_ns, rival.low_ns), max(high_ns, rival.high_ns)
        return Offset(low_ns, high_ns, max(0, now_ns - self._interval.at_ns), self._answers, self._drift_ppm())

    def _begin(self, found: _Interval) -> None:
        self._interval, self._rival = found, None
        self._anchors.clear()
        self._answers = 1

    def _contradict(self, now_ns: int, *, stands: bool = False) -> NoClock | None:
        """Take notice of a contradiction; return once that this is no clock."""
        self._contradictions.append(now_ns)
        if not self._is_clock or (len(self._contradictions) < _MANY and not stands):
            return None
        self._is_clock = False
        return NoClock(stands)

    def _follow_drift(self) -> None:
        here = self._interval
        assert here
        if not self._anchors or here.at_ns - self._anchors[-1].at_ns >= _WINDOW_NS:
            self._anchors.append(here)

    def _drift_ppm(self) -> tuple[float, float] | None:
        here = self._interval
        if not here or not self._anchors or (span_ns := here.at_ns - self._anchors[0].at_ns) < _DRIFT_MIN_NS:
            return None
        then = self._anchors[0]
        low, high = (here.low_ns - then.high_ns) / span_ns * 1e6, (here.high_ns - then.low_ns) / span_ns * 1e6
        return max(low, -float(DRIFT_PPM)), min(high, float(DRIFT_PPM))


class PeerClocks:
    """The clocks of the peers of a session, by link, from questions and answers."""

    def __init__(self) -> None:
        self._hosts: dict[int, str] = {}
        self._estimates: dict[int, OffsetEstimate] = {}
        self._waiting: dict[int, deque[int]] = {}  # link → when it was asked; 0: before a clock was set
        self._quiet_until_ns = 0

    def up(self, link: int, address: str) -> None:
        """A peer has connected from ``HOST:PORT``."""
        self._hosts[link] = address.rpartition(":")[0].strip("[]")

    def down(self, link: int) -> None:
        """A peer has disconnected: what comes next there may be another one."""
        for known in (self._hosts, self._estimates, self._waiting):
            known.pop(link, None)

    def stepped(self, now_ns: int) -> None:
        """This host's clock was set, so all offsets are others."""
        self._quiet_until_ns = now_ns + _QUIET_NS
        for estimate in self._estimates.values():
            estimate.restart()
        for link, waiting in self._waiting.items():
            self._waiting[link] = deque([0] * len(waiting), maxlen=_MOST_WAITING)

    def asked(self, link: int, now_ns: int) -> None:
        """A question leaves."""
        at_ns = now_ns if now_ns >= self._quiet_until_ns else 0
        self._waiting.setdefault(link, deque(maxlen=_MOST_WAITING)).append(at_ns)

    def answered(self, link: int, stamp_ns: int, now_ns: int) -> ClockStep | NoClock | None:
        """Take the answer to the first question that waits; without one it shows nothing."""
        asked_ns = self.take_question(link)
        return self.add(link, asked_ns, stamp_ns, now_ns) if asked_ns else None

    def add(self, link: int, asked_ns: int, stamp_ns: int, now_ns: int) -> ClockStep | NoClock | None:
        """Take an answer, as ``OffsetEstimate.add``."""
        return self._estimates.setdefault(link, OffsetEstimate()).add(asked_ns, stamp_ns, now_ns)

    def take_question(self, link: int) -> int:
        """Return when the first question that waits has left, and have it wait no more; 0: none, or not usable."""
        waiting = self._waiting.get(link)
        return waiting.popleft() if waiting else 0

    def waits(self, link: int) -> bool:
        """Whether a question has no answer yet."""
        return bool(self._waiting.get(link))

    def offset(self, link: int, now_ns: int) -> Offset | None:
        """The offset of the clock of a peer: by its answers, or by those of another program on its host."""
        own = self._estimates.get(link)
        if own and (found := own.offset(now_ns)):
            return found
        host = self._hosts.get(link, "")
        if not _is_elsewhere(host):
            return None
        return next(filter(None, self._of_host(host, now_ns)), None)

    def _of_host(self, host: str, now_ns: int) -> Iterator[Offset | None]:
        for link, estimate in tuple(self._estimates.items()):
            if self._hosts.get(link) == host:
                yield estimate.offset(now_ns)

    def text(self, link: int, now_ns: int) -> str:
        """By which clock an age is that the stamps of a peer show, as the end of a sentence."""
        found = self.offset(link, now_ns)
        return "by the sender's clock" + (f" (offset {found})" if found else "")


def _drift(ns: int) -> int:
    """What two clocks drift apart in a time at most, rounded up; ns."""
    return -(-max(0, ns) * DRIFT_PPM // 1_000_000)


def _is_elsewhere(host: str) -> bool:
    """Whether an address is of another machine: tunnels end at this one."""
    try:
        return not ip_address(host).is_loopback
    except ValueError:
        return False
