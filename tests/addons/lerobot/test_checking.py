"""Sets as LeRobot writes, merges, edits and converts them: the check finds what is lost, and nothing else.

Strategy: a small exported set is brought into the forms of LeRobot by hand; each function names the one it follows,
of version 0.6.1 where no other is named.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Sequence
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from pyarrow import parquet

from igtl_gateway.addon.messages import import_av
from igtl_gateway.addons.lerobot.comparing import check
from igtl_gateway.addons.lerobot.export import export_sessions
from igtl_gateway.addons.lerobot.reading import read_data_set
from igtl_gateway.addons.lerobot.stats import number_stats
from igtl_gateway.addons.lerobot.video import read_video
from igtl_gateway.wire.image import Image
from tests.addons.lerobot.sessions import Sent, arm, bars, write_session
from tests.tables import table

RECIPE = """\
[dataset]
fps = 10
task = "sew"
format = "v3.0"
measure_lags = false
[[feature]]
name = "observation.state"
stream = "TRANSFORM/ArmToBase"
[[feature]]
name = "observation.images.view"
stream = "IMAGE/View"
[[feature]]
name = "action"
next_of = "observation.state"
[splits]
train = ["P01", "P02"]
val = ["P03"]
"""
STATE, VIEW = "observation.state", "observation.images.view"
DATA, EPISODES, VIDEOS = "data/chunk-{:03d}/file-{:03d}.parquet", "meta/episodes", f"videos/{VIEW}/chunk-000"
QUANTILES = ("q01", "q10", "q50", "q90", "q99")
KEYS = ("min", "max", "mean", *QUANTILES)
#: Messages of each session; an episode has one frame less.
LENGTHS = {"P01": 8, "P02": 11, "P03": 9}
#: What the check reports of statistics that another program left.
LEFT = "LeRobot's merge, split, delete and modify_tasks do not renew them"
IN_TRAIN = "meta/info.json: all episodes are in train: LeRobot's merge, delete and split write that"
MEANS = "meta/stats.json: quantiles are means of those of the episodes, as LeRobot joins them: "


@pytest.fixture(scope="module")
def ours(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three sessions of one episode each, the last one held out, and their recordings beside the set."""
    folder = tmp_path_factory.mktemp("ours")
    paths = []
    for number, (name, count) in enumerate(LENGTHS.items()):
        times = [100 * number + 0.1 * each for each in range(count)]
        messages: list[Sent] = [(at, "TRANSFORM/ArmToBase", arm(at, 0)) for at in times]
        messages += [(at, "IMAGE/View", Image((64, 48, 1), 3, bars(each + 8 * number).tobytes()))
                     for each, at in enumerate(times)]  # fmt: skip
        paths.append(write_session(folder / f"{name}.mcap", sorted(messages, key=lambda each: each[0])))
    recipe = folder / "recipe.toml"
    recipe.write_text(RECIPE, "utf-8")
    export_sessions(paths, recipe, folder / "set")
    return folder


# --- files of a set -------------------------------------------------------------------------------------------------


def changed_json(path: Path, change: Callable[[Any], object]) -> None:
    value = json.loads(path.read_text("utf-8"))
    change(value)
    path.write_text(json.dumps(value), "utf-8")


def info(root: Path, change: Callable[[Any], object]) -> None:
    changed_json(root / "meta/info.json", change)


def stats(root: Path, change: Callable[[Any], object]) -> None:
    changed_json(root / "meta/stats.json", change)


def tables(root: Path, folder: str) -> list[Path]:
    return sorted((root / folder).rglob("*.parquet"))


def with_column(path: Path, name: str, values: Any) -> None:
    found = parquet.read_table(path)
    parquet.write_table(found.append_column(name, values), path)


def without_columns(path: Path, is_out: Callable[[str], bool]) -> None:
    found = parquet.read_table(path)
    parquet.write_table(found.select([each for each in found.schema.names if not is_out(each)]), path)


def changed_rows(path: Path, change: Callable[[dict[str, list[Any]]], object]) -> None:
    found = parquet.read_table(path)
    columns = found.to_pydict()
    change(columns)
    arrays = [pa.array(columns[field.name], field.type) for field in found.schema]
    parquet.write_table(pa.Table.from_arrays(arrays, schema=found.schema), path)


# --- forms ----------------------------------------------------------------------------------------------------------


def without_our_files(root: Path) -> None:
    """A set that never was ours: LeRobot's tools write a new folder."""
    for name in ("sessions.json", "recipe.toml", "SHA256SUMS", "README.md", "SYNCHRONIZATION.md"):
        (root / "meta" / name).unlink()
    for path in (root / "meta").glob("provenance*"):
        path.unlink()


def histograms(root: Path) -> None:
    """RunningQuantileStats: the first and the last bin are 1e-10 wider, and sums are float32."""

    def widened(each: dict[str, Any]) -> None:
        if np.ndim(each["min"]) == 1:
            each["q01"] = [value - 1e-10 for value in each["min"]]
            each["q99"] = [value + 1e-10 for value in each["max"]]
            each["mean"] = np.float32(each["mean"]).tolist()
            most = np.maximum(np.abs(each["min"]), np.abs(each["max"]))
            each["std"] = np.sqrt(np.square(each["std"]) + 1e-7 * most**2).tolist()
        else:
            each["q01"] = [[[value[0][0] - 4e-13]] for value in each["min"]]

    def rows(columns: dict[str, list[Any]]) -> None:
        names = {name.split("/")[1] for name in columns if name.startswith("stats/")}
        for name in names:
            for row in range(len(columns["length"])):
                own = {key: columns[f"stats/{name}/{key}"][row] for key in ("min", "max", "mean", "std", "q01", "q99")}
                widened(own)
                for key, value in own.items():
                    columns[f"stats/{name}/{key}"][row] = value

    for path in tables(root, EPISODES):
        changed_rows(path, rows)
    aggregated(root)


def means_of_quantiles(root: Path) -> None:
    """aggregate_feature_stats."""
    found = read_data_set(root)
    parts = [(each.length, each.read_stats()) for each in found.episodes]

    def change(value: Any) -> None:
        for key in QUANTILES:
            means = [length * np.array(each[STATE][key]) for length, each in parts]
            value[STATE][key] = (np.sum(means, axis=0) / sum(length for length, _ in parts)).tolist()

    stats(root, change)


def without_videos(root: Path) -> None:
    """LeRobotDatasetMetadata.create with ``use_videos=False``."""
    shutil.rmtree(root / "videos")
    info(root, lambda each: (each.update(video_path=None), each["features"].pop(VIEW)))
    stats(root, lambda each: each.pop(VIEW))
    for path in tables(root, EPISODES):
        without_columns(path, lambda name: VIEW in name)


def lists_of_any_length(root: Path) -> None:
    """aggregate_data and convert_data: pandas writes lists without their length."""
    for path in tables(root, "data"):
        found = parquet.read_table(path)
        kinds = [
            pa.list_(pa.float32()) if pa.types.is_fixed_size_list(each.type) else each.type for each in found.schema
        ]
        arrays = [pa.array(found[name].to_pylist(), kind) for name, kind in zip(found.schema.names, kinds, strict=True)]
        parquet.write_table(pa.table(dict(zip(found.schema.names, arrays, strict=True))), path)


def episodes_in_row_groups(root: Path) -> None:
    """_flush_metadata_buffer: a row group for every ten episodes of a file."""
    first, *others = tables(root, EPISODES)
    found = pa.concat_tables([parquet.read_table(each) for each in (first, *others)])
    parquet.write_table(found, first, row_group_size=1)
    for path in others:
        path.unlink()


def png(picture: Any) -> bytes:
    av = import_av()
    codec = av.CodecContext.create("png", "w")
    codec.height, codec.width = picture.shape[:2]
    codec.pix_fmt, codec.time_base = "rgb24", Fraction(1, 10)
    found = [*codec.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")), *codec.encode(None)]
    return b"".join(map(bytes, found))


def pictures_in_the_table(root: Path) -> None:
    """DatasetWriter with pictures as ``image``: a structure of bytes and path, one row group for each episode."""
    frames = [picture for path in sorted((root / VIDEOS).iterdir()) for _, picture in read_video(path)]
    shutil.rmtree(root / "videos")
    for path in tables(root, "data"):
        found = parquet.read_table(path)
        cells = [{"bytes": png(frames[each]), "path": "frame.png"} for each in found["index"].to_pylist()]
        kind = pa.struct([("bytes", pa.binary()), ("path", pa.string())])
        parquet.write_table(found.append_column(VIEW, pa.array(cells, kind)), path, row_group_size=4)
    for path in tables(root, EPISODES):
        without_columns(path, lambda name: name.startswith("videos/"))
    info(root, lambda each: (each.update(video_path=None), each["features"][VIEW].update(dtype="image")))


def damaged_picture(root: Path) -> None:
    pictures_in_the_table(root)
    changed_rows(tables(root, "data")[1], lambda each: each[VIEW].__setitem__(4, {"bytes": b"GIF89a", "path": ""}))


def channels_first(root: Path) -> None:
    info(root, lambda each: each["features"][VIEW].update(shape=[3, 48, 64], names=["channels", "height", "width"]))


def depth(root: Path) -> None:
    """compute_episode_stats: one channel, in the unit of the depth."""
    info(root, lambda each: each["features"][VIEW].update(shape=[48, 64, 1], info={"is_depth_map": True}))
    stats(root, lambda each: each[VIEW].update({key: [[[500.0]]] for key in each[VIEW] if key != "count"}))
    for path in tables(root, EPISODES):
        found = parquet.read_table(path)
        names = [
            each for each in found.schema.names if each.startswith(f"stats/{VIEW}/") and not each.endswith("count")
        ]
        for name in names:
            values = pa.array([[[[500.0]]]] * found.num_rows)
            found = found.set_column(found.schema.names.index(name), name, values)
        parquet.write_table(found, path)


def more_kinds(root: Path) -> None:
    """get_hf_features_from_features: lists of lists, truth values, and statistics of the last dimension."""
    names, first = ("observation.matrix", "observation.flags"), 0
    found: list[np.ndarray] = []
    for path, episodes in zip(tables(root, "data"), tables(root, EPISODES), strict=True):
        count = parquet.read_table(path).num_rows
        matrix = np.arange(6 * count, dtype=np.float32).reshape(count, 2, 3) + first
        found.append(matrix)
        with_column(path, names[0], pa.array(matrix.tolist(), pa.list_(pa.list_(pa.float32()))))
        with_column(path, names[1], pa.array([[True, number == 0] for number in range(count)]))
        for key, value in number_stats(matrix.reshape(-1, 3)).items():
            with_column(episodes, f"stats/{names[0]}/{key}", pa.array([[count] if key == "count" else value]))
        for key, value in number_stats(np.array([[1, n == 0] for n in range(count)])).items():
            is_truth = key in ("min", "max")
            with_column(episodes, f"stats/{names[1]}/{key}", pa.array([list(map(bool, value)) if is_truth else value]))
        first += count
    flags = np.concatenate([np.array([[1, n == 0] for n in range(len(each))]) for each in found])
    total = {
        names[0]: number_stats(np.concatenate(found).reshape(-1, 3)) | {"count": [first]},
        names[1]: number_stats(flags),
    }
    stats(root, lambda each: each.update(total))
    shapes = {names[0]: ("float32", [2, 3]), names[1]: ("bool", [2])}
    more = {name: {"dtype": kind, "shape": shape, "names": None} for name, (kind, shape) in shapes.items()}
    info(root, lambda each: each["features"].update(more))


def index_without_a_name(root: Path) -> None:
    """save_episode_tasks of 0.4.4: the index of the tasks has no name."""
    path = root / "meta/tasks.parquet"
    found = parquet.read_table(path)
    text = found.schema.metadata[b"pandas"].decode()
    value = json.loads(text)
    value["index_columns"] = ["__index_level_0__"]
    for each in value["columns"]:
        if each["name"] == "task":
            each.update(name=None, field_name="__index_level_0__")
    names = ["__index_level_0__" if each == "task" else each for each in found.schema.names]
    parquet.write_table(found.rename_columns(names).replace_schema_metadata({"pandas": json.dumps(value)}), path)


def tasks_in_another_order(root: Path) -> None:
    path = root / "meta/tasks.parquet"
    found = parquet.read_table(path)
    rows = pa.table({"task_index": pa.array([1, 0]), "task": ["knot", "sew"]})
    parquet.write_table(rows.replace_schema_metadata(found.schema.metadata), path)
    info(root, lambda each: each.update(total_tasks=2))


def pixels_counted(root: Path) -> None:
    """_CameraEncoderThread: the count of pictures that are encoded at once is that of their pixels."""
    stats(root, lambda each: each[VIEW].update(count=[48 * 64 * 25]))


def added_feature(root: Path) -> None:
    """add_features: nothing has statistics of it."""
    for path in tables(root, "data"):
        with_column(path, "next.reward", pa.array(np.zeros(parquet.read_table(path).num_rows, np.float32)))
    info(root, lambda each: each["features"].update({"next.reward": {"dtype": "float32", "shape": [1], "names": None}}))


def pictures_to_videos(root: Path) -> None:
    """convert_image_to_video_dataset: episodes have neither tasks nor statistics."""
    for path in tables(root, EPISODES):
        without_columns(path, lambda name: name == "tasks" or name.startswith("stats/"))


def deleted(root: Path) -> None:
    """delete_episodes of episode 0: numbers begin again, statistics of episodes and all splits do not."""
    for number, path in enumerate(tables(root, "data")):
        if number == 0:
            path.unlink()
            continue
        count = len(parquet.read_table(path))
        first = 0 if number == 1 else LENGTHS["P02"] - 1
        columns = {"episode_index": [number - 1] * count, "index": list(range(first, first + count))}
        changed_rows(path, lambda each, columns=columns: each.update(columns))  # type: ignore[misc]
    first = 0
    for number, path in enumerate(tables(root, EPISODES)):
        if number == 0:
            path.unlink()
            continue
        count = list(LENGTHS.values())[number] - 1
        columns = {"episode_index": [number - 1], "dataset_from_index": [first], "dataset_to_index": [first + count]}
        changed_rows(path, lambda each, columns=columns: each.update(columns))  # type: ignore[misc]
        first += count
    (root / VIDEOS / "file-000.mp4").unlink()
    info(root, lambda each: each.update(total_episodes=2, total_frames=first, splits={"train": "0:2"}))
    aggregated(root)


def aggregated(root: Path) -> None:
    """aggregate_stats: those of all from those of the episodes."""
    found = read_data_set(root)
    parts = [each.read_stats() for each in found.episodes]
    counts = [each.length for each in found.episodes]

    def change(total: Any) -> None:
        for name, each in total.items():
            means = np.array([part[name]["mean"] for part in parts])
            mean = np.average(means, axis=0, weights=counts)
            squares = np.square([part[name]["std"] for part in parts]) + (means - mean) ** 2
            each["mean"] = mean.tolist()
            each["std"] = np.sqrt(np.average(squares, axis=0, weights=counts)).tolist()
            for key in ("min", "max"):
                each[key] = getattr(np, key)([part[name][key] for part in parts], axis=0).tolist()
            each["count"] = [sum(part[name]["count"][0] for part in parts)]
            for key in QUANTILES:
                each[key] = np.average([part[name][key] for part in parts], axis=0, weights=counts).tolist()

    stats(root, change)


def merged_numbers(root: Path) -> None:
    """finalize_aggregation: the statistics of all are those of the parts, each with its own numbers."""
    stats(root, lambda each: each["index"].update({key: [0.5 * each["index"][key][0]] for key in KEYS}))
    info(root, lambda each: each.update(splits={"train": "0:3"}))


def resumed(root: Path) -> None:
    """LeRobotDataset.resume: one more episode in files of its own."""
    data, episodes = tables(root, "data")[2], tables(root, EPISODES)[2]
    first = sum(LENGTHS.values()) - 3
    shutil.copy(root / VIDEOS / "file-002.mp4", root / VIDEOS / "file-003.mp4")
    copies = [each.with_name("file-003.parquet") for each in (data, episodes)]
    shutil.copy(data, copies[0])
    shutil.copy(episodes, copies[1])
    count = LENGTHS["P03"] - 1
    columns = {"episode_index": [3] * count, "index": list(range(first, first + count))}
    changed_rows(copies[0], lambda each: each.update(columns))

    def row(each: dict[str, list[Any]]) -> None:
        each.update(episode_index=[3], dataset_from_index=[first], dataset_to_index=[first + count])
        each.update({"data/file_index": [3], f"videos/{VIEW}/file_index": [3]})
        for name, values in (("index", range(first, first + count)), ("episode_index", [3] * count)):
            for key, value in number_stats(np.array(values).reshape(-1, 1)).items():
                each[f"stats/{name}/{key}"] = [value]

    changed_rows(copies[1], row)
    info(root, lambda each: each.update(total_episodes=4, total_frames=first + count, splits={"train": "0:4"}))
    aggregated(root)


def beside_our_files(change: Callable[[Path], None]) -> Callable[[Path], None]:
    """The change to an exported set, as a repository on a hub keeps the files that LeRobot does not write."""

    def changed(root: Path) -> None:
        change(root)

    changed.__name__ = f"{change.__name__} beside our files"
    return changed


def of_others(*changes: Callable[[Path], None]) -> Callable[[Path], None]:
    def changed(root: Path) -> None:
        for change in changes:
            change(root)
        without_our_files(root)

    changed.__name__ = " ".join(each.__name__ for each in changes) or "as it is"
    return changed


#: Change, the beginnings of all findings, and of all notes.
CASES: list[tuple[Callable[[Path], None], Sequence[str], Sequence[str]]] = [
    (of_others(), [], []),
    (of_others(histograms), [], [f"{MEANS}q"]),
    (of_others(means_of_quantiles), [], [f"{MEANS}q"]),
    (of_others(without_videos), [], []),
    (of_others(lists_of_any_length), [], []),
    (of_others(episodes_in_row_groups), [], []),
    (of_others(pictures_in_the_table), [], []),
    (of_others(damaged_picture), [f"episode 1: {VIEW}: frame 4: found no PNG, JPEG or TIFF"], []),
    (of_others(channels_first), [], []),
    (of_others(depth), [], []),
    (of_others(more_kinds), [], []),
    (of_others(index_without_a_name), [], []),
    (of_others(tasks_in_another_order), ["meta/tasks.parquet: row 0: found task_index 1, expected 0: "], []),
    (of_others(pixels_counted), [], []),
    (
        of_others(added_feature), [],
        ["no episode has statistics of next.reward", "meta/stats.json: next.reward: no statistics: LeRobot does not"],
    ),
    (
        of_others(pictures_to_videos), ["episode 0: found no task (3 episodes), expected one or more"],
        [f"no episode has statistics of {STATE}, {VIEW}, action, timestamp, frame_index and 3 more"],
    ),
    (
        of_others(deleted),
        [
            "episode 0: stats of index, episode_index: found those of another number (2 episodes), expected its own: "
            f"{LEFT}",
            "meta/stats.json: episode_index, index: min: found [1], expected [0]",
        ],
        [IN_TRAIN, f"{MEANS}q"],
    ),
    (of_others(merged_numbers), ["meta/stats.json: index: max: found [12], expected [24]"], [IN_TRAIN]),
    (
        beside_our_files(deleted),
        [
            "meta/sessions.json: found no episode 0 of P01.mcap, expected it: it was episode 0 and is gone",
            "meta/info.json: splits: found episode 1 (P03.mcap) in train, expected val as exported: held-out episodes "
            "have become training data",
            *["data/", "data/", "data/", "meta/episodes/", "meta/episodes/", "meta/SHA256SUMS: 4 more files that are "],
            "episode 0: stats of index, episode_index: found those of another number (2 episodes)",
            "meta/stats.json: episode_index, index: min: found [1], expected [0]",
        ],
        [IN_TRAIN, f"{MEANS}q"],
    ),
    (
        beside_our_files(resumed),
        [
            "meta/sessions.json: found episode 3 of no session, expected those of the export",
            "meta/info.json: splits: found episode 2 (P03.mcap) in train, expected val as exported: held-out",
            "meta/info.json: found another SHA-256",
            "meta/stats.json: found another SHA-256",
            *["data/", "meta/episodes/", "videos/"],
        ],
        [f"{MEANS}q"],
    ),
]  # fmt: skip


#: The forms that most sets of LeRobot have, and what is lost; the others take a second more.
GATE = ("deleted beside our files", "deleted", "pictures_in_the_table", "lists_of_any_length", "episodes_in_row_groups")


@table(("change", "findings", "notes"), CASES, gate=lambda change, findings, notes: change.__name__ in GATE)
def test_what_lerobot_leaves_behind(
    change: Callable[[Path], None], findings: Sequence[str], notes: Sequence[str], ours: Path, tmp_path: Path
) -> None:
    root = shutil.copytree(ours / "set", tmp_path / "set")
    change(root)
    found = check(root, [])
    for text, expected in ((found.findings, findings), (found.notes, notes)):
        assert len(text) == len(expected), text
        assert all(one.startswith(two) for one, two in zip(text, expected, strict=True)), text


@table(
    ("key", "value", "text"),
    [
        ("episodes", 10**15, "episode_index: found other episodes, expected the 1,000,000,000,000,000 episodes"),
        ("episodes", -1, "sessions[0].episodes: found -1"),
        ("others", 2**62, "episode_index: found other episodes"),
        ("split", "no such", "in train, expected no such as exported"),
    ],
)
def test_a_list_of_sessions_of_any_numbers(key: str, value: object, text: str, ours: Path, tmp_path: Path) -> None:
    root = shutil.copytree(ours / "set", tmp_path / "set")

    def change(listed: Any) -> None:
        (listed if key == "others" else listed["sessions"][0])[key] = value

    changed_json(root / "meta/sessions.json", change)
    assert any(text in each for each in check(root, []).findings), check(root, []).findings
