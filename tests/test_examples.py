"""The worked examples in examples/ do what they show."""

from __future__ import annotations

import re
import shutil
from pathlib import Path

import numpy as np
import pytest

from igtl_gateway.convert.common_msgs import JointState, PoseStamped
from igtl_gateway.convert.rosmsg import Header
from igtl_gateway.testing.gateway import ManualGateway
from igtl_gateway.wire import Message
from igtl_gateway.wire.transform import Transform
from tests.places import ROOT
from tests.testing.outside import run_pytest


def programs_in(page: str) -> list[str]:
    """The Python of a document, block by block."""
    return re.findall(r"^```python\n(.*?)^```", (ROOT / "docs" / page).read_text("utf-8"), re.DOTALL | re.MULTILINE)


def test_without_hardware() -> None:
    result = run_pytest(ROOT / "examples" / "test_without_hardware")
    assert result.returncode == 0, result.stdout + result.stderr
    outcome = re.search(r"(\d+) passed(?:, 1 skipped)?[ ,]", result.stdout)  # without ROS one is skipped
    assert outcome, result.stdout
    assert int(outcome[1]) >= 4


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


def test_the_first_offline_test(tmp_path: Path) -> None:
    """docs/how-to/offline-test.md, as a reader types it."""
    program, test = programs_in("how-to/offline-test.md")
    (tmp_path / "watch.py").write_text(program, "utf-8")
    (tmp_path / "test_watch.py").write_text(test, "utf-8")
    shutil.copyfile(ROOT / "fixtures" / "star.mcap", tmp_path / "star.mcap")
    result = run_pytest(tmp_path)
    assert result.returncode == 0, result.stdout + result.stderr


def test_from_a_recording_to_numpy(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.chdir(ROOT)
    for program in programs_in("how-to/numpy.md"):
        exec(program, {})
    assert capsys.readouterr().out.splitlines() == [
        "(1200, 4, 4) mm",
        "fastest: 143 mm/s",
        "99",
        "(1200, 4, 4) m",
        "(1, 240, 320, 3) (240, 320, 3) uint8 (1.0, 1.0, 1.0) mm",
        "(27197, 3) mm ['RGB']",
    ]
