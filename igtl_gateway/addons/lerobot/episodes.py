"""Where episodes begin and end, and what is done in them."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cache
from itertools import pairwise
from typing import Any

import numpy as np
import numpy.typing as npt

from igtl_gateway.addon import NS_PER_S, ConfigError, matches
from igtl_gateway.addon.reading import Recording
from igtl_gateway.addons.lerobot.recipe import Cuts, Recipe
from igtl_gateway.addons.lerobot.samples import JoinedStreams, stream_of
from igtl_gateway.addons.lerobot.values import columns_of

Times = npt.NDArray[np.int64]

_ALWAYS = (-(1 << 62), 1 << 62)


@dataclass(frozen=True, slots=True)
class Span:
    """A part of the recording: times in ns on the clock of the data set, both included; and the task."""

    start_ns: int
    end_ns: int
    task: str


@dataclass(frozen=True, slots=True)
class Event:
    """A string at a time, ns on the clock of the data set."""

    time_ns: int
    text: str


def spans_of(recording: Recording, recipe: Recipe, joined: JoinedStreams) -> list[Span]:
    """Return the parts that may become episodes, in the order of time; ranges in that of the recipe.

    Args:
        recording: the recording.
        recipe: the recipe.
        joined: its streams on the clock of the data set.

    Raises:
        ConfigError: the recording has not what the recipe names.
    """
    cuts, offset_ns = recipe.episodes, joined.offset_ns
    match cuts.by:
        case "whole":
            return [Span(*_ALWAYS, recipe.task)]
        case "ranges":
            begin = recording.start_time - offset_ns
            return [
                Span(begin + round(each.start * NS_PER_S), begin + round(each.end * NS_PER_S) - 1,
                     each.task or recipe.task)
                for each in cuts.range
            ]  # fmt: skip
        case "markers":
            return _between(_markers(recording, cuts, joined), recipe, f"strings of {cuts.stream}")
        case "notes":
            notes = [Event(each.time - offset_ns, each.text) for each in recording.notes]
            return _between(notes, recipe, "notes")
        case "marks":
            return _phases(recording, recipe, offset_ns)
    stream = stream_of(recording, cuts.stream, "episodes.stream")
    times = np.sort(joined.times(stream))
    if cuts.by == "gap":
        ends = np.flatnonzero(np.diff(times) > round(cuts.pause_s * NS_PER_S))
        firsts, lasts = np.concatenate([[0], ends + 1]), np.concatenate([ends, [len(times) - 1]])
        return [Span(int(times[one]), int(times[two]), recipe.task) for one, two in zip(firsts, lasts, strict=True)]
    try:
        poses = stream.poses().in_unit("m")
    except ConfigError as error:
        raise ConfigError(f"episodes.stream: {error}") from None
    own = joined.times(stream)[poses.rows]
    return [Span(*each, recipe.task) for each in moving(own, poses.positions, cuts.pause_s, cuts.still_mm / 1e3)]


def moving(times: Times, positions: npt.NDArray[Any], pause_s: float, still_m: float) -> list[tuple[int, int]]:
    """Return the times between which positions (N, 3), m, move.

    A pause is a time of ``pause_s`` or more in which the positions stay within ``still_m`` of its first one.
    """
    order = np.argsort(times, kind="stable")
    times, positions = times[order], positions[order]
    pause_ns, found, begin, at = round(pause_s * NS_PER_S), list[tuple[int, int]](), 0, 0
    while at < len(times):
        away = np.linalg.norm(positions[at:] - positions[at], axis=1) > still_m
        end = at + (int(np.argmax(away)) if away.any() else len(away)) - 1
        if times[end] - times[at] >= pause_ns:
            if at > begin:
                found.append((int(times[begin]), int(times[at])))
            begin = at = end
        else:
            at += 1
    if begin < len(times) - 1:
        found.append((int(times[begin]), int(times[-1])))
    return found


def _markers(recording: Recording, cuts: Cuts, joined: JoinedStreams) -> list[Event]:
    stream = stream_of(recording, cuts.stream, "episodes.stream")
    table, rows = stream.arrow_and_rows()
    texts = [name for name in ("string", "data") if name in columns_of(stream)]
    if not texts:
        raise ConfigError(f"episodes.stream: found {stream.type} in {stream.key}, expected STRING or std_msgs/String")
    times = joined.times(stream)[rows]
    found = [Event(int(at), text) for at, text in zip(times, table[texts[0]].to_pylist(), strict=True) if text]
    return sorted(found, key=lambda each: each.time_ns)


def _phases(recording: Recording, recipe: Recipe, offset_ns: int) -> list[Span]:
    """Return the phases with a label that matches, without their ends: those of one moment would be empty."""
    found = [
        Span(mark.time_ns - offset_ns, mark.end_ns - 1 - offset_ns, mark.text or recipe.task)
        for mark in recording.marks
        if mark.end_ns is not None and mark.end_ns > mark.time_ns and matches(recipe.episodes.label, mark.label)
    ]
    if not found:
        raise ConfigError(f"episodes.label: found no phase with a label like {recipe.episodes.label!r}, expected one")
    for one, two in pairwise(found):
        if two.start_ns <= one.end_ns:
            at_s = (two.start_ns + offset_ns - recording.start_time) / NS_PER_S
            raise ConfigError(
                f"episodes.label: found a phase at {at_s:.3f} s before the end of the one before, expected one by one"
            )
    return found


def _between(events: Iterable[Event], recipe: Recipe, what: str) -> list[Span]:
    """An episode goes from a start to the next stop or start; the last one may have no stop."""
    cuts, found = recipe.episodes, list[Span]()
    begin: Event | None = None
    for event in events:
        starts = event.text.startswith(cuts.start)
        if begin is not None and (starts or event.text.startswith(cuts.stop)):
            found.append(_span(begin, event.time_ns - 1, recipe))
            begin = None
        if starts:
            begin = event
    if begin is not None:
        found.append(_span(begin, _ALWAYS[1], recipe))
    if not found:
        raise ConfigError(f"episodes.start: found {what} without one that begins with {cuts.start!r}, expected one")
    return found


def _span(begin: Event, end_ns: int, recipe: Recipe) -> Span:
    rest = begin.text[len(recipe.episodes.start) :].strip(" :=-\t\n\0")
    task = "".join(char if char.isprintable() else " " for char in rest)[:2000]
    return Span(begin.time_ns, end_ns, task or recipe.task)


@cache
def longest(fps: int) -> int:
    """Return the largest number of frames whose float32 time stamps keep to 1 / fps within ``TOLERANCE_S``.

    It is what the readers check: the steps between float32 stamps, and their distance to the frames of the video.
    """
    # the error of a float32 stamp is at most half a unit in the last place: 3.8e-6 s at 64 s, so nothing fails before
    count = 64 * fps
    while count < 1 << 23:
        exact = np.arange(count) / fps
        stamps = exact.astype(np.float32)
        steps = np.abs(np.diff(stamps) - np.float32(1 / fps)) > TOLERANCE_S
        away = np.abs(stamps.astype(np.float64) - exact) > TOLERANCE_S
        if steps.any() or away.any():
            return int(min(np.argmax(steps) + 1 if steps.any() else count, np.argmax(away) if away.any() else count))
        count *= 2
    return count


#: Deviation that the readers of the format accept by default, s.
TOLERANCE_S = 1e-4


def parts_of(count: int, most: int) -> Sequence[int]:
    """Return the lengths of the fewest parts of ``count`` frames with at most ``most`` each, as equal as possible."""
    parts = -(-count // most)
    return [count // parts + (number < count % parts) for number in range(parts)]
