"""The data set before it is written: episodes of frames, and for each frame the messages that it was made of."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from igtl_gateway.addon import ConfigError, GatewayError
from igtl_gateway.addon.reading import Recording
from igtl_gateway.addon.terminal import count_text, counted
from igtl_gateway.addon.untrusted import check_limit
from igtl_gateway.addons.lerobot.episodes import Span, longest, parts_of, spans_of
from igtl_gateway.addons.lerobot.recipe import Feature, Recipe
from igtl_gateway.addons.lerobot.resampling import Picks, common, coverage, frame_count, moments, pick
from igtl_gateway.addons.lerobot.samples import JoinedStreams, Samples, read_samples, stream_of
from igtl_gateway.addons.lerobot.splits import has_ranges, splits_of

Array = npt.NDArray[Any]
Times = npt.NDArray[np.int64]

#: Frames of a data set; a day at 100 Hz has fewer.
MAX_FRAMES = 10_000_000


@dataclass(frozen=True, slots=True, eq=False)
class Episode:
    """An episode.

    Attributes:
        index: number in the session.
        demonstration: number of the part of the recording that it is from.
        task: what is done.
        count: number of frames.
        times: (count,) int64, ns on the clock of the data set.
        picks: for each row of the recipe the samples of (count + ``extra``,) moments; None for the next value of
            another feature.  ``extra`` is 1 if a feature has such values.
    """

    index: int
    demonstration: int
    task: str
    count: int
    times: Times
    picks: tuple[Picks | None, ...]


@dataclass(frozen=True, slots=True)
class Place:
    """Where a session is in the data set.

    Attributes:
        episode, frame: number of its first one.
        tasks: of the data set; empty: those of the session.
        names: row of the recipe → names of its numbers in the order of the data set; a row without them has its own.
    """

    episode: int = 0
    frame: int = 0
    tasks: tuple[str, ...] = ()
    names: Mapping[int, tuple[str, ...]] = field(default_factory=dict)


@dataclass(slots=True)
class Plan:
    """All frames of a session.

    Attributes:
        recipe: the recipe.
        joined: the streams on one clock.
        samples: for each row of the recipe; None for the next value of another feature.
        episodes: the episodes.
        left_out: reason → frames that are in no episode.
        demonstrations: parts of the recording that ``[episodes]`` describes, with and without frames.
        splits: name → range of episodes, if the recipe has ranges of demonstrations.
        place: where the session is in the data set.
    """

    recipe: Recipe
    joined: JoinedStreams
    samples: list[Samples | None]
    episodes: list[Episode] = field(default_factory=list)
    left_out: dict[str, int] = field(default_factory=dict)
    demonstrations: int = 0
    splits: dict[str, str] = field(default_factory=dict)
    place: Place = field(default_factory=Place)

    @property
    def clock(self) -> str:
        """``source`` or ``gateway``."""
        return self.joined.clock

    @property
    def frame_count(self) -> int:
        """Number of frames."""
        return sum(each.count for each in self.episodes)

    @property
    def owners(self) -> list[int]:
        """The demonstration of each episode."""
        return [each.demonstration for each in self.episodes]

    @property
    def empty(self) -> list[int]:
        """The demonstrations without a frame."""
        return sorted(set(range(self.demonstrations)) - set(self.owners))

    @property
    def cuts(self) -> int:
        """Number of episodes beyond one for each demonstration: those with a gap, and those that are too long."""
        return len(self.episodes) - len(set(self.owners))

    @property
    def tasks(self) -> list[str]:
        """The tasks of the data set, in the order of their numbers."""
        return list(self.place.tasks or dict.fromkeys(each.task for each in self.episodes))

    def of(self, name: str) -> list[Samples]:
        """Return the samples of the rows of a feature; of the next value those of the other feature."""
        rows = self.recipe.rows(name)
        source = self.recipe.features[rows[0]].next_of
        found = [self.samples[index] for index in (self.recipe.rows(source) if source else rows)]
        return [each for each in found if each is not None]

    def names(self, name: str) -> list[str]:
        """Return the names of the numbers of a feature; unique: rows after the first have the name of the stream."""
        samples = self.of(name)
        names = [each for one in samples for each in one.names]
        if len(set(names)) < len(names):
            names = [f"{_short(one.row)}.{each}" for one in samples for each in one.names]
        return [each if names.count(each) == 1 else f"{each}_{number}" for number, each in enumerate(names)]

    def kind(self, name: str) -> str:
        """Return the kind of a feature: ``picture``, ``text`` or ``numbers``."""
        kind = self.of(name)[0].kind
        return "numbers" if kind == "pose" else kind

    def values(self, episode: Episode, name: str) -> Any:
        """Return a feature of an episode: (count, K) float32, (count,) strings or indices of pictures."""
        rows = self.recipe.rows(name)
        source = self.recipe.features[rows[0]].next_of
        shift = 1 if source else 0
        found = []
        for index in self.recipe.rows(source) if source else rows:
            samples, picks = self.samples[index], episode.picks[index]
            if samples is None or picks is None:
                continue
            chosen = slice(shift, shift + episode.count)
            found.append(samples.at(picks.before[chosen], picks.after[chosen], picks.share[chosen]))
        if self.kind(name) != "numbers":
            return found[0]
        return np.concatenate(found, axis=1).astype(np.float32)

    def provenance(self, episode: Episode, index: int) -> dict[str, Array]:
        """Return for each frame of an episode the messages of a row of the recipe: entry numbers and stamps."""
        samples, picks = self.samples[index], episode.picks[index]
        if samples is None or picks is None:
            return {}
        own = picks.part(0, episode.count)
        found = {
            "entry": samples.entries[own.before],
            "entry_after": samples.entries[own.after],
            "stamp_ns": samples.stamps[own.before],
            "stamp_after_ns": samples.stamps[own.after],
            "offset_ns": samples.times[own.before] - episode.times,
            "share": own.share,
            "held": own.held,
        }
        # a frame without a string by the rule ``none`` has no message
        return {name: np.where(own.empty, np.zeros(1, each.dtype), each) for name, each in found.items()}


def _short(row: Feature) -> str:
    return (row.frame or row.stream.rstrip("/").rpartition("/")[2] or row.stream).replace(" ", "_")


def join_streams(recording: Recording, recipe: Recipe) -> JoinedStreams:
    """Return the streams of a session on the clock of the data set.

    Raises ConfigError for a stream that the recording does not have, or has without messages or stamps.
    """
    rows = [(number, row) for number, row in enumerate(recipe.features) if not row.next_of]
    streams = [stream_of(recording, row.stream, f"feature[{number}].stream") for number, row in rows]
    events = {recipe.episodes.stream, *(row.against for _, row in rows)} - {""}
    others = [recording[name] for name in sorted(events) if name in recording]
    return JoinedStreams(streams, recipe.clock, others)


def build(recording: Recording, recipe: Recipe, place: Place | None = None) -> Plan:
    """Return the frames of a session.

    Args:
        recording: the session.
        recipe: of the data set.
        place: where the session is in the data set; None: it is alone.

    Raises:
        ConfigError: the recipe and the recording do not fit, with place, found and expected.
        GatewayError: there is no frame.
    """
    joined = join_streams(recording, recipe)
    samples: list[Samples | None] = [None] * len(recipe.features)
    place = place or Place()
    for number, row in enumerate(recipe.features):
        if not row.next_of:
            samples[number] = read_samples(recording, row, joined, f"feature[{number}]", place.names.get(number, ()))
    plan = Plan(recipe, joined, samples, place=place)
    _check_kinds(plan)
    found = [each for each in samples if each is not None]
    covered = coverage(found[0])
    for each in found[1:]:
        covered = common(covered, coverage(each))
    # a sample that is valid forever ends with the last sample of any stream
    last = max(int(each.times[-1]) for each in found)
    covered = [(start, min(end, last)) for start, end in covered if start <= last]
    for span in spans_of(recording, recipe, joined):
        _add(plan, span, covered)
        plan.demonstrations += 1
    if not plan.episodes:
        reasons = "; ".join(f"{count_text(number, 'frame')}: {why}" for why, number in plan.left_out.items())
        raise GatewayError(
            f"found no frame that has all streams{f' ({reasons})' if reasons else ''}, expected one or more; "
            "see tolerance_ms, clock and [episodes] of the recipe"
        )
    check_limit("count", len(plan.episodes), "episodes of the data set")
    if recipe.splits and has_ranges(recipe.splits):
        ranges = {name: str(value) for name, value in recipe.splits.items()}
        plan.splits = splits_of(ranges, plan.demonstrations, plan.owners)
    return plan


def _check_kinds(plan: Plan) -> None:
    for name in plan.recipe.names:
        kinds = {each.kind for each in plan.of(name)}
        if len(plan.of(name)) > 1 and kinds & {"text", "picture"}:
            raise ConfigError(f"feature {name}: found several rows with a string or a picture, expected one row")
        if name in ("action", "observation.state") and "text" in kinds:
            raise ConfigError(f"feature {name}: found a string, expected numbers")
        if "text" in {plan.kind(row.next_of) for row in plan.recipe.features if row.next_of and row.name == name}:
            raise ConfigError(f"feature {name}.next_of: found a string, expected numbers")


def _add(plan: Plan, span: Span, covered: list[tuple[int, int]]) -> None:
    """Add the episodes of a span: one for each time without a gap."""
    recipe, extra = plan.recipe, int(plan.recipe.has_next)
    for start_ns, end_ns in common([(span.start_ns, span.end_ns)], covered):
        count = frame_count(start_ns, end_ns, recipe.fps) - extra
        if count + plan.frame_count > MAX_FRAMES:
            raise GatewayError(
                f"found more than {MAX_FRAMES:,} frames, expected fewer; see tolerance_ms and [episodes]"
            )
        if count < recipe.min_frames:
            _count(plan, f"fewer than {counted(recipe.min_frames, 'frame')} without a gap", max(count, 0))
            continue
        most = longest(recipe.fps)
        if count > most and not recipe.split_long:
            raise ConfigError(
                f"episode {len(plan.episodes)}: found {count_text(count, 'frame')} ({count / recipe.fps:,.0f} s), "
                "expected at most "
                f"{most:,} ({most / recipe.fps:,.0f} s): float32 time stamps of more are wrong by more than 0.1 ms; "
                "see [episodes], or set split_long = true"
            )
        grid = moments(start_ns, count + extra, recipe.fps)
        picks = [None if each is None else pick(each, grid, recipe.fps) for each in plan.samples]
        first = 0
        for length in parts_of(count, most):
            times = grid[first : first + length + extra]
            part = tuple(None if each is None else each.part(first, first + length + extra) for each in picks)
            plan.episodes.append(
                Episode(len(plan.episodes), plan.demonstrations, span.task, length, times[:length], part)
            )
            first += length


def _count(plan: Plan, why: str, number: int) -> None:
    if number:
        plan.left_out[why] = plan.left_out.get(why, 0) + number
