"""The clock of a playback: maps recorded time to the current time.  The current time is an argument; the caller waits.

The rate does not influence contents and order: the same entries come in the same order.  An entry that is late is due
immediately; nothing is skipped to catch up.
"""

from __future__ import annotations

from igtl_gateway.base.errors import ConfigError
from igtl_gateway.replay.timeline import SessionTimeline

#: Rate of a playback without pauses between entries.
UNLIMITED = None
#: The maximum rate, and the reciprocal of the minimum: a second becomes a nanosecond, or 30 years.
_MOST = 1e9


def checked_rate(rate: float | None) -> float | None:
    """Return ``rate`` if it is in range.  Raises ConfigError."""
    if rate is not UNLIMITED and not 1 / _MOST <= rate <= _MOST:
        raise ConfigError(f"--rate: found {rate}, expected a number above 0: {1 / _MOST:g} to {_MOST:g}")
    return rate


class PlaybackClock:
    """The current position in the recording: it advances at a rate, stops during a pause, and can seek.

    It starts with the first entry, unless a seek has set it before.

    Args:
        rate: recorded seconds per real second; None: as fast as possible.
        paused: start paused.
        pace: time line of the session.
    """

    def __init__(self, rate: float | None, paused: bool = False, pace: SessionTimeline | None = None) -> None:
        self._rate = checked_rate(rate)
        self._paused = paused
        self._pace = pace or SessionTimeline()
        self._recorded_ns: int | None = None  # the position in the recording ...
        self._real_ns = 0  # ... at this real time
        self._state_before_ns = 0

    @property
    def rate(self) -> float | None:
        """Recorded seconds per real second; None: as fast as possible."""
        return self._rate

    @property
    def paused(self) -> bool:
        """Whether the playback is paused."""
        return self._paused

    def position_ns(self, now_ns: int) -> int | None:
        """Return the current position in the recording; None before the first entry."""
        if self._recorded_ns is None or self._paused or self._rate is UNLIMITED:
            return self._recorded_ns
        passed_ns = self._pace.passed_ns(self._recorded_ns) + int((now_ns - self._real_ns) * self._rate)
        return max(self._recorded_ns, self._pace.recorded_ns(passed_ns))

    def is_state(self, recorded_ns: int) -> bool:
        """Return whether an entry is before the target of the last seek: such latched entries are due immediately."""
        return recorded_ns < self._state_before_ns

    def wait_ns(self, recorded_ns: int, now_ns: int) -> int | None:
        """Return the time until ``recorded_ns`` is due; 0 if it is due; None while paused."""
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
        """Record that this moment has been played: without a rate, the entries advance the position."""
        if (self._paused or self._rate is UNLIMITED) and (self._recorded_ns is None or recorded_ns > self._recorded_ns):
            self._set(recorded_ns, now_ns)

    def pause(self, now_ns: int) -> None:
        """Pause."""
        self._hold(now_ns)
        self._paused = True

    def resume(self, now_ns: int) -> None:
        """Resume at the current position."""
        self._hold(now_ns)
        self._paused = False

    def set_rate(self, rate: float | None, now_ns: int) -> None:
        """Change the rate.  Raises ConfigError for a rate out of range."""
        checked_rate(rate)
        self._hold(now_ns)
        self._rate = rate

    def jump(self, recorded_ns: int | None, now_ns: int) -> None:
        """Seek: set the position to ``recorded_ns``; None: to the next entry."""
        self._state_before_ns = recorded_ns or 0
        self._set(recorded_ns, now_ns)

    def _hold(self, now_ns: int) -> None:
        self._set(self.position_ns(now_ns), now_ns)

    def _set(self, recorded_ns: int | None, now_ns: int) -> None:
        self._recorded_ns, self._real_ns = recorded_ns, now_ns
