"""``igtl-gateway demo``: the first thing that a new user runs."""

from __future__ import annotations

import importlib.util
import subprocess
import sys
from pathlib import Path

import pytest

from igtl_gateway.record.sessionfile.reader import SessionFile

pytestmark = [
    pytest.mark.ros,
    pytest.mark.skipif(importlib.util.find_spec("rclpy") is None, reason="ROS 2 (rclpy) is not installed"),
]


def test_the_demo_does_what_it_says(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "igtl_gateway", "demo", "--seconds", "3", "--keep", str(tmp_path)]
    told = subprocess.run(command, capture_output=True, text=True, check=False, timeout=110)
    assert told.returncode == 0, told.stdout + told.stderr
    assert "Traceback" not in told.stderr
    for sentence in (
        "ROS 2 node (rclpy) sent",
        "OpenIGTLink client (pyigtl) sent",
        "verified: all",
        "bytes were identical",
    ):
        assert sentence in told.stdout
    recording = tmp_path / "demo.mcap"
    assert f"demo: all good; the recording is {recording}" in told.stdout
    commands = [line.split("  ")[1] for line in told.stdout.partition("try next\n")[2].splitlines()]
    assert [words.split()[1] for words in commands] == ["view", "replay", "bridge"]
    with SessionFile.open(tmp_path / "demo.mcap") as file:
        assert file.ledger is not None and not file.ledger["recorder"]["dropped_entries"]
