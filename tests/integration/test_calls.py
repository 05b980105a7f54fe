"""A service and an action of rclpy: recorded, verified, answered by a replay, called by one, and in a re-simulation."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path

import pytest

from igtl_gateway.addons.resim.engine import Program as Resimulated
from igtl_gateway.addons.resim.engine import ResimOptions, run
from igtl_gateway.addons.resim.verdict import compare
from igtl_gateway.cli import main
from igtl_gateway.convert.exchanges import action_of
from igtl_gateway.record.sessionfile.reader import SessionFile
from tests.addons.resim.runs import strings
from tests.integration.bridge import Bridge, Program, environment, gateway

pytestmark = [
    pytest.mark.ros,
    pytest.mark.skipif(not find_spec("rclpy") or not find_spec("test_msgs"), reason="needs ROS 2 and test_msgs"),
]
NODE = Path(__file__).with_name("calls_node.py")
SAID = [
    "True: True on",
    "False: False off",
    "1: 4 [1, 10] feedback [1, 2] cancel -",
    "2: 6 [2, 20] feedback [1, 2] cancel -",
    "3: 5 [3, 30] feedback [1, 2] cancel 0",
    "4: rejected",
    "end",
]
#: Responses that a replay gets as a client.
CALLED = {"send_goal": "4 responses", "get_result": "3 responses", "cancel_goal": "1 response"}


@contextmanager
def node(role: str) -> Iterator[Program]:
    program = Program([sys.executable, str(NODE), role], environment())
    try:
        yield program
        program.end()  # one that is killed stays in the graph for a while
    finally:
        program.close()


def said_by_a_client() -> list[str]:
    with node("client") as client:
        client.wait_until(lambda: "end" in client.lines, "end of the client")
        return client.lines


def record(path: Path) -> Path:
    """What a client asks of a server, recorded."""
    topics = ("/enable/_service_event", "/fib/_action/**", "/out")
    with node("server"):
        bridge = Bridge("--record", str(path), *(word for topic in topics for word in ("--record-topics", topic)))
        try:
            assert said_by_a_client() == SAID
            assert bridge.end().code == 0
        finally:
            bridge.close()
    return path


def test_from_the_record_to_the_re_simulation(tmp_path: Path) -> None:
    recording = record(tmp_path / "calls.mcap")
    assert main(["verify", str(recording)]) == 0

    only = ("--streams", "/enable/**", "--streams", "/fib/**")
    replay = gateway("replay", str(recording), "--to", "ros", "--loop", *only)
    try:
        replay.wait_until(lambda: any(line.startswith("answers as") for line in replay.lines), "answers")
        with node("echo") as client:
            client.wait_until(lambda: "end" in client.lines, "end of the client")
            assert client.lines == SAID
        replay.end()
        assert {"/enable: 2 requests answered", "/fib: 4 goals answered"} <= set(replay.lines), replay.said()
    finally:
        replay.close()

    program = Resimulated((sys.executable, str(NODE), "resimulated"))
    result = run(recording, [program], ResimOptions(runs=2, lead_ns=10**9), tmp_path)
    verdict = compare(result)
    assert verdict.is_deterministic, verdict.line()
    assert strings(result.runs[0].outputs, "/out") == SAID
    assert result.roles and (result.roles.played, result.roles.answered) == ({"/fib": 4}, {"/enable": 2})


@pytest.mark.slow
@pytest.mark.long
def test_what_a_replay_asks_is_what_was_asked(tmp_path: Path) -> None:
    """The requests of a replay reach a server, and with a black box the goal that it aborts has a file."""
    recording = record(tmp_path / "calls.mcap")
    with node("server"):
        bridge = Bridge("--record", str(tmp_path / "box.mcap"), "--snapshot", "60", "--trigger", "action_aborted=/fib")
        replay = gateway("replay", str(recording), "--to", "ros", "--services", "call")
        try:
            replay.wait_until(lambda: any(line.startswith("sha256") for line in replay.lines), "end of the replay")
            assert replay.end(None).code == 0
            assert {f"/fib/_action/{part}: {count}" for part, count in CALLED.items()} <= set(replay.lines), (
                replay.said()
            )
            assert bridge.end().code == 0
        finally:
            replay.close()
            bridge.close()
    (found,) = tmp_path.glob("box_*.mcap")
    assert parts_of(found) >= {"send_goal", "get_result", "feedback", "status"}


@pytest.mark.slow
@pytest.mark.long
def test_each_goal_that_a_server_aborts_has_a_file(tmp_path: Path) -> None:
    """Of rclpy's own server: 20 goals, of which the odd ones are aborted, 0.5 s after each other."""
    with node("aborts"):
        rule = "action_aborted,before=0.2,after=0.1"
        bridge = Bridge("--record", str(tmp_path / "box.mcap"), "--snapshot", "60", "--trigger", rule)
        try:
            with node("orders") as client:
                client.wait_until(lambda: "end" in client.lines, "end of the client")
            assert bridge.end().code == 0
        finally:
            bridge.close()
    files = sorted(tmp_path.glob("box_*.mcap"))
    assert len(files) == 10
    for path in files:
        assert main(["verify", str(path)]) == 0
        with SessionFile.open(path) as file:
            (row,) = (file.ledger or {})["triggers"]
        assert (row["count"], row["missing"]) == (1, "")
        assert "status" in parts_of(path)


def parts_of(path: Path) -> set[str]:
    """The parts of actions that a recording has."""
    with SessionFile.open(path) as file:
        return {part for entry in file.entries() if (part := (action_of(entry.channel) or ("", ""))[1])}
