"""Scenes for 3D Slicer: its own classes read and play them, and find the recorded values."""

from __future__ import annotations

import hashlib
import pickle
import subprocess
import sys
import zipfile
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import igtl_gateway
from igtl_gateway.addons.exchange.account import ExportAccount
from igtl_gateway.addons.exchange.targets import export_to
from igtl_gateway.base.errors import GatewayError, UnsupportedRecording
from igtl_gateway.base.stamp import NS_PER_MS, NS_PER_S, ns_to_ticks
from igtl_gateway.cli import main
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.record.sessionfile.reader import SessionFile
from igtl_gateway.record.sessionfile.writer import SessionWriter
from igtl_gateway.wire import Message, encode
from igtl_gateway.wire.image import Image
from igtl_gateway.wire.text import String
from igtl_gateway.wire.transform import Transform
from tests.places import FIXTURES

JUDGE = Path(__file__).with_name("scene_judge.py")
pytestmark = pytest.mark.skipif(find_spec("slicer") is None, reason="slicer-core is not installed")

START_NS = 1_700_000_000 * NS_PER_S
Scene = tuple[dict[str, Any], ExportAccount, str]


def judged(path: Path) -> tuple[dict[str, Any], str]:
    """What 3D Slicer finds in a scene, and its log."""
    out = path.parent / "found.pickle"
    ran = subprocess.run([sys.executable, JUDGE, path, out], check=False, capture_output=True, text=True, timeout=300)
    assert not ran.returncode, ran.stderr
    found: dict[str, Any] = pickle.loads(out.read_bytes())
    return found, ran.stderr


def made(recording: Path, out: Path, to: str = "mrb", globs: tuple[str, ...] = (), rate: float = 0.0) -> ExportAccount:
    with SessionFile.open(recording) as file:
        return export_to(to, file, out, globs, rate=rate)


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Scene]:
    """The scene of a golden recording, as 3D Slicer found it, each once."""
    known: dict[str, Scene] = {}

    def of(name: str) -> Scene:
        if name not in known:
            out = tmp_path_factory.mktemp(name) / "scene.mrb"
            account = made(FIXTURES / f"{name}.mcap", out)
            known[name] = (*judged(out)[:1], account, judged(out)[1])
        return known[name]

    return of


def sequence(found: dict[str, Any], stream: str) -> dict[str, Any]:
    (one,) = (each for each in found["sequences"] if each["stream"] == stream)
    return dict(one)


def item_at(one: dict[str, Any], ms: int) -> Any:
    """The item that a browser shows at a time: the last one that is not later."""
    indexes = np.array([round(float(text) * 1000) for text in one["index"]])
    order = np.argsort(indexes, kind="stable")
    return one["items"][order[max(0, int(np.searchsorted(indexes[order], ms, side="right")) - 1)]]


#: Recording, key of a stream of poses, and its name in the scene.
POSES = [
    ("star", "/star/tool", "in:/star/tool"),
    ("star", "/star/camera_pose", "in:/star/camera_pose"),
    ("ultrasound", "TRANSFORM/ProbeToTracker", "in:TRANSFORM/ProbeToTracker"),
    ("ultrasound", "TRANSFORM/ReferenceToTracker", "in:TRANSFORM/ReferenceToTracker"),
    ("crtk", "/PSM1/measured_cp", "in:/PSM1/measured_cp"),
    ("crtk", "/PSM2/local/measured_cp", "in:/PSM2/local/measured_cp"),
]


@pytest.mark.parametrize(("name", "key", "stream"), POSES)
def test_poses_are_the_recorded_ones_at_any_time(
    scene: Callable[[str], Scene], name: str, key: str, stream: str
) -> None:
    found, _, _ = scene(name)
    one = sequence(found, stream)
    with igtl_gateway.open(FIXTURES / f"{name}.mcap") as recording:
        poses = recording[key].poses().in_unit("mm")
    times = poses.stamps if name != "crtk" else poses.times
    ms = (times - found["begin_ns"] + NS_PER_MS // 2) // NS_PER_MS
    picked = np.random.default_rng(1).integers(ms[0], ms[-1] + 1, 200).tolist()
    for at in [int(ms[0]), int(ms[len(ms) // 2]), int(ms[-1]), *picked]:
        expected = poses.matrices[np.searchsorted(ms, at, side="right") - 1]
        assert np.abs(item_at(one, at) - expected).max() < 1e-6, at
    assert one["unit"] == "s"
    assert len(one["index"]) == len(ms) + (ms[0] > 0)


@pytest.mark.parametrize("name", ["star", "ultrasound", "crtk"])
def test_the_browser_plays_all_without_a_line_in_the_log(scene: Callable[[str], Scene], name: str) -> None:
    found, account, log = scene(name)
    assert log == ""
    assert all(row.good for row in account.rows)
    numbers = [n for n, each in enumerate(found["sequences"]) if each["class"] == "vtkMRMLLinearTransformNode"]
    assert numbers
    for text, moved in found["played"]:
        for number in numbers:
            expected = item_at(found["sequences"][number], round(float(text) * 1000))
            assert np.abs(moved[number] - expected).max() < 1e-9


def test_pictures_lie_below_the_transform_of_their_frame(scene: Callable[[str], Scene]) -> None:
    found, _, _ = scene("ultrasound")
    one = sequence(found, "in:IMAGE/Image_Probe")
    with igtl_gateway.open(FIXTURES / "ultrasound.mcap") as recording:
        stream = recording["IMAGE/Image_Probe"]
        images, stamps = stream.images(), stream.stamps
    assert one["parent"] == "ProbeToTracker"
    assert len(one["items"]) == len(images) + 1
    for number, view in enumerate(images):
        at = (int(stamps[number]) - found["begin_ns"] + NS_PER_MS // 2) // NS_PER_MS
        item = item_at(one, at)
        assert np.array_equal(item["pixels"].ravel(), np.asarray(view.array).ravel())
        assert np.abs(item["place"] - view.matrix).max() < 1e-6
    assert not item_at(one, 0)["pixels"].any(), "an empty one before the first"


@pytest.mark.parametrize(("name", "picture"), [("ultrasound", "Image_Probe"), ("star", "star/camera/image")])
def test_slices_draw_pictures_in_their_colours(scene: Callable[[str], Scene], name: str, picture: str) -> None:
    found, _, _ = scene(name)
    (one,) = (each for each in found["sequences"] if each["name"] == picture)
    last = item_at(one, round(float(found["played"][-1][0]) * 1000))["pixels"]
    drawn = found["drawn"][picture][:, :3].astype(int)
    assert last.any()
    assert np.abs(drawn - last.reshape(len(last), -1)).max() <= 1


def test_surfaces_points_and_texts_are_the_recorded_ones(scene: Callable[[str], Scene]) -> None:
    found, _, _ = scene("star")
    with igtl_gateway.open(FIXTURES / "star.mcap") as recording:
        clouds, plan = recording["/star/cloud"].points(), recording["in:POINT/PlanPoints"].points()
        texts = [message.content.data for message in recording["/star/status"].messages()]
    one = sequence(found, "in:/star/cloud")
    assert one["parent"] == "star/camera_pose"
    items = [each for each in one["items"] if len(each["points"])]
    assert len(items) == len(clouds)
    for item, cloud in zip(items, clouds, strict=True):
        good = np.isfinite(cloud.xyz).all(axis=1)
        assert np.abs(item["points"] - cloud.xyz[good] * 1000).max() < 1e-3
        assert item["cells"] >= 1, "nothing is drawn of points without a cell"
        assert item["colours"] is not None
    points = [each for each in sequence(found, "in:POINT/PlanPoints")["items"] if len(each["points"])]
    assert np.abs(points[0]["points"] - plan[0].xyz).max() < 1e-6
    assert points[0]["labels"] == list(plan[0].names)
    assert [each for each in sequence(found, "in:/star/status")["items"] if each] == texts


def test_a_robot_stands_on_its_joints(scene: Callable[[str], Scene]) -> None:
    found, _, _ = scene("crtk")
    nodes = found["nodes"]
    assert nodes["PSM1_pitch"][1] == "PSM1_yaw"
    assert nodes["PSM1_insertion"][1] == "PSM1_pitch"
    moved = [each for each in found["sequences"] if each["name"] == "PSM1_insertion"]
    with igtl_gateway.open(FIXTURES / "crtk.mcap") as recording:
        states = list(recording["/PSM1/measured_js"].messages())
    place = list(states[-1].content.name).index("PSM1_insertion") if "PSM1_insertion" in states[-1].content.name else 2
    assert len(moved[0]["items"]) == len(states)
    table = found["tables"]["PSM1/measured_js"]
    names = [name for name in table if name.endswith(" position")]
    assert len(table["time [s]"]) == len(states)
    assert float(table[names[place]][-1]) == pytest.approx(float(states[-1].content.position[place]), abs=1e-12)


def test_it_states_where_it_is_from(scene: Callable[[str], Scene]) -> None:
    found, account, _ = scene("star")
    assert "star.mcap" in found["about"]
    assert f"SHA-256: {hashlib.sha256((FIXTURES / 'star.mcap').read_bytes()).hexdigest()}" in found["about"]
    assert "TRANSFORM/ToolToBase (TRANSFORM): 1,200: copies of /star/tool" in found["about"]
    assert any("stamps of the senders" in note for note in account.notes)


def test_a_folder_has_the_same_scene(tmp_path: Path, scene: Callable[[str], Scene]) -> None:
    made(FIXTURES / "ultrasound.mcap", tmp_path / "scene", "mrml")
    found, log = judged(tmp_path / "scene")
    assert log == ""
    whole, _, _ = scene("ultrasound")
    assert [each["index"] for each in found["sequences"]] == [each["index"] for each in whole["sequences"]]


# -- sessions that are made here


def session(path: Path, messages: list[tuple[int, Message]]) -> Path:
    """Messages of a peer, each at its time after the start, ns."""
    writer = SessionWriter(path, {})
    for number, (after_ns, message) in enumerate(messages, 1):
        at_ns = START_NS + after_ns
        stamped = Message(message.type, message.device_name, message.content, ns_to_ticks(at_ns))
        channel = f"{message.type}/{message.device_name}"
        data = b"".join(bytes(part) for part in encode(stamped))
        arrived_ns = at_ns + 1000 * number
        writer.write(Entry(number, arrived_ns, Kind.IGTL_IN, channel, message.type, (data,), (1,), at_ns))
    writer.close({})
    return path


def pose(x: float, device: str = "ToolToBase") -> Message:
    return Message("TRANSFORM", device, Transform((1.0, 0, 0, 0, 1, 0, 0, 0, 1, x, 0, 0)))


def test_items_of_one_millisecond_are_thinned_and_counted(tmp_path: Path) -> None:
    recording = session(tmp_path / "fast.mcap", [(number * NS_PER_MS // 2, pose(number)) for number in range(400)])
    account = made(recording, tmp_path / "fast.mrb")
    (row,) = account.rows
    assert (row.taken, row.left_out) == (201, 199)
    assert "another one has its millisecond" in row.why
    found, log = judged(tmp_path / "fast.mrb")
    assert log == ""
    assert len(set(found["sequences"][0]["index"])) == 201


def test_a_rate_keeps_the_first_of_each_period(tmp_path: Path) -> None:
    recording = session(tmp_path / "in.mcap", [(number * 10 * NS_PER_MS, pose(number)) for number in range(100)])
    account = made(recording, tmp_path / "slow.mrb", rate=10.0)
    assert account.rows[0].taken == 10
    assert "thinned to 10 Hz" in account.rows[0].why
    found, _ = judged(tmp_path / "slow.mrb")
    assert [item[0, 3] for item in found["sequences"][0]["items"]] == [float(10 * n) for n in range(10)]


def picture(level: int, x: float, size: tuple[int, int] = (6, 4)) -> Message:
    pixels = np.full(size[0] * size[1], level, np.uint8).tobytes()
    return Message("IMAGE", "Image", Image((*size, 1), 3, pixels, wire_matrix=(0.5, 0, 0, 0, 0.5, 0, 0, 0, 1, x, 2, 3)))


def test_pictures_that_move_have_a_transform_that_moves(tmp_path: Path) -> None:
    messages = [(number * 50 * NS_PER_MS, picture(number + 1, 10.0 * number)) for number in range(8)]
    recording = session(tmp_path / "moving.mcap", messages)
    made(recording, tmp_path / "moving.mrb")
    found, log = judged(tmp_path / "moving.mrb")
    assert log == ""
    volumes, moves = sequence(found, "in:IMAGE/Image"), sequence(found, "in:IMAGE/Image position")
    with igtl_gateway.open(recording) as opened:
        views = list(opened["IMAGE/Image"].images())
    assert volumes["parent"] == moves["name"]
    for item, move, view in zip(volumes["items"], moves["items"], views, strict=True):
        assert np.abs(move @ item["place"] - view.matrix).max() < 1e-6
        assert item["pixels"][0] == view.array.ravel()[0]
    with pytest.raises(UnsupportedRecording, match="several positions"):
        made(recording, tmp_path / "moving.seq.nrrd", "seq.nrrd")
    assert not (tmp_path / "moving.seq.nrrd").exists()


def test_pictures_of_one_millisecond_leave_the_others_whole(tmp_path: Path) -> None:
    """The pixels are written before the clock is known: then they are written again."""
    times = [0, 50 * NS_PER_MS, 50 * NS_PER_MS + 100_000, 100 * NS_PER_MS]
    recording = session(tmp_path / "same.mcap", [(at, picture(n + 1, 0.0)) for n, at in enumerate(times)])
    account = made(recording, tmp_path / "same.mrb")
    assert (account.rows[0].taken, account.rows[0].left_out) == (3, 1)
    found, log = judged(tmp_path / "same.mrb")
    assert log == ""
    assert [int(item["pixels"][0]) for item in found["sequences"][0]["items"]] == [1, 3, 4]
    made(recording, tmp_path / "same.seq.nrrd", "seq.nrrd")
    assert b"axis 3 index values:=0.000 0.050 0.100\n" in (tmp_path / "same.seq.nrrd").read_bytes()


def test_a_name_with_a_meaning_to_slicer_keeps_its_poses(tmp_path: Path) -> None:
    """Its reader drops transforms with Status in their name; names that are one as files are two nodes."""
    devices = ("StatusToBase", "Tool A", "Tool_A", "Transform")
    messages = [(n * NS_PER_MS * 10, pose(n, device)) for n in range(5) for device in devices]
    made(session(tmp_path / "names.mcap", messages), tmp_path / "names.mrb")
    found, log = judged(tmp_path / "names.mrb")
    assert log == ""
    assert sorted(each["name"] for each in found["sequences"]) == sorted(devices)
    assert all(len(each["items"]) == 5 for each in found["sequences"])


def test_words_of_any_kind_arrive(tmp_path: Path) -> None:
    texts = ["a\nb", 'call "hi" & <bye>', "naïve ; : %20", "tab\there"]
    messages = [(n * 20 * NS_PER_MS, Message("STRING", "Words", String(text.encode()))) for n, text in enumerate(texts)]
    made(session(tmp_path / "words.mcap", messages), tmp_path / "words.mrb")
    found, log = judged(tmp_path / "words.mrb")
    assert log == ""
    assert found["sequences"][0]["items"] == texts


def test_nothing_is_left_of_an_export_that_fails(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> bytes:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("igtl_gateway.addons.exchange.scene_out.pose_file", refuse)
    for to, out in (("mrb", tmp_path / "out.mrb"), ("mrml", tmp_path / "out")):
        with pytest.raises(GatewayError, match="No space left"):
            made(FIXTURES / "ultrasound.mcap", out, to)
    assert not list(tmp_path.iterdir())


def test_a_bundle_is_a_plain_zip_of_one_folder(tmp_path: Path) -> None:
    made(FIXTURES / "crtk.mcap", tmp_path / "my scene.mrb")
    with zipfile.ZipFile(tmp_path / "my scene.mrb") as bundle:
        names = bundle.namelist()
        assert bundle.testzip() is None
    assert {name.split("/")[0] for name in names} == {"my_scene"}
    assert "my_scene/my_scene.mrml" in names


def test_the_command_line_writes_and_refuses(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    recording, name = str(FIXTURES / "acquisition.mcap"), tmp_path / "out.seq.nrrd"
    first = session(tmp_path / "one.mcap", [(n * 50 * NS_PER_MS, picture(n, 0.0)) for n in range(3)])
    assert main(["export", str(first), "--to", "seq.nrrd", "-o", str(name)]) == 0
    assert main(["export", str(first), "--to", "mrb", "-o", str(tmp_path / "a.mrb"), "--rate", "10"]) == 0
    capsys.readouterr()
    for words, told in (
        (["--to", "mrb", "-o", str(tmp_path / "a.mcap")], "expected a scene of 3D Slicer: *.mrb"),
        (["--to", "mrb", "-o", str(tmp_path / "b.mrb"), "--rate", "0"], "--rate: found 0, expected 0.001 to 1,000 Hz"),
        (["--to", "csv", "-o", str(tmp_path / "t"), "--rate", "5"], "the option has no effect here"),
        (["--to", "mrml", "-o", str(tmp_path / "b.mrml")], "expected a directory"),
    ):
        assert main(["export", recording, *words]) != 0
        assert told in capsys.readouterr().err
