"""What the recorder's worker spends its time with: whether it waits for the disk, for a processor, or works.

The system counts how long a thread runs, and how long it could run but has no processor.  The rest of the time it
waits, and while entries wait for it, that is for the disk.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from igtl_gateway.base.quantities import duration_text, size_text
from igtl_gateway.base.stamp import NS_PER_S

#: Returns the time (ns) that a worker ran, and the time that it was ready and had no processor; None: unknown.
Times = Callable[[], tuple[int, int] | None]

DISK, PROCESSORS, WORK = range(3)
_CAUSES = (
    "the disk is too slow",
    "other programs have the processors",
    "more arrives than the recorder can write",
)


@dataclass(frozen=True, slots=True)
class Shares:
    """Of a worker's time: for the disk, for a processor, and at work; each 0 to 1."""

    shares: tuple[float, float, float]

    @property
    def cause(self) -> int:
        """What it does most: DISK, PROCESSORS or WORK."""
        return self.shares.index(max(self.shares))

    def __str__(self) -> str:
        disk, processors, work = (f"{100 * share:.0f} %" for share in self.shares)
        waits = f"waited for a processor for {processors}, for the disk for {disk}"
        return f"the recorder worked for {work} of the time, {waits}"


class Pace:
    """The time of a worker since ``begin``.

    Args:
        times: of its thread.
    """

    def __init__(self, times: Times) -> None:
        self._times = times
        self._begun_ns = self._bytes = 0
        self._before: tuple[int, int] | None = None

    def begin(self, now_ns: int, taken: int) -> None:
        """From now (monotonic) on; the worker has taken this number of bytes."""
        self._begun_ns, self._bytes, self._before = now_ns, taken, self._times()

    def shares(self, now_ns: int) -> Shares | None:
        """Return the shares until now; None: the system does not count them."""
        passed_ns, after = now_ns - self._begun_ns, self._times()
        if not (self._before and after) or passed_ns <= 0:
            return None
        work, ready = (min(1.0, (b - a) / passed_ns) for a, b in zip(self._before, after, strict=True))
        return Shares((max(0.0, 1 - work - ready), ready, work))

    def describe(self, now_ns: int, taken: int) -> tuple[str, str]:
        """Return why the worker is too slow, and the figures: a few words each."""
        shares, passed_s = self.shares(now_ns), (now_ns - self._begun_ns) / NS_PER_S
        if shares is None:
            return "the recorder is too slow", ""
        rate = (taken - self._bytes) / passed_s
        return _CAUSES[shares.cause], f"in {duration_text(passed_s * NS_PER_S)} it took {size_text(rate)}/s; {shares}"
