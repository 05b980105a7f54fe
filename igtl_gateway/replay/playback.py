"""Playback: when recorded entries are due.  Time is an argument, waiting is the caller's.

Pacing never influences content or order: whatever the rate, the same entries come in the same order.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator

from igtl_gateway.errors import ConfigError
from igtl_gateway.session.entry import Entry
from igtl_gateway.stamp import NS_PER_S


class PlaybackClock:
    """Maps recorded time to the time of now.

    Args:
        rate: recorded seconds per real second; None: as fast as possible.
        monotonic_ns: gives the time of now, in ns of any monotonic clock.
    """

    def __init__(self, rate: float | None, monotonic_ns: Callable[[], int]) -> None:
        if rate is not None and not 0 < rate < float("inf"):
            raise ConfigError(f"--rate: found {rate}, expected a number above 0")
        self._rate = rate
        self._now_ns = monotonic_ns
        self._origin: tuple[int, int] | None = None  # (recorded, real): the moment at which they were the same

    def wait_ns(self, recorded_ns: int) -> int:
        """How long from now until ``recorded_ns`` is due; 0 if it is.  The first call is due at once."""
        if self._rate is None:
            return 0
        now_ns = self._now_ns()
        if self._origin is None:
            self._origin = (recorded_ns, now_ns)
        recorded_origin, real_origin = self._origin
        due_ns = real_origin + int((recorded_ns - recorded_origin) / self._rate)
        return max(0, due_ns - now_ns)


def paced(entries: Iterable[Entry], clock: PlaybackClock, wait: Callable[[float], bool]) -> Iterator[Entry]:
    """The entries, each when it is due.

    Args:
        wait: sleeps so many seconds; True means "stop", and ends the playback.
    """
    for entry in entries:
        while (left_ns := clock.wait_ns(entry.stamp_ns)) > 0:
            if wait(left_ns / NS_PER_S):
                return
        yield entry
