"""Puts the parts of sessions into a data set: files get their numbers, and the metadata are those of all sessions.

Each session has files of its own, so what it costs does not depend on those before it, except for the statistics: those
of numbers are computed in one pass over the tables, those of pictures from sums.  Files are replaced and never changed:
a folder of links to the files of an older set can be made into a newer one.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from igtl_gateway.addon import DamagedRecording
from igtl_gateway.addon.terminal import count_text
from igtl_gateway.addon.untrusted import parquet_columns, read_bytes
from igtl_gateway.addon.writing import make_folder, write_bytes, write_text
from igtl_gateway.addons.lerobot.card import CardFacts, card
from igtl_gateway.addons.lerobot.checksums import write_checksums
from igtl_gateway.addons.lerobot.columns import is_numeric, matrix_of
from igtl_gateway.addons.lerobot.layout import (
    CHUNK,
    Facts,
    episodes_table,
    file_of,
    info_of,
    task_table,
    write_json,
    write_table,
)
from igtl_gateway.addons.lerobot.native import NATIVE, native_of
from igtl_gateway.addons.lerobot.recipe import Recipe
from igtl_gateway.addons.lerobot.schema import Described, RowFacts, Schema
from igtl_gateway.addons.lerobot.session_list import SESSIONS, SessionList, SetSession, joined_pictures, pictures_of
from igtl_gateway.addons.lerobot.splits import ranges_of
from igtl_gateway.addons.lerobot.stats import Stats, bounded_stats, number_stats
from igtl_gateway.addons.lerobot.writing import CARD, DATA, EPISODES, PROVENANCE, RECIPE, SYNCHRONIZATION

Array = npt.NDArray[Any]

#: Keys of info.json that follow from the episodes; all others of an older set stay as they are.
_TOTALS = ("total_episodes", "total_frames", "total_tasks", "total_videos", "total_chunks", "splits")


@dataclass(frozen=True, slots=True)
class Part:
    """The part of a session.

    Attributes:
        session: its description.
        group: session or patient.
        split: of the group; "" for ranges of demonstrations.
        folder: where the part is.
        written: the reply of the job that wrote it.
    """

    session: Described
    group: str
    split: str
    folder: Path
    written: Mapping[str, Any]


@dataclass(slots=True)
class SetSoFar:
    """What a data set has before a part is added.

    Attributes:
        sessions: the sessions.
        tasks: in the order of their numbers.
        episodes, frames: their number.
        splits: of each episode.
        data_files, video_files: number of the next file, of v3.0.
        episode_files: number of the next file of ``meta/episodes``, of v3.0.
        episode_schema: columns of these files; None before the first one.
        info, stats: info.json and stats.json, of which keys that are not ours stay.
        checksums: SHA-256 of the files that do not change.
    """

    sessions: SessionList = field(default_factory=SessionList)
    tasks: list[str] = field(default_factory=list)
    episodes: int = 0
    frames: int = 0
    splits: list[str] = field(default_factory=list)
    data_files: int = 0
    video_files: dict[str, int] = field(default_factory=dict)
    episode_files: int = 0
    episode_schema: pa.Schema | None = None
    info: Mapping[str, Any] = field(default_factory=dict)
    stats: Mapping[str, Any] = field(default_factory=dict)
    checksums: Mapping[str, str] = field(default_factory=dict)


def assemble(root: Path, recipe: Recipe, text: bytes, schema: Schema, so_far: SetSoFar, parts: Sequence[Part]) -> None:
    """Add parts to a data set, and write its metadata; the folders of the parts have no data after it.

    Args:
        root: the data set, or an empty folder.
        recipe: of the set.
        text: of the recipe.
        schema: of all sessions.
        so_far: what the set has; it is changed.
        parts: in the order of their sessions.

    Raises GatewayError for a table of the set that cannot be read, OSError.
    """
    meta, version = root / "meta", recipe.format
    make_folder(meta, exist_ok=True)
    new = _New(root)
    rows: list[dict[str, Any]] = []
    for part in parts:
        own = json.loads((part.folder / EPISODES).read_text("utf-8"))
        if version == "v2.1":
            _move_all(part.folder / DATA, root)
            rows += own
        else:
            _add_version30(root, part, own, so_far)
        number = len(so_far.sessions.sessions)
        os.rename(part.folder / PROVENANCE, meta / provenance_of(number))
        for path in sorted((part.folder / NATIVE).glob("*.parquet")):
            make_folder(meta / NATIVE / path.stem, parents=True, exist_ok=True)
            os.rename(path, meta / native_of(path.stem, number))
        _count(so_far, part)
    if version == "v2.1":
        _add_lines(new, rows, so_far.tasks)
    else:
        write_table(new.path("meta/tasks.parquet"), task_table(so_far.tasks))
        numbers = number_totals(root, schema.features)
        if numbers["index"]["count"] != [so_far.frames]:
            raise DamagedRecording(
                f"{root}/data: found {count_text(numbers['index']['count'][0], 'frame')}, expected {so_far.frames:,}"
            )
        pictures = picture_totals(so_far, parts)
        write_json(new.path("meta/stats.json"), {**so_far.stats, **pictures, **numbers})
    sizes = {name: (0, 0) for name, each in schema.features.items() if each["dtype"] == "video"}
    splits = split_ranges(parts, so_far)
    info = info_of(
        version, Facts(recipe.fps, recipe.codec, sizes, schema.features, recipe.robot_type),
        episodes=so_far.episodes, frames=so_far.frames, tasks=len(so_far.tasks), splits=splits,
    )  # fmt: skip
    kept = {name: value for name, value in so_far.info.items() if name not in _TOTALS}
    write_json(new.path("meta/info.json"), info | kept)
    write_bytes(new.path(f"meta/{RECIPE}"), text)
    before = meta / SYNCHRONIZATION
    lines = read_bytes(before).decode("utf-8", "replace") if before.exists() else ""
    for part in parts:
        lines += ("\n" if lines else "") + (part.folder / SYNCHRONIZATION).read_text("utf-8")
    write_text(new.path(f"meta/{SYNCHRONIZATION}"), lines)
    _write_card(new, recipe, schema, so_far, parts, splits)
    write_checksums(root, so_far.checksums)


def split_ranges(parts: Sequence[Part], so_far: SetSoFar) -> dict[str, str]:
    """Return the episodes of each split."""
    return dict(parts[0].session.splits) or ranges_of(so_far.splits)


def provenance_of(session: int) -> str:
    """Return the name of the file with the messages of a session."""
    return f"provenance-{session:06d}.parquet" if session else PROVENANCE


class _New:
    """Gives paths of files that are written again; what they were stays in other folders that have links to them."""

    def __init__(self, root: Path) -> None:
        self.root = root

    def path(self, name: str) -> Path:
        path = self.root / name
        path.unlink(missing_ok=True)
        return path


def _move_all(source: Path, root: Path) -> None:
    for path in sorted(each for each in source.rglob("*") if each.is_file()):
        target = root / path.relative_to(source)
        make_folder(target.parent, parents=True, exist_ok=True)
        os.rename(path, target)


def _add_version30(root: Path, part: Part, rows: list[dict[str, Any]], so_far: SetSoFar) -> None:
    """Move the files of a part to their numbers, and write the file about its episodes."""
    firsts = {"data": so_far.data_files} | {
        f"videos/{name}": so_far.video_files.get(name, 0)
        for name, each in part.written["features"].items()
        if each["dtype"] == "video"
    }
    counts = dict.fromkeys(firsts, 0)
    moved = set[Path]()
    for row in rows:
        for key, first in firsts.items():
            own = row[f"{key}/chunk_index"] * CHUNK + row[f"{key}/file_index"]
            counts[key] = max(counts[key], own + 1)
            row[f"{key}/chunk_index"], row[f"{key}/file_index"] = divmod(first + own, CHUNK)
            camera = key.partition("/")[2]
            kind = "video_path" if camera else "data_path"
            source = part.folder / DATA / file_of("v3.0", kind, own, camera)
            if source not in moved:
                moved.add(source)
                target = root / file_of("v3.0", kind, first + own, camera)
                make_folder(target.parent, parents=True, exist_ok=True)
                os.rename(source, target)
        row["meta/episodes/chunk_index"], row["meta/episodes/file_index"] = divmod(so_far.episode_files, CHUNK)
    for key, count in counts.items():
        if key == "data":
            so_far.data_files += count
        else:
            so_far.video_files[key.partition("/")[2]] = firsts[key] + count
    chunk, file = divmod(so_far.episode_files, CHUNK)
    table = episodes_table(rows)
    path = root / f"meta/episodes/chunk-{chunk:03d}/file-{file:03d}.parquet"
    if so_far.episode_schema is None:
        so_far.episode_schema = table.schema
    write_table(path, _conformed(table, so_far.episode_schema, path))
    so_far.episode_files += 1


def _conformed(table: pa.Table, schema: pa.Schema, path: Path) -> pa.Table:
    """A table with these columns: LeRobot reads all files about episodes with those of the first one."""
    try:
        columns = [
            table[each.name].cast(each.type) if each.name in table.schema.names else pa.nulls(table.num_rows, each.type)
            for each in schema
        ]
    except pa.ArrowException as error:
        raise DamagedRecording(f"{path.parent}: found columns of other types in the first file: {error}") from None
    return pa.table(columns, schema=schema)


def _count(so_far: SetSoFar, part: Part) -> None:
    session, listed = part.session, so_far.sessions
    row = SetSession(
        session.name, session.sha256, session.start_ns, part.group, part.split, len(session.episodes), session.frames,
        part.written["unaligned"], tuple(part.written["notes"]),
    )  # fmt: skip
    pictures = {name: pictures_of(each) for name, each in part.written["pictures"].items()}
    so_far.sessions = replace(
        listed, sessions=(*listed.sessions, row), pictures=joined_pictures([listed.pictures, pictures])
    )
    so_far.episodes += len(session.episodes)
    so_far.frames += session.frames
    so_far.splits += [part.split] * len(session.episodes)


def _add_lines(new: _New, rows: list[dict[str, Any]], tasks: Sequence[str]) -> None:
    meta = new.root / "meta"
    before = [
        read_bytes(path).decode("utf-8") if (path := meta / f"{name}.jsonl").exists() else ""
        for name in ("episodes", "episodes_stats")
    ]
    episodes = [{key: value for key, value in row.items() if key != "stats"} for row in rows]
    stats = [{key: row[key] for key in ("episode_index", "stats")} for row in rows]
    numbered = [{"task_index": number, "task": text} for number, text in enumerate(tasks)]
    for name, old, more in (
        ("tasks", "", numbered),
        ("episodes", before[0], episodes),
        ("episodes_stats", before[1], stats),
    ):
        lines = "".join(json.dumps(row, ensure_ascii=False) + "\n" for row in more)
        end = "\n" if old and not old.endswith("\n") else ""
        write_text(new.path(f"meta/{name}.jsonl"), old + end + lines)


def picture_totals(so_far: SetSoFar, parts: Sequence[Part]) -> dict[str, Stats]:
    """Return the statistics of the pictures of all sessions: exact, except in a set that another program began.

    Raises DamagedRecording for statistics of another form.
    """
    if not so_far.sessions.others:
        return {name: each.stats() for name, each in so_far.sessions.pictures.items()}
    added = joined_pictures(
        [{name: pictures_of(each) for name, each in part.written["pictures"].items()} for part in parts]
    )
    found = {}
    for name, each in added.items():
        try:
            found[name] = bounded_stats(so_far.stats[name], each.stats())
        except (KeyError, IndexError, TypeError, ValueError):
            raise DamagedRecording(f"meta/stats.json: {name}: found no mean, std and count of pictures") from None
    return found


def number_totals(root: Path, features: Mapping[str, Any]) -> dict[str, Stats]:
    """Return the statistics of all numbers in the tables of a data set: of one pass over them.

    Raises GatewayError for a table that cannot be read, or that lacks a column of numbers.
    """
    names = [name for name, each in features.items() if each["dtype"] not in ("video", "image", "string")]
    found: dict[str, list[Array]] = {name: [] for name in names}
    for path in sorted((root / "data").glob("chunk-*/file-*.parquet")):
        with parquet_columns(path) as columns:
            table = columns.read(names)
        for name in names:
            if not is_numeric(table, name):
                raise DamagedRecording(f"{path}: {name}: found missing values or no numbers, expected numbers")
            found[name].append(matrix_of(table, name))
    return {name: number_stats(np.concatenate(each)) for name, each in found.items() if each}


def _write_card(
    new: _New, recipe: Recipe, schema: Schema, so_far: SetSoFar, parts: Sequence[Part], splits: Mapping[str, str]
) -> None:
    """Write the list of the sessions and the card; a card that the user has edited stays as it is."""
    listed, path = so_far.sessions, new.root / "meta" / CARD
    notes = list(dict.fromkeys(note for each in listed.sessions for note in each.notes))
    facts = CardFacts(
        recipe, so_far.tasks, len(listed.sessions), so_far.episodes, so_far.frames, splits,
        sum(each.unaligned for each in listed.sessions), parts[-1].written["spaces"], parts[-1].written["approach"],
        notes, listed.others,
    )  # fmt: skip
    digest = listed.card
    if not path.exists() or _digest(read_bytes(path)) == listed.card:
        text = card(facts)
        write_text(new.path(f"meta/{CARD}"), text)
        digest = _digest(text.encode())
    rows = tuple(RowFacts.of(asdict(each)) for each in schema.rows)
    listed = so_far.sessions = replace(listed, clock=schema.clock, rows=rows, card=digest)
    write_text(new.path(f"meta/{SESSIONS}"), json.dumps(listed.to_dict(), ensure_ascii=False) + "\n")


def _digest(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()
