"""Playback: recorded time against the time of now.  Now is an argument, waiting is the caller's.

Pacing never influences content or order: whatever the rate, the same entries come in the same order.  What is late,
because a reader was slow or the playback was, is due at once; nothing is skipped to catch up.
"""

from __future__ import annotations

from igtl_gateway.errors import ConfigError
from igtl_gateway.replay.timeline import SessionTimeline

#: Of a playback without pauses between entries.
UNLIMITED = None
#: The highest rate, and one over the lowest: a second becomes 30 years, or a nanosecond.
_MOST = 1e9


def checked_rate(rate: float | None) -> float | None:
    """``rate``, if one can play at it.  Raises ConfigError."""
    if rate is not UNLIMITED and not 1 / _MOST <= rate <= _MOST:
        raise ConfigError(f"--rate: found {rate}, expected a number above 0: {1 / _MOST:g} to {_MOST:g}")
    return rate


class PlaybackClock:
    """The moment of the recording that is now: it runs at a rate, stands while paused, and can jump.

    It starts with the first entry that it is asked about, unless a jump has set it before.

    Args:
        rate: recorded seconds per real second; None: as fast as possible.
        paused: begin so.
        pace: of the session.
    """

    def __init__(self, rate: float | None, paused: bool = False, pace: SessionTimeline | None = None) -> None:
        self._rate = checked_rate(rate)
        self._paused = paused
        self._pace = pace or SessionTimeline()
        self._recorded_ns: int | None = None  # the moment of the recording ...
        self._real_ns = 0  # ... that was at this one
        self._state_before_ns = 0

    @property
    def rate(self) -> float | None:
        """Recorded seconds per real second; None: as fast as possible."""
        return self._rate

    @property
    def paused(self) -> bool:
        """Whether it stands."""
        return self._paused

    def position_ns(self, now_ns: int) -> int | None:
        """The moment of the recording that is now; None before the first entry."""
        if self._recorded_ns is None or self._paused or self._rate is UNLIMITED:
            return self._recorded_ns
        passed_ns = self._pace.passed_ns(self._recorded_ns) + int((now_ns - self._real_ns) * self._rate)
        return max(self._recorded_ns, self._pace.recorded_ns(passed_ns))

    def is_state(self, recorded_ns: int) -> bool:
        """Whether an entry lies before the target of the last jump: it rebuilds the state there, and is due at once."""
        return recorded_ns < self._state_before_ns

    def wait_ns(self, recorded_ns: int, now_ns: int) -> int | None:
        """How long from now until ``recorded_ns`` is due; 0 if it is; None while paused."""
        if self._paused:
            return None
        if self._recorded_ns is None:
            self._set(recorded_ns, now_ns)
        if self._rate is UNLIMITED or self._recorded_ns is None:
            return 0
        passed_ns = self._pace.passed_ns(recorded_ns) - self._pace.passed_ns(self._recorded_ns)
        due_ns = self._real_ns + int(passed_ns / self._rate)
        return max(0, due_ns - now_ns)

    def reached(self, recorded_ns: int, now_ns: int) -> None:
        """This moment has been played: where no time runs, the entries are the time."""
        if (self._paused or self._rate is UNLIMITED) and (self._recorded_ns is None or recorded_ns > self._recorded_ns):
            self._set(recorded_ns, now_ns)

    def pause(self, now_ns: int) -> None:
        """Stand from now on."""
        self._hold(now_ns)
        self._paused = True

    def resume(self, now_ns: int) -> None:
        """Run again, from the moment where it stands."""
        self._hold(now_ns)
        self._paused = False

    def set_rate(self, rate: float | None, now_ns: int) -> None:
        """Run at this rate from now on.  Raises ConfigError for one that is none."""
        checked_rate(rate)
        self._hold(now_ns)
        self._rate = rate

    def jump(self, recorded_ns: int | None, now_ns: int) -> None:
        """``recorded_ns`` is now; None: the next entry is, whenever it was recorded."""
        self._state_before_ns = recorded_ns or 0
        self._set(recorded_ns, now_ns)

    def _hold(self, now_ns: int) -> None:
        self._set(self.position_ns(now_ns), now_ns)

    def _set(self, recorded_ns: int | None, now_ns: int) -> None:
        self._recorded_ns, self._real_ns = recorded_ns, now_ns
