"""What the standard error shows while packages are compiled: on a terminal a bar, elsewhere a line now and then.

The estimate of what is left follows from this run alone, because the machine may be any, and busy: packages go on as
fast as they did so far, one after the other on each processor.
"""

from __future__ import annotations

import os
import shutil
import sys
from collections.abc import Mapping

from igtl_gateway.base.clock import Clock
from igtl_gateway.base.quantities import count_text, seconds_text
from igtl_gateway.base.stamp import NS_PER_S

_CLEAR = "\r\x1b[K"
_BAR = 20
#: Seconds between two lines where no terminal shows a bar.
_LINE_EACH_S = 10
#: Below it an estimate has single seconds.
_FINE_S = 15
#: From this part of the work on, its speed is known.
_KNOWN = 0.15
#: What is under way counts up to this part of it, by the speed so far.
_UNDER_WAY = 0.9


def write_line(text: str) -> None:
    """Write a line to the standard error; nothing where that is closed."""
    _write(f"{text}\n")


class Progress:
    """The bar, and the estimate of what is left.

    Args:
        costs: package → the seconds of CPU time that it takes, in the order in which they begin.
        at_once: number of packages that are compiled at once.
        clock: measures the time.
    """

    def __init__(self, costs: Mapping[str, float], at_once: int, clock: Clock) -> None:
        self._costs = costs
        self._clock = clock
        self._begun_ns = self._shown_ns = clock.monotonic_ns()
        self._at_once = at_once
        self._whole = sum(costs.values())
        self._shares = dict.fromkeys(costs, 0.0)
        self._times: dict[str, tuple[float, float]] = {}  # when each began, and when it was seen last, s
        self._is_live = _has_cursor()
        packages = count_text(len(costs), "ROS message package")
        write_line(f"First start: compiling {packages}, once for this environment.")
        if not self._is_live:
            write_line(self._text())

    @property
    def elapsed_s(self) -> float:
        return (self._clock.monotonic_ns() - self._begun_ns) / NS_PER_S

    def show(self, package: str, share: float, under_way: float = 0.0) -> None:
        """Show what share of a package, 0 to 1, is done and under way; call it often, because time passes too."""
        now_s = self.elapsed_s
        begun_s, seen_s = self._times.get(package, (now_s, now_s))
        self._times[package] = begun_s, now_s
        so_far = self._shares[package]
        expected = so_far * (now_s - begun_s) / (seen_s - begun_s) if seen_s > begun_s else so_far
        self._shares[package] = max(so_far, share, min(expected, share + _UNDER_WAY * under_way))
        if self._is_live:
            _write(f"{_CLEAR}{self._text()[: shutil.get_terminal_size().columns - 1]}")
            return
        now_ns = self._clock.monotonic_ns()
        if now_ns - self._shown_ns >= _LINE_EACH_S * NS_PER_S:
            self._shown_ns = now_ns
            write_line(self._text())

    def close(self) -> None:
        """Take the bar away."""
        if self._is_live:
            _write(_CLEAR)

    @property
    def _done(self) -> float:
        return sum(self._costs[package] * share for package, share in self._shares.items()) / self._whole

    def _text(self) -> str:
        done = self._done
        filled = int(done * _BAR)
        bar = ("=" * filled + ">" * (filled < _BAR)).ljust(_BAR)
        return f"compiling ROS messages [{bar}] {done:4.0%}{self._left()}"

    def _left(self) -> str:
        """What is left by the speed so far, as soon as that is known."""
        if self._done < _KNOWN:
            return ""
        busy_s = sum(last - first for first, last in self._times.values())
        ends = [0.0] * self._at_once
        for package, cost in self._costs.items():
            ends[ends.index(min(ends))] += cost * (1 - self._shares[package])
        left_s = max(ends) * busy_s / (self._done * self._whole)
        step = 5 if left_s > _FINE_S else 1
        return f", about {seconds_text(step * max(1, round(left_s / step)))} left"


def _has_cursor() -> bool:
    return sys.stderr is not None and sys.stderr.isatty() and os.environ.get("TERM") != "dumb"


def _write(text: str) -> None:
    try:
        sys.stderr.write(text)
        sys.stderr.flush()
    except (AttributeError, OSError, ValueError):  # there is none, or nothing reads it
        return
