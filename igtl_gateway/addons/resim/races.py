"""Whether a timer races an input: up to two more runs after runs that are equal.

In the first one, the programs start a little earlier.  A message that a timer publishes has another time then, and one
that an input causes has the same time.  The second one is necessary only if the first one shows that an order may
matter: timers come before inputs of the same time.  A race is a message with other values there, if an input causes it,
or if a timer does that is at the time of an input now and then only.  A timer that mostly is, such as one of 10 Hz
beside inputs of 100 Hz, samples its input regularly, as it does where it never is.

Without a tie, an output of an input that depends on when the programs start is only a remark: it may contain a time.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from igtl_gateway.addon import Kind, SessionFile, make_folder
from igtl_gateway.addons.resim.engine import Program, ResimOptions, RunResult, run
from igtl_gateway.addons.resim.inputs import CLOCK
from igtl_gateway.addons.resim.verdict import Race, first_at_one_time, is_judged

#: No multiple of a usual period, and more than half of that of 40 Hz.
_EARLIER_NS = 13_713_701
_ROS = frozenset({Kind.ROS_IN, Kind.ROS_OUT})
_Times = Any  # array of int64, ns


def find_race(result: RunResult, programs: Sequence[Program], options: ResimOptions, folder: Path) -> Race | None:
    """Return the first output that depends on a timer; None for none, or if that cannot be judged.

    Args:
        result: of runs that are equal.
        programs, options: of these runs.
        folder: where the outputs of the other runs go.
    """
    if len(result.runs) < 2 or any(program.igtl for program in programs):
        return None
    once = replace(options, runs=1, swap_ties=False)
    earlier = run(result.recording, programs, replace(once, lead_ns=options.lead_ns + _EARLIER_NS), folder)
    if earlier.fault:
        return None
    one, other = result.runs[0].outputs, earlier.runs[0].outputs
    names = [name for name in result.runs[0].streams if is_judged(name, options.outputs)]
    inputs = _input_times(result)
    moments = {name: _Moments(one, other, name, inputs) for name in names}
    dependent = [name for name in names if first_at_one_time(one, other, [name])]
    sampled = [name for name in names if moments[name].are_seldom_ties]
    if not dependent and not sampled:
        return None
    first = folder / "timers-first"
    make_folder(first)
    swapped = run(result.recording, programs, replace(once, timers_first=True), first)

    def counts(name: str, time_ns: int) -> bool:
        return (name in dependent and moments[name].is_of_input(time_ns)) or (
            name in sampled and moments[name].is_tie(time_ns)
        )

    if not swapped.fault:
        found = first_at_one_time(one, swapped.runs[0].outputs, sorted({*dependent, *sampled}), counts)
        if found:
            return Race(found, _input_at(result, found.time_ns))
    found = first_at_one_time(one, other, dependent)
    return Race(found, _input_at(result, found.time_ns), _EARLIER_NS) if found else None


class _Moments:
    """The times of a stream's messages: of those that an input causes, and those of a timer at the time of an input.

    Args:
        one: outputs of a run.
        other: of a run that started earlier.
        name: the stream.
        inputs: times of inputs, in order.
    """

    def __init__(self, one: Path, other: Path, name: str, inputs: _Times) -> None:
        times, counts = np.unique(_times(one, [name]), return_counts=True)
        others, other_counts = np.unique(_times(other, [name]), return_counts=True)
        _, at, other_at = np.intersect1d(times, others, assume_unique=True, return_indices=True)
        self._of_inputs = times[at]
        counts[at] -= other_counts[other_at]
        of_timers = times[counts > 0]
        if len(inputs):
            of_timers = of_timers[(of_timers >= inputs[0]) & (of_timers <= inputs[-1])]
        self._ties = np.intersect1d(of_timers, inputs)
        self._timers = len(of_timers)

    @property
    def are_seldom_ties(self) -> bool:
        """Whether some messages of timers, but fewer than half, are at the time of an input."""
        return 0 < 2 * len(self._ties) < self._timers

    def is_of_input(self, time_ns: int) -> bool:
        return _has(self._of_inputs, time_ns)

    def is_tie(self, time_ns: int) -> bool:
        return _has(self._ties, time_ns)


def _has(times: _Times, time_ns: int) -> bool:
    at = int(np.searchsorted(times, time_ns))
    return at < len(times) and int(times[at]) == time_ns


def _times(path: Path, names: Sequence[str], *, are_inputs: bool = False) -> _Times:
    """Session times of the messages of some ROS topics, in order; of inputs, when they arrived."""
    found = [np.empty(0, np.int64)]
    with SessionFile.open(path) as file:
        for channel in file.channels:
            if channel.kind in _ROS and channel.topic in names:
                for block in file.blocks(channel):
                    is_arrival = are_inputs | (block.source_times == 0)
                    found.append(np.where(is_arrival, block.times, block.source_times))
    return np.sort(np.concatenate(found))


def _input_times(result: RunResult) -> _Times:
    """Times at which the recording has inputs; without /clock, whose ticks are those of timers."""
    names = [name for name in (result.roles.inputs if result.roles else {}) if name != CLOCK]
    return _times(result.recording, names, are_inputs=True)


def _input_at(result: RunResult, time_ns: int) -> str:
    """The input of a time; ``""`` for none."""
    inputs = result.roles.inputs if result.roles else {}
    with SessionFile.open(result.recording) as file:
        return next(
            (each.channel for each in file.entries() if each.stamp_ns == time_ns and each.channel in inputs), ""
        )
