"""A starting recipe, made of the streams of a recording; it works as it is."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from igtl_gateway.addon import NS_PER_MS, NS_PER_S, ConfigError, GatewayError
from igtl_gateway.addon.reading import Recording, Stream
from igtl_gateway.addons.lerobot.pictures import Pictures, first_pixels, has_pictures
from igtl_gateway.addons.lerobot.recipe import ACTION, IMAGES, STATE, Feature, Recipe
from igtl_gateway.addons.lerobot.recipe_file import toml_value
from igtl_gateway.addons.lerobot.resampling import common, coverage, frame_count
from igtl_gateway.addons.lerobot.samples import JoinedStreams, Samples, read_samples

#: Words in the names of streams that carry commands (CRTK, and usual names).
_COMMANDS = re.compile(r"(^|[/_])(servo|move|setpoint|goal|cmd|command|target)(_|/|$)", re.IGNORECASE)
_NUMBERS = {"sensor_msgs/msg/JointState": ("position",), "SENSOR": ("values",)}
#: Part of the time of the other streams that a stream must have, to be part of the recipe.
_LEAST_SHARE = 0.5
_MOST_FPS, _USUAL_MS = 30, 100.0


@dataclass(frozen=True, slots=True)
class _Candidate:
    """A row of the recipe, with its samples."""

    feature: Feature
    samples: Samples


def draft(recording: Recording) -> str:
    """Return a recipe as TOML: poses and joints are the state, pictures are views, strings and other numbers follow.

    A stream with a command in its name is the action; otherwise the action is the next state.

    Raises:
        GatewayError: no stream can be the state.
    """
    streams = [each for each in recording.streams.values() if each.direction.endswith("_in")]
    streams = streams or list(recording.streams.values())
    good = [each for each in streams if len(each)]
    joined = JoinedStreams(good, "auto")
    chosen, left_out = list[_Candidate](), list[str]()
    covered: list[tuple[int, int]] = []
    taken: set[str] = set()
    # the state first: without it there is no data set
    candidates = list(_candidates(recording, good, joined, left_out))
    for candidate in sorted(candidates, key=lambda each: (_order(each), -_length(coverage(each.samples)))):
        has = coverage(candidate.samples)
        both = common(covered, has) if chosen else has
        if not _frames(both, _fps([*chosen, candidate])):
            left_out.append(f"{candidate.feature.stream}: has no time in common with the others")
        elif chosen and _length(both) < _LEAST_SHARE * _length(covered):
            left_out.append(f"{candidate.feature.stream}: has messages in less than half of the time of the others")
        elif candidate.feature.name in taken and candidate.feature.name not in (STATE, ACTION):
            left_out.append(f"{candidate.feature.stream}: {candidate.feature.name} is another stream")
        else:
            covered = both
            taken.add(candidate.feature.name)
            chosen.append(candidate)
    if not any(each.feature.name == STATE for each in chosen):
        raise GatewayError(
            f"{recording.path}: found no stream of poses or joints with two or more messages, expected one as "
            "observation.state"
        )
    return "\n".join(_lines(recording, chosen, left_out)) + "\n"


def _order(candidate: _Candidate) -> int:
    name = candidate.feature.name
    return 0 if name == STATE else 1 if name == ACTION else 2 if candidate.feature.is_picture else 3


def _length(intervals: list[tuple[int, int]]) -> int:
    return sum(min(end, 1 << 62) - start + 1 for start, end in intervals)


def _frames(intervals: list[tuple[int, int]], fps: int) -> bool:
    """Whether an interval has enough moments for an episode, and one more."""
    return any(frame_count(start, min(end, 1 << 62), fps) > Recipe(fps, "").min_frames for start, end in intervals)


def _candidates(
    recording: Recording, streams: list[Stream], joined: JoinedStreams, left_out: list[str]
) -> Iterator[_Candidate]:
    for stream in streams:
        try:
            stream.key.encode()
            feature = _feature(stream)
            if feature is None:
                continue
            usual = _with_tolerance(feature, read_samples(recording, feature, joined, stream.key), stream)
            yield _Candidate(usual, read_samples(recording, usual, joined, stream.key))
        except (GatewayError, UnicodeEncodeError) as error:
            text = str(error)
            left_out.append(text if stream.key in text else f"{stream.key}: {text}")


def _feature(stream: Stream) -> Feature | None:
    """A row for a stream, or None if nothing in it fits."""
    name = re.sub(r"[^A-Za-z0-9_]+", "_", stream.name.rpartition("/")[2]).strip("_").lower() or "unnamed"
    if has_pictures(stream):
        view = re.sub(r"[^A-Za-z0-9_]+", "_", stream.name.replace("IMAGE/", "").strip("/")).lower() or "view"
        return Feature(f"{IMAGES}{view}", stream.key, window=_window(stream))
    if stream.type in ("STRING", "std_msgs/msg/String"):
        return Feature(f"observation.meta.{name}", stream.key, tolerance_ms=None)
    main = ACTION if _COMMANDS.search(stream.name) else STATE
    if len(stream) < 2:
        return None
    fields = _NUMBERS.get(stream.type)
    if fields:
        return Feature(main if fields == ("position",) else f"observation.{name}", stream.key, fields=fields)
    if stream.type.startswith("geometry_msgs/msg/Wrench") or stream.type.startswith("geometry_msgs/msg/Twist"):
        names = [each for each in _floats(stream)]
        return Feature(f"observation.{name}", stream.key, fields=tuple(names)) if names else None
    try:
        stream.poses()
    except ConfigError:
        return None
    return Feature(main, stream.key)


def _floats(stream: Stream) -> Iterator[str]:
    import pyarrow as pa

    return (each.name for each in stream.to_arrow().schema if pa.types.is_floating(each.type))


def _window(stream: Stream) -> tuple[float, ...]:
    """Darkest and brightest value of the first picture, for more than 8 bits."""
    try:
        Pictures(stream)
    except ConfigError as error:
        if "window" not in str(error):
            raise
    else:
        return ()
    pixels = first_pixels(stream)
    finite = pixels[np.isfinite(pixels)]
    low, high = (float(finite.min()), float(finite.max())) if finite.size else (0.0, 0.0)
    return (low, high) if low < high else (low, low + 1)


def _with_tolerance(feature: Feature, samples: Samples, stream: Stream) -> Feature:
    """The row with a tolerance of five intervals, in steps of 10 ms; any for a single message."""
    if feature.tolerance_ms is None:
        return feature
    if len(stream) < 2 or len(samples.times) < 2:
        return replace(feature, rule="hold", tolerance_ms=None)
    period_ms = float(np.median(np.diff(samples.times))) / NS_PER_MS
    return replace(feature, tolerance_ms=min(max(_USUAL_MS, 10.0 * np.ceil(period_ms / 2)), 3_600_000.0))


def _fps(chosen: list[_Candidate]) -> int:
    """The rate of the first camera, or of the state; at most 30."""
    cameras = [each for each in chosen if each.feature.is_picture and len(each.samples.times) > 2]
    times = (cameras or chosen)[0].samples.times
    period_ns = float(np.median(np.diff(times))) if len(times) > 1 else NS_PER_S
    return int(min(max(round(NS_PER_S / max(period_ns, 1.0)), 1), _MOST_FPS))


def _lines(recording: Recording, chosen: list[_Candidate], left_out: list[str]) -> Iterator[str]:
    names = [each.feature.name for each in chosen]
    default = Recipe(1, "x")
    yield "# A recipe for `igtl-gateway export --to lerobot`; docs/how-to/lerobot.md describes all keys."
    yield "[dataset]"
    yield f"fps = {_fps(chosen)}"
    yield 'task = "not stated"  # what is done, in words: policies read it'
    yield f"robot_type = {toml_value(default.robot_type)}"
    yield f"format = {toml_value(default.format)}  # v2.1 for Open-H; v3.0 for lerobot 0.4 and later"
    yield f"clock = {toml_value(default.clock)}  # source stamps if every message has one, otherwise gateway times"
    yield "split_long = true  # divide episodes that are too long for float32 time stamps"
    yield ""
    yield "[episodes]"
    yield f"by = {toml_value(default.episodes.by)}  # ranges, marks, markers, notes, gap or still"
    for each in chosen:
        yield ""
        yield from _row(each.feature)
    if ACTION not in names:
        yield from ("", "[[feature]]", f"name = {toml_value(ACTION)}")
        yield f"next_of = {toml_value(STATE)}  # no stream has a command in its name: the next state"
    yield ""
    yield "[card]  # what the recording does not know; see docs/how-to/lerobot.md"
    yield '# data_type = "Table-top phantom"'
    yield '# license = "CC BY 4.0"'
    if left_out:
        yield ""
        yield "# Streams that are not used:"
        yield from (f"#   {''.join(char if char.isprintable() else '?' for char in each)}" for each in left_out)


def _row(feature: Feature) -> Iterator[str]:
    yield "[[feature]]"
    values: dict[str, Any] = {"name": feature.name, "stream": feature.stream}
    values |= {name: getattr(feature, name) for name in ("fields", "window", "rule") if getattr(feature, name)}
    values["tolerance_ms"] = "any" if feature.tolerance_ms is None else feature.tolerance_ms
    yield from (f"{name} = {toml_value(value)}" for name, value in values.items())
