"""Whether a timer races an input: up to two more runs after runs that are equal.

In the first one, the programs start a little earlier.  A message that a timer publishes has another time then, and one
that an input causes has the same time.  The second one is necessary only if the first one shows that an order may
matter: timers come before inputs of the same time.  A race is a message with other values there, if an input causes it,
or if a timer does that is at the time of an input now and then only.  A timer that mostly is, such as one of 10 Hz
beside inputs of 100 Hz, samples its input regularly, as it does where it never is.

Without a tie, an output that depends on when the programs start is only stated: a node whose callbacks read what its
timer has counted, or a controller of 50 Hz that samples a pose, has no fault, and nothing in its outputs distinguishes
it from one that has.  ``Verdict.wants_any_start`` is for those who know that theirs must not.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from igtl_gateway.addon.reading import Kind, SessionFile
from igtl_gateway.addon.writing import make_folder
from igtl_gateway.addons.resim.engine import Program, ResimOptions, RunResult, run
from igtl_gateway.addons.resim.inputs import CLOCK
from igtl_gateway.addons.resim.verdict import Difference, Race, first_at_one_time, is_judged

#: Far from the multiples of usual periods: 47 % of one of 7 ms, 26 % of 100 Hz, 13 % of 50 Hz, 35 % of 20 Hz.
_EARLIER_NS = 17_377_701
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
    if found := _of_ties(result, programs, once, folder, moments, dependent, sampled):
        return Race(found, _input_at(result, found.time_ns))
    by_stream = {
        name: first_at_one_time(
            one, other, [name], lambda each, time_ns: not moments[each].is_of_input(time_ns), _EARLIER_NS
        )
        for name in names
    }
    samples = [found for found in by_stream.values() if found]
    streams = frozenset(dependent) | {name for name, found in by_stream.items() if found or moments[name].are_of_timers}
    if found := first_at_one_time(one, other, dependent):
        return Race(found, _input_at(result, found.time_ns), _EARLIER_NS, streams=streams)
    found = min(samples, key=lambda each: each.time_ns, default=None)
    return Race(found, "", _EARLIER_NS, is_sample=True, streams=streams) if found else None


def _of_ties(
    result: RunResult,
    programs: Sequence[Program],
    options: ResimOptions,
    folder: Path,
    moments: Mapping[str, _Moments],
    dependent: Sequence[str],
    sampled: Sequence[str],
) -> Difference | None:
    """The first output that is another one if timers come before inputs of the same time.

    Args:
        result, programs, options: as of `find_race`; for one run.
        folder: where its outputs go.
        moments: stream → its times.
        dependent: streams whose messages of inputs depend on the start.
        sampled: those whose messages of timers are at the time of an input now and then.
    """
    if not dependent and not sampled:
        return None
    make_folder(first := folder / "timers-first")
    swapped = run(result.recording, programs, replace(options, timers_first=True), first)

    def counts(name: str, time_ns: int) -> bool:
        return (name in dependent and moments[name].is_of_input(time_ns)) or (
            name in sampled and moments[name].is_tie(time_ns)
        )

    names = sorted({*dependent, *sampled})
    one, other = result.runs[0].outputs, swapped.runs[0].outputs
    return None if swapped.fault else first_at_one_time(one, other, names, counts)


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

    @property
    def are_of_timers(self) -> bool:
        """Whether some messages have other times if the programs start earlier."""
        return self._timers > 0

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
