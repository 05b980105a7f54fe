"""The check of a data set finds what is wrong in it: each case damages a good set in one place."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import av
import numpy as np
import pyarrow as pa
import pytest
from pyarrow import parquet

from igtl_gateway.lerobot.comparing import check
from igtl_gateway.lerobot.export import export_lerobot
from tests.lerobot.sessions import TRIAL_RECIPE, trial_messages, write_session

VERSIONS = ("v2.1", "v3.0")
DATA = {"v2.1": "data/chunk-000/episode_000000.parquet", "v3.0": "data/chunk-000/file-000.parquet"}
LEFT = {
    "v2.1": "videos/chunk-000/observation.images.left/episode_000000.mp4",
    "v3.0": "videos/observation.images.left/chunk-000/file-000.mp4",
}


@pytest.fixture(scope="module")
def sets(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a recording and a data set of each format."""
    folder = tmp_path_factory.mktemp("sets")
    path = write_session(folder / "trials.mcap", trial_messages())
    for version in VERSIONS:
        recipe = folder / f"{version}.toml"
        recipe.write_text(TRIAL_RECIPE.format(format=version, lags="false"), "utf-8")
        export_lerobot(path, recipe, folder / version)
    return folder


def changed_table(path: Path, change: Callable[[dict[str, list[Any]]], None]) -> None:
    table = parquet.read_table(path)
    columns = table.to_pydict()
    change(columns)
    arrays = [pa.array(columns[field.name], field.type) for field in table.schema]
    parquet.write_table(pa.Table.from_arrays(arrays, schema=table.schema), path)


def shifted_state(root: Path, version: str) -> None:
    def change(columns: dict[str, list[Any]]) -> None:
        columns["observation.state"][7] = columns["observation.state"][8]

    changed_table(root / DATA[version], change)


def shifted_stamp(root: Path, version: str) -> None:
    def change(columns: dict[str, list[Any]]) -> None:
        columns["timestamp"][7] += 0.04

    changed_table(root / DATA[version], change)


def not_a_number(root: Path, version: str) -> None:
    def change(columns: dict[str, list[Any]]) -> None:
        columns["action"][3] = [float("nan")] * 14

    changed_table(root / DATA[version], change)


def shifted_picture(root: Path, version: str) -> None:
    """Frame 5 of a video shows the picture of frame 6."""
    path = root / LEFT[version]
    with av.open(str(path)) as file:
        pictures = [frame.to_ndarray(format="rgb24") for frame in file.decode(video=0)]
    pictures[5] = pictures[6]
    with av.open(str(path), "w") as file:
        stream = file.add_stream("libx264", rate=20, options={"crf": "18", "bf": "0"})
        stream.height, stream.width, stream.pix_fmt = 48, 64, "yuv420p"
        for picture in pictures:
            file.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")))
        file.mux(stream.encode(None))


def changed_info(root: Path, change: Callable[[dict[str, Any]], None]) -> None:
    path = root / "meta" / "info.json"
    info = json.loads(path.read_text("utf-8"))
    change(info)
    path.write_text(json.dumps(info), "utf-8")


def wrong_total(root: Path, _version: str) -> None:
    changed_info(root, lambda info: info.update(total_frames=info["total_frames"] + 1))


def wrong_split(root: Path, _version: str) -> None:
    changed_info(root, lambda info: info.update(splits={"train": "0:3"}))


def climbing_path(root: Path, _version: str) -> None:
    changed_info(root, lambda info: info.update(data_path="../../{episode_index}.parquet"))


def extra_column(root: Path, version: str) -> None:
    table = parquet.read_table(root / DATA[version])
    parquet.write_table(table.append_column("secret", pa.array(np.arange(table.num_rows))), root / DATA[version])


def no_stats(root: Path, version: str) -> None:
    if version == "v2.1":
        path = root / "meta" / "episodes_stats.jsonl"
        rows = [json.loads(line) for line in path.read_text("utf-8").splitlines()]
        del rows[0]["stats"]["action"]
        path.write_text("".join(json.dumps(row) + "\n" for row in rows), "utf-8")
    else:
        path = root / "meta/episodes/chunk-000/file-000.parquet"
        table = parquet.read_table(path)
        names = [name for name in table.schema.names if not name.startswith("stats/action/")]
        parquet.write_table(table.select(names), path)


def no_total_stats(root: Path, _version: str) -> None:
    (root / "meta" / "stats.json").unlink()


def no_video(root: Path, version: str) -> None:
    (root / LEFT[version]).unlink()


def no_parquet(root: Path, version: str) -> None:
    (root / DATA[version]).write_bytes(b"PAR1 is not enough")


def other_entry(root: Path, _version: str) -> None:
    def change(columns: dict[str, list[Any]]) -> None:
        columns["observation.images.left[0].entry"][4] += 1

    changed_table(root / "meta" / "provenance.parquet", change)


#: Damage, what is found, and in which formats: each takes half a second.
CASES: list[tuple[Callable[[Path, str], None], str, tuple[str, ...]]] = [
    (shifted_state, "episode 0: observation.state: frame 7: found [", VERSIONS),
    (shifted_stamp, "episode 0: timestamp: frame 7: found 0.39", ("v3.0",)),
    (not_a_number, "episode 0: action: found values that are not finite", ("v2.1",)),
    (shifted_picture, "episode 0: observation.images.left: frame 5: found the picture of entry", VERSIONS),
    (wrong_total, "total_frames: found", ("v2.1",)),
    (wrong_split, "splits.train: found '0:3'", ("v3.0",)),
    (climbing_path, "data_path: found", ("v2.1",)),
    (extra_column, "found the column 'secret'", ("v2.1",)),
    (no_stats, "stats of action: found no min, max", VERSIONS),
    (no_total_stats, "meta/stats.json: No such file", ("v3.0",)),
    (no_video, "No such file", ("v3.0",)),
    (no_parquet, "is not valid Parquet", ("v2.1",)),
    (other_entry, "observation.images.left[0].entry: row 4", ("v2.1",)),
]


@pytest.mark.parametrize(
    ("damage", "text", "version"),
    [(damage, text, version) for damage, text, versions in CASES for version in versions],
)
def test_damage_is_found(
    damage: Callable[[Path, str], None], text: str, version: str, sets: Path, tmp_path: Path
) -> None:
    root = tmp_path / "set"
    shutil.copytree(sets / version, root)
    damage(root, version)
    _, findings = check(root, sets / "trials.mcap")
    assert any(text in each for each in findings), findings
    assert len(findings) <= 6, findings
