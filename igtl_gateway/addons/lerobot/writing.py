"""Writes what a session gives to a data set: tables, videos, statistics of episodes, provenance, part of the card."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from pyarrow import parquet

from igtl_gateway.addon import UnsupportedRecording
from igtl_gateway.addon.writing import check_folder, make_folder, open_new, write_text
from igtl_gateway.addons.lerobot.depth import depth_info
from igtl_gateway.addons.lerobot.frames import Episode, Plan
from igtl_gateway.addons.lerobot.layout import Facts, Layout, layout_of
from igtl_gateway.addons.lerobot.recipe import STAMPS, TIME
from igtl_gateway.addons.lerobot.stats import PictureStats, Stats, number_stats, sampled
from igtl_gateway.addons.lerobot.video import video_info

PROVENANCE, RECIPE, SYNCHRONIZATION, CARD = "provenance.parquet", "recipe.toml", "SYNCHRONIZATION.md", "README.md"
#: Folder of a part: its files of data and videos, named as in a data set of this session alone.
DATA = "files"
#: What the metadata have about the episodes of a part.
EPISODES = "episodes.json"


def write_part(plan: Plan, part: Path, synchronization: str) -> dict[str, Any]:
    """Write what a session gives to a data set into a new folder.

    Args:
        plan: the frames.
        part: the folder.
        synchronization: the part of the card.

    Returns:
        ``features``, and the statistics of the ``pictures``.

    Raises:
        Unavailable: PyAV is missing, and the recipe has pictures.
        OSError: it cannot be written.
    """
    make_folder(part)
    facts = facts_of(plan)
    layout = layout_of(plan.recipe.format, part / DATA, facts, plan.place.frame)
    pictures = _write_episodes(plan, layout)
    with open_new(part / PROVENANCE) as file:
        parquet.write_table(trace_of(plan), file, compression="zstd")
    write_text(part / SYNCHRONIZATION, synchronization)
    write_text(part / EPISODES, json.dumps(layout.rows))
    return {"features": facts.features, "pictures": {name: each.to_dict() for name, each in pictures.items()}}


def check_out(out: Path) -> None:
    """Raise UnsupportedRecording or GatewayError if no data set can be written to ``out``."""
    if out.is_symlink():
        raise UnsupportedRecording(f"{out}: found a link, expected a new or empty directory")
    check_folder(out)


def facts_of(plan: Plan) -> Facts:
    """Return what info.json states about a data set."""
    recipe, sizes = plan.recipe, dict[str, tuple[int, int]]()
    features: dict[str, Any] = {}
    for name in recipe.names:
        match plan.kind(name):
            case "picture":
                pictures, depth_mm = plan.of(name)[0].pictures, plan.of(name)[0].row.depth_mm
                size = sizes[name] = pictures.padded if pictures else (0, 0)
                of_depth = depth_mm and depth_info(size, recipe.fps, depth_mm)
                features[name] = {
                    "dtype": "video",
                    "shape": [*size, 1 if depth_mm else 3],
                    "names": ["height", "width", "channels"],
                    "info": of_depth or video_info(size, recipe.fps, recipe.codec),
                }
            case "text":
                features[name] = {"dtype": "string", "shape": [1], "names": [name.rpartition(".")[2]]}
            case _:
                names = plan.names(name)
                features[name] = {"dtype": "float32", "shape": [len(names)], "names": names}
    if recipe.stamps:
        # a policy takes as input what begins with observation. or action., and in float32 a stamp is wrong by 137 s
        labels = stamp_names(plan)
        features[TIME] = {"dtype": "int64", "shape": [1], "names": None}
        features[STAMPS] = {"dtype": "int64", "shape": [len(labels)], "names": labels}
    features["timestamp"] = {"dtype": "float32", "shape": [1], "names": None}
    for name in ("frame_index", "episode_index", "index", "task_index"):
        features[name] = {"dtype": "int64", "shape": [1], "names": None}
    return Facts(recipe.fps, recipe.codec, sizes, features, recipe.robot_type)


def own_columns(plan: Plan, episode: Episode, first: int) -> dict[str, Any]:
    """Return the columns that every data set has; ``first`` is the index of the first frame in the data set."""
    frames = np.arange(episode.count, dtype=np.int64)
    stamps = {TIME: episode.times, STAMPS: _stamps(plan, episode)} if plan.recipe.stamps else {}
    return stamps | {
        "timestamp": (frames / plan.recipe.fps).astype(np.float32),
        "frame_index": frames,
        "episode_index": np.full(episode.count, plan.place.episode + episode.index, np.int64),
        "index": first + frames,
        "task_index": np.full(episode.count, plan.tasks.index(episode.task), np.int64),
    }


def stamp_names(plan: Plan) -> list[str]:
    """Return the names of the stamps of a frame: two for a row that is interpolated, otherwise one."""
    return [plan.recipe.label(index) + key for index, key in _stamp_columns(plan)]


def _stamp_columns(plan: Plan) -> list[tuple[int, str]]:
    """Row of the recipe, and "" or ".after"."""
    rows = [(index, each.row.rule) for index, each in enumerate(plan.samples) if each is not None]
    return [(index, key) for index, rule in rows for key in (("", ".after") if rule == "interpolate" else ("",))]


def _stamps(plan: Plan, episode: Episode) -> Any:
    """The stamps of the messages of each frame, (count, K) int64 ns as recorded; 0 for a frame without a string."""
    columns = {"": "stamp_ns", ".after": "stamp_after_ns"}
    found = {index: plan.provenance(episode, index) for index, _ in _stamp_columns(plan)}
    return np.stack([found[index][columns[key]] for index, key in _stamp_columns(plan)], axis=1)


def _write_episodes(plan: Plan, layout: Layout) -> dict[str, PictureStats]:
    """Write the episodes, and return the statistics of the pictures of all of them."""
    pictures = {name: PictureStats() for name in plan.recipe.names if plan.kind(name) == "picture"}
    first = plan.place.frame
    for episode in plan.episodes:
        columns: dict[str, Any] = {}
        stats: dict[str, Stats] = {}
        for name in plan.recipe.names:
            values = plan.values(episode, name)
            if name in pictures:
                found = _write_video(plan, layout, episode, name, values)
                pictures[name].join(found)
                stats[name] = found.stats()
            else:
                columns[name] = values
        own = own_columns(plan, episode, first)
        table = _table(columns | own)
        for name, values in (columns | own).items():
            if values.dtype != object:
                stats[name] = number_stats(values.reshape(len(values), -1))
        layout.add(plan.place.episode + episode.index, episode.task, table, stats)
        first += episode.count
    layout.finish()
    return pictures


def _write_video(plan: Plan, layout: Layout, episode: Episode, name: str, indices: Any) -> PictureStats:
    pictures, chosen = plan.of(name)[0].pictures, set(sampled(episode.count).tolist())
    stats = pictures.no_stats() if pictures else PictureStats()
    number = plan.place.episode + episode.index
    video = layout.video(name, number, episode.count)
    for frame, index in enumerate(indices.tolist() if pictures else ()):
        picture = pictures.rgb(index) if pictures else None
        if picture is not None:
            video.add(picture)
            if frame in chosen:
                stats.add(picture)
    layout.end_video(name, number, video)
    return stats


def _table(columns: dict[str, Any]) -> pa.Table:
    return pa.table({name: _column(values) for name, values in columns.items()})


def _column(values: Any) -> pa.Array:
    if values.dtype == object:
        return pa.array(values.tolist(), pa.string())
    if values.ndim == 1:
        return pa.array(values)
    if values.shape[1] == 1:  # a feature of the shape [1] is a plain column
        return pa.array(values[:, 0])
    return pa.FixedSizeListArray.from_arrays(pa.array(values.ravel()), values.shape[1])


def trace_of(plan: Plan) -> pa.Table:
    """Return the messages of all frames: entry numbers, stamps, distance in time, whether the last sample is held."""
    tables, first = [], plan.place.frame
    for episode in plan.episodes:
        own = own_columns(plan, episode, first)
        columns: dict[str, Any] = {name: own[name] for name in ("index", "episode_index", "frame_index")}
        columns["time_ns"] = episode.times
        for index in range(len(plan.recipe.features)):
            label = plan.recipe.label(index)
            columns |= {f"{label}.{key}": values for key, values in plan.provenance(episode, index).items()}
        tables.append(pa.table({name: pa.array(values) for name, values in columns.items()}))
        first += episode.count
    return pa.concat_tables(tables)
