"""The programs of docs/start/install.md: ``tools/try_release.py`` runs them in a fresh environment, this in ours."""

from __future__ import annotations

import os
import sys
from pathlib import Path

import pytest

from tools.try_release import PAGE, PORT, Trial, exchange, programs


def test_the_page_has_both_programs_with_the_port_of_the_bridge() -> None:
    found = programs(PAGE.read_text("utf-8"))
    assert found.keys() == {"listen.py", "send.py"}
    assert PORT in found["send.py"]


@pytest.mark.ros
@pytest.mark.slow
@pytest.mark.skipif("IGTL_GATEWAY_TRIAL" not in os.environ, reason="opt-in: set IGTL_GATEWAY_TRIAL=1")
def test_a_pose_passes_and_the_recording_verifies(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "igtl").symlink_to(sys.prefix)
    trial = Trial(tmp_path)
    trial.environment["PYTHONPATH"] = str(PAGE.parents[2])
    trial.environment["ROS_DOMAIN_ID"] = os.environ["ROS_DOMAIN_ID"]
    printed = exchange(trial)
    assert "Vector3(x=0.01, y=0.02, z=0.03)" in printed
    assert "bridge: first message" in capsys.readouterr().out
