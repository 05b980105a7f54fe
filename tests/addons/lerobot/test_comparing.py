"""The check of a data set finds what is wrong in it: each case damages a good set in one place."""

from __future__ import annotations

import hashlib
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

from igtl_gateway.addon.untrusted import Deadline
from igtl_gateway.addons.lerobot.checksums import check_checksums, write_checksums
from igtl_gateway.addons.lerobot.comparing import check
from igtl_gateway.addons.lerobot.export import export_lerobot
from igtl_gateway.addons.lerobot.video import VideoFile
from igtl_gateway.wire.image import Image
from tests.addons.lerobot.sessions import TRIAL_RECIPE, Sent, arm, trial_messages, write_session

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


def changed_stats(root: Path, version: str, name: str, change: Callable[[dict[str, Any]], None]) -> None:
    """Change the statistics of a feature: of the whole set in v3.0, of episode 1 in v2.1."""
    if version == "v3.0":
        path = root / "meta" / "stats.json"
        stats = json.loads(path.read_text("utf-8"))
        change(stats[name])
        path.write_text(json.dumps(stats), "utf-8")
    else:
        path = root / "meta" / "episodes_stats.jsonl"
        rows = [json.loads(line) for line in path.read_text("utf-8").splitlines()]
        change(rows[1]["stats"][name])
        path.write_text("".join(json.dumps(row) + "\n" for row in rows), "utf-8")


def wrong_mean(root: Path, version: str) -> None:
    changed_stats(root, version, "observation.state", lambda each: each.update(mean=[99.0] * 14, std=[0.0] * 14))


def wrong_count(root: Path, version: str) -> None:
    changed_stats(root, version, "action", lambda each: each.update(count=[7]))


def wrong_quantile(root: Path, version: str) -> None:
    changed_stats(root, version, "observation.state", lambda each: each["q50"].__setitem__(0, each["q90"][0]))


def wrong_picture_mean(root: Path, version: str) -> None:
    changed_stats(root, version, "observation.images.left", lambda each: each.update(mean=[[[0.9]]] * 3))


def slightly_wrong_picture_mean(root: Path, version: str) -> None:
    def change(stats: dict[str, Any]) -> None:
        stats["mean"] = [[[each[0][0] + 1e-4]] for each in stats["mean"]]

    changed_stats(root, version, "observation.images.left", change)


def stats_of_an_episode(root: Path, _version: str) -> None:
    def change(columns: dict[str, list[Any]]) -> None:
        columns["stats/observation.state/mean"][1][0] += 0.01
        columns["stats/observation.images.left/std"][1][0] = [[0.0]]

    changed_table(root / "meta/episodes/chunk-000/file-000.parquet", change)


def overlapping_splits(root: Path, _version: str) -> None:
    changed_info(root, lambda info: info.update(splits={"train": "0:2", "val": "1:2"}))


def episode_in_no_split(root: Path, _version: str) -> None:
    changed_info(root, lambda info: info.update(splits={"train": "0:1"}))


def coded_again(root: Path, version: str, change: Callable[[list[Any]], None]) -> None:
    """The video with other pictures, and a list of checksums that fits."""
    path = root / LEFT[version]
    with av.open(str(path)) as file:
        pictures = [frame.to_ndarray(format="rgb24") for frame in file.decode(video=0)]
    change(pictures)
    with av.open(str(path), "w") as file:
        stream = file.add_stream("libx264", rate=20, options={"crf": "18", "bf": "0"})
        stream.height, stream.width, stream.pix_fmt = 48, 64, "yuv420p"
        for picture in pictures:
            file.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")))
        file.mux(stream.encode(None))
    write_checksums(root)


def shifted_picture(root: Path, version: str) -> None:
    """Frame 5 of a video shows the picture of frame 6."""
    coded_again(root, version, lambda pictures: pictures.__setitem__(5, pictures[6]))


def small_spot(root: Path, version: str) -> None:
    """An instrument of 6 pixels is missing in one frame."""
    coded_again(root, version, lambda pictures: pictures[3].__setitem__((slice(20, 26), slice(30, 36)), 255))


def flipped_byte(root: Path, version: str) -> None:
    path = root / LEFT[version]
    data = bytearray(path.read_bytes())
    data[data.index(b"mdat") + 900] ^= 0x10
    path.write_bytes(data)


def flipped_byte_of_the_card(root: Path, _version: str) -> None:
    path = root / "meta" / "SYNCHRONIZATION.md"
    path.write_bytes(path.read_bytes().replace(b"positive", b"negative"))


def no_checksums(root: Path, _version: str) -> None:
    (root / "meta" / "SHA256SUMS").unlink()


def climbing_checksums(root: Path, _version: str) -> None:
    path = root / "meta" / "SHA256SUMS"
    path.write_text(path.read_text("utf-8") + f"{'0' * 64}  ../../secret\n", "utf-8")


def unlisted_file(root: Path, _version: str) -> None:
    (root / "meta" / "more.json").write_text("{}", "utf-8")


def null_cell(root: Path, version: str) -> None:
    def change(columns: dict[str, list[Any]]) -> None:
        columns["observation.state"][2] = None

    changed_table(root / DATA[version], change)


def null_number(root: Path, version: str) -> None:
    def change(columns: dict[str, list[Any]]) -> None:
        columns["observation.state"][2] = [*columns["observation.state"][2][:-1], None]

    changed_table(root / DATA[version], change)


def null_in_the_provenance(root: Path, _version: str) -> None:
    def change(columns: dict[str, list[Any]]) -> None:
        columns["time_ns"][4] = None

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
    (wrong_mean, "stats of observation.state: mean: found [99, 99", ("v2.1",)),
    (wrong_mean, "meta/stats.json: observation.state: mean: found [99, 99", ("v3.0",)),
    (wrong_count, "action: count: found [7], expected", VERSIONS),
    (wrong_quantile, "meta/stats.json: observation.state: q50: found", ("v3.0",)),
    (wrong_picture_mean, "observation.images.left: mean: found [0.9, 0.9, 0.9]", VERSIONS),
    (slightly_wrong_picture_mean, "observation.images.left: mean: found [[[0.", VERSIONS),
    (stats_of_an_episode, "episode 1: stats of observation.state: mean: found", ("v3.0",)),
    (stats_of_an_episode, "episode 1: stats of observation.images.left: std: found [0, ", ("v3.0",)),
    (overlapping_splits, "splits.val: found episode 1, which is in train, expected one split", ("v2.1",)),
    (episode_in_no_split, "splits: found episode 1 in no split (1 in none)", ("v3.0",)),
    (small_spot, "observation.images.left: frame 3: found a mean squared difference of", VERSIONS),
    (flipped_byte, ".mp4: found another SHA-256", VERSIONS),
    (flipped_byte_of_the_card, "meta/SYNCHRONIZATION.md: found another SHA-256", ("v2.1",)),
    (no_checksums, "meta/SHA256SUMS: No such file", ("v3.0",)),
    (climbing_checksums, "found '0000", ("v2.1",)),
    (unlisted_file, "meta/more.json: found a file that meta/SHA256SUMS does not list", ("v3.0",)),
    (null_cell, "observation.state: found 1 missing value", VERSIONS),
    (null_number, "observation.state: found 1 missing value", ("v2.1",)),
    (null_in_the_provenance, "time_ns: found missing values or no numbers", ("v2.1",)),
]


@pytest.mark.slow
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
    findings = check(root, [sets / "trials.mcap"]).findings
    assert any(text in each for each in findings), findings
    assert len(findings) <= 6, findings


@pytest.mark.parametrize("version", VERSIONS)
def test_every_flipped_byte_is_found(version: str, sets: Path, tmp_path: Path) -> None:
    """In any file of a set, also where no decoder sees it."""
    root = tmp_path / "set"
    shutil.copytree(sets / version, root)
    random = np.random.default_rng(5)
    files = sorted(path for path in root.rglob("*") if path.is_file())
    assert len(files) > 8
    for path in files:
        data = path.read_bytes()
        changed = bytearray(data)
        changed[int(random.integers(0, len(data)))] ^= 1 << int(random.integers(0, 8))
        path.write_bytes(changed)
        assert list(check_checksums(root, Deadline(0))), path
        path.write_bytes(data)
    assert not list(check_checksums(root, Deadline(0)))


def test_the_checksums_are_those_of_sha256sum(sets: Path) -> None:
    lines = (sets / "v3.0" / "meta" / "SHA256SUMS").read_text("utf-8").splitlines()
    for line in lines:
        digest, name = line.split("  ", 1)
        assert hashlib.sha256((sets / "v3.0" / name).read_bytes()).hexdigest() == digest
    assert len(lines) == sum(path.is_file() for path in (sets / "v3.0").rglob("*")) - 1


def test_noise_is_within_the_loss_of_the_codec(tmp_path: Path) -> None:
    """What no codec keeps, noise in colour, is no finding; one frame of other noise is."""
    random = np.random.default_rng(3)
    noise = [random.integers(0, 256, (48, 64, 3), np.uint8) for _ in range(12)]
    path = picture_set(tmp_path, noise)
    assert check(tmp_path / "set", [path]).findings == []
    view = tmp_path / "set/videos/chunk-000/observation.images.noise/episode_000000.mp4"
    other = VideoFile(tmp_path / "other.mp4", (48, 64), 10, "h264")
    for number, each in enumerate(noise[:11]):
        other.add(random.integers(0, 256, (48, 64, 3), np.uint8) if number == 4 else each)
    other.close()
    shutil.copy(other.path, view)
    found = [each for each in check(tmp_path / "set", [path]).findings if "SHA-256" not in each]
    assert any("observation.images.noise: frame 4: found a mean squared" in each for each in found), found


def test_an_even_change_that_the_codec_leaves_out_is_no_other_picture(tmp_path: Path) -> None:
    """It keeps the blue of a frame before, which another frame then has."""
    path = picture_set(tmp_path, [np.full((30, 44, 3), (250, 10, number), np.uint8) for number in range(40)])
    assert check(tmp_path / "set", [path]).findings == []


def picture_set(folder: Path, pictures: list[Any]) -> Path:
    """Write a recording with pictures (rows, columns, 3) at 10 Hz, and its data set beside it."""
    messages: list[Sent] = [(0.05 * n, "TRANSFORM/Arm0ToBase", arm(0.05 * n, 0)) for n in range(2 * len(pictures))]
    for number, each in enumerate(pictures):
        size = (each.shape[1], each.shape[0], 1)
        messages.append((0.1 * number, "IMAGE/Noise", Image(size, 3, each.tobytes(), num_components=3)))
    path = write_session(folder / "s.mcap", sorted(messages, key=lambda each: each[0]))
    recipe = folder / "r.toml"
    recipe.write_text(NOISE, "utf-8")
    export_lerobot(path, recipe, folder / "set")
    return path


NOISE = """\
[dataset]
fps = 10
task = "none"
measure_lags = false
[[feature]]
name = "observation.state"
stream = "TRANSFORM/Arm0ToBase"
[[feature]]
name = "observation.images.noise"
stream = "IMAGE/Noise"
[[feature]]
name = "action"
next_of = "observation.state"
"""
