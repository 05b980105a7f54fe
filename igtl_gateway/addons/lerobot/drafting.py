"""A starting recipe, made of the streams of a recording; it works as it is.

Frames are as many as the slowest wanted stream has messages.  Wanted are the streams that the user names; without a
name the state, the action and the pictures, unless they are so slow that the set would be useless: these are held.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from igtl_gateway.addon import NS_PER_MS, NS_PER_S, ConfigError, GatewayError, matches, unmatched, without_match
from igtl_gateway.addon.reading import Recording, Stream
from igtl_gateway.addon.terminal import count_text
from igtl_gateway.addons.lerobot.pictures import Pictures, has_pictures, some_pixels
from igtl_gateway.addons.lerobot.recipe import ACTION, IMAGES, STATE, Feature, Recipe
from igtl_gateway.addons.lerobot.recipe_file import toml_value
from igtl_gateway.addons.lerobot.resampling import common, coverage, frame_count
from igtl_gateway.addons.lerobot.samples import JoinedStreams, Samples, read_samples
from igtl_gateway.addons.lerobot.set_topics import SetTopics
from igtl_gateway.addons.lerobot.values import columns_of

#: Words in the names of streams that carry commands (CRTK, and usual names).
_COMMANDS = re.compile(r"(^|[/_])(servo|move|setpoint|goal|cmd|command|target)(_|/|$)", re.IGNORECASE)
_NUMBERS = {"sensor_msgs/msg/JointState": ("position",), "SENSOR": ("values",)}
#: Part of the time of the other streams that a stream must have, to be part of the recipe.
_LEAST_SHARE = 0.5
#: The order of the rows: those that are neither state, action nor picture come last, and give no rate unless named.
_OTHERS = 3
_MOST_FPS, _USUAL_MS = 30, 100.0
#: Messages per second from which on a stream without a name gives the rate.
_LEAST_HZ = 5
#: Intervals of a stream that its tolerance has, and those of a slow one, which is held.
_INTERVALS, _SLOW_INTERVALS = 5, 2


@dataclass(frozen=True, slots=True)
class _Candidate:
    """A row of the recipe, with its samples."""

    feature: Feature
    samples: Samples

    @property
    def rate_hz(self) -> float:
        """Samples per second, from the median interval; 0 for strings and for a single sample."""
        times = self.samples.times
        if self.samples.kind == "text" or len(times) < 2:
            return 0.0
        return NS_PER_S / float(np.median(np.diff(times)))


@dataclass(frozen=True, slots=True)
class Draft:
    """A starting recipe.

    Attributes:
        text: of the TOML file.
        fps: frames per second.
        stream: the one that gave the rate.
        reason: why.
        costs: what the rate means for the messages of each other rate, a line each.
    """

    text: str
    fps: int
    stream: str
    reason: str
    costs: tuple[str, ...]


def draft(recording: Recording, globs: Sequence[str] = ()) -> Draft:
    """Return a recipe: poses and joints are the state, pictures are views, strings and other numbers follow.

    A stream with a command in its name is the action; otherwise the action is the next state.

    Args:
        recording: the session.
        globs: the wanted streams: only they have rows, and the slowest of them gives the rate.

    Raises:
        ConfigError: a glob matches no stream.
        GatewayError: no stream can be the state.
    """
    streams, of_set = _wanted(recording, globs), SetTopics.of(recording)
    good = [each for each in streams if len(each)]
    joined = JoinedStreams(good, "auto")
    chosen, left_out = list[_Candidate](), list[str]()
    covered: list[tuple[int, int]] = []
    taken: set[str] = set()
    # the state first: without it there is no data set
    candidates = list(_candidates(recording, good, joined, left_out, of_set, is_named=bool(globs)))
    for found in sorted(candidates, key=lambda each: (_order(each), -_length(coverage(each.samples)))):
        candidate = _own_name(found, taken)
        has = coverage(candidate.samples)
        both = common(covered, has) if chosen else has
        if not _frames(both, _fps(_giver([*chosen, candidate], is_named=bool(globs)))):
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
    chosen = [_latched(each, covered[0][0]) for each in chosen]
    giver = _giver(chosen, is_named=bool(globs))
    fps = _fps(giver)
    facts = Draft(
        "", fps, giver.feature.stream, _reason(giver, chosen, is_named=bool(globs)), tuple(_costs(chosen, fps))
    )
    default = of_set.defaults() if of_set else Recipe(1, "x")
    return replace(facts, text="\n".join(_lines(facts, chosen, left_out, default)) + "\n")


def _wanted(recording: Recording, globs: Sequence[str]) -> list[Stream]:
    """The received streams, of which those that the globs name; all if there is none that was received."""
    every = recording.streams
    if without := without_match(globs, every):
        raise ConfigError("; ".join(f"--streams {glob}: {unmatched(glob, every)}" for glob in without))
    received = [each for each in every.values() if each.direction.endswith("_in")]
    return [each for each in received or every.values() if not globs or _is_named(each.key, globs)]


def _is_named(key: str, globs: Sequence[str]) -> bool:
    device = "" if key.startswith("/") else key.partition("/")[2]
    return any(matches(glob, name) for glob in globs for name in (key, device) if name)


def _order(candidate: _Candidate) -> int:
    name = candidate.feature.name
    return 0 if name == STATE else 1 if name == ACTION else 2 if candidate.feature.is_picture else _OTHERS


def _own_name(candidate: _Candidate, taken: set[str]) -> _Candidate:
    """A row with the whole name of its stream where another row has its name: the force of the second arm."""
    feature = candidate.feature
    if feature.name in (STATE, ACTION) or feature.name not in taken:
        return candidate
    name = f"{feature.name.rpartition('.')[0]}.{_word(feature.stream)}"
    return replace(candidate, feature=replace(feature, name=name))


def _word(name: str) -> str:
    return re.sub(r"[^A-Za-z0-9_]+", "_", name).strip("_").lower()


def _length(intervals: list[tuple[int, int]]) -> int:
    return sum(min(end, 1 << 62) - start + 1 for start, end in intervals)


def _frames(intervals: list[tuple[int, int]], fps: int) -> bool:
    """Whether an interval has enough moments for an episode, and one more."""
    return any(frame_count(start, min(end, 1 << 62), fps) > Recipe(fps, "").min_frames for start, end in intervals)


def _candidates(
    recording: Recording,
    streams: list[Stream],
    joined: JoinedStreams,
    left_out: list[str],
    of_set: SetTopics | None,
    *,
    is_named: bool,
) -> Iterator[_Candidate]:
    for stream in streams:
        try:
            stream.key.encode()
            if of_set and stream.name in of_set.topics:
                feature = of_set.feature(stream.name, stream.key, stream.type, columns_of(stream))
                if feature is None:
                    raise ConfigError("found no row that gives the feature of the set back, expected one")
            else:
                feature = _feature(stream)
            first = _Candidate(feature, read_samples(recording, feature, joined, stream.key))
            usual = _sampled(first, is_named=is_named)
            yield _Candidate(usual, read_samples(recording, usual, joined, stream.key))
        except (GatewayError, UnicodeEncodeError) as error:
            text = str(error)
            left_out.append(text if stream.key in text else f"{stream.key}: {text}")


def _feature(stream: Stream) -> Feature:
    """A row for a stream.  Raises ConfigError if nothing in it fits."""
    name = _word(stream.name.rpartition("/")[2]) or "unnamed"
    if has_pictures(stream):
        view = re.sub(r"[^A-Za-z0-9_]+", "_", stream.name.replace("IMAGE/", "").strip("/")).lower() or "view"
        return Feature(f"{IMAGES}{view}", stream.key, window=_window(stream))
    if stream.type in ("STRING", "std_msgs/msg/String"):
        return Feature(f"observation.meta.{name}", stream.key, tolerance_ms=None)
    main = ACTION if _COMMANDS.search(stream.name) else STATE
    if len(stream) < 2:
        raise ConfigError("found 1 message, expected 2 or more")
    fields = _NUMBERS.get(stream.type)
    if fields:
        return Feature(main if fields == ("position",) else f"observation.{name}", stream.key, fields=fields)
    if stream.type.startswith("geometry_msgs/msg/Wrench") or stream.type.startswith("geometry_msgs/msg/Twist"):
        return Feature(f"observation.{name}", stream.key, fields=tuple(_floats(stream)))
    stream.poses()
    return Feature(main, stream.key)


def _floats(stream: Stream) -> Iterator[str]:
    import pyarrow as pa

    return (each.name for each in stream.to_arrow().schema if pa.types.is_floating(each.type))


def _window(stream: Stream) -> tuple[float, ...]:
    """Darkest and brightest value of some pictures, for more than 8 bits: the first one may be black."""
    try:
        Pictures(stream)
    except ConfigError as error:
        if "window" not in str(error):
            raise
    else:
        return ()
    finite = [each[np.isfinite(each)] for each in some_pixels(stream)]
    low = float(min((each.min() for each in finite if each.size), default=0))
    high = float(max((each.max() for each in finite if each.size), default=0))
    return (low, high) if low < high else (low, low + 1)


def _sampled(candidate: _Candidate, *, is_named: bool) -> Feature:
    """The row with rule and tolerance: five intervals, in steps of 10 ms; any for strings and for a single sample."""
    feature, samples = candidate.feature, candidate.samples
    if samples.kind == "text":
        return replace(feature, rule="none", tolerance_ms=None)
    if not candidate.rate_hz:
        return replace(feature, rule="hold", tolerance_ms=None)
    is_slow = not is_named and round(candidate.rate_hz) < _LEAST_HZ
    if samples.kind == "pose" or feature.fields == ("position",):
        rule = "interpolate"
    else:
        rule = "nearest" if samples.kind == "picture" and not is_slow else "hold"
    intervals = _SLOW_INTERVALS if is_slow and rule == "hold" else _INTERVALS
    wanted_ms = 10.0 * np.ceil(intervals * NS_PER_S / candidate.rate_hz / NS_PER_MS / 10)
    return replace(feature, rule=rule, tolerance_ms=min(max(_USUAL_MS, wanted_ms), 3_600_000.0))


def _latched(candidate: _Candidate, start_ns: int) -> _Candidate:
    """A row whose strings all come before the first frame: its last one is that of all frames."""
    if candidate.feature.rule != "none" or candidate.samples.times[-1] >= start_ns:
        return candidate
    return replace(candidate, feature=replace(candidate.feature, rule="hold"))


def _giver(chosen: Sequence[_Candidate], *, is_named: bool) -> _Candidate:
    """The slowest wanted row; the fastest one where all are slow, and the first one where none has a rate."""
    rated = [each for each in chosen if each.rate_hz]
    main = [each for each in rated if _order(each) < _OTHERS]
    wanted = rated if is_named else [each for each in main if round(each.rate_hz) >= _LEAST_HZ]
    if wanted:
        return min(wanted, key=lambda each: each.rate_hz)
    return max(main or rated or chosen, key=lambda each: each.rate_hz)


def _fps(giver: _Candidate) -> int:
    return int(min(max(round(giver.rate_hz), 1), _MOST_FPS))


def _reason(giver: _Candidate, chosen: Sequence[_Candidate], *, is_named: bool) -> str:
    fastest = max(each.rate_hz for each in chosen)
    if is_named:
        why = "the slowest named stream"
    elif round(giver.rate_hz) >= _LEAST_HZ:
        why = f"the slowest state, action or picture of {_LEAST_HZ} Hz or more"
    else:
        why = f"the fastest: no state, action or picture has {_LEAST_HZ} Hz"
    if giver.rate_hz > _MOST_FPS:
        why += f"; at most {_MOST_FPS} here"
    elif fastest > 2 * giver.rate_hz:
        why += "; leave it out, or raise fps, for more"
    return f"{giver.feature.stream} has {_hz(giver.rate_hz)}, {why}"


def _costs(chosen: Sequence[_Candidate], fps: int) -> Iterator[str]:
    """What the rate means for the streams that have another one."""
    known = {each.feature.stream: each for each in reversed(chosen) if each.rate_hz}
    for stream, each in sorted(known.items()):
        if each.rate_hz >= 1.5 * fps:
            frames = count_text(round(100 * fps / each.rate_hz), "frame")
            yield f"{stream}: {_hz(each.rate_hz)}, {frames} for 100 messages"
        elif each.rate_hz <= fps / 1.5:
            most = "any age" if each.feature.tolerance_ms is None else f"up to {each.feature.tolerance_ms:,.0f} ms"
            yield (
                f"{stream}: {_hz(each.rate_hz)}, {count_text(round(fps / each.rate_hz), 'frame')} for a message: "
                f'rule = "{each.feature.rule}", {most}'
            )


def _hz(rate_hz: float) -> str:
    return f"{rate_hz:,.3g} Hz" if rate_hz < 100 else f"{rate_hz:,.0f} Hz"


def _lines(facts: Draft, chosen: list[_Candidate], left_out: list[str], default: Recipe) -> Iterator[str]:
    names = [each.feature.name for each in chosen]
    yield "# A recipe for `igtl-gateway export --to lerobot`; docs/how-to/lerobot.md describes all keys."
    yield "[dataset]"
    yield from (f"# {_plain(each)}" for each in (facts.reason, *facts.costs))
    yield f"fps = {facts.fps}"
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
        yield "# Streams that are not used; a row with fields takes numbers of any:"
        yield from (f"#   {_plain(each)}" for each in left_out)


def _plain(text: str) -> str:
    return "".join(char if char.isprintable() else "?" for char in text)


def _row(feature: Feature) -> Iterator[str]:
    yield "[[feature]]"
    values: dict[str, Any] = {"name": feature.name, "stream": feature.stream}
    values |= {name: getattr(feature, name) for name in ("fields", "names", "window", "rule") if getattr(feature, name)}
    values["tolerance_ms"] = "any" if feature.tolerance_ms is None else feature.tolerance_ms
    yield from (f"{name} = {toml_value(value)}" for name, value in values.items())
    if feature.window:
        yield '# of depth, format = "v3.0" and depth_mm = [0, 4095] instead of window keep each millimetre'
