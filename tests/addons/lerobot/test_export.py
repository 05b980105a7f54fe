"""Data sets of both formats, read again by pyarrow, PyAV and json alone, and compared with what was sent."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest
from pyarrow import parquet

import igtl_gateway
from igtl_gateway.addons.lerobot.export import export_lerobot
from igtl_gateway.cli import main
from tests.addons.lerobot.sessions import (
    BEGIN_NS,
    TRIAL_RECIPE,
    Sent,
    arm,
    number_of,
    pose_m,
    quaternion,
    trial_messages,
    write_session,
)
from tests.places import FIXTURES
from tests.plus_sequences import ultrasound_of_old
from tests.tables import table

FPS = 20
STATISTICS = {"min", "max", "mean", "std", "count"}


@pytest.fixture(scope="module")
def messages() -> list[Sent]:
    return trial_messages()


@pytest.fixture(scope="module")
def recording(messages: list[Sent], tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_session(tmp_path_factory.mktemp("trials") / "trials.mcap", messages)


def lines(path: Path) -> list[Any]:
    return [json.loads(line) for line in path.read_text("utf-8").splitlines()]


def frames_of(path: Path) -> tuple[list[float], list[Any]]:
    with av.open(str(path)) as file:
        found = [(float(frame.time), frame.to_ndarray(format="rgb24")) for frame in file.decode(video=0)]
    return [at for at, _ in found], [picture for _, picture in found]


def episodes_of(root: Path) -> list[dict[str, Any]]:
    """Rows, tasks, videos and statistics of each episode, as the format describes their places."""
    info = json.loads((root / "meta" / "info.json").read_text("utf-8"))
    videos = [name for name, each in info["features"].items() if each["dtype"] == "video"]
    found = []
    if info["codebase_version"] == "v2.1":
        stats = lines(root / "meta" / "episodes_stats.jsonl")
        for row in lines(root / "meta" / "episodes.jsonl"):
            index = row["episode_index"]
            place = {"episode_chunk": 0, "episode_index": index}
            table = parquet.read_table(root / info["data_path"].format(**place))
            pictures = {name: frames_of(root / info["video_path"].format(**place, video_key=name)) for name in videos}
            found.append(row | {"table": table, "videos": pictures, "stats": stats[index]["stats"]})
        return found
    for row in parquet.read_table(root / "meta/episodes/chunk-000/file-000.parquet").to_pylist():
        data = parquet.read_table(
            root / info["data_path"].format(chunk_index=row["data/chunk_index"], file_index=row["data/file_index"])
        )
        table = data.slice(row["dataset_from_index"], row["dataset_to_index"] - row["dataset_from_index"])
        pictures = {}
        for name in videos:
            chunk, file = row[f"videos/{name}/chunk_index"], row[f"videos/{name}/file_index"]
            path = info["video_path"].format(video_key=name, chunk_index=chunk, file_index=file)
            first, last = (row[f"videos/{name}/{each}_timestamp"] for each in ("from", "to"))
            both = list(zip(*frames_of(root / path), strict=True))
            own = [(at - first, picture) for at, picture in both if first - 1e-6 <= at < last - 1e-6]
            pictures[name] = [at for at, _ in own], [picture for _, picture in own]
        own_stats: dict[str, dict[str, Any]] = {}
        for key, value in row.items():
            if key.startswith("stats/"):
                own_stats.setdefault(key.split("/")[1], {})[key.split("/")[2]] = value
        found.append(row | {"table": table, "videos": pictures, "stats": own_stats})
    return found


def times_of(messages: list[Sent], stream: str) -> list[int]:
    return [BEGIN_NS + round(at * 1e9) for at, name, _ in messages if name == stream]


@pytest.mark.slow
@pytest.mark.parametrize("version", ["v2.1", "v3.0"])
def test_two_arms_and_two_cameras(
    version: str, recording: Path, messages: list[Sent], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    recipe, root = tmp_path / "recipe.toml", tmp_path / "set"
    recipe.write_text(TRIAL_RECIPE.format(format=version, lags=str(version == "v2.1").lower()), "utf-8")
    assert main(["export", str(recording), "--to", "lerobot", "--recipe", str(recipe), "-o", str(root)]) == 0
    info = json.loads((root / "meta" / "info.json").read_text("utf-8"))
    episodes = episodes_of(root)
    assert [each["tasks"] for each in episodes] == [["left knot"], ["right knot"]]
    lengths = [each["length"] for each in episodes]
    assert (info["total_episodes"], info["total_frames"]) == (2, sum(lengths))
    assert (info["fps"], info["robot_type"], info["total_tasks"]) == (FPS, "two arms", 2)
    assert info["splits"] == {"train": "0:1", "val": "1:2"}
    assert info["features"]["observation.images.right"]["shape"] == [50, 66, 3]  # odd sizes are extended
    assert info["features"]["observation.state.joint_positions"]["names"] == ["yaw.position", "pitch.position"]
    trace = parquet.read_table(root / "meta" / "provenance.parquet")
    assert trace.num_rows == sum(lengths)
    left, right = (np.array(times_of(messages, name)) for name in ("IMAGE/Left", "/right/image"))
    index = 0
    for number, episode in enumerate(episodes):
        table, count = episode["table"], episode["length"]
        assert table.num_rows == count and count in (19, 17, 18, 20)  # 1 s and 0.9 s, and the last has no next
        assert set(table.schema.names) == {n for n, each in info["features"].items() if each["dtype"] != "video"}
        columns = table.to_pydict()
        assert columns["frame_index"] == list(range(count)) and columns["episode_index"] == [number] * count
        assert columns["index"] == list(range(index, index + count)) and columns["task_index"] == [number] * count
        assert columns["timestamp"] == [float(np.float32(frame / FPS)) for frame in range(count)]
        moments = trace["time_ns"].to_pylist()[index : index + count]
        assert [at - moments[0] for at in moments] == [frame * 50_000_000 for frame in range(count)]
        begin = BEGIN_NS + round((0.5, 1.8)[number] * 1e9)
        assert 0 <= moments[0] - begin < 1_000_000
        for frame, at_ns in enumerate(moments):
            at = (at_ns - BEGIN_NS) / 1e9
            for name, when in (("observation.state", at), ("action", at + 1 / FPS)):
                expected = [value for each in (0, 1) for value in (*pose_m(when, each)[:3, 3], *quaternion(when, each))]
                # jitter of the stamps is that of the wire, 0.2 ns; positions are float32 millimetres
                assert np.allclose(columns[name][frame], expected, atol=1e-6), (name, frame)
            held = np.floor((at - 0.003) * 50 + 1e-6) / 50 + 0.003
            assert np.allclose(
                columns["observation.state.joint_positions"][frame], [0.5 * held, 1 - 0.25 * held], atol=1e-6
            )
            assert number_of(episode["videos"]["observation.images.left"][1][frame]) == np.argmin(np.abs(left - at_ns))
            blue = episode["videos"]["observation.images.right"][1][frame]
            newest = np.flatnonzero(right <= at_ns)[-1]
            assert number_of(blue[:, :64, 2] * 2.0) == newest and blue[:, :, 0].mean() < 60
        assert set(columns["observation.meta.trial"]) == {("start: left knot", "start right knot")[number]}
        for name in ("observation.images.left", "observation.images.right"):
            assert np.allclose(episode["videos"][name][0], np.arange(count) / FPS, atol=1e-6)
            assert np.shape(episode["stats"][name]["mean"]) == (3, 1, 1)
        for name, stats in episode["stats"].items():
            assert set(stats) == STATISTICS | ({"q01", "q10", "q50", "q90", "q99"} if version == "v3.0" else set()), (
                name
            )
        state = np.array(columns["observation.state"])
        assert np.allclose(episode["stats"]["observation.state"]["std"], state.std(axis=0), atol=1e-6)
        index += count
    if version == "v3.0":
        total = json.loads((root / "meta" / "stats.json").read_text("utf-8"))
        every = np.concatenate([np.array(each["table"]["observation.state"].to_pylist()) for each in episodes])
        assert np.allclose(total["observation.state"]["mean"], every.mean(axis=0), atol=1e-6)
        tasks = parquet.read_table(root / "meta" / "tasks.parquet").to_pandas()
        assert tasks.index.name == "task" and tasks["task_index"].to_dict() == {"left knot": 0, "right knot": 1}
    card = (root / "meta" / "README.md").read_text("utf-8") + (root / "meta" / "SYNCHRONIZATION.md").read_text("utf-8")
    assert "CC BY 4.0" in card and "institution: not stated" in card and "## Lags" in card
    capsys.readouterr()
    assert main(["export", str(recording), "--to", "lerobot", "--check", str(root)]) == 0
    assert "0 findings" in capsys.readouterr().out


def test_every_frame_names_its_messages(recording: Path, tmp_path: Path) -> None:
    """The entry numbers are those of messages that Python reads, with the values that the frames have."""
    recipe, root = tmp_path / "recipe.toml", tmp_path / "set"
    recipe.write_text(TRIAL_RECIPE.format(format="v2.1", lags="false"), "utf-8")
    export_lerobot(recording, recipe, root)
    card = (root / "meta" / "SYNCHRONIZATION.md").read_text("utf-8")
    told = card.partition("## Episodes with streams that were not aligned")[2]
    assert all(f"| {number} | `" in told and "(lag unknown)" in told for number in (0, 1))
    assert "streams that were not aligned: 2 of 2" in (root / "meta" / "README.md").read_text("utf-8")
    trace = parquet.read_table(root / "meta" / "provenance.parquet").to_pydict()
    values = parquet.read_table(root / "data/chunk-000/episode_000000.parquet").to_pydict()
    with igtl_gateway.open(recording) as opened:
        poses = opened["TRANSFORM/Arm0ToBase"].poses().in_unit("m")
        rows = {number: row for row, number in enumerate(opened["TRANSFORM/Arm0ToBase"].numbers.tolist())}
        for frame, state in enumerate(values["observation.state"]):
            before, after = (rows[trace[f"observation.state[0].{name}"][frame]] for name in ("entry", "entry_after"))
            assert after == before + 1
            assert trace["observation.state[0].stamp_ns"][frame] == poses.source_times[before]
            span = poses.source_times[after] - poses.source_times[before]
            share = (trace["time_ns"][frame] - poses.source_times[before]) / span
            assert share == pytest.approx(trace["observation.state[0].share"][frame])
            between = poses.positions[before] + share * (poses.positions[after] - poses.positions[before])
            assert np.array_equal(np.float32(between), np.float32(state[:3]))


HOUR = """\
[dataset]
fps = 30
task = "wait"
split_long = {split}
measure_lags = false
[[feature]]
name = "observation.state"
stream = "TRANSFORM/Arm0ToBase"
tolerance_ms = 20_000
[[feature]]
name = "action"
next_of = "observation.state"
"""


def test_an_hour_is_refused_or_divided(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = write_session(tmp_path / "hour.mcap", [(10.0 * n, "TRANSFORM/Arm0ToBase", arm(0, 0)) for n in range(361)])
    recipe, root = tmp_path / "recipe.toml", tmp_path / "set"
    recipe.write_text(HOUR.format(split="false"), "utf-8")
    words = ["export", str(path), "--to", "lerobot", "--recipe", str(recipe), "-o", str(root)]
    assert main(words) == 2 and not root.exists()
    assert "found 108,000 frames (3,600 s), expected at most 30,7" in capsys.readouterr().err
    recipe.write_text(HOUR.format(split="true"), "utf-8")
    assert main(words) == 0
    episodes = episodes_of(root)
    assert [each["length"] for each in episodes] == [27_000] * 4
    for each in episodes:  # what the readers check
        stamps = np.array(each["table"]["timestamp"].to_pylist(), np.float32)
        assert np.abs(np.diff(stamps) - 1 / 30).max() < 1e-4
    moments = parquet.read_table(root / "meta" / "provenance.parquet")["time_ns"].to_numpy()
    assert np.abs(np.diff(moments) - 1e9 / 30).max() <= 1  # nothing is lost between the parts


@pytest.mark.parametrize("name", ["star", "every-type"])
def test_a_recipe_of_the_recording_works_as_it_is(name: str, tmp_path: Path) -> None:
    path, recipe, root = f"fixtures/{name}.mcap", tmp_path / "recipe.toml", tmp_path / "set"
    assert main(["export", path, "--to", "lerobot", "--write-recipe", str(recipe)]) == 0
    assert main(["export", path, "--to", "lerobot", "--recipe", str(recipe), "-o", str(root)]) == 0
    assert main(["export", path, "--to", "lerobot", "--check", str(root)]) == 0


@pytest.mark.slow
@pytest.mark.parametrize("version", ["v2.1", "v3.0"])
def test_a_sequence_of_plus(version: str, tmp_path: Path) -> None:
    """Tracked ultrasound of PLUS: the frames are the recorded pictures and poses, and a shifted frame is found."""
    source = ultrasound_of_old(tmp_path / "some.igs.mha", 60)
    path, recipe, root = tmp_path / "real.mcap", tmp_path / "recipe.toml", tmp_path / "set"
    assert main(["import", str(source), "-o", str(path)]) == 0
    assert main(["export", str(path), "--to", "lerobot", "--write-recipe", str(recipe)]) == 0
    recipe.write_text(recipe.read_text("utf-8").replace('"v2.1"', f'"{version}"'), "utf-8")
    assert main(["export", str(path), "--to", "lerobot", "--recipe", str(recipe), "-o", str(root)]) == 0
    assert main(["export", str(path), "--to", "lerobot", "--check", str(root)]) == 0
    (episode,) = episodes_of(root)
    moments = parquet.read_table(root / "meta" / "provenance.parquet")["time_ns"].to_numpy()
    with igtl_gateway.open(path) as opened:
        images, stamps = opened["IMAGE/Image"].images(), opened["IMAGE/Image"].source_times
        poses = opened["TRANSFORM/ProbeToTracker"].poses().in_unit("m")
        for frame, at_ns in enumerate(moments.tolist()):
            nearest = int(np.argmin(np.abs(stamps - at_ns)))
            shown = episode["videos"]["observation.images.image"][1][frame][:, :, 0].astype(float)
            errors = {
                row: np.mean((shown[: images[row].plane.shape[0]] - images[row].plane) ** 2)
                for row in range(max(nearest - 2, 0), min(nearest + 3, len(images)))
            }
            assert min(errors, key=lambda row: errors[row]) == nearest and errors[nearest] < 30, frame
            after = min(int(np.searchsorted(poses.source_times, at_ns)), len(poses) - 1)
            before = max(after - 1, 0)
            span = int(poses.source_times[after] - poses.source_times[before])
            share = (at_ns - int(poses.source_times[before])) / max(span, 1)
            between = poses.positions[before] + share * (poses.positions[after] - poses.positions[before])
            assert np.allclose(episode["table"]["observation.state"][frame].as_py()[:3], between, atol=1e-6), frame


@pytest.mark.parametrize(
    ("words", "code", "text"),
    [
        ([], 2, "expected one of --recipe"),
        (["--recipe", "r.toml"], 2, "-o: found it or --recipe alone"),
        (["--recipe", "missing.toml", "-o", "set"], 2, "missing.toml: cannot be read: No such file"),
        (["--check", "nothing"], 1, "nothing/meta/info.json: No such file or directory"),
        (["--recipe", "r.toml", "-o", "set", "--streams", "a"], 2, "--streams: found it"),
    ],
)
def test_wrong_words(
    words: list[str], code: int, text: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
) -> None:  # fmt: skip
    star = str(Path("fixtures/star.mcap").absolute())
    monkeypatch.chdir(tmp_path)
    assert main(["export", star, "--to", "lerobot", *words]) == code
    said = capsys.readouterr()
    assert text in said.out + said.err


NOTE = (
    "note: observation.meta.{name}: policies of several observations fail at strings of this name, but not meta.{name}"
)


@table(
    "version, prefix, notes",
    [("v2.1", "observation.meta", ""), ("v3.0", "observation.meta", NOTE), ("v3.0", "meta", "")],
)
def test_strings_that_some_policies_cannot_take_are_named(
    version: str, prefix: str, notes: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    recipe, out = tmp_path / "recipe.toml", tmp_path / "set"
    features = (("observation.state", "/star/tool", ""), (f"{prefix}.status", "/star/status", 'tolerance_ms = "any"'))
    rows = "".join(f'[[feature]]\nname = "{name}"\nstream = "{stream}"\n{more}\n' for name, stream, more in features)
    recipe.write_text(
        f'[dataset]\nfps = 1\ntask = "sew"\nformat = "{version}"\nmeasure_lags = false\n{rows}'
        '[[feature]]\nname = "action"\nnext_of = "observation.state"\n', "utf-8"
    )  # fmt: skip
    words = ["export", str(FIXTURES / "star.mcap"), "--to", "lerobot"]
    assert main([*words, "--recipe", str(recipe), "-o", str(out)]) == 0
    printed = capsys.readouterr().out
    assert notes.format(name="status") in printed and ("policies" in printed) == bool(notes)
    assert main([*words, "--check", str(out)]) == 0
