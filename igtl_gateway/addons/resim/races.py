"""Whether outputs depend on the phase of timers: one more run, in which the programs start a little earlier.

Their timers are earlier by as much.  A message that a timer publishes then has another time, and is not looked at.  One
that an input causes has the same time, and must have the same values: if not, a timer races that input.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from igtl_gateway.addon import SessionFile
from igtl_gateway.addons.resim.engine import Program, ResimOptions, RunResult, run
from igtl_gateway.addons.resim.verdict import Race, first_at_one_time, is_judged

#: No multiple of a usual period, and more than half of that of 40 Hz.
_EARLIER_NS = 13_713_701


def find_race(result: RunResult, programs: Sequence[Program], options: ResimOptions, folder: Path) -> Race | None:
    """Return the first output that depends on when timers are; None for none, or if that cannot be judged.

    Args:
        result: of runs that are equal.
        programs, options: of these runs.
        folder: where the outputs of the other run go.
    """
    if len(result.runs) < 2 or any(program.igtl for program in programs):
        return None
    earlier = replace(options, runs=1, swap_ties=False, lead_ns=options.lead_ns + _EARLIER_NS)
    other = run(result.recording, programs, earlier, folder)
    if other.fault:
        return None
    names = [name for name in result.runs[0].streams if is_judged(name, options.outputs)]
    found = first_at_one_time(result.runs[0].outputs, other.runs[0].outputs, names)
    return Race(found, _input_at(result, found.time_ns), _EARLIER_NS) if found else None


def _input_at(result: RunResult, time_ns: int) -> str:
    """The input of a time; ``""`` for none."""
    inputs = result.roles.inputs if result.roles else {}
    with SessionFile.open(result.recording) as file:
        return next(
            (each.channel for each in file.entries() if each.stamp_ns == time_ns and each.channel in inputs), ""
        )
