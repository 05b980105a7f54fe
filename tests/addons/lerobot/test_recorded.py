"""Recordings as a data set: every number is that of the exported set, every picture that of the recording."""

from __future__ import annotations

import json
import multiprocessing
import os
import pickle
import re
import shutil
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pyarrow import parquet

import igtl_gateway
from igtl_gateway.addons.lerobot import RecordedSet, dataset, recorded_open
from igtl_gateway.addons.lerobot.export import export_sessions
from igtl_gateway.base.errors import ClockWarning, ConfigError, GatewayError, Unavailable
from igtl_gateway.convert.common_msgs import JointState
from igtl_gateway.convert.rosmsg import Header
from igtl_gateway.record.sessionfile.reader import SessionFile
from igtl_gateway.record.sessionfile.writer import SessionWriter
from igtl_gateway.wire.image import Image
from igtl_gateway.wire.text import String
from tests.addons.lerobot.sessions import Sent, arm, bars, number_of, write_session
from tests.places import ROOT
from tests.tables import table

STAR = ROOT / "fixtures" / "star.mcap"
VIEW = "observation.images.view"
OWN = ("timestamp", "frame_index", "episode_index", "index", "task_index")
RECIPE = """\
[dataset]
fps = 10
task = "sew"
format = "v3.0"
measure_lags = false
stamps = true
[[feature]]
name = "observation.state"
stream = "TRANSFORM/ArmToBase"
[[feature]]
name = "observation.joints"
stream = "/joint_states"
fields = ["position"]
[[feature]]
name = "observation.yaw"
stream = "/yaw"
fields = ["position"]
[[feature]]
name = "observation.images.view"
stream = "IMAGE/View"
[[feature]]
name = "observation.images.depth"
stream = "IMAGE/Depth"
depth_mm = [0, 200]
[[feature]]
name = "observation.meta.step"
stream = "STRING/Step"
tolerance_ms = "any"
[[feature]]
name = "action"
next_of = "observation.state"
"""
SPLITS = '[splits]\ntrain = ["P01", "P03"]\nval = ["P02"]\n'
STAR_RECIPE = """\
[dataset]
fps = 2
task = "sew"
format = "v3.0"
measure_lags = false
[[feature]]
name = "observation.state"
stream = "/star/tool"
[[feature]]
name = "observation.images.camera"
stream = "/star/camera/image"
tolerance_ms = 1000
[[feature]]
name = "observation.meta.navigation"
stream = "STRING/Navigation"
tolerance_ms = "any"
[[feature]]
name = "action"
next_of = "observation.state"
"""


def joints(at: float, *names: str) -> Callable[[int], JointState]:
    """Joints whose positions follow from their names."""
    places, nothing = np.array([len(name) + at for name in names]), np.array([])
    return lambda stamp_ns: JointState(Header(stamp_ns, ""), names, places, nothing, nothing)


def messages(first: float, names: tuple[str, ...] = ("yaw", "pitch"), columns: int = 64) -> list[Sent]:
    """A second of an arm, joints, a string and pictures, with a gap in the arm, so two episodes."""
    found: list[Sent] = [(first, "STRING/Step", String(f"step {first:.0f}".encode()))]
    for number in range(50):
        at = first + 0.02 * number
        found += [(at, "/joint_states", joints(at, *names)), (at, "/yaw", joints(at, "yaw"))]
        if not 24 <= number < 32:
            found.append((at, "TRANSFORM/ArmToBase", arm(at, 0)))
    for number in range(10):
        at, pixels = first + 0.1 * number, bars(number + round(first), columns=columns)
        found.append((at, "IMAGE/View", Image((columns, 48, 1), 3, pixels.tobytes())))
        found.append((at, "IMAGE/Depth", Image((20, 16, 1), 5, slope(number).tobytes())))
    return sorted(found, key=lambda each: each[0])


def slope(number: int) -> Any:
    """Depth in mm, (16, 20) uint16, some of it beyond the window of the recipe."""
    return (np.arange(16 * 20).reshape(16, 20) + 10 * number).astype("<u2")


def recipe_in(folder: Path, text: str = RECIPE) -> Path:
    path = folder / "recipe.toml"
    path.write_text(text, "utf-8")
    return path


@pytest.fixture(scope="module")
def study(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three sessions; the joints of one come in another order."""
    folder = tmp_path_factory.mktemp("study")
    for number, name in enumerate(("P01", "P02", "P03")):
        order = ("pitch", "yaw") if number == 1 else ("yaw", "pitch")
        write_session(folder / f"{name}.mcap", messages(10.0 * number, order))
    recipe_in(folder, RECIPE + SPLITS)
    return folder


@pytest.fixture
def samples(study: Path) -> Iterator[RecordedSet]:
    found = dataset(study, study / "recipe.toml")
    yield found
    found.close()


def is_equal(one: Any, two: Any) -> bool:
    """Whether two samples have equal keys, in order, and equal values of the same types and shapes."""
    return list(one) == list(two) and all(
        np.asarray(each).dtype == np.asarray(two[name]).dtype and np.array_equal(each, two[name])
        for name, each in one.items()
    )


def check_numbers(samples: RecordedSet, root: Path) -> None:
    """Compare numbers, strings and metadata with those of an exported set."""
    info = json.loads((root / "meta" / "info.json").read_text("utf-8"))
    assert samples.features == info["features"]
    assert (samples.fps, samples.splits) == (info["fps"], info["splits"])
    assert samples.tasks == parquet.read_table(root / "meta" / "tasks.parquet")["task"].to_pylist()
    episodes = parquet.read_table(root / "meta" / "episodes").to_pylist()
    assert [(each.episode_index, each.length, list(each.tasks)) for each in samples.episodes] == [
        (each["episode_index"], each["length"], each["tasks"]) for each in episodes
    ]
    rows = [row for file in sorted((root / "data").rglob("*.parquet")) for row in parquet.read_table(file).to_pylist()]
    assert len(samples) == len(rows) == info["total_frames"]
    for sample, row in zip(samples, rows, strict=True):
        for name, value in row.items():
            assert np.asarray(sample[name]).tolist() == value, (row["index"], name)
        kinds = {name: np.asarray(each).dtype for name, each in sample.items() if not isinstance(each, str)}
        types = {3: "uint8", 1: "float32"}
        assert {name: str(each) for name, each in kinds.items()} == {
            name: types[each["shape"][2]] if each["dtype"] == "video" else each["dtype"]
            for name, each in info["features"].items()
            if name in kinds
        }
    stats = json.loads((root / "meta" / "stats.json").read_text("utf-8"))
    found = {name: {key: each.tolist() for key, each in own.items()} for name, own in samples.stats.items()}
    assert found == stats


def test_star_has_the_numbers_of_the_exported_set(tmp_path: Path) -> None:
    recipe = recipe_in(tmp_path, STAR_RECIPE)
    export_sessions([STAR], recipe, tmp_path / "set")
    with pytest.warns(ClockWarning, match="one clock is assumed"):
        samples = dataset(STAR, recipe)
    check_numbers(samples, tmp_path / "set")
    with igtl_gateway.open(STAR) as recording:
        images = [each.plane for each in recording["/star/camera/image"].images()]
    for number in (0, 7, len(samples) - 1):  # its own pixels: a frame of the video would differ by its coding
        assert any(np.array_equal(samples[number]["observation.images.camera"], each) for each in images)
    samples.close()


def test_a_folder_has_the_numbers_of_the_exported_set(samples: RecordedSet, study: Path, tmp_path: Path) -> None:
    export_sessions([study / f"{name}.mcap" for name in ("P03", "P01", "P02")], study / "recipe.toml", tmp_path / "set")
    check_numbers(samples, tmp_path / "set")
    assert samples.splits == {"train": "0:4", "val": "4:6"}
    assert [each.session for each in samples.episodes[::2]] == ["P01.mcap", "P03.mcap", "P02.mcap"]
    for sample in samples:  # the second episode begins behind the gap
        session, is_second = divmod(int(sample["episode_index"]), 2)
        first, at = (0, 20, 10)[session], 0.64 * is_second + 0.1 * sample["frame_index"]
        assert sample["observation.joints"].tolist() == pytest.approx([first + at + 3, first + at + 5])  # yaw, pitch
        assert number_of(sample[VIEW]) == first + int(10 * at + 0.01)  # the nearest one
        assert sample["observation.meta.step"] == f"step {first}"
        away = sample["observation.images.depth"][:, :, 0] - np.minimum(slope(int(10 * at + 0.01)), 200)
        assert np.abs(away).max() <= 200 / 4095 / 2 + 1e-5


def test_the_example_of_the_document(study: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (code,) = re.findall(r"```python\n([^`]*)```", (ROOT / "docs" / "how-to" / "lerobot.md").read_text("utf-8"))
    shutil.copytree(study, tmp_path / "sessions")
    recipe_in(tmp_path, RECIPE + SPLITS)
    monkeypatch.chdir(tmp_path)
    names: dict[str, Any] = {}
    exec(compile(code, "lerobot.md", "exec"), names)
    assert names["sample"]["observation.state"].shape == (7,) and names["sample"][VIEW].shape == (48, 64, 3)
    assert {each.split for each in names["samples"].episodes} == {"train"}
    names["samples"].close()


def test_what_is_corrected_is_said_with_its_recording(tmp_path: Path) -> None:
    path = write_session(tmp_path / "P01.mcap", messages(0.0), ahead_s={"IMAGE/View": 3.0})
    other = write_session(tmp_path / "P02.mcap", messages(1.0))
    with pytest.warns(ClockWarning, match="IMAGE/View are 3 s ahead .*corrected by") as warned:
        samples = dataset(path, recipe_in(tmp_path))
    assert samples.clock == "source" and [str(each.message) for each in warned] == ["; ".join(samples.notes)]
    with pytest.warns(ClockWarning, match="P01.mcap: clock: .*IMAGE/View"):
        assert all(note.startswith("P01.mcap: ") for note in dataset([path, other], recipe_in(tmp_path)).notes)


def test_places_in_a_data_set(samples: RecordedSet, study: Path) -> None:
    count = len(samples)
    assert is_equal(samples[-1], samples[count - 1])
    assert [each["index"] for each in samples[1:4]] == [1, 2, 3]
    for wrong in (count, -count - 1):
        with pytest.raises(IndexError, match=f"found index {wrong}, expected one from -{count} to {count - 1}"):
            samples[wrong]
    part = dataset([study / "P01.mcap", study / "P02.mcap", study / "P03.mcap"], study / "recipe.toml", split="val")
    assert len(part) < count and {each.split for each in part.episodes} == {"val"}
    whole = samples[count - len(part) :]
    assert all(is_equal(one, two) for one, two in zip(part, whole, strict=True))
    assert {name: each["count"].tolist() for name, each in part.stats.items()}["index"] == [count]
    part.close()


def test_windows_stay_in_their_episode(study: Path) -> None:
    offsets: dict[str, list[float]] = {
        VIEW: [-0.1, 0.0],
        "action": [0.0, 0.1, 0.2],
        "observation.meta.step": [0.0, 0.1],
        "observation.yaw": [0],
    }
    samples = dataset(study, study / "recipe.toml", delta_timestamps=offsets)
    closed = dataset(study, study / "recipe.toml")
    plain = list(closed)
    for number, found in enumerate(samples):
        inside = [n for n, each in enumerate(plain) if each["episode_index"] == plain[number]["episode_index"]]
        for name, each in offsets.items():
            wanted = [number + round(10 * second) for second in each]
            assert found[f"{name}_is_pad"].tolist() == [n not in inside for n in wanted]
            values = [plain[min(max(n, inside[0]), inside[-1])][name] for n in wanted]
            assert np.array_equal(found[name], values) and type(found[name]) is (list if "meta" in name else np.ndarray)
    one = dataset(study, study / "recipe.toml", delta_timestamps={VIEW: [0.1]})
    assert one[0][VIEW].shape == (48, 64, 3) and number_of(one[0][VIEW]) == 1
    for part in (samples, closed, one):
        part.close()


@table(
    ("options", "text"),
    [
        ({"split": "test"}, "split: found 'test', expected one of train, val"),
        ({"delta_timestamps": {"acton": [0.0]}}, "delta_timestamps: found 'acton', expected "),
        ({"delta_timestamps": {"action": [0.0, 0.15]}}, "action: found 0.15 s, expected multiples of 1 / 10 s"),
        ({"delta_timestamps": {"action": 0.1}}, "action: found 0.1, expected a list of one or more seconds"),
        ({"delta_timestamps": {"action": []}}, "action: found [], expected a list of one or more seconds"),
        ({"delta_timestamps": {"action": ["a"]}}, "action: found ['a'], expected a list of one or more seconds"),
        ({"delta_timestamps": {"action": [0.0, float("nan")]}}, "action: found [0.0, nan], expected a list of"),
        ({"source": "EMPTY"}, "found no *.mcap in the folder, expected recordings"),
        ({"source": []}, "source: found no path, expected recordings"),
        ({"source": ["P01.mcap", "P01.mcap"]}, "P01.mcap twice, expected each session once"),
    ],
)  # fmt: skip
def test_what_does_not_fit_is_named(options: dict[str, Any], text: str, study: Path, tmp_path: Path) -> None:
    source = options.pop("source", study)
    source = (
        [study / each for each in source] if isinstance(source, list) else tmp_path if source == "EMPTY" else source
    )
    with pytest.raises(ConfigError, match=re.escape(text)):
        dataset(source, study / "recipe.toml", **options)


def test_sessions_that_differ_have_the_text_of_the_export(tmp_path: Path) -> None:
    paths = [tmp_path / f"P{number}.mcap" for number in range(3)]
    for number, path in enumerate(paths):
        write_session(path, messages(10.0 * number, columns=64 if number else 80))
    recipe = recipe_in(tmp_path)
    with pytest.raises(ConfigError) as export:
        export_sessions(paths, recipe, tmp_path / "set")
    with pytest.raises(ConfigError) as opened:
        dataset(tmp_path, recipe)
    assert str(opened.value) == str(export.value) and "pictures: found 80 × 48 pixels" in str(opened.value)


def test_a_recording_that_has_changed_is_one_error(study: Path, tmp_path: Path) -> None:
    path = tmp_path / "P01.mcap"
    path.write_bytes((study / "P01.mcap").read_bytes())
    samples = dataset(path, recipe_in(tmp_path))
    first = samples[0]
    data = path.read_bytes()
    os.utime(path, (1, 1))  # copied: the content is the same
    for one in (samples, pickle.loads(pickle.dumps(samples))):
        assert is_equal(one[0], first)
    changes: list[Callable[[], object]] = [
        lambda: path.write_bytes(data[:-1] + b"\0"),
        lambda: path.write_bytes((study / "P02.mcap").read_bytes()),
        path.unlink,
    ]
    for change in changes:
        change()
        for one in (samples, pickle.loads(pickle.dumps(samples))):  # also where it is open
            with pytest.raises(
                GatewayError, match=rf"^{re.escape(str(path))}: (found other content|No such file)"
            ) as error:
                one[0]
            assert "\n" not in str(error.value)
    path.write_bytes(data)
    assert is_equal(samples[0], first)
    path.unlink()
    samples.close()
    with pytest.raises(GatewayError, match="No such file"):
        samples[0]


def test_a_split_recording_is_one(study: Path, tmp_path: Path) -> None:
    with SessionFile.open(study / "P01.mcap") as file:
        entries, facts = list(file.entries()), file.recorded_session
    (tmp_path / "long").mkdir()
    for number in range(6):
        before = {"previous_part": f"long_{number - 1}.mcap"} if number else {}
        writer = SessionWriter(tmp_path / "long" / f"long_{number}.mcap", facts | {"part": str(number)} | before)
        for entry in entries[len(entries) * number // 6 : len(entries) * (number + 1) // 6]:
            writer.write(entry)
        writer.close({})
    (tmp_path / "P02.mcap").write_bytes((study / "P02.mcap").read_bytes())
    samples, whole = dataset(tmp_path, recipe_in(tmp_path)), dataset(study / "P01.mcap", recipe_in(tmp_path))
    assert [each.session for each in samples.episodes] == ["long", "long", "P02.mcap", "P02.mcap"]
    for number in np.random.default_rng(1).permutation(len(whole)).tolist():
        assert is_equal(samples[number], whole[number])
    samples.close()
    whole.close()


def test_a_recording_without_an_index_is_refused(study: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(SessionFile, "is_indexed", False)
    with pytest.raises(ConfigError, match="IMAGE/View: found messages that no index has in their order, expected "):
        dataset(study, study / "recipe.toml")


def test_few_recordings_are_open(samples: RecordedSet, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(recorded_open, "MOST_OPEN", 2)
    expected = list(samples)
    order = np.random.default_rng(1).permutation(len(samples)).tolist()
    for number in order:
        assert is_equal(samples[number], expected[number])
        opened = samples._opened
        assert opened is not None and len(opened._open) <= 2
        kept = [recording._source.file._chunks._kept for recording, _ in opened._open.values()]
        assert sum(map(bool, kept)) == 1  # of the last one that was used


def test_processes_share_no_file(samples: RecordedSet) -> None:
    expected = list(samples)
    reader, writer = os.pipe()
    child = os.fork() if hasattr(os, "fork") else pytest.skip("Windows has no fork")
    if not child:  # pragma: no cover - another process
        right = all(is_equal(samples[number], expected[number]) for number in range(len(expected)))
        os.write(writer, b"right" if right else b"wrong")
        os._exit(0)
    for _ in range(3):  # while the other one reads
        assert all(is_equal(samples[number], expected[number]) for number in range(len(expected)))
    os.close(writer)
    assert (os.read(reader, 5), os.waitpid(child, 0)[1]) == (b"right", 0)
    os.close(reader)
    copy = pickle.loads(pickle.dumps(samples))
    assert copy._opened is None and all(is_equal(one, two) for one, two in zip(copy, expected, strict=True))
    copy.close()


@pytest.mark.slow
@pytest.mark.long
def test_a_spawned_process_opens_its_own(samples: RecordedSet) -> None:
    with multiprocessing.get_context("spawn").Pool(2) as pool:
        found = pool.map(samples.__getitem__, range(len(samples)))
    assert all(is_equal(one, two) for one, two in zip(found, samples, strict=True))


@pytest.mark.slow
@pytest.mark.long
def test_torch_has_the_samples_of_lerobot(study: Path) -> None:
    torch = pytest.importorskip("torch")
    samples = dataset(study, study / "recipe.toml", delta_timestamps={"action": [0.0, 0.1]})
    found = samples.to_torch()
    assert isinstance(found, torch.utils.data.Dataset)
    one = found[3]
    assert one[VIEW].dtype == torch.float32 and one[VIEW].shape == (3, 48, 64)
    assert torch.equal(one[VIEW], torch.from_numpy(samples[3][VIEW]).permute(2, 0, 1) / 255)
    assert one["index"].dtype == torch.int64 and one["index"].shape == () and one["action_is_pad"].dtype == torch.bool
    assert samples.to_torch(return_uint8=True)[3][VIEW].dtype == torch.uint8
    for context in ("fork", "spawn"):
        loader = torch.utils.data.DataLoader(found, batch_size=4, num_workers=2, multiprocessing_context=context)
        batches = list(loader)
        assert [int(each) for batch in batches for each in batch["index"]] == list(range(len(samples)))
        assert torch.equal(torch.cat([each[VIEW] for each in batches])[3], one[VIEW])


def test_without_torch_it_is_named(samples: RecordedSet, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "torch", None)
    monkeypatch.delitem(sys.modules, "igtl_gateway.addons.lerobot.torch_set", raising=False)
    with pytest.raises(Unavailable, match=r"PyTorch: found .*, expected it; run: pip install torch"):
        samples.to_torch()
