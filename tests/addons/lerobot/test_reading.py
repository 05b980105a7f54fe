"""Data sets of others that are out to break the check: each ends with findings, soon, and without a traceback."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from pyarrow import parquet

from igtl_gateway.addons.lerobot import columns
from igtl_gateway.addons.lerobot.checking import check_rules
from igtl_gateway.addons.lerobot.export import export_lerobot
from igtl_gateway.addons.lerobot.reading import read_data_set, read_table
from igtl_gateway.base.errors import DamagedRecording, LimitExceeded
from igtl_gateway.base.untrusted.limits import FileLimits, limits_in_force
from igtl_gateway.cli import main
from tests.addons.lerobot.sessions import Sent, arm, bars, write_session
from tests.tables import table

MIB = 1 << 20
VERSIONS = ("v2.1", "v3.0")
DATA = {"v2.1": "data/chunk-000/episode_000000.parquet", "v3.0": "data/chunk-000/file-000.parquet"}
VIEW = {
    "v2.1": "videos/chunk-000/observation.images.view/episode_000000.mp4",
    "v3.0": "videos/observation.images.view/chunk-000/file-000.mp4",
}
#: Types of a column of pandas that no column has.
_TYPES = {"pandas_type": "int7", "numpy_type": "int7", "metadata": None}
EPISODES = "meta/episodes/chunk-000/file-000.parquet"
RECIPE = """\
[dataset]
fps = 10
task = "sew"
format = "{format}"
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
"""


@pytest.fixture(scope="module")
def sets(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a recording and a small data set of each format."""
    from igtl_gateway.wire.image import Image

    folder = tmp_path_factory.mktemp("sets")
    messages: list[Sent] = [(0.1 * n, "TRANSFORM/ArmToBase", arm(0.1 * n, 0)) for n in range(12)]
    messages += [(0.1 * n, "IMAGE/View", Image((64, 48, 1), 3, bars(n).tobytes())) for n in range(12)]
    path = write_session(folder / "s.mcap", sorted(messages, key=lambda each: each[0]))
    for version in VERSIONS:
        recipe = folder / f"{version}.toml"
        recipe.write_text(RECIPE.format(format=version), "utf-8")
        export_lerobot(path, recipe, folder / version)
    return folder


# --- info.json ------------------------------------------------------------------------------------------------------


def feature(**change: Any) -> Callable[[dict[str, Any]], None]:
    return lambda info: info["features"]["observation.state"].update(change)


def info_of(**change: Any) -> Callable[[dict[str, Any]], None]:
    return lambda info: info.update(change)


INFO: list[tuple[Callable[[dict[str, Any]], None], str]] = [
    (feature(shape=[10**18]), "features.observation.state.shape: found [1000000000000000000]"),
    (feature(shape=[2**40, 2**40]), "observation.state.shape: found"),
    (feature(shape=[0]), "observation.state.shape: found [0]"),
    (feature(shape=[]), "observation.state.shape: found []"),
    (feature(shape=[-7]), "observation.state.shape[0]: found -7"),
    (feature(shape=[1] * 100_000), "observation.state: found"),
    (feature(shape=[7.0]), "observation.state.shape[0]: found 7.0"),
    (feature(dtype="complex64"), "observation.state.dtype: found complex64, expected one of video, image"),
    (feature(dtype="uint8"), "observation.state: found fixed_size_list"),
    (feature(dtype="image"), "observation.state.shape: found [7], expected rows, columns and channels"),
    (feature(dtype="video"), "observation.state.shape: found [7], expected rows, columns and channels"),
    (feature(dtype="string"), "observation.state: found fixed_size_list"),
    (feature(dtype="bool"), "observation.state: found fixed_size_list"),
    (feature(dtype="int64", shape=[1]), "observation.state: found fixed_size_list"),
    (feature(dtype=None), "observation.state.dtype: found null"),
    (lambda info: info["features"]["observation.images.view"].update(shape=[48]), "rows, columns and channels"),
    (lambda info: info["features"]["observation.images.view"].update(shape=[2**20, 2**20, 3]), "rows, columns and"),
    (lambda info: info["features"]["observation.images.view"].update(shape=[50, 64, 3]), "found 64 × 48 pixels"),
    (info_of(features={}), "features: found no observation.state"),
    (info_of(features=[]), "features: found [], expected an object"),
    (info_of(fps=0), "fps: found 0, expected 1 to 1000"),
    (info_of(fps=10**15), "fps: found 1000000000000000, expected 1 to 1000"),
    (info_of(fps=29.97), "fps: found 29.97"),
    (info_of(fps=-10), "fps: found -10"),
    (info_of(total_frames=2**62), "total_frames: found 4611686018427387904"),
    (info_of(total_frames=None), "total_frames: found null"),
    (info_of(data_files_size_in_mb=[1] * 9), "data_files_size_in_mb: found"),
    (info_of(chunks_size="x"), "chunks_size: found"),
    (info_of(splits={"train": "0:" + "9" * 5000}), "splits.train: found"),
    (info_of(splits={"train": "٠:١"}), "splits.train: found"),
    (info_of(splits={"train": "-1:1"}), "splits.train: found"),
    (info_of(splits={}), "splits: found episode 0 in no split"),
    (info_of(codebase_version="v9"), "codebase_version: found"),
    (info_of(data_path="/etc/{episode_index}"), "data_path: found"),
]  # fmt: skip


@table(
    ("change", "text", "version"),
    [(*each, VERSIONS[number % 2]) for number, each in enumerate(INFO)],
    ids=[text[:40] for _, text in INFO],
)
def test_info_of_any_numbers(
    change: Callable[[dict[str, Any]], None], text: str, version: str, sets: Path, tmp_path: Path
) -> None:
    root = shutil.copytree(sets / version, tmp_path / "set")
    info = json.loads((root / "meta" / "info.json").read_text("utf-8"))
    change(info)
    (root / "meta" / "info.json").write_text(json.dumps(info), "utf-8")
    _, findings = check_rules(root)
    assert any(text in each for each in findings), findings
    assert all(len(each) < 2_000 for each in findings)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("[" * 100_000, "found 65, expected at most 64"),
        ('{"fps": ' + "9" * 5000 + "}", "found invalid JSON"),
        ('{"fps": NaN}', "found no field 'codebase_version'"),
        ("", "found invalid JSON"),
        ("null", "found null, expected an object"),
        ("{}", "found no field 'codebase_version'"),
    ],
)
def test_info_that_is_no_info(text: str, expected: str, sets: Path, tmp_path: Path) -> None:
    root = shutil.copytree(sets / "v2.1", tmp_path / "set")
    (root / "meta" / "info.json").write_text(text, "utf-8")
    _, findings = check_rules(root)
    assert len(findings) == 1 and expected in findings[0], findings


def test_text_that_is_not_utf_8_is_named(sets: Path, tmp_path: Path) -> None:
    root = shutil.copytree(sets / "v2.1", tmp_path / "set")
    for name, text in (("info.json", b'"unknown"'), ("tasks.jsonl", b"sew"), ("episodes_stats.jsonl", b"mean")):
        path = root / "meta" / name
        data = path.read_bytes()
        path.write_bytes(data.replace(text, text[:2] + b"\xff" + text[3:], 1))
        _, findings = check_rules(root)
        place = data.index(text) + 2
        assert findings == [f"{path}: byte {place}: found 0xff, expected UTF-8"]
        path.write_bytes(data)


# --- the index of the tasks, which LeRobot reads with pandas ----------------------------------------------------------


def test_a_flipped_bit_of_the_tasks_that_pandas_refuses_is_found(sets: Path, tmp_path: Path) -> None:
    pandas = pytest.importorskip("pandas")
    root = shutil.copytree(sets / "v3.0", tmp_path / "set")
    path = root / "meta" / "tasks.parquet"
    data, expected = path.read_bytes(), pandas.read_parquet(path)
    refused = 0
    for at in range(data.index(b"index_columns") - 9, len(data), 5):
        path.write_bytes(data[:at] + bytes([data[at] ^ (0x80 if at % 2 else 1)]) + data[at + 1 :])
        try:
            accepts = bool(pandas.read_parquet(path).equals(expected))
        except (ValueError, TypeError, KeyError, OSError):
            accepts = False
        try:
            found = read_data_set(root).tasks == {0: "sew"}
        except DamagedRecording:
            found = False
        assert accepts or not found, at
        refused += not accepts
    assert refused > 50


@table(
    ("change", "text"),
    [
        ({"index_columns": []}, 'metadata pandas.index_columns: found [], expected ["task"]'),
        ({"column_indexes": []}, "metadata pandas.column_indexes: found [], expected the names [None]"),
        ({"columns": [{}]}, "metadata pandas.columns[0]: found no field 'name', expected one"),
        ({"columns": None}, "metadata pandas.columns: found null, expected an array"),
        (
            {"columns": [dict.fromkeys(("name", "field_name"), "task") | _TYPES]},
            "metadata pandas.columns: found [\"task\"], expected the names ['task', 'task_index']",
        ),
        (
            {"column_indexes": [dict.fromkeys(("name", "field_name")) | _TYPES]},
            "expected None of the type object",
        ),
    ],
)
def test_tasks_without_the_index_that_is_read(change: dict[str, Any], text: str, sets: Path, tmp_path: Path) -> None:
    root = shutil.copytree(sets / "v3.0", tmp_path / "set")
    path = root / "meta" / "tasks.parquet"
    tasks = parquet.read_table(path)
    stated = json.loads(tasks.schema.metadata[b"pandas"]) | change
    parquet.write_table(tasks.replace_schema_metadata({"pandas": json.dumps(stated)}), path)
    _, findings = check_rules(root)
    assert len(findings) == 1 and text in findings[0], findings


# --- lines and tables -----------------------------------------------------------------------------------------------


@table(
    ("name", "line", "text"),
    [
        ("episodes", '{"episode_index": 0, "tasks": ["sew"], "length": 9999999999}', "frames of all episodes: found"),
        ("episodes", '{"episode_index": -1, "tasks": ["sew"], "length": 11}', "episode_index: found -1"),
        ("episodes", '{"episode_index": 0, "tasks": ["sew"], "length": 11.5}', "length: found 11.5"),
        ("episodes", '{"episode_index": 0, "tasks": "sew", "length": 11}', "tasks: found"),
        ("episodes", '{"episode_index": 4611686018427387904, "tasks": ["sew"], "length": 11}', "No such file"),
        ("episodes", "", "found no episode"),
        ("tasks", '{"task_index": ' + "1" * 5000 + "}", "found invalid JSON"),
        ("tasks", '{"task_index": 7, "task": "sew"}', "task_index: found 0, expected the number of 'sew'"),
        ("tasks", '{"task_index": 0, "task": "sew"}\n' * 2, "tasks.jsonl: task_index: found 0, expected each once"),
        (
            "tasks",
            '{"task_index": 0, "task": "sew"}\n{"task_index": 1, "task": "sew"}',
            'task: found "sew", expected each once',
        ),
        ("episodes_stats", '{"episode_index": 0, "stats": {"action": {"mean": [1e400]}}}', "stats of action"),
        ("episodes_stats", '{"episode_index": 0, "stats": {"action": 7}}', "stats.action: found 7"),
        ("episodes_stats", '{"episode_index": 0, "stats": null}', "stats: found null"),
        ("episodes_stats", "", "stats of action: found no min"),
    ],
)
def test_lines_of_version_21(name: str, line: str, text: str, sets: Path, tmp_path: Path) -> None:
    root = shutil.copytree(sets / "v2.1", tmp_path / "set")
    (root / "meta" / f"{name}.jsonl").write_text(line, "utf-8")
    _, findings = check_rules(root)
    assert any(text in each for each in findings), findings


WRONG_STATS = {
    "text": "a",
    "texts": ["1", "2"],
    "nulls": [None] * 7,
    "infinite": [float("inf")] * 7,
    "no number": [float("nan")] * 7,
    "huge": [10**400] * 7,
    "ragged": [[1], [2, 3]],
    "deep": [[[[[1.0]]]]] * 7,
    "short": [1.0],
    "truth": [True] * 7,
    "object": {"a": 1},
}


@table("name", WRONG_STATS)
def test_statistics_of_any_form(name: str, sets: Path, tmp_path: Path) -> None:
    root = shutil.copytree(sets / "v3.0", tmp_path / "set")
    path = root / "meta" / "stats.json"
    stats = json.loads(path.read_text("utf-8"))
    stats["action"]["std"] = WRONG_STATS[name]
    path.write_text(json.dumps(stats), "utf-8")
    _, findings = check_rules(root)
    found = "meta/stats.json: found invalid JSON" if name == "huge" else "meta/stats.json: action: std: found"
    assert any(found in each for each in findings), findings


def with_column(path: Path, name: str, values: pa.Array | None) -> None:
    """Replace a column of a table, or drop it."""
    table = parquet.read_table(path, partitioning=None)
    if values is None:
        table = table.drop_columns([name])
    elif name in table.schema.names:
        table = table.set_column(table.schema.names.index(name), name, values)
    else:
        table = table.append_column(name, values)
    parquet.write_table(table, path)


ROWS = 11
COLUMNS: list[tuple[str, pa.Array | None, str]] = [
    ("observation.state", None, "found no column 'observation.state'"),
    ("observation.state", pa.array(["x"] * ROWS), "observation.state: found string"),
    ("observation.state", pa.array([[1.0]] * ROWS), "observation.state: found list<"),
    ("observation.state", pa.nulls(ROWS), "observation.state: found null"),
    ("observation.state", pa.array([{"a": 1}] * ROWS), "observation.state: found struct<"),
    (
        "observation.state",
        pa.array([[0.0] * 6] * ROWS, pa.list_(pa.float32(), 6)),
        "observation.state: found lists of 6, expected 7",
    ),
    ("observation.state", pa.array([[1e308] * 7] * ROWS, pa.list_(pa.float64(), 7)), "observation.state: found"),
    ("observation.state", pa.array([[float("inf")] * 7] * ROWS, pa.list_(pa.float32(), 7)), "not finite"),
    ("action", pa.array([None] * ROWS, pa.list_(pa.float32(), 7)), "action: found 11 missing values"),
    ("timestamp", pa.array([float("nan")] * ROWS, pa.float32()), "timestamp: found values that are not finite"),
    ("timestamp", pa.array([-1e30] * ROWS, pa.float32()), "timestamp: frame 0: found -1"),
    ("timestamp", pa.array([None] * ROWS, pa.float32()), "timestamp: found 11 missing values"),
    ("index", pa.array([-1] * ROWS), "index: frame 0: found -1, expected 0"),
    ("index", pa.array([2**63 - 1] * ROWS), "index: frame 0: found 9223372036854775807"),
    ("task_index", pa.array([-5] * ROWS), "task_index: found -5"),
    ("task_index", pa.array([0.5] * ROWS), "task_index: found double"),
    ("more", pa.array([b"\xff"] * ROWS), "found the column 'more'"),
]


@pytest.mark.slow
@table(
    ("name", "values", "text", "version"),
    [(*each, VERSIONS[number % 2]) for number, each in enumerate(COLUMNS)],
    ids=[text[:40] for _, _, text in COLUMNS],
)
def test_columns_of_any_type(
    name: str, values: pa.Array | None, text: str, version: str, sets: Path, tmp_path: Path
) -> None:
    root = shutil.copytree(sets / version, tmp_path / "set")
    with_column(root / DATA[version], name, values)
    path = sets / "s.mcap"
    assert main(["export", str(path), "--to", "lerobot", "--check", str(root), "--json"]) == 1
    _, findings = check_rules(root)
    assert any(text in each for each in findings), findings


EPISODE_COLUMNS: list[tuple[str, pa.Array | None, str]] = [
    ("length", pa.array([None], pa.int64()), "length: found null"),
    ("length", pa.array([2**62]), "frames of all episodes: found"),
    ("length", None, "found no column length"),
    ("tasks", pa.array([[None]], pa.list_(pa.string())), "tasks[0]: found null"),
    ("tasks", pa.array([["a"] * 100_000]), "tasks: found 100,000 values"),
    ("episode_index", pa.array([-1]), "episode_index: found -1"),
    ("data/chunk_index", pa.array([None], pa.int64()), "data/chunk_index: found null"),
    ("data/file_index", pa.array([2**60]), "No such file"),
    ("dataset_to_index", pa.array([-11]), "dataset_to_index: found -11"),
    ("dataset_from_index", pa.array([50]), "expected increasing frame numbers"),
    ("dataset_to_index", pa.array([5]), "found 5 rows, expected 11"),
    ("videos/observation.images.view/chunk_index", pa.array([None], pa.int64()), "chunk_index: found null"),
    ("videos/observation.images.view/from_timestamp", pa.array([float("nan")]), "expected from_timestamp and"),
    ("videos/observation.images.view/to_timestamp", pa.array([None], pa.float64()), "expected from_timestamp and"),
    ("stats/action/mean", pa.array([None], pa.list_(pa.float64())), "stats of action: found no mean"),
    ("stats/action/mean", pa.array([[None] * 7], pa.list_(pa.float64())), "action: mean: found no numbers"),
    ("stats/action/mean", pa.array([np.zeros(2 * MIB)]), "stats of action: found no mean"),
    ("stats/action/mean", pa.array(["x"]), "action: mean: found no numbers"),
]


@table(("name", "values", "text"), EPISODE_COLUMNS, ids=[text[:40] for _, _, text in EPISODE_COLUMNS])
def test_episodes_of_version_30(
    name: str, values: pa.Array | None, text: str, sets: Path, tmp_path: Path
) -> None:  # fmt: skip
    root = shutil.copytree(sets / "v3.0", tmp_path / "set")
    with_column(root / EPISODES, name, values)
    _, findings = check_rules(root)
    assert any(text in each for each in findings), findings


def test_a_set_without_episodes(sets: Path, tmp_path: Path) -> None:
    root = shutil.copytree(sets / "v3.0", tmp_path / "set")
    parquet.write_table(parquet.read_table(root / EPISODES).slice(0, 0), root / EPISODES)
    _, findings = check_rules(root)
    assert any("found no episode, expected one or more" in each for each in findings), findings
    shutil.rmtree(root / "meta" / "episodes")
    assert any("found no episode, expected one or more" in each for each in check_rules(root)[1])


def test_a_small_table_of_many_wrong_episodes_is_soon_read(
    sets: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each looked for its data again, and each had its findings."""
    root, count = shutil.copytree(sets / "v3.0", tmp_path / "set"), 1_500
    one = parquet.read_table(root / EPISODES).slice(0, 1)
    many = pa.concat_tables([one] * count).set_column(
        one.schema.get_field_index("episode_index"), "episode_index", pa.array(range(count))
    )
    parquet.write_table(many.combine_chunks(), root / EPISODES)
    (root / DATA["v3.0"]).write_bytes(b"PAR1" + bytes(100) + b"PAR1")
    read: list[Path] = []

    def counted(path: Path) -> pa.Table:
        read.append(path)
        return read_table(path)

    monkeypatch.setattr(columns, "read_table", counted)
    _, findings = check_rules(root)
    assert len(findings) == 1001 and findings[-1] == "found more than 1,000 findings: no more are looked for"
    assert len(read) == 1


def test_the_work_for_a_set_is_bounded_by_its_bytes(sets: Path, tmp_path: Path) -> None:
    """The holes of a sparse file are no bytes: to hash a terabyte of them took hours."""
    root = shutil.copytree(sets / "v3.0", tmp_path / "set")
    huge(root / VIEW["v3.0"])
    with limits_in_force(FileLimits(seconds=1)), pytest.raises(LimitExceeded, match="expected at most 1 s"):
        check_rules(root)


# --- other things than files


def fifo(path: Path) -> None:
    os.mkfifo(path)


def device(path: Path) -> None:
    path.symlink_to("/dev/zero")


def folder(path: Path) -> None:
    path.mkdir()


def link_to_itself(path: Path) -> None:
    path.symlink_to(path.name)


def huge(path: Path) -> None:
    with path.open("wb") as file:
        file.truncate(1 << 40)


def other_format(path: Path) -> None:
    path.write_text(f"ffconcat version 1.0\nfile {path.parent}/other.mp4\n", "utf-8")


def playlist(path: Path) -> None:
    path.write_text("#EXTM3U\n#EXTINF:1,\nhttp://127.0.0.1:9/a.ts\n#EXT-X-ENDLIST\n", "utf-8")


def nothing(path: Path) -> None:
    path.write_bytes(b"")


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="a system with FIFOs")
@table(
    ("place", "text"),
    [
        (fifo, "found a FIFO, expected a file"),
        (device, "found a device, expected a file"),
        (folder, "found a folder, expected a file"),
        (link_to_itself, "Too many levels of symbolic links"),
        (huge, "cannot be decoded"),
        (other_format, "cannot be decoded"),
        (playlist, "cannot be decoded"),
        (nothing, "cannot be decoded"),
    ],
)
@table("version", VERSIONS)
def test_a_video_that_is_none(
    place: Callable[[Path], None], text: str, version: str, sets: Path, tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    root = shutil.copytree(sets / version, tmp_path / "set")
    path = root / VIEW[version]
    path.unlink()
    place(path)
    (root / "meta" / "SHA256SUMS").unlink()  # a terabyte of zeros takes its time
    assert main(["export", str(sets / "s.mcap"), "--to", "lerobot", "--check", str(root)]) == 1
    out = capsys.readouterr().out
    assert any(path.name in line and text in line for line in out.splitlines()), out


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="a system with FIFOs")
@pytest.mark.parametrize(
    "name",
    [
        "meta/info.json", "meta/README.md", "meta/SHA256SUMS", "meta/recipe.toml", "meta/stats.json", EPISODES,
        DATA["v3.0"],
    ],
)  # fmt: skip
def test_a_fifo_anywhere(name: str, sets: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    root = shutil.copytree(sets / "v3.0", tmp_path / "set")
    (root / name).unlink()
    os.mkfifo(root / name)
    assert main(["export", str(sets / "s.mcap"), "--to", "lerobot", "--check", str(root)]) == 1
    assert "found a FIFO, expected a file" in capsys.readouterr().out


# --- bombs ----------------------------------------------------------------------------------------------------------


def zeros(path: Path) -> None:
    with_column(path, "observation.state", None)
    table = parquet.read_table(path, partitioning=None)
    big = pa.table({name: pa.array(np.zeros(MIB, np.float32)) for name in table.schema.names})
    parquet.write_table(big, path)


def one_long_row(path: Path) -> None:
    values = pa.array([np.zeros(8 * MIB, np.float32)] + [None] * (ROWS - 1), pa.list_(pa.float32()))
    with_column(path, "action", values)


def repeated_text(path: Path) -> None:
    texts = pa.DictionaryArray.from_arrays(np.zeros(20_000, np.int32), ["x" * 10_000])
    values = pa.ListArray.from_arrays(pa.array([0, *([20_000] * ROWS)], pa.int32()), texts)
    with_column(path, "more", values)


@pytest.mark.parametrize("bomb", [zeros, one_long_row, repeated_text], ids=lambda each: each.__name__)
@pytest.mark.parametrize("version", VERSIONS)
def test_bombs_end_at_a_limit(bomb: Callable[[Path], None], version: str, sets: Path, tmp_path: Path) -> None:
    root = shutil.copytree(sets / version, tmp_path / "set")
    bomb(root / DATA[version])
    with limits_in_force(FileLimits(memory=16 * MIB, free=2 * MIB, ratio=10)):
        _, findings = check_rules(root)
    assert any("expected at most" in each and "--limit" in each for each in findings), findings
