"""The worked examples in examples/ do what they show."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest

import igtl_gateway
from igtl_gateway import cli
from igtl_gateway.convert.common_msgs import JointState, PoseStamped
from igtl_gateway.convert.rosmsg import Header
from igtl_gateway.testing.compare import assert_session_equal
from igtl_gateway.testing.gateway import ManualGateway
from igtl_gateway.wire import Message
from igtl_gateway.wire.transform import Transform
from tests.places import ROOT
from tests.testing.outside import run_pytest


def programs_in(page: str) -> list[str]:
    """The Python of a document, block by block."""
    return re.findall(r"^```python\n(.*?)^```", (ROOT / "docs" / page).read_text("utf-8"), re.DOTALL | re.MULTILINE)


@pytest.mark.slow
def test_without_hardware() -> None:
    result = run_pytest(ROOT / "examples" / "test_without_hardware")
    assert result.returncode == 0, result.stdout + result.stderr
    outcome = re.search(r"(\d+) passed(?:, 1 skipped)?[ ,]", result.stdout)  # without ROS one is skipped
    assert outcome, result.stdout
    assert int(outcome[1]) >= 4


@pytest.mark.ros
@pytest.mark.skipif(not find_spec("rclpy"), reason="needs ROS 2")
def test_a_planner_on_its_recording() -> None:
    result = run_pytest(ROOT / "examples" / "resim")
    assert result.returncode == 0, result.stdout + result.stderr
    assert "2 passed" in result.stdout


def test_the_recording_of_the_planner(tmp_path: Path) -> None:
    """Its script writes it again; with the baseline it is small enough for any repository."""
    folder = ROOT / "examples" / "resim"
    script, kept = folder / "make_recording.py", folder / "test" / "session.mcap"
    subprocess.run([sys.executable, str(script), str(tmp_path / "again.mcap")], check=True)
    assert_session_equal(kept, tmp_path / "again.mcap")
    assert sum(path.stat().st_size for path in kept.parent.glob("*.mcap")) < 200_000


def test_dvrk() -> None:
    """Poses and joints of the arms go to the peers; no message of a peer goes to ROS."""
    gateway = ManualGateway(ROOT / "examples" / "dvrk.toml")
    gateway.connect()
    pose = PoseStamped(Header(gateway.now_ns, "ECM"), (0.1, 0.0, 0.25, 0.0, 0.0, 0.0, 1.0))
    for topic, device in (("/PSM1/measured_cp", "PSM1_measured_cp"), ("/ECM/measured_cp", "EndoscopeToBase")):
        (sent,) = gateway.from_ros(topic, pose).igtl("TRANSFORM/**")
        assert sent.message.device_name == device
        assert isinstance(sent.message.content, Transform)
        assert sent.message.content.wire_matrix[9:] == pytest.approx((100.0, 0.0, 250.0))  # millimetres
    joints = JointState(Header(gateway.now_ns), ("yaw", "pitch", "insertion"), np.array([0.1, 0.2, 0.3]))
    (sent,) = gateway.from_ros("/PSM2/measured_js", joints).igtl("SENSOR/**")
    assert sent.stream == "SENSOR/PSM2_measured_js"
    assert gateway.from_ros("/PSM1/servo_cp", pose).igtl() == []
    identity = Transform((1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0))
    assert gateway.from_peer(Message("TRANSFORM", "PSM1/servo_cp", identity)).ros("/igtl/in/**") == []


@pytest.mark.slow
def test_the_first_offline_test(tmp_path: Path) -> None:
    """docs/how-to/offline-test.md, as a reader types it."""
    program, test = programs_in("how-to/offline-test.md")
    (tmp_path / "watch.py").write_text(program, "utf-8")
    (tmp_path / "test_watch.py").write_text(test, "utf-8")
    shutil.copyfile(ROOT / "fixtures" / "star.mcap", tmp_path / "star.mcap")
    result = run_pytest(tmp_path)
    assert result.returncode == 0, result.stdout + result.stderr


def test_an_addon_of_a_stranger(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Its entry point is that of an installed distribution; it stands only on the surface for add-ons."""
    folder = ROOT / "examples" / "addon"
    (place,) = re.findall(r'^count = "(.*)"$', (folder / "pyproject.toml").read_text("utf-8"), re.MULTILINE)
    meta = tmp_path / "igtl_gateway_count-1.dist-info"
    meta.mkdir()
    (meta / "METADATA").write_text("Metadata-Version: 2.1\nName: igtl-gateway-count\nVersion: 1\n", "utf-8")
    (meta / "entry_points.txt").write_text(f"[igtl_gateway.verbs]\ncount = {place}\n", "utf-8")
    for each in (folder, tmp_path):
        monkeypatch.syspath_prepend(str(each))
    star, out = str(ROOT / "fixtures" / "star.mcap"), tmp_path / "count.csv"
    assert cli.main(["count", star, "/star/tool", "-o", str(out)]) == 0
    head, *rows = out.read_text("utf-8").splitlines()
    assert head == "second,messages" and [row.split(",")[0] for row in rows] == list(map(str, range(len(rows))))
    with igtl_gateway.open(star) as recording:
        assert sum(int(row.split(",")[1]) for row in rows) == len(recording["/star/tool"])
    assert cli.main(["count", star, "/star/none", "-o", str(tmp_path / "none.csv")]) == 1
    assert "found no stream '/star/none'" in capsys.readouterr().err
    text = (folder / "igtl_gateway_count.py").read_text("utf-8")
    assert set(re.findall(r"^from (igtl_gateway(?:\.\w+)?)\S* import", text, re.MULTILINE)) == {"igtl_gateway.addon"}
