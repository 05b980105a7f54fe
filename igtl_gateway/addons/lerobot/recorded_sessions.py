"""What recordings give to a data set that is not written: numbers and strings of all frames, and places of pictures.

It is what ``export`` writes, by the same plan.  Everything here is plain arrays, which go to other processes.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from igtl_gateway.addon import ConfigError, GatewayError
from igtl_gateway.addon.reading import SessionFile, layout, open_recording
from igtl_gateway.addon.untrusted import check_limit
from igtl_gateway.addon.writing import is_unfinished
from igtl_gateway.addons.lerobot.export import check_schema, describe, groups_of, here, splits_of_groups
from igtl_gateway.addons.lerobot.frames import MAX_FRAMES, Place, Plan, build
from igtl_gateway.addons.lerobot.parts import Job, content_digest, described
from igtl_gateway.addons.lerobot.recipe import Recipe
from igtl_gateway.addons.lerobot.recipe_file import read_recipe
from igtl_gateway.addons.lerobot.schema import Described, Schema, schema_of
from igtl_gateway.addons.lerobot.splits import ranges_of
from igtl_gateway.addons.lerobot.writing import own_columns

Array = npt.NDArray[Any]
#: Name, size in bytes and time of the last change (ns) of each file of a recording.
Files = tuple[tuple[str, int, int], ...]


@dataclass(frozen=True, slots=True)
class KnownRecording:
    """A recording as it was when it was read.

    Attributes:
        path: of the file, or of the folder of a split recording.
        sha256: of its content.
        files: its files.
    """

    path: Path
    sha256: str
    files: Files

    def check(self, last: Files = ()) -> Files:
        """Return its files as they are now.

        Args:
            last: files that an earlier check returned: others whose times alone differ are read.

        Raises GatewayError if its content is another one now.
        """
        try:
            found = files_of(self.path)
            if found in (self.files, last) or content_digest(self.path) == self.sha256:
                return found
        except OSError as error:
            raise GatewayError(f"{self.path}: {error.strerror}, expected the recording of the data set") from None
        raise GatewayError(
            f"{self.path}: found other content than when the data set was opened, expected the same; open the data "
            "set again"
        )


@dataclass(frozen=True, slots=True)
class PictureSource:
    """Where the pictures of a feature are from: key of the stream, and windows as in the recipe."""

    stream: str
    window: tuple[float, ...]
    depth_mm: tuple[float, ...]


@dataclass(frozen=True, slots=True, eq=False)
class SessionColumns:
    """The frames of a session.

    Attributes:
        columns: feature → (frames, K) numbers, or (frames,) strings; those that every data set has are numbered from 0.
        places: feature of pictures → (frames, 3) int64, a ``Place`` each.
        sources: feature of pictures → its source.
        names: row of the recipe → names of its numbers in this order.
        notes: what was corrected, or assumed to be one clock.
    """

    columns: Mapping[str, Array]
    places: Mapping[str, Array]
    sources: Mapping[str, PictureSource]
    names: Mapping[int, tuple[str, ...]]
    notes: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class ReadSessions:
    """The sessions of a data set, in their order in the set.

    Attributes:
        recipe: of the set.
        schema: that all of them have.
        sessions: their descriptions.
        columns: of each.
        recordings: of each.
        splits: name → ranges of episodes, as in info.json.
    """

    recipe: Recipe
    schema: Schema
    sessions: Sequence[Described]
    columns: Sequence[SessionColumns]
    recordings: Sequence[KnownRecording]
    splits: Mapping[str, str]


def recordings_in(folder: Path) -> list[Path]:
    """Return the recordings in and below a folder; one that has the parts of a split recording is one itself.

    Raises ConfigError if there is none, GatewayError for one that cannot be read.
    """
    found: list[Path] = []
    names = sorted(each for each in folder.rglob("*.mcap") if each.is_file() and not is_unfinished(each))
    for parent in dict.fromkeys(each.parent for each in names):
        own = [each for each in names if each.parent == parent]
        with SessionFile.open(own[0]) as file:
            is_split = layout.PART_KEY in file.session
        found += [parent] if is_split else own
    if not found:
        raise ConfigError(f"{folder}: found no *.mcap in the folder, expected recordings")
    return found


def read_sessions(paths: Sequence[Path], recipe_path: Path) -> ReadSessions:
    """Read recordings, which are compared as ``export`` does.

    Raises ConfigError, GatewayError as ``export_sessions``; OSError.
    """
    recipe = read_recipe(recipe_path)
    read: dict[str, tuple[KnownRecording, SessionColumns]] = {}

    def run(value: Mapping[str, Any]) -> Mapping[str, Any]:
        path = Path(Job.of(value).path)
        with open_recording(path) as recording:
            files = files_of(path)
            plan = build(recording, recipe)
            found = described(path, recipe, recording, plan)
            read[found.path] = KnownRecording(path, found.sha256, files), _columns(plan)
        if files_of(path) != files:
            raise GatewayError(f"{path}: it changed while it was read, expected a recording that is complete")
        return found.to_dict()

    sessions = describe(paths, recipe_path, recipe, lambda jobs: here(jobs, run))
    schema = schema_of(sessions)
    check_schema(sessions, schema, recipe)
    splits = splits_of_groups(sessions, groups_of(sessions, recipe), recipe)
    rank = {name: number for number, name in enumerate(recipe.splits or ())}
    sessions.sort(key=lambda each: (rank.get(splits[each.path], 0), *each.order))
    check_limit("count", sum(len(each.episodes) for each in sessions), "episodes of the data set")
    if sum(each.frames for each in sessions) > MAX_FRAMES:
        raise GatewayError(f"found more than {MAX_FRAMES:,} frames in all sessions, expected fewer")
    owners = [splits[each.path] for each in sessions for _ in each.episodes]
    return ReadSessions(
        recipe, schema, sessions, [_in_order(*read[each.path], recipe, schema) for each in sessions],
        [read[each.path][0] for each in sessions], dict(sessions[0].splits) or ranges_of(owners),
    )  # fmt: skip


def _columns(plan: Plan) -> SessionColumns:
    columns: dict[str, Array] = {}
    places: dict[str, Array] = {}
    sources: dict[str, PictureSource] = {}
    for name in plan.recipe.names:
        values = np.concatenate([plan.values(episode, name) for episode in plan.episodes])
        samples = plan.of(name)[0]
        if samples.pictures is None:
            columns[name] = values
            continue
        if not samples.pictures.is_indexed:
            raise ConfigError(
                f"{samples.row.stream}: found messages that no index has in their order, expected a recording with "
                "one; `igtl-gateway import` makes it"
            )
        places[name] = samples.pictures.places[values]
        sources[name] = PictureSource(samples.row.stream, samples.row.window, samples.row.depth_mm)
    own = [own_columns(plan, each, 0) for each in plan.episodes]
    columns |= {name: np.concatenate([each[name] for each in own]) for name in own[0]}
    names = {row: each.recorded_names for row, each in enumerate(plan.samples) if each is not None}
    return SessionColumns(columns, places, sources, names, tuple(plan.joined.notes))


def _in_order(known: KnownRecording, columns: SessionColumns, recipe: Recipe, schema: Schema) -> SessionColumns:
    """The columns with the names of the numbers in the order of the data set; those in another order are read again."""
    if all(columns.names[row] == names for row, names in schema.names.items()):
        return columns
    known.check()
    with open_recording(known.path) as recording:
        return _columns(build(recording, recipe, Place(names=schema.names)))


def files_of(path: Path) -> Files:
    """Return name, size and time of the last change of the files of a recording.  Raises OSError."""
    files = sorted(each for each in path.rglob("*") if each.is_file()) if path.is_dir() else [path]
    facts = [(each.relative_to(path).as_posix(), each.stat()) for each in files]
    return tuple((name, each.st_size, each.st_mtime_ns) for name, each in facts)
