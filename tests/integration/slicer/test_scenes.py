"""What 3D Slicer finds in scenes of sessions that a user might have: plans, peers of one name, gaps, de-identified."""

from __future__ import annotations

import errno
import json
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import igtl_gateway
from igtl_gateway.addons.exchange.scene_reading import TooLarge
from igtl_gateway.addons.exchange.targets import export_to
from igtl_gateway.base.stamp import NS_PER_MS, NS_PER_S, ns_to_ticks
from igtl_gateway.cli import main
from igtl_gateway.convert.igtl_msgs import Trajectory, TrajectoryList
from igtl_gateway.convert.rosmsg import Header
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.record.sessionfile.reader import SessionFile
from igtl_gateway.record.sessionfile.writer import SessionWriter
from igtl_gateway.wire import Message, encode
from igtl_gateway.wire.image import Image
from igtl_gateway.wire.text import String
from igtl_gateway.wire.trajectory import ENTRY_AND_TARGET, ENTRY_ONLY, TARGET_ONLY, Trajectories
from igtl_gateway.wire.transform import Transform
from tests import slicer
from tests.places import FIXTURES

START_NS = 1_700_000_000 * NS_PER_S
#: Time after the start, ms; link; message.
Sent = tuple[int, int, Message]


def session(path: Path, messages: list[Sent], ros: Sequence[tuple[int, str, str, bytes]] = ()) -> Path:
    """Messages of peers, and of ROS: time, topic, type, bytes."""
    writer = SessionWriter(path, {})
    found: list[tuple[int, Kind, str, str, bytes, tuple[int, ...], int]] = []
    for after_ms, link, message in messages:
        at_ns = START_NS + after_ms * NS_PER_MS
        stamped = Message(message.type, message.device_name, message.content, ns_to_ticks(at_ns))
        data = b"".join(bytes(part) for part in encode(stamped))
        channel = f"{message.type}/{message.device_name}"
        found.append((at_ns, Kind.IGTL_IN, channel, message.type, data, (link,), at_ns))
    for after_ms, topic, kind, data in ros:
        at_ns = START_NS + after_ms * NS_PER_MS
        found.append((at_ns, Kind.ROS_IN, topic, kind, data, (), at_ns))
    for number, (at_ns, side, channel, kind, data, links, own_ns) in enumerate(
        sorted(found, key=lambda one: one[0]), 1
    ):
        writer.write(Entry(number, at_ns + number, side, channel, kind, (data,), links, own_ns))
    writer.close({})
    return path


def scene_of(recording: Path, cache: Path, globs: tuple[str, ...] = ()) -> Any:
    """The scene of a recording as 3D Slicer reads it, without a line in its log."""
    out = recording.with_suffix(".mrb")
    with SessionFile.open(recording) as file:
        export_to("mrb", file, out, globs)
    return read_scene(out, cache)


def sequence(scene: Any, stream: str) -> list[tuple[int, Any]]:
    """The items of the sequence of a stream: ms and node."""
    found = [
        node
        for number in range(scene.GetNumberOfNodesByClass("vtkMRMLSequenceNode"))
        if (node := scene.GetNthNodeByClass(number, "vtkMRMLSequenceNode")).GetAttribute("IgtlGateway.Stream") == stream
    ]
    (one,) = found
    return [(round(float(index) * 1000), node) for index, node in slicer.items(one)]


def points_of(node: Any) -> list[tuple[float, ...]]:
    return [tuple(node.GetNthControlPointPosition(at)) for at in range(node.GetNumberOfControlPoints())]


def plan(*paths: tuple[str, int, tuple[float, ...], tuple[float, ...]]) -> Message:
    elements = np.zeros(len(paths), Trajectories.DTYPE)
    for at, (name, kind, entry, target) in enumerate(paths):
        elements[at] = (name.encode(), b"Group", kind, 0, (255, 128, 0, 255), entry, target, 2.5, b"CT")
    return Message("TRAJ", "Plan", Trajectories(elements))


def test_each_path_of_a_plan_is_a_line(tmp_path: Path) -> None:
    first = ("left", ENTRY_AND_TARGET, (1.0, 2.0, 3.0), (4.0, 5.0, 6.5))
    moved = ("left", ENTRY_AND_TARGET, (1.5, 2.0, 3.0), (4.0, 5.0, 6.5))
    second = ("right", ENTRY_AND_TARGET, (-1.0, 0.0, 0.25), (-4.0, 0.0, 0.5))
    ends = (("", ENTRY_ONLY, (7.0, 7.0, 7.0), (0.0, 0.0, 0.0)), ("", TARGET_ONLY, (0.0, 0.0, 0.0), (8.0, 8.0, 8.0)))
    sent = [(0, 1, plan(first, second, *ends)), (500, 1, plan(moved)), (1000, 1, plan(second, moved))]
    scene = scene_of(session(tmp_path / "plan.mcap", sent), tmp_path / "cache")
    left = [(at, points_of(node)) for at, node in sequence(scene, "in:TRAJ/Plan left")]
    assert left == [(0, [first[2], first[3]]), (500, [moved[2], moved[3]]), (1000, [moved[2], moved[3]])]
    right = sequence(scene, "in:TRAJ/Plan right")
    assert [(at, points_of(node)) for at, node in right] == [
        (0, [second[2], second[3]]), (500, []), (1000, [second[2], second[3]]),
    ]  # fmt: skip
    assert all(node.IsA("vtkMRMLMarkupsLineNode") for _, node in right)
    node = right[0][1]
    assert [node.GetNthControlPointLabel(at) for at in range(2)] == ["entry", "target"]
    assert "diameter: 2.5 mm" in node.GetNthControlPointDescription(0)
    assert "group: Group" in node.GetNthControlPointDescription(1)
    assert points_of(sequence(scene, "in:TRAJ/Plan path")[0][1]) == [(7.0, 7.0, 7.0)]
    assert points_of(sequence(scene, "in:TRAJ/Plan path 2")[0][1]) == [(8.0, 8.0, 8.0)]


def test_a_plan_of_ros_is_in_millimetres(tmp_path: Path) -> None:
    path = Trajectory(
        "needle", "", ENTRY_AND_TARGET, (255, 255, 255, 255), (0.01, 0.02, 0.03), (0.04, 0.05, 0.06), 0.002, ""
    )
    data = TrajectoryList(Header(START_NS, "base"), (path,)).pack()
    recording = session(tmp_path / "ros.mcap", [], [(0, "/plan", TrajectoryList.TYPE, bytes(data))])
    scene = scene_of(recording, tmp_path / "cache")
    ((_, node),) = sequence(scene, "in:/plan needle")
    assert np.abs(np.array(points_of(node)) - [[10, 20, 30], [40, 50, 60]]).max() < 1e-4


def test_the_plan_of_star_is_there(tmp_path: Path) -> None:
    (tmp_path / "star.mcap").write_bytes((FIXTURES / "star.mcap").read_bytes())
    scene = scene_of(tmp_path / "star.mcap", tmp_path / "cache")
    with igtl_gateway.open(FIXTURES / "star.mcap") as recording:
        plans = [name for name in recording.streams if "TRAJ/" in name]
        lines = scene.GetNumberOfNodesByClass("vtkMRMLMarkupsLineNode")
    assert bool(plans) is bool(lines)


def pose(x: float, device: str = "Tool") -> Message:
    return Message("TRANSFORM", device, Transform((1.0, 0, 0, 0, 1, 0, 0, 0, 1, x, 0, 0)))


def places(items: list[tuple[int, Any]]) -> dict[int, float]:
    return {at: float(slicer.to_parent(node)[0, 3]) for at, node in items}


def test_two_peers_of_one_device_name_are_two_movements(tmp_path: Path) -> None:
    sent = [(20 * number, link, pose(1000.0 * link + number)) for number in range(20) for link in (1, 2)]
    scene = scene_of(session(tmp_path / "two.mcap", sent), tmp_path / "cache")
    for link in (1, 2):
        found = places(sequence(scene, f"in:TRANSFORM/Tool@{link}"))
        assert found == {20 * number: 1000.0 * link + number for number in range(20)}


def picture(level: int) -> Image:
    return Image((6, 4, 1), 3, bytes([level]) * 24, wire_matrix=(0.5, 0, 0, 0, 0.5, 0, 0, 0, 1, 1, 2, 3))


def test_pictures_of_two_peers_are_two_volumes(tmp_path: Path) -> None:
    sent = [
        (50 * number, link, Message("IMAGE", "Image", picture(100 * link + number)))
        for number in range(5)
        for link in (1, 2)
    ]
    scene = scene_of(session(tmp_path / "two.mcap", sent), tmp_path / "cache")
    for link in (1, 2):
        found = sequence(scene, f"in:IMAGE/Image@{link}")
        assert {at: int(slicer.voxels(node).flat[0]) for at, node in found} == {
            50 * number: 100 * link + number for number in range(5)
        }


def test_a_gap_keeps_its_times(tmp_path: Path) -> None:
    times = [*range(0, 200, 20), *range(5_000, 5_200, 20)]
    scene = scene_of(session(tmp_path / "gap.mcap", [(at, 1, pose(float(at))) for at in times]), tmp_path / "cache")
    assert places(sequence(scene, "in:TRANSFORM/Tool")) == {at: float(at) for at in times}


def test_a_session_in_parts_is_one_scene(tmp_path: Path) -> None:
    sent = [(20 * number, 1, pose(float(number))) for number in range(40)]
    whole, parts = session(tmp_path / "whole.mcap", sent), tmp_path / "parts"
    parts.mkdir()
    with SessionFile.open(whole) as file:
        entries = list(file.entries())
    for number in range(2):
        writer = SessionWriter(parts / f"parts_{number}.mcap", {"part": str(number)})
        for entry in entries[20 * number : 20 * number + 20]:
            writer.write(entry)
        writer.close({})
    scene = scene_of(parts, tmp_path / "cache")
    assert places(sequence(scene, "in:TRANSFORM/Tool")) == {20 * number: float(number) for number in range(40)}


def test_a_deidentified_session(tmp_path: Path) -> None:
    clean = tmp_path / "clean.mcap"
    assert main(["deidentify", str(FIXTURES / "ultrasound.mcap"), "-o", str(clean)]) < 2
    scene = scene_of(clean, tmp_path / "cache")
    with igtl_gateway.open(clean) as recording:
        name = next(name for name in recording.streams if name.startswith("TRANSFORM/"))
        poses = recording[name].poses().in_unit("mm")
    found = [slicer.to_parent(node) for _, node in sequence(scene, f"in:{name}")]
    assert np.abs(np.array(found[-len(poses) :]) - poses.matrices).max() < 1e-6


PARTS = "igtl_gateway.addons.exchange.scene_reading.MOST_PIXELS"


def text(words: bytes) -> Message:
    return Message("STRING", "Phase", String(words))


def in_parts(path: Path) -> Path:
    """Ten pictures at 20 Hz, poses at 100 Hz, a pose that comes once, and strings."""
    sent = [(50 * number, 1, Message("IMAGE", "Image", picture(number))) for number in range(10)]
    sent += [(10 * number, 1, pose(float(number))) for number in range(46)]
    sent += [(0, 1, pose(7.0, "Once")), (5, 1, text(b"plan")), (420, 1, text(b"cut"))]
    return session(path, sent)


def read_scene(out: Path, cache: Path) -> Any:
    """A scene as 3D Slicer reads it, without a line in its log."""
    scene = slicer.new_scene(cache)
    logic = slicer.slicer().vtkSlicerSequencesLogic()
    with slicer.log_of():  # it registers nodes again
        logic.SetMRMLScene(scene)
    scene.AddNewNodeByClass("vtkMRMLSelectionNode")  # of the program
    with slicer.log_of() as log:
        if out.suffix == ".mrb":
            assert scene.ReadFromMRB(str(out), False)
        else:
            scene.SetURL(str(out / f"{out.name}.mrml"))
            assert scene.Import()
    assert not log, log
    return scene


@pytest.mark.parametrize("to", ["mrb", "mrml"])
def test_more_pictures_than_a_scene_holds_are_parts_that_open_alone(
    to: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    recording = in_parts(tmp_path / "long.mcap")
    monkeypatch.setattr(PARTS, 5 * 24)
    suffix = ".mrb" if to == "mrb" else ""
    outs = [tmp_path / "out" / f"a{number}{suffix}" for number in ("", "-2", "-3")]
    outs[0].parent.mkdir()
    assert main(["export", str(recording), "--to", to, "-o", str(outs[0]), "--json"]) == 0
    account = json.loads(capsys.readouterr().out)
    assert sorted(outs[0].parent.iterdir()) == sorted(outs)
    assert account["files"] == 3 and {(row["stream"], row["found"], row["exported"]) for row in account["rows"]} == {
        ("IMAGE/Image", 10, 10), ("TRANSFORM/Tool", 46, 46), ("TRANSFORM/Once", 1, 1), ("STRING/Phase", 2, 2),
    }  # fmt: skip
    for number, out in enumerate(outs, 1):
        assert any(f"part {number}, {out.name}: index 0 is 2023-11-14" in note for note in account["notes"])
    # the second and third one begin with a copy of the picture before them, so four of their five are new
    begins, ends = [0, 250, 450], [240, 440, 450]
    phases = [{0: "", 5: "plan"}, {0: "plan", 170: "cut"}, {0: "cut"}]
    for number, (out, begin, end, phase) in enumerate(zip(outs, begins, ends, phases, strict=True), 1):
        scene = read_scene(out, tmp_path / f"cache{number}")
        movement = places(sequence(scene, "in:TRANSFORM/Tool"))
        assert movement == pytest.approx({at - begin: at / 10 for at in range(begin, end + 1, 10)}, abs=1e-9)
        assert places(sequence(scene, "in:TRANSFORM/Once")) == {0: 7.0}
        pixels = {at: int(slicer.voxels(node).max()) for at, node in sequence(scene, "in:IMAGE/Image")}
        assert pixels == {at - begin: at // 50 for at in range(begin, end + 1, 50)}
        assert {at: node.GetText() for at, node in sequence(scene, "in:STRING/Phase")} == phase
        about = scene.GetFirstNodeByName("About this scene")
        assert f"part {number}, {out.name}" in about.GetText()


def test_no_part_is_left_of_an_export_that_fails(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    recording, out = in_parts(tmp_path / "long.mcap"), tmp_path / "out"
    monkeypatch.setattr(PARTS, 5 * 24)
    out.mkdir()
    (out / "a-3.mrb").write_bytes(b"mine")
    assert main(["export", str(recording), "--to", "mrb", "-o", str(out / "a.mrb")]) == 2
    assert [each.name for each in out.iterdir()] == ["a-3.mrb"]
    (out / "a-3.mrb").unlink()

    def full(old: Path, new: Path, *, overwrite: bool) -> None:
        if new.name == "a.mrb":
            raise OSError(errno.ENOSPC, "No space left on device")
        os.rename(old, new)

    monkeypatch.setattr("igtl_gateway.record.sessionfile.whole_files._move", full)
    assert main(["export", str(recording), "--to", "mrb", "-o", str(out / "a.mrb")]) != 0
    assert not list(out.iterdir())


def test_one_sequence_with_more_pictures_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    recording = in_parts(tmp_path / "long.mcap")
    monkeypatch.setattr(PARTS, 5 * 24)
    assert main(["export", str(recording), "--to", "seq.nrrd", "-o", str(tmp_path / "a.seq.nrrd")]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "found 240 bytes of pictures" in line and "expected at most 120" in line and "--to mrb" in line
    assert [each.name for each in tmp_path.iterdir()] == ["long.mcap"]
    assert main(["export", str(recording), "--to", "seq.nrrd", "-o", str(tmp_path / "a.seq.nrrd"), "--rate", "10"]) == 0
    with SessionFile.open(recording) as file, pytest.raises(TooLarge):
        export_to("seq.nrrd", file, tmp_path / "b.seq.nrrd", ())
