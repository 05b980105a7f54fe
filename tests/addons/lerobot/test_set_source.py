"""Data sets of others as sessions: PyAV and pyarrow read the set; each number, stamp, text and pixel is compared."""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import av
import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pytest
from pyarrow import parquet

import igtl_gateway
from igtl_gateway.addons.lerobot.comparing import check
from igtl_gateway.addons.lerobot.drafting import draft
from igtl_gateway.addons.lerobot.export import export_lerobot
from igtl_gateway.addons.lerobot.set_topics import ITEM, SetTopics
from igtl_gateway.base.buffers import join
from igtl_gateway.base.stamp import NS_PER_S
from igtl_gateway.cli import FAILURE, USAGE, main
from igtl_gateway.wire import Message, encode
from igtl_gateway.wire.image import Image
from igtl_gateway.wire.text import String
from tests.addons.lerobot.sessions import BEGIN_NS, Sent, arm, bars, joints, write_session
from tests.tables import table

Array = npt.NDArray[Any]
VERSIONS = ("v2.1", "v3.0")
FPS = 10
#: 2000-01-01, where a set without times begins.
EPOCH_NS = 946_684_800 * NS_PER_S
VIEW = "observation.images.view"
RECIPE = """\
[dataset]
fps = 10
task = "sew"
format = "{format}"
measure_lags = false
[episodes]
by = "markers"
stream = "STRING/Trial"
[[feature]]
name = "observation.state"
stream = "TRANSFORM/ArmToBase"
[[feature]]
name = "observation.state.joints"
stream = "/joint_states"
fields = ["position"]
[[feature]]
name = "observation.images.view"
stream = "IMAGE/View"
[[feature]]
name = "observation.meta.trial"
stream = "STRING/Trial"
tolerance_ms = "any"
[[feature]]
name = "action"
next_of = "observation.state"
"""


@pytest.fixture(scope="module")
def sets(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a set of two episodes in each format; the second begins inside of a group of pictures in v3.0."""
    folder = tmp_path_factory.mktemp("sets")
    messages: list[Sent] = [(0.1 * n, "TRANSFORM/ArmToBase", arm(0.1 * n, 0)) for n in range(14)]
    messages += [(0.1 * n, "/joint_states", joints(0.1 * n)) for n in range(14)]
    messages += [(0.1 * n, "IMAGE/View", Image((32, 32, 1), 3, bars(n, 32, 32).tobytes())) for n in range(14)]
    marks = ((0.0, "start: left"), (0.55, "stop"), (0.75, "start: right"), (1.3, "stop"))
    messages += [(at, "STRING/Trial", String(text.encode())) for at, text in marks]
    path = write_session(folder / "s.mcap", sorted(messages, key=lambda each: each[0]))
    for version in VERSIONS:
        recipe = folder / f"{version}.toml"
        recipe.write_text(RECIPE.format(format=version), "utf-8")
        export_lerobot(path, recipe, folder / version)
    return folder


def without_times(root: Path, place: Path) -> Path:
    """A copy of a set as LeRobot writes it: without what only our own sets have."""
    copy = shutil.copytree(root, place)
    for name in ("provenance.parquet", "recipe.toml", "SHA256SUMS", "README.md", "SYNCHRONIZATION.md", "sessions.json"):
        (copy / "meta" / name).unlink(missing_ok=True)
    return copy


def source_rows(root: Path) -> list[dict[str, Any]]:
    """All frames of a set, as pyarrow reads them."""
    tables = [parquet.read_table(path) for path in sorted(root.glob("data/*/*.parquet"))]
    return [row for each in tables for row in each.to_pylist()]


def source_pictures(root: Path) -> Array:
    """All pictures of a set, as PyAV reads them."""
    found = []
    for path in sorted(root.glob("videos/**/*.mp4")):
        with av.open(str(path)) as file:
            found += [frame.to_ndarray(format="rgb24") for frame in file.decode(video=0)]
    return np.array(found)


def decoded(stream: igtl_gateway.Stream) -> Iterator[tuple[int, Array]]:
    """Stamp and picture of each message of a stream of H.264, as PyAV decodes it."""
    codec = av.CodecContext.create("h264", "r")
    for message in stream.messages():
        content = message.content
        assert content.format == "h264"
        stamp = content.timestamp.sec * NS_PER_S + content.timestamp.nanosec
        assert stamp == message.source_time
        packet = av.Packet(bytes(content.data))
        packet.pts = stamp
        for frame in codec.decode(packet):
            yield frame.pts, frame.to_ndarray(format="rgb24")
    for frame in codec.decode(None):
        yield frame.pts, frame.to_ndarray(format="rgb24")


def imported(root: Path, place: Path, *more: str) -> Path:
    assert main(["import", str(root), "-o", str(place), *more]) == 0
    return place


@table("version", VERSIONS)
def test_each_number_stamp_text_and_pixel_is_that_of_the_set(version: str, sets: Path, tmp_path: Path) -> None:
    root = without_times(sets / version, tmp_path / "set")
    rows, pictures = source_rows(root), source_pictures(root)
    assert [sum(row["episode_index"] == each for row in rows) for each in (0, 1)] == [5, 5]
    stamps = [EPOCH_NS + 11 * NS_PER_S * row["episode_index"] + row["frame_index"] * NS_PER_S // FPS for row in rows]
    with igtl_gateway.open(imported(root, tmp_path / "s.mcap")) as recording:
        for feature in ("observation.state", "observation.state.joints", "action"):
            stream = recording[f"/{feature.replace('.', '/')}"]
            assert stream.source_times.tolist() == stamps
            for row, message in zip(rows, stream.messages(), strict=True):
                assert message.content.position.tolist() == row[feature]
                stamp = message.content.header.stamp
                assert stamp.sec * NS_PER_S + stamp.nanosec == message.source_time
        poses = recording["/observation/state/pose"].poses()
        assert poses.positions.tolist() == [row["observation.state"][:3] for row in rows]
        texts = [message.content.data for message in recording["/observation/meta/trial"].messages()]
        assert texts == [row["observation.meta.trial"] for row in rows]
        assert [each.content.data for each in recording["/task"].messages()] == ["left", "right"]
        phases = [(mark.label, mark.text, mark.time_ns, mark.end_ns) for mark in recording.marks]
        assert phases == [
            (f"episode-{each}", text, stamps[5 * each] + 1, stamps[5 * each + 4] + 50_000_001)
            for each, text in enumerate(("left", "right"))
        ]
        shown = dict(decoded(recording["/observation/images/view"]))
        assert len(recording["/observation/images/view"]) == (11 if version == "v3.0" else 10)
        for stamp, picture in zip(stamps, pictures, strict=True):
            assert (shown[stamp] == picture).all()


@table(
    ("version", "tolerance"),
    [("v2.1", "1000.0"), ("v3.0", "1000.0"), ("v2.1", '"any"')],
    gate=lambda version, tolerance: tolerance == '"any"',
)
def test_our_own_set_comes_back_with_its_times(version: str, tolerance: str, sets: Path, tmp_path: Path) -> None:
    root, out, recipe = sets / version, tmp_path / "again", tmp_path / "back.toml"
    session = imported(root, tmp_path / "s.mcap")
    with igtl_gateway.open(session) as recording:
        text = draft(recording).text
    recipe.write_text(re.sub(r"tolerance_ms = [\d.]+", f"tolerance_ms = {tolerance}", text), "utf-8")
    export_lerobot(session, recipe, out)
    assert source_rows(out) == source_rows(root)
    before, after = (json.loads((each / "meta" / "info.json").read_text("utf-8")) for each in (root, out))
    assert before == after
    times = parquet.read_table(root / "meta" / "provenance.parquet")["time_ns"].to_pylist()
    assert parquet.read_table(out / "meta" / "provenance.parquet")["time_ns"].to_pylist() == times
    assert times[0] == BEGIN_NS
    assert check(out, [session]).findings == []
    one, two = source_pictures(root).astype(int), source_pictures(out).astype(int)
    assert one.shape == two.shape == (10, 32, 32, 3)
    assert np.abs(one - two).mean() < 2 < np.abs(one - np.roll(one, 1, axis=0)).mean()


def test_one_episode_has_the_stamps_that_it_has_in_all(sets: Path, tmp_path: Path) -> None:
    root = without_times(sets / "v3.0", tmp_path / "set")
    every, one = imported(root, tmp_path / "every.mcap"), imported(root, tmp_path / "1.mcap", "--episodes", "1")
    with igtl_gateway.open(every) as all_of_it, igtl_gateway.open(one) as part:
        assert [mark.label for mark in part.marks] == ["episode-1"]
        for key in part:
            assert part[key].source_times.tolist() == all_of_it[key].source_times.tolist()[-len(part[key]) :]
        for stamp, picture in zip(part["/action"].source_times, source_pictures(root)[5:], strict=True):
            assert (dict(decoded(part["/observation/images/view"]))[stamp] == picture).all()


# --- sets that are not whole ----------------------------------------------------------------------------------------

DATA = "data/chunk-000/episode_000001.parquet"
VIDEO = f"videos/chunk-000/{VIEW}/episode_000001.mp4"


def column(name: str, change: Callable[[list[Any]], list[Any]]) -> Callable[[Path], None]:
    """A change of a column of the second episode."""

    def write(root: Path) -> None:
        found = parquet.read_table(root / DATA)
        values = pa.array(change(found[name].to_pylist()), found[name].type)
        parquet.write_table(found.set_column(found.schema.get_field_index(name), name, values), root / DATA)

    return write


def info(**values: Any) -> Callable[[Path], None]:
    return lambda root: _change_info(root, lambda found: found.update(values))


def feature(name: str, **values: Any) -> Callable[[Path], None]:
    return lambda root: _change_info(root, lambda found: found["features"].setdefault(name, {}).update(values))


def _change_info(root: Path, change: Callable[[dict[str, Any]], None]) -> None:
    path = root / "meta" / "info.json"
    found = json.loads(path.read_text("utf-8"))
    change(found)
    path.write_text(json.dumps(found), "utf-8")


def line(name: str, number: int, text: str) -> Callable[[Path], None]:
    """A change of a line of the metadata."""

    def write(root: Path) -> None:
        lines = (root / "meta" / name).read_text("utf-8").splitlines()
        lines[number] = text
        (root / "meta" / name).write_text("\n".join(lines), "utf-8")

    return write


def change_bytes(path: Path, old: bytes, new: bytes) -> None:
    data = path.read_bytes()
    assert old in data
    path.write_bytes(data.replace(old, new))


def rotated(values: list[float]) -> list[float]:
    return [*values[:2], values[1], *values[3:]]


NUMBERS = {"dtype": "float32", "shape": [7]}
BAD: list[tuple[str, Callable[[Path], Any], str]] = [
    ("no table", lambda root: (root / DATA).unlink(), f"set: found no {DATA}, expected the 4 files of 2 episodes"),
    ("no video", lambda root: (root / VIDEO).unlink(), f"set: found no {VIDEO}, expected the 4 files of 2 episodes"),
    ("no metadata", lambda root: (root / "meta" / "tasks.jsonl").unlink(), "tasks.jsonl: No such file"),
    ("half a video", lambda root: (root / VIDEO).write_bytes((root / VIDEO).read_bytes()[:900]), "episode_000001.mp4:"),
    ("codec", lambda root: change_bytes(root / VIDEO, b"avc1", b"zzzz"), "01.mp4: found a video of an unknown codec"),
    (
        "short video",
        lambda root: shutil.copy(root / "short.mp4", root / VIDEO),
        "episode_000001.mp4: episode 1: found 3 frames, expected 5 as the table has",
    ),
    ("time back", column("timestamp", rotated), "episode 1: row 2: timestamp: found 0.1 s, expected 0.2 s, 2 / 10"),
    ("NaN", column("timestamp", lambda each: [*each[:4], float("nan")]), "row 4: timestamp: found nan s"),
    ("null", column("timestamp", lambda each: [*each[:4], None]), "timestamp: found 4 numbers in 5 rows, expected 1"),
    ("other rows", column("episode_index", lambda each: [0] * 5), "row 0: episode_index: found 0, expected 1"),
    ("no task", column("task_index", lambda each: [9] * 5), "row 0: task_index: found 9, expected one of 2 tasks"),
    ("no column", feature("observation.force", **NUMBERS), "episode 0: found no column observation.force, expected"),
    ("width", feature("action", shape=[6], names=None), "action: found 35 numbers in 5 rows, expected 6 in each"),
    ("text", feature("observation.meta.trial", dtype="float32"), "meta.trial: found string, expected numbers"),
    ("number", feature("action", dtype="string"), "action: found fixed_size_list"),
    ("picture", feature("action", dtype="image"), "action.shape: found [7], expected rows, columns and channels"),
    ("out of the folder", feature("../../x", **NUMBERS), 'found "../../x", expected a name without slash'),
    ("path", info(data_path="/etc/{episode_index}.parquet"), "data_path: found"),
    ("rate", info(fps=10**15), "fps: found 1000000000000000, expected 1 to 1000"),
    (
        "length",
        line("episodes.jsonl", 1, '{"episode_index": 1, "tasks": ["right"], "length": 1000000000000000}'),
        "frames of all episodes: found 1000000000000005, expected at most 10,000,000",
    ),
    ("rows", line("episodes.jsonl", 1, '{"episode_index": 1, "tasks": [], "length": 6}'), "found 5 rows, expected 6"),
]  # fmt: skip


@table(
    ("change", "text"),
    [case[1:] for case in BAD],
    ids=[case[0] for case in BAD],
    gate=lambda change, text: text in {case[2] for case in BAD[::3]},
)
def test_a_set_that_is_not_whole_is_one_line(
    change: Callable[[Path], Any], text: str, sets: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    root = without_times(sets / "v2.1", tmp_path / "set")
    shutil.copy(short_video(sets), root / "short.mp4")
    change(root)
    assert main(["import", str(root), "-o", str(tmp_path / "s.mcap")]) != 0
    out, err = capsys.readouterr()
    told = [each for each in (out + err).splitlines() if text in each]
    assert len(told) == 1, out + err
    assert len(told[0]) < 500 and not (tmp_path / "s.mcap").exists()


def short_video(folder: Path) -> Path:
    from igtl_gateway.addons.lerobot.video import VideoFile

    path = folder / "short.mp4"
    if not path.exists():
        video = VideoFile(path, (32, 32), FPS, "h264")
        for number in range(3):
            video.add(np.repeat(bars(number, 32, 32)[:, :, np.newaxis], 3, axis=2))
        video.close()
    return path


@table(("text", "expected"), [("9", "found 9"), ("1:1", "found 1:1"), ("x", "found x"), ("-1", "found -1")])
def test_episodes_that_are_not_there(
    text: str, expected: str, sets: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = ["import", str(sets / "v2.1"), "-o", str(tmp_path / "s.mcap"), f"--episodes={text}"]
    assert main(command) == USAGE
    assert f"--episodes: {expected}, expected a number or a half-open range such as 0:8 of 2 episodes" in (
        capsys.readouterr().err
    )


def test_what_is_not_taken_is_named(sets: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    root = shutil.copytree(sets / "v2.1", tmp_path / "set")
    feature("observation.audio.room", dtype="audio", shape=[1])(root)
    feature(VIEW, info={"is_depth_map": True})(root)
    info(total_frames=11)(root)
    (root / "LICENSE").write_text("none", "utf-8")
    assert main(["import", str(root), "-o", str(tmp_path / "s.mcap"), "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert [row for row in told["rows"] if row["type"] == "audio"] == [
        {
            "stream": "observation.audio.room", "type": "audio", "unit": "messages", "declared": 10, "imported": 0,
            "left_out": 10, "why": "no message has audio", "good": True,
        }
    ]  # fmt: skip
    assert [row["why"] for row in told["rows"] if row["stream"] == VIEW] == ["depth in a video is not imported"]
    totals = "meta/info.json has 2 episodes and 11 frames, the list of episodes 2 episodes and 10 frames"
    assert totals in told["notes"]
    assert any(note.startswith("not imported: LICENSE, meta/README.md") for note in told["notes"])


def test_stamps_that_no_message_has_exactly_are_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    recipe, path = tmp_path / "recipe.toml", tmp_path / "s.mcap"
    row = '[[feature]]\nname = "observation.state"\nstream = "TRANSFORM/ArmToBase"\n'
    of_set = '[dataset]\nfps = 10\ntask = "sew"\nmeasure_lags = false\nstamps = true\n'
    recipe.write_text(f'{of_set}{row}[[feature]]\nname = "action"\nnext_of = "observation.state"\n', "utf-8")
    write_session(path, [(0.1 * n, "TRANSFORM/ArmToBase", arm(0.1 * n, 0)) for n in range(5)])
    export_lerobot(path, recipe, tmp_path / "set")
    capsys.readouterr()
    session = imported(tmp_path / "set", tmp_path / "back.mcap", "--json")
    rows = {each["stream"]: each for each in json.loads(capsys.readouterr().out)["rows"]}
    for name in ("time_ns", "stamp_ns"):
        assert (rows[name]["imported"], rows[name]["left_out"]) == (0, 4)
        assert rows[name]["why"] == "an integer beyond 2^53"
    with igtl_gateway.open(session) as recording:
        assert len(recording["/observation/state"]) == 4 and "/time_ns" not in recording


def test_a_damaged_end_leaves_what_was_before_it(sets: Path, tmp_path: Path) -> None:
    root = without_times(sets / "v2.1", tmp_path / "set")
    column("task_index", lambda each: [0, 0, 9, 0, 0])(root)
    out = tmp_path / "s.mcap"
    assert main(["import", str(root), "-o", str(out), "--partial"]) == FAILURE
    with igtl_gateway.open(out) as recording:
        assert len(recording["/action"]) == 5


def test_a_session_for_each_episode(sets: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    root, out = without_times(sets / "v3.0", tmp_path / "set"), tmp_path / "sessions"
    assert main(["import", str(root), "-o", str(out), "--each", "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert [each["file"] for each in told["sessions"]] == ["episode-000000.mcap", "episode-000001.mcap"]
    one = imported(root, tmp_path / "1.mcap", "--episodes", "1")
    assert (out / "episode-000001.mcap").read_bytes() == one.read_bytes()
    [actions] = [row for row in told["rows"] if row["stream"] == "action"]
    assert (actions["declared"], actions["imported"], actions["good"]) == (10, 10, True)


def test_a_damaged_episode_has_no_session(sets: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    root, out = without_times(sets / "v2.1", tmp_path / "set"), tmp_path / "sessions"
    column("task_index", lambda each: [9] * 5)(root)
    assert main(["import", str(root), "-o", str(out), "--each"]) == FAILURE
    assert [each.name for each in out.iterdir()] == ["episode-000000.mcap"]
    lines = capsys.readouterr().out.splitlines()
    assert any(each.startswith("! episode-000001.mcap: not written: ") and "task_index" in each for each in lines)
    assert lines[-1].startswith(f"{out}: 1 session, ")
    for number in (0, 1):
        path = root / "data" / "chunk-000" / f"episode_{number:06d}.parquet"
        path.write_bytes(path.read_bytes()[:100])
    assert main(["import", str(root), "-o", str(tmp_path / "no"), "--each"]) == FAILURE
    assert not (tmp_path / "no").exists()


def test_a_file_has_no_episodes(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "s.igtl").write_bytes(join(encode(Message("STRING", "Said", String(b"go")))))
    for words in (["--each"], ["--episodes", "1"]):
        assert main(["import", str(tmp_path / "s.igtl"), "-o", str(tmp_path / "s"), *words]) == USAGE
        assert f"{words[0]}: found it with another source, expected a LeRobot data set" in capsys.readouterr().err


@table("text", ["", "{", "[]", '{"version": "v2.1"}', '{"version": 1, "robot_type": "", "topics": {}}'])
def test_a_recording_that_states_no_set(text: str) -> None:
    recording: Any = SimpleNamespace(session={ITEM: text})
    assert SetTopics.of(recording) is None
    recording.session[ITEM] = SetTopics("v2.1", "arm", {"/a": ("action", ("x",))}).facts()[ITEM]
    assert SetTopics.of(recording) == SetTopics("v2.1", "arm", {"/a": ("action", ("x",))})
