"""The way back from a frame of a data set to the messages that its values are made of, and to their bytes.

The provenance of the session names the messages; with the recording, the record of each is found in the file.  A set
that another program has changed since is traced by what its episodes were at the export.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import accumulate
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from igtl_gateway.addon import ConfigError, DamagedRecording, UnsupportedRecording, one_of
from igtl_gateway.addon.reading import MessagePlace, Recording, Stream, messages_at, open_recording, session_of
from igtl_gateway.addon.terminal import count_text
from igtl_gateway.addon.untrusted import parquet_columns, printable
from igtl_gateway.addons.lerobot.assembling import provenance_of
from igtl_gateway.addons.lerobot.columns import is_numeric, matrix_of
from igtl_gateway.addons.lerobot.frames import join_streams
from igtl_gateway.addons.lerobot.parts import content_digest
from igtl_gateway.addons.lerobot.provenance import ExportedEpisode, exported_episodes, origins
from igtl_gateway.addons.lerobot.reading import FoundDataSet, read_data_set
from igtl_gateway.addons.lerobot.recipe import Feature, Recipe
from igtl_gateway.addons.lerobot.recipe_file import read_recipe
from igtl_gateway.addons.lerobot.resampling import moments, pick
from igtl_gateway.addons.lerobot.samples import read_samples, recorded_stamps, stream_of
from igtl_gateway.addons.lerobot.session_list import SESSIONS, SessionList, SetSession, read_session_list
from igtl_gateway.addons.lerobot.writing import RECIPE

#: Bits of an entry number that a record has.
_SEQUENCE = (1 << 32) - 1


@dataclass(frozen=True, slots=True)
class TracedMessage:
    """A message of a frame.

    Attributes:
        entry: its entry number; 0 in files of other programs.
        stamp_ns: its recorded time.
        place: its record in the recording; None without the recording, and for one that was latched before.
    """

    entry: int
    stamp_ns: int
    place: MessagePlace | None = None


@dataclass(frozen=True, slots=True)
class TracedRow:
    """A row of the recipe in a frame.

    Attributes:
        feature: its name.
        row: its name in the provenance.
        stream: of the recording.
        next_frame: whether it has the values of the next frame, whose messages these are.
        offset_ns: time of the first message minus that of the frame.
        share: part of the way from the first message to the second one.
        held: whether the first message is older than the tolerance.
        messages: one or two; of strings in one frame the first and the last one; none where the frame has no string,
            and behind the last frame of an episode, whose next one is in the recording alone.
    """

    feature: str
    row: str
    stream: str
    next_frame: bool
    offset_ns: int = 0
    share: float = 0.0
    held: bool = False
    messages: tuple[TracedMessage, ...] = ()


@dataclass(frozen=True, slots=True)
class Traced:
    """A frame.

    Attributes:
        index: its number in the set.
        episode, frame: number of its episode, and its number in it.
        time_ns: its time on the clock of the data set, UTC ns.
        session: of which it is.
        recording: of the session; None if it is not given.
        rows: of the recipe.
    """

    index: int
    episode: int
    frame: int
    time_ns: int
    session: SetSession
    recording: Path | None
    rows: tuple[TracedRow, ...]


def trace(root: Path, episode: int | None, frame: int, feature: str, paths: Sequence[Path]) -> Traced:
    """Return the messages behind a frame.

    Args:
        root: the data set.
        episode: number of the episode; None: ``frame`` is a number of the whole set.
        frame: number of the frame.
        feature: that one alone; "": all.
        paths: recordings of the set; empty: the bytes are not looked for.

    Raises:
        ConfigError: there is no such frame or feature, or no recording is that of the session.
        UnsupportedRecording: the set has no provenance.
        GatewayError: a file cannot be read, or has other content than the set states.
    """
    found, listed = read_data_set(root), read_session_list(root)
    if listed is None:
        raise UnsupportedRecording(f"{root}: found no meta/{SESSIONS}, expected a data set of this program")
    recipe = read_recipe(root / "meta" / RECIPE)
    names = [feature] if feature else list(recipe.names)
    if feature and feature not in recipe.names:
        raise ConfigError(f"--feature: found {feature!r}, expected {one_of(feature, list(recipe.names))}")
    index, episode, frame = _numbers(found, episode, frame)
    exported = exported_episodes(root, listed)
    known = origins(found, exported, listed.others)
    origin = None if known is None or episode < listed.others else known[episode - listed.others]
    if origin is None:
        raise ConfigError(
            f"--frame: found episode {episode}, which is of no session of meta/{SESSIONS}, expected one of them"
        )
    of_session = exported[origin]
    place = f"meta/{provenance_of(of_session.session)}"
    with parquet_columns(root / place) as columns:
        table = _Provenance(columns.read, place, of_session)
        rows = [row for name in names for row in _rows(table, recipe, name, frame)]
        time_ns = int(table.value("time_ns", frame))
    session = listed.sessions[of_session.session]
    path = _recording_of(session, paths)
    if path is not None:
        rows = _placed(path, recipe, listed, rows, time_ns)
    return Traced(index, episode, frame, time_ns, session, path, tuple(rows))


def _numbers(found: FoundDataSet, episode: int | None, frame: int) -> tuple[int, int, int]:
    """Number of the frame in the set, of its episode, and in that one.  Raises ConfigError."""
    lengths = [each.length for each in found.episodes]
    ends = list(accumulate(lengths))
    if episode is None:
        if frame >= sum(lengths):
            raise ConfigError(f"--frame: found {frame}, expected one of {count_text(sum(lengths), 'frame')}, from 0 on")
        episode = int(np.searchsorted(ends, frame, "right"))
        return frame, episode, frame - (ends[episode] - lengths[episode])
    if episode >= len(lengths):
        raise ConfigError(
            f"--frame: found episode {episode}, expected one of {count_text(len(lengths), 'episode')}, from 0 on"
        )
    if frame >= lengths[episode]:
        raise ConfigError(
            f"--frame: found {episode}:{frame}, expected one of {count_text(lengths[episode], 'frame')}, from 0 on"
        )
    return ends[episode] - lengths[episode] + frame, episode, frame


@dataclass(frozen=True, slots=True)
class _Provenance:
    """The rows of an episode in an open file."""

    read: Callable[[list[str]], pa.Table]
    place: str
    episode: ExportedEpisode

    def value(self, name: str, frame: int) -> Any:
        """Return a number of a frame.  Raises DamagedRecording."""
        table = self.read([name])
        if not is_numeric(table, name):
            raise DamagedRecording(f"{self.place}: {name}: found no numbers, expected them")
        return matrix_of(table, name)[self.episode.first + frame, 0]


def _rows(table: _Provenance, recipe: Recipe, name: str, frame: int) -> Iterator[TracedRow]:
    """The rows of a feature, without the places of their messages."""
    source = recipe.features[recipe.rows(name)[0]].next_of
    frame += bool(source)
    for index in recipe.rows(source or name):
        label, stream = recipe.label(index), recipe.features[index].stream
        if frame >= table.episode.length:
            yield TracedRow(name, label, stream, True)
            continue
        found = [
            TracedMessage(int(table.value(f"{label}.{entry}", frame)), int(table.value(f"{label}.{stamp}", frame)))
            for entry, stamp in (("entry", "stamp_ns"), ("entry_after", "stamp_after_ns"))
        ]
        share = float(table.value(f"{label}.share", frame))
        messages = tuple(dict.fromkeys(each for each in found if each.entry or each.stamp_ns))
        offset_ns, held = int(table.value(f"{label}.offset_ns", frame)), bool(table.value(f"{label}.held", frame))
        yield TracedRow(name, label, stream, bool(source), offset_ns, share, held, messages)


def _recording_of(session: SetSession, paths: Sequence[Path]) -> Path | None:
    found = next((path for path in paths if content_digest(path) == session.sha256), None)
    if paths and found is None:
        raise ConfigError(
            f"found no recording with the SHA-256 {session.sha256[:12]}…, expected {printable(session.name)}, of which "
            "the frame is"
        )
    return found


# --- the bytes --------------------------------------------------------------------------------------------------------


def _placed(
    path: Path, recipe: Recipe, listed: SessionList, rows: Sequence[TracedRow], time_ns: int
) -> list[TracedRow]:
    """The rows of a frame at a time with the places of their messages."""
    labels = {recipe.label(index): row for index, row in enumerate(recipe.features)}
    wanted: dict[tuple[str, TracedMessage], tuple[Any, ...]] = {}
    with open_recording(path) as recording, session_of(recording) as file:
        rows = [
            _behind(recording, recipe, each, time_ns) if each.next_frame and not each.messages else each
            for each in rows
        ]
        for row in rows:
            for message in row.messages:
                key = _key(recording, labels[row.row], listed.clock, message)
                if key is not None:
                    wanted[row.row, message] = key
        files = [each.path for each in file.parts] or [path]
    times = {key[0] for key in wanted.values()}
    places: dict[tuple[Any, ...], MessagePlace] = {}
    ranks = Counter[tuple[str, int]]()
    for each in (place for file_path in files if times for place in messages_at(file_path, times)):
        rank = ranks[each.topic, each.time_ns]
        ranks[each.topic, each.time_ns] += 1
        places.setdefault((each.time_ns, each.sequence), each)
        places.setdefault((each.time_ns, each.topic, rank), each)
    return [
        replace(
            row,
            messages=tuple(replace(each, place=places.get(wanted.get((row.row, each), ()))) for each in row.messages),
        )
        for row in rows
    ]


def _behind(recording: Recording, recipe: Recipe, row: TracedRow, time_ns: int) -> TracedRow:
    """The row of the frame behind the last one of an episode, at a time, made again."""
    index = next(number for number in range(len(recipe.features)) if recipe.label(number) == row.row)
    place = f"feature[{index}]"
    samples = read_samples(recording, recipe.features[index], join_streams(recording, recipe), place)
    wanted = moments(time_ns, 2, recipe.fps)[1:]
    found = pick(samples, wanted, recipe.fps)
    at = int(found.before[0]), int(found.after[0])
    messages = (TracedMessage(int(samples.entries[each]), int(samples.stamps[each])) for each in at)
    return replace(
        row,
        offset_ns=int(samples.times[at[0]] - wanted[0]),
        share=float(found.share[0]),
        held=bool(found.held[0]),
        messages=tuple(dict.fromkeys(messages)),
    )


def _key(recording: Recording, row: Feature, clock: str, message: TracedMessage) -> tuple[Any, ...] | None:
    """What finds a message in the file: its time of receipt, and its number or, of other programs, topic and rank."""
    stream = stream_of(recording, row.stream, f"feature {row.name}")
    if message.entry:
        rows = np.flatnonzero(stream.numbers == message.entry)
        return (int(stream.times[rows[0]]), message.entry & _SEQUENCE) if len(rows) else None
    stamps = stream.times if clock == "gateway" else recorded_stamps(stream, row)
    rows = np.flatnonzero(stamps == message.stamp_ns)
    if not len(rows):
        return None
    last = int(rows[-1])  # of several with one stamp, the last one counts
    return int(stream.times[last]), stream.name, _rank(stream, last)


def _rank(stream: Stream, row: int) -> int:
    return row - int(np.searchsorted(stream.times, stream.times[row]))
