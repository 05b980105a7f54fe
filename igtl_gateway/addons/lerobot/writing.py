"""Writes a data set: tables, videos, statistics, provenance, recipe and card."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from pyarrow import parquet

from igtl_gateway.addon import UnsupportedRecording
from igtl_gateway.addon.untrusted import read_bytes
from igtl_gateway.addon.writing import check_folder, make_folder, open_new, write_bytes, written_folder
from igtl_gateway.addons.lerobot.card import write_card
from igtl_gateway.addons.lerobot.card_streams import Facts as StreamFacts
from igtl_gateway.addons.lerobot.checksums import write_checksums
from igtl_gateway.addons.lerobot.frames import Episode, Plan
from igtl_gateway.addons.lerobot.layout import Facts, Layout, layout_of
from igtl_gateway.addons.lerobot.stats import PictureStats, Stats, number_stats, sampled
from igtl_gateway.addons.lerobot.video import video_info

PROVENANCE, RECIPE = "provenance.parquet", "recipe.toml"


def write_data_set(plan: Plan, out: Path, recipe: Path, streams: list[StreamFacts]) -> int:
    """Write a data set to a new or empty directory, and return the number of files.

    The directory is complete or absent at the end.

    Args:
        plan: the frames.
        out: the directory.
        recipe: the recipe, of which the data set has a copy.
        streams: what was found about the streams, for the card.

    Raises:
        UnsupportedRecording: the directory has files.
        Unavailable: PyAV is missing, and the recipe has pictures.
        OSError: it cannot be written.
    """
    check_out(out)
    with written_folder(out) as root:
        meta = root / "meta"
        make_folder(meta)
        facts = facts_of(plan)
        layout = layout_of(plan.recipe.format, root, facts)
        _write_episodes(plan, layout, meta / PROVENANCE)
        write_bytes(meta / RECIPE, read_bytes(recipe))
        write_card(plan, meta, streams)
        write_checksums(root)
        return sum(each.is_file() for each in root.rglob("*"))


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
                pictures = plan.of(name)[0].pictures
                size = sizes[name] = pictures.padded if pictures else (0, 0)
                features[name] = {
                    "dtype": "video",
                    "shape": [*size, 3],
                    "names": ["height", "width", "channels"],
                    "info": video_info(size, recipe.fps, recipe.codec),
                }
            case "text":
                features[name] = {"dtype": "string", "shape": [1], "names": [name.rpartition(".")[2]]}
            case _:
                names = plan.names(name)
                features[name] = {"dtype": "float32", "shape": [len(names)], "names": names}
    features["timestamp"] = {"dtype": "float32", "shape": [1], "names": None}
    for name in ("frame_index", "episode_index", "index", "task_index"):
        features[name] = {"dtype": "int64", "shape": [1], "names": None}
    return Facts(recipe.fps, recipe.codec, sizes, features, plan.tasks, recipe.robot_type, plan.splits)


def own_columns(plan: Plan, episode: Episode, first: int) -> dict[str, Any]:
    """Return the columns that every data set has; ``first`` is the index of the first frame in the data set."""
    frames = np.arange(episode.count, dtype=np.int64)
    return {
        "timestamp": (frames / plan.recipe.fps).astype(np.float32),
        "frame_index": frames,
        "episode_index": np.full(episode.count, episode.index, np.int64),
        "index": first + frames,
        "task_index": np.full(episode.count, plan.tasks.index(episode.task), np.int64),
    }


def _write_episodes(plan: Plan, layout: Layout, provenance: Path) -> None:
    everything: dict[str, list[Any]] = {}
    pictures = {name: PictureStats() for name in plan.recipe.names if plan.kind(name) == "picture"}
    first = 0
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
                matrix = values.reshape(len(values), -1)
                stats[name] = number_stats(matrix)
                everything.setdefault(name, []).append(matrix)
        layout.add(episode.index, episode.task, table, stats)
        first += episode.count
    total = {name: each.stats() for name, each in pictures.items()}
    layout.finish(total | {name: number_stats(np.concatenate(each)) for name, each in everything.items()})
    with open_new(provenance) as file:
        parquet.write_table(trace_of(plan), file, compression="zstd")


def _write_video(plan: Plan, layout: Layout, episode: Episode, name: str, indices: Any) -> PictureStats:
    pictures, stats, chosen = plan.of(name)[0].pictures, PictureStats(), set(sampled(episode.count).tolist())
    video = layout.video(name, episode.index, episode.count)
    for number, index in enumerate(indices.tolist() if pictures else ()):
        picture = pictures.rgb(index) if pictures else None
        if picture is not None:
            video.add(picture)
            if number in chosen:
                stats.add(picture)
    layout.end_video(name, episode.index, video)
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
    tables, first = [], 0
    for episode in plan.episodes:
        own = own_columns(plan, episode, first)
        columns: dict[str, Any] = {name: own[name] for name in ("index", "episode_index", "frame_index")}
        columns["time_ns"] = episode.times
        for index, row in enumerate(plan.recipe.features):
            label = f"{row.name}[{plan.recipe.rows(row.name).index(index)}]"
            columns |= {f"{label}.{key}": values for key, values in plan.provenance(episode, index).items()}
        tables.append(pa.table({name: pa.array(values) for name, values in columns.items()}))
        first += episode.count
    return pa.concat_tables(tables)
