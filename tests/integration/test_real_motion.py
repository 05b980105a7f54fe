"""Real recordings as sessions: PLUS's water tank by our import, and the movement of a real dVRK."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

import igtl_gateway
from igtl_gateway.api.lags import movement
from igtl_gateway.cli import main
from igtl_gateway.convert.common_msgs import JointState, PoseStamped
from igtl_gateway.convert.rosmsg import Header
from igtl_gateway.session.entry import Entry, Kind
from igtl_gateway.sessionfile.writer import SessionWriter
from igtl_gateway.stamp import NS_PER_MS, NS_PER_S
from igtl_gateway.sync.plus import plus_lag
from igtl_gateway.sync.signal import Signal, main_component

BASELINE_S = -0.0648266
START_NS = 1_767_225_600 * NS_PER_S
LATE_NS = 120 * NS_PER_MS
JOINTS = ("yaw", "pitch", "insertion", "roll", "wrist_pitch", "wrist_yaw")


def test_the_method_of_plus_on_our_import_of_its_sequences(
    shared_dir: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for name in ("Video", "Tracker"):
        source = shared_dir / f"data/plus-temporal-calibration/WaterTankBottomTranslation{name}Buffer.igs.mha"
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


@pytest.fixture
def insertions(shared_dir: Path, tmp_path: Path) -> Path:
    """Needle insertions of a real dVRK (d-lfd, MIT): pose and joints of one arm; the joints are stamped 120 ms late."""
    with np.load(shared_dir / "data/star/dlfd_kinematics.npz") as data:
        poses, joints = data["arm1_T"][: data["trial_offsets"][12]], data["arm1_q"]
    path = tmp_path / "insertions.mcap"
    writer = SessionWriter(path, {})
    number = 0
    for index, pose in enumerate(poses.astype(np.float64)):
        stamp_ns = START_NS + index * NS_PER_S // 16
        w = np.sqrt(max(1 + pose[0, 0] + pose[1, 1] + pose[2, 2], 1e-12)) / 2
        turn = (pose[2, 1] - pose[1, 2], pose[0, 2] - pose[2, 0], pose[1, 0] - pose[0, 1])
        quaternion = (*(part / (4 * w) for part in turn), w)
        late_ns = stamp_ns + LATE_NS
        for topic, message, source_ns in (
            ("/PSM1/measured_cp", PoseStamped(Header(stamp_ns, "base"), (*pose[:, 3], *quaternion)), stamp_ns),
            ("/PSM1/measured_js", JointState(Header(late_ns, ""), JOINTS, joints[index].astype(np.float64)), late_ns),
        ):
            number += 1
            entry = Entry(number, stamp_ns + number, Kind.ROS_IN, topic, message.TYPE, (message.pack(),), (), source_ns)
            writer.write(entry)
    writer.close({})
    return path


@pytest.mark.slow
def test_the_lag_between_pose_and_joints_of_a_real_arm(
    insertions: Path, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    assert main(["sync", str(insertions), "/PSM1/measured_cp", "/PSM1/measured_js", "--json"]) in (0, 1)
    (lag,) = json.loads(capsys.readouterr().out)["lags"]
    assert lag["verdict"] in ("measured", "varies")
    assert lag["lag_s"] == pytest.approx(0.12, abs=0.025)
    assert lag["low_s"] <= 0.12 <= lag["high_s"]
    assert main(["export", str(insertions), "--to", "parquet", "--out", str(tmp_path / "tables")]) == 0
    assert len(list((tmp_path / "tables").rglob("*.parquet"))) == 2
    assert main(["view", str(insertions), "--save", str(tmp_path / "out.rrd"), "--json"]) == 0
