"""A service and an action of rclpy, recorded: what is named although it is hidden, and what ``--record-all`` takes."""

from __future__ import annotations

import json
import sys
from collections import Counter
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path

import pytest

from igtl_gateway.cli import main
from igtl_gateway.record.sessionfile.reader import SessionFile
from tests.integration.bridge import Bridge, Program
from tests.integration.test_cli_bridge import wait_flushed

WORLD = Path(__file__).with_name("services_world.py")
RESULTS = "/fib/_action/get_result/_service_event"
EVENTS, STATES, FEEDBACK = "/arm/enable/_service_event", "/fib/_action/status", "/fib/_action/feedback"
NAMED = ["/arm/enable/_service_event", "/fib/_action/**", "/rosout"]

pytestmark = [
    pytest.mark.slow,
    pytest.mark.ros,
    pytest.mark.skipif(not find_spec("test_msgs"), reason="needs test_msgs"),
]


@pytest.fixture
def world() -> Iterator[Program]:
    running = Program([sys.executable, str(WORLD)])
    yield running
    running.close()


@pytest.mark.parametrize(
    "options", [["--record-topics", *NAMED], pytest.param(["--record-all"], marks=pytest.mark.long)]
)
def test_a_service_and_an_action_are_recorded(
    options: list[str], world: Program, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "out.mcap"
    bridge = Bridge("--record", str(path), *options)
    try:
        world.wait_until(lambda: "end" in world.lines, "end of the goals")
        wait_flushed(path, lambda found: Counter(topic for topic, _ in found)[RESULTS] == 6)
        result = bridge.end()
    finally:
        bridge.close()
    assert (result.code, result.err) == (0, "")
    assert world.lines[:3] == ["3 4", "9 6", "5 5"]
    with SessionFile.open(path) as file:
        counts = Counter(entry.channel for entry in file.entries())
        types = {each.topic: each.type for each in file.channels}
    assert counts[EVENTS] == 16 and counts[STATES] >= 9 and counts[FEEDBACK] >= 6
    assert ("/rosout" in counts) is (options[0] == "--record-topics")
    assert types[EVENTS] == "std_srvs/srv/SetBool_Event"
    assert types[RESULTS] == "test_msgs/action/Fibonacci_GetResult_Event"
    assert types[FEEDBACK] == "test_msgs/action/Fibonacci_FeedbackMessage"
    assert main(["info", str(path), "--json"]) == 0
    facts = json.loads(capsys.readouterr().out)
    assert [(each["service"], each["calls"], each["answered"]) for each in facts["services"]] == [("/arm/enable", 4, 4)]
    (action,) = facts["actions"]
    assert [action[key] for key in ("goals", "succeeded", "aborted", "canceled", "open")] == [3, 1, 1, 1, 0]
