"""The module with the robot of a recording: the recorded bytes of a session, on a real socket."""

from __future__ import annotations

import threading

import pytest
from tool_monitor import ToolMonitor

STAR = "../../fixtures/star.mcap"  # relative to this file


def test_the_path_of_a_whole_session(igtl_replay):
    with igtl_replay(STAR, streams=["TRANSFORM/ToolToBase", "StarStatus"]) as robot:
        monitor = ToolMonitor(robot.host, robot.port, limit_mm=0)
        program = threading.Thread(target=monitor.run)
        program.start()
        robot.wait_connected()
        robot.play()  # 12 s of recorded time, at the highest rate without loss
        robot.wait_done()
    program.join()  # the server has closed
    assert monitor.path_mm == pytest.approx(285.789, abs=0.01)
    assert monitor.lowest_mm == pytest.approx(179.060, abs=0.01)
    assert robot.received == [], "no warning"


def test_a_tool_that_goes_too_deep_causes_a_warning(igtl_replay):
    with igtl_replay(STAR, streams=["ToolToBase"]) as robot:
        monitor = ToolMonitor(robot.host, robot.port, limit_mm=180)
        program = threading.Thread(target=monitor.run)
        program.start()
        robot.wait_connected()
        robot.play()
        warning = robot.wait_received(1, "STRING")[0]
    program.join()
    assert (warning.device_name, warning.content.text) == ("ToolMonitor", "tool below 180 mm")
