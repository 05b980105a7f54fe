"""The plugin in a project of a user: pytest in a separate process."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tests.places import ROOT
from tests.testing.outside import run_pytest

FIXTURES = ROOT / "fixtures"

TESTS = """
import socket

from igtl_gateway.wire import Header

def test_replay(igtl_replay):
    with igtl_replay("star.mcap", streams=["StarStatus"]) as peer:
        with socket.create_connection((peer.host, peer.port), 20) as client:
            peer.wait_connected()
            peer.play()
            data = client.recv(58, socket.MSG_WAITALL)
            assert Header.unpack(data).device_name == "StarStatus"

def test_not_closed_by_the_test(igtl_replay):
    igtl_replay("star.mcap").play()

def test_gateway(igtl_gateway, assert_session_equal):
    gateway = igtl_gateway("lab.toml", base_frame="map")
    assert (gateway.config.ros_unit, gateway.config.base_frame) == ("mm", "map")
    again = igtl_gateway("star.mcap")
    again.play("star.mcap")
    assert_session_equal("star.mcap", again)

def test_difference(igtl_gateway, assert_session_equal):
    assert_session_equal("star.mcap", igtl_gateway())
"""


@pytest.mark.slow
def test_a_project_uses_the_fixtures(tmp_path: Path) -> None:
    (tmp_path / "test_it.py").write_text(TESTS)
    (tmp_path / "lab.toml").write_text('[gateway]\nros_unit = "mm"\n')
    shutil.copy(FIXTURES / "star.mcap", tmp_path)
    # the working directory is another one: paths are relative to the test
    result = run_pytest(tmp_path, "-W", "error")
    assert "1 failed, 3 passed" in result.stdout, result.stdout + result.stderr
    assert "AssertionError: sessions differ" in result.stdout
    assert "OpenIGTLink out IMAGE/Camera: 12 messages expected, 0 found" in result.stdout


def test_nothing_is_imported_before_it_is_used() -> None:
    code = (
        "import pytest, sys; before = set(sys.modules); import igtl_gateway.testing.plugin; "
        "print(sorted(name for name in set(sys.modules) - before))"
    )
    env = os.environ | {"PYTHONPATH": str(ROOT)}
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=env, check=True)
    version = ["igtl_gateway.base", "igtl_gateway.base.version"]
    plugin = ["igtl_gateway.testing", "igtl_gateway.testing.plugin"]
    assert result.stdout.strip() == str(["igtl_gateway", *version, *plugin])


def test_no_ros_is_needed() -> None:
    code = (
        "import sys; sys.modules['rclpy'] = None; sys.modules['geometry_msgs'] = None; "  # as if not installed
        "from igtl_gateway.testing import compare, gateway, peer; "
        "gateway.ManualGateway().from_peer(bytes(58)); peer.ReplayPeer(sys.argv[1]).close()"
    )
    env = os.environ | {"PYTHONPATH": str(ROOT)}
    subprocess.run([sys.executable, "-c", code, str(FIXTURES / "star.mcap")], env=env, check=True)
