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


def test_from_the_record_to_the_re_simulation(tmp_path: Path) -> None:
    box = ("--snapshot", "60", "--trigger", "action_aborted=/fib,after=0.3")
    recording, aborted = tmp_path / "calls.mcap", tmp_path / "aborted.mcap"
    topics = ("/enable/_service_event", "/fib/_action/**", "/out")
    options = [word for topic in topics for word in ("--record-topics", topic)]
    with node("server"):
        watching = Bridge("--record", str(aborted), *box)
        writing = Bridge("--record", str(recording), *options)
        try:
            assert said_by_a_client() == SAID
            for bridge in (watching, writing):
                assert bridge.end().code == 0
        finally:
            watching.close()
            writing.close()

    # the black box has one file, with what led to the abort
    (found,) = tmp_path.glob("aborted_*.mcap")
    with SessionFile.open(found) as file:
        assert [row["count"] for row in (file.ledger or {})["triggers"]] == [1]
        assert {"send_goal", "status", "feedback"} <= {
            entry.channel.split("/_action/")[1].split("/")[0]
            for entry in file.entries()
            if "/_action/" in entry.channel
        }
    for path in (found, recording):
        assert main(["verify", str(path)]) == 0

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
