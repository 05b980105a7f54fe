"""Why runs differ: the programs run again, three times for each thing that may differ between runs and is now the same.

The runs end at the first difference.  If they are equal now, and once more in as many runs as a rare difference needs,
that thing is the likely cause.  After `MOST_S` no run begins: the cause is not worth more.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from igtl_gateway.addon import NS_PER_S, GatewayError, SystemClock
from igtl_gateway.addons.resim.engine import Clocks, Program, ResimOptions, Run, run
from igtl_gateway.addons.resim.verdict import Verdict, compare

#: Real seconds after which no run begins.
MOST_S = 60
#: Of each try: two may be equal by chance.
_RUNS = 3
#: At most this number of runs has to be equal once more.
_MOST_AGAIN = 12
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
    shorter = replace(options, runs=_RUNS, until_ns=first.time_ns + _BEHIND_NS)
    tries = _Tries(recording, folder, again=min(_MOST_AGAIN, _RUNS * (verdict.unequal_run - 1)))
    try:
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


class _Tries:
    """Runs the programs again; raises _Late after a run that ends too late.

    ``again``: runs that have to be equal after the first ones, which may be so by chance.
    """

    def __init__(self, recording: Path, folder: Path, *, again: int) -> None:
        self._recording, self._folder, self._clock = recording, folder, SystemClock()
        self._again = again
        self._end_ns = self._clock.monotonic_ns() + MOST_S * NS_PER_S

    def is_equal(self, programs: Sequence[Program], options: ResimOptions) -> bool:
        return all(
            compare(run(self._recording, programs, each, self._folder, on_run=self._look)).is_deterministic
            for each in (options, replace(options, runs=self._again))
        )

    def _look(self, _one: Run) -> None:
        if self._clock.monotonic_ns() > self._end_ns:
            raise _Late
