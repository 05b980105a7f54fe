"""Movement as programs record it: PLUS's water tank by our import, and needle insertions of an arm."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

import igtl_gateway
from igtl_gateway.addons.sync.lags import movement
from igtl_gateway.addons.sync.plus import plus_lag
from igtl_gateway.addons.sync.signal import Signal, main_component
from igtl_gateway.base.stamp import NS_PER_MS, NS_PER_S
from igtl_gateway.cli import main
from igtl_gateway.convert.common_msgs import JointState, PoseStamped
from igtl_gateway.convert.rosmsg import Header
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.record.sessionfile.writer import SessionWriter
from tests.plus_sequences import water_tank_tracker, water_tank_video

Array = npt.NDArray[Any]

BASELINE_S = -0.0648266
START_NS = 1_767_225_600 * NS_PER_S
LATE_NS = 120 * NS_PER_MS
JOINTS = ("yaw", "pitch", "insertion", "roll", "wrist_pitch", "wrist_yaw")


def test_the_method_of_plus_on_our_import_of_its_sequences(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for name, write in (("Video", water_tank_video), ("Tracker", water_tank_tracker)):
        source = write(tmp_path / f"{name}.igs.mha")
        assert main(["import", str(source), "-o", str(tmp_path / f"{name}.mcap")]) == 0
    with igtl_gateway.open(tmp_path / "Video.mcap") as video, igtl_gateway.open(tmp_path / "Tracker.mcap") as tracker:
        line = movement(video["IMAGE/Image"], line=True)
        probe, reference = (tracker[f"TRANSFORM/{name}ToTracker"] for name in ("Probe", "Reference"))
        both = probe.source_times
        assert np.array_equal(both, reference.source_times)  # one frame of the file has both
        places = np.linalg.inv(reference.poses().matrices) @ probe.poses().matrices
        unit = probe.unit
    near = (both >= line.times_ns[0] - NS_PER_S) & (both <= line.times_ns[-1] + NS_PER_S)
    found = plus_lag(line, Signal.of(both[near], main_component(places[near, :3, 3]), "tracker", unit))
    assert found
    assert found.lag_s == pytest.approx(BASELINE_S, abs=0.001)
    capsys.readouterr()


def insertion_joints(count: int) -> Array:
    """Joints (count, 6) of an arm that puts a needle in again and again: 10 s each at 16 Hz, never twice alike.

    It goes to a place, waits, goes in, waits and comes out; a hand trembles.
    """
    chance = np.random.default_rng(12)
    joints = np.zeros((count, 6))
    for start in range(0, count, 160):
        size = min(160, count - start)
        place = chance.uniform(-0.25, 0.25, 6) * (1, 1, 0, 2, 1, 1)
        depth, begin, speed = chance.uniform(0.02, 0.04), chance.uniform(2, 4), chance.uniform(0.5, 1.5)
        seconds = np.arange(size) / 16
        share = 1 / (1 + np.exp(-4 * speed * (seconds - 1)))
        inside = 1 / (1 + np.exp(-3 * speed * (seconds - begin))) - 1 / (1 + np.exp(-3 * speed * (seconds - begin - 4)))
        before = joints[start - 1] if start else np.zeros(6)
        joints[start : start + size] = before + share[:, np.newaxis] * (place - before)
        joints[start : start + size, 2] = 0.1 + depth * inside
    tremor = np.cumsum(chance.normal(0, 1, (count, 6)), axis=0)
    tremor -= np.stack([np.convolve(column, np.ones(33) / 33, "same") for column in tremor.T], axis=1)
    return np.asarray(joints + tremor * (3e-4, 3e-4, 5e-5, 3e-3, 1e-3, 1e-3))


def turn(axis: int, angle: float) -> Array:
    """Rotation (3, 3) about a coordinate axis."""
    made = np.eye(3)
    first, second = (axis + 1) % 3, (axis + 2) % 3
    made[[first, second], [first, second]] = math.cos(angle)
    made[first, second], made[second, first] = -math.sin(angle), math.sin(angle)
    return made


def tip(joints: Array) -> Array:
    """Pose (3, 4) in metres of the tip of an arm that turns about a remote centre of motion."""
    yaw, pitch, depth, roll, wrist_pitch, wrist_yaw = joints.tolist()
    shaft = turn(1, yaw) @ turn(0, pitch)
    wrist = shaft @ turn(2, roll) @ turn(0, wrist_pitch) @ turn(1, wrist_yaw)
    return np.asarray(np.c_[wrist, shaft @ (0, 0, -depth) + wrist @ (0, 0, -0.01)])


@pytest.fixture
def insertions(tmp_path: Path) -> Path:
    """Needle insertions like those of a dVRK: pose and joints of one arm; the joints are stamped 120 ms late."""
    joints = insertion_joints(1600)
    poses = np.array([tip(row) for row in joints])
    path = tmp_path / "insertions.mcap"
    writer = SessionWriter(path, {})
    number = 0
    for index, pose in enumerate(poses):
        stamp_ns = START_NS + index * NS_PER_S // 16
        w = np.sqrt(max(1 + pose[0, 0] + pose[1, 1] + pose[2, 2], 1e-12)) / 2
        turn = (pose[2, 1] - pose[1, 2], pose[0, 2] - pose[2, 0], pose[1, 0] - pose[0, 1])
        quaternion = (*(part / (4 * w) for part in turn), w)
        late_ns = stamp_ns + LATE_NS
        for topic, message, source_ns in (
            ("/PSM1/measured_cp", PoseStamped(Header(stamp_ns, "base"), (*pose[:, 3], *quaternion)), stamp_ns),
            ("/PSM1/measured_js", JointState(Header(late_ns, ""), JOINTS, joints[index]), late_ns),
        ):
            number += 1
            entry = Entry(number, stamp_ns + number, Kind.ROS_IN, topic, message.TYPE, (message.pack(),), (), source_ns)
            writer.write(entry)
    writer.close({})
    return path


@pytest.mark.slow
def test_the_lag_between_pose_and_joints_of_an_arm(
    insertions: Path, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    assert main(["sync", str(insertions), "/PSM1/measured_cp", "/PSM1/measured_js", "--json"]) in (0, 1)
    (lag,) = json.loads(capsys.readouterr().out)["lags"]
    assert lag["verdict"] in ("measured", "varies")
    assert lag["lag_s"] == pytest.approx(0.12, abs=0.025)
    assert lag["low_s"] <= 0.12 <= lag["high_s"]
    assert main(["export", str(insertions), "--to", "parquet", "-o", str(tmp_path / "tables")]) == 0
    assert len(list((tmp_path / "tables").rglob("*.parquet"))) == 2
    assert main(["view", str(insertions), "-o", str(tmp_path / "out.rrd"), "--json"]) == 0
