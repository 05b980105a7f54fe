"""Why runs differ: the programs run again for each thing that may differ between runs and is now the same.

First they run as they did, until two more runs differ from the first one: how often they do decides how many equal runs
are no chance.  If that many are equal with one thing the same, that thing is the likely cause.  A difference that is
too rare for this has no likely cause, and after `MOST_S` no run begins: the cause is not worth more.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from math import ceil
from pathlib import Path

from igtl_gateway.addon import NS_PER_S, GatewayError, SystemClock
from igtl_gateway.addons.resim.engine import Clocks, Program, ResimOptions, Run, RunResult, run
from igtl_gateway.addons.resim.verdict import Verdict, compare

#: Real seconds after which no run begins.
MOST_S = 60
#: Runs that have to differ once more, and at most this number of runs to see that.
_DIFFERING, _CONTROLS = 2, 24
#: This number of equal runs, over the part of runs that differ, is a chance of 1 %.
_EQUAL = 4.6
#: Session time behind the first difference: the message has to be there.
_BEHIND_NS = 1_000_000


@dataclass(frozen=True, slots=True)
class _Cause:
    """Something that may differ between runs.

    Attributes:
        text: what it is, for a person.
        env: variables that make it the same.
        command: words before the command that do so.
        clocks: the clocks that do so.
    """

    text: str
    env: dict[str, str] = field(default_factory=dict)
    command: tuple[str, ...] = ()
    clocks: Clocks | None = None


_CAUSES = (
    _Cause("the wall clock, such as time.time()", clocks=Clocks.SESSION),
    _Cause("the order of a set or of hashes of strings", env={"PYTHONHASHSEED": "0"}),
    _Cause("random numbers without a seed", env={"IGTL_GATEWAY_RESIM_RANDOM": "1"}),
    _Cause("the order of addresses in memory", command=("setarch", "-R")),
)
_TIES = "which of two events of one time is first"
_SEVERAL = "several: the wall clock, hashes, random numbers or addresses"
_RARE = "not found, as it is too rare"
_OTHER = "threads that race, or something outside of the session"


def likely_cause(
    recording: Path, programs: Sequence[Program], options: ResimOptions, verdict: Verdict, folder: Path
) -> str:
    """Return what probably makes the runs differ, for a person; ``""`` if they do not.

    Args:
        recording, programs, options: of the runs.
        verdict: on them.
        folder: where outputs go meanwhile.
    """
    first = verdict.first
    if not verdict.unequal_run or first is None:
        return ""
    shorter = replace(options, until_ns=first.time_ns + _BEHIND_NS)
    tries = _Tries(recording, folder)
    try:
        runs, differing = tries.differing(programs, shorter)
        if differing < _DIFFERING:
            return f"{_RARE}: {differing} of {runs} more runs differ"
        tries.enough = ceil(_EQUAL * runs / differing)
        if options.swap_ties:
            shorter = replace(shorter, swap_ties=False)
            if tries.is_equal(programs, shorter):
                return _TIES
        every = programs
        for cause in _CAUSES:
            every = _with(every, cause)
            if tries.is_equal(_with(programs, cause), replace(shorter, clocks=cause.clocks or options.clocks)):
                return cause.text
        return _SEVERAL if tries.is_equal(every, replace(shorter, clocks=Clocks.SESSION)) else _OTHER
    except _Late:
        return f"not found within {MOST_S} s"


class _Late(GatewayError):
    """The time of all tries is over."""


def _with(programs: Sequence[Program], cause: _Cause) -> list[Program]:
    return [
        replace(each, command=(*cause.command, *each.command), name=each.title, env={**each.env, **cause.env})
        for each in programs
    ]


class _Seen(Exception):
    """Enough runs differ."""


class _Tries:
    """Runs the programs again, and compares each run with the first one; raises _Late after a run that ends too late.

    Attributes:
        enough: equal runs that are not by chance.
    """

    def __init__(self, recording: Path, folder: Path) -> None:
        self._recording, self._folder, self._clock = recording, folder, SystemClock()
        self._end_ns = self._clock.monotonic_ns() + MOST_S * NS_PER_S
        self.enough = 0

    def is_equal(self, programs: Sequence[Program], options: ResimOptions) -> bool:
        """Return whether enough runs are equal to the first one."""
        return not self._run(programs, options, self.enough, most_differing=1)[1]

    def differing(self, programs: Sequence[Program], options: ResimOptions) -> tuple[int, int]:
        """Return how many runs were compared with the first one, and how many of them differ."""
        return self._run(programs, options, _CONTROLS, most_differing=_DIFFERING)

    def _run(
        self, programs: Sequence[Program], options: ResimOptions, count: int, *, most_differing: int
    ) -> tuple[int, int]:
        done: list[Run] = []
        differing = 0

        def look(one: Run) -> None:
            nonlocal differing
            done.append(one)
            pair = RunResult(self._recording, runs=[done[0], one])
            differing += len(done) > 1 and not compare(pair, outputs=options.outputs).is_deterministic
            if differing == most_differing:
                raise _Seen
            if self._clock.monotonic_ns() > self._end_ns:
                raise _Late

        try:
            run(self._recording, programs, replace(options, runs=count + 1), self._folder, on_run=look)
        except _Seen:
            pass
        return len(done) - 1, differing
