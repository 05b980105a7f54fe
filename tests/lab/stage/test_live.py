"""The live stage with small programs in the place of the real ones: order, ends, and that none is left behind."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import threading
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import pytest

from igtl_gateway.base.clock import SystemClock
from igtl_gateway_lab.programs import Event
from igtl_gateway_lab.simulate.actor import ActorProtocol, ActorReport, Publishes, Received, Sent
from igtl_gateway_lab.stage.live import Stage, StageEnd, StageError, StagePlan

LIMIT_S = 20.0

#: Runs its arguments: it reports JSON, ``wait`` waits for an order, anything else is its last output.
PROGRAM = """
import sys
for word in sys.argv[1:]:
    if word == "wait":
        sys.stdin.readline()
    elif word.startswith("{"):
        print(word, flush=True)
    else:
        sys.exit(word)
"""
REPORT = {
    "event": "report",
    "good": True,
    "lines": ["it went well"],
    "facts": {"n": 1},
    "sent": {"A": 2},
    "received": {},
}
GOOD = ({"event": "ready"}, "wait", {"event": "done"}, "wait", REPORT)


class Named:
    """An actor, as far as the stage needs one."""

    def __init__(self, name: str, side: ActorProtocol) -> None:
        self.name, self.side = name, side
        self.subscribes: dict[str, str] = {}
        self.publishes: dict[str, Publishes] = {}
        self.due_ns: int | None = None
        self.done = False

    def begin(self, now_ns: int) -> None: ...
    def act(self, now_ns: int) -> Iterable[Sent]:
        return ()

    def receive(self, now_ns: int, heard: Received) -> Iterable[Sent]:
        return ()

    def report(self) -> ActorReport:
        return ActorReport(False)


class Theatre:
    """Runs a stage, and keeps the events that it reported."""

    def __init__(self, **scripts: Sequence[str | dict[str, Any]]) -> None:
        self.scripts = scripts
        self.where: dict[str, Sequence[str]] = {}
        self.events: list[tuple[str, Event]] = []
        self.stop = threading.Event()
        self.stop_at = ""

    def command(self, name: str, where: Sequence[str]) -> list[str]:
        self.where[name] = where
        words = [word if isinstance(word, str) else json.dumps(word) for word in self.scripts[name]]
        return [sys.executable, "-c", PROGRAM, *words]

    def tell(self, name: str, event: Event) -> None:
        self.events.append((name, event))
        if event["event"] == self.stop_at:
            self.stop.set()

    def stage(self, **settings: Any) -> Stage:
        actors = [Named(name, ActorProtocol.IGTL if name == "planner" else ActorProtocol.ROS) for name in self.scripts]
        usual: dict[str, Any] = {
            "actors": actors,
            "command": self.command,
            "bridge": None,
            "start_s": LIMIT_S,
            "limit_s": LIMIT_S,
        }
        plan = StagePlan(**usual | settings)
        return Stage(plan, SystemClock(), self.stop, self.tell)


def test_all_begin_when_all_are_ready_and_end_when_all_are_done() -> None:
    theatre = Theatre(planner=GOOD, robot=GOOD)
    outcome = theatre.stage(connect=("::1", 7)).run()
    assert outcome.good and outcome.end is StageEnd.OVER
    assert theatre.where == {"planner": ("--connect", "[::1]:7"), "robot": ()}
    told = [event["event"] for _, event in theatre.events]
    assert sorted(told[:2]) == ["ready", "ready"]
    assert told[2] == "begun"
    assert sorted(told[3:]) == ["done", "done", "report", "report"]
    part = outcome.parts["planner"]
    assert (part.side, part.done, part.sent, part.report) == (
        ActorProtocol.IGTL, True, {"A": 2}, ActorReport(True, ("it went well",), {"n": 1}),
    )  # fmt: skip


def test_a_report_that_is_not_good_is_not_good() -> None:
    outcome = Theatre(robot=(*GOOD[:-1], {**REPORT, "good": False})).stage().run()
    assert outcome.end is StageEnd.OVER and not outcome.good


def test_a_program_that_dies_ends_all_with_its_last_words() -> None:
    theatre = Theatre(planner=GOOD, robot=({"event": "ready"}, "igtl-gateway simulate: no ROS here"))
    with pytest.raises(StageError, match=r"^robot: no ROS here$"):
        theatre.stage(connect=("h", 1)).run()


def test_one_that_dies_without_a_word_is_named_with_its_code() -> None:
    with pytest.raises(StageError, match=r"^robot: ended unexpectedly with exit code 0$"):
        Theatre(robot=({"event": "ready"},)).stage().run()


def test_a_limit_before_it_begins_tells_who_waits_for_what() -> None:
    waiting = ({"event": "waiting", "for": "a server"}, "wait", {**REPORT, "good": False})
    outcome = Theatre(planner=waiting, robot=GOOD).stage(start_s=0.5, connect=("h", 1)).run()
    assert outcome.end is StageEnd.TIMEOUT and not outcome.good
    assert outcome.waiting == {"planner": "a server"}
    assert outcome.seconds == 0.0


def test_a_story_that_does_not_end_is_ended() -> None:
    theatre = Theatre(robot=({"event": "ready"}, "wait", "wait", REPORT))
    outcome = theatre.stage(limit_s=0.3).run()
    assert outcome.end is StageEnd.TIMEOUT and not outcome.good and outcome.waiting == {}
    assert not outcome.parts["robot"].done and outcome.seconds > 0.3


def test_an_interruption_takes_the_reports() -> None:
    """``wait`` ends with the standard input, as an actor's play does."""
    theatre = Theatre(robot=({"event": "ready"}, "wait", {"event": "warning", "text": "slow"}, "wait", REPORT))
    theatre.stop_at = "warning"
    outcome = theatre.stage().run()
    assert outcome.end is StageEnd.INTERRUPTED and not outcome.good
    assert not outcome.parts["robot"].done and outcome.parts["robot"].report.good
    assert outcome.warnings == ("slow",)


def test_nothing_is_left_of_one_that_does_not_end(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("igtl_gateway_lab.stage.live._END_S", 0.3)
    theatre = Theatre(robot=({"event": "ready"}, "wait", {"event": "done"}, "wait"))
    deaf = theatre.command
    pids: list[int] = []

    def command(name: str, where: Sequence[str]) -> list[str]:
        words = deaf(name, where)
        return [*words[:2], PROGRAM + "\nimport threading\nthreading.Event().wait()", *words[3:]]

    stage = theatre.stage(command=command)
    take = stage._take

    def watch(timeout_s: float) -> None:
        take(timeout_s)
        pids.extend(program.pid for program in stage._programs.values())

    monkeypatch.setattr(stage, "_take", watch)
    with pytest.raises(StageError, match=r"robot: did not end within 0\.3 s"):
        stage.run()
    with pytest.raises(ProcessLookupError):
        os.kill(pids[0], 0)


def test_servers_are_started_before_the_bridge_that_connects_to_them() -> None:
    """The real bridge, without ROS: it gets their addresses."""
    server = ({"event": "listening", "host": "127.0.0.1", "port": 9}, *GOOD)
    theatre = Theatre(planner=server)
    outcome = theatre.stage(bridge=["--no-ros", "--duration", "60"], listen=("127.0.0.1", 0)).run()
    assert outcome.good and outcome.recording == {}
    assert theatre.where == {"planner": ("--listen", "127.0.0.1:0")}
    (started,) = [event for _, event in theatre.events if event["event"] == "started"]
    assert started["connect"] == [{"host": "127.0.0.1", "port": 9}]


def test_a_bridge_that_cannot_start_ends_all(tmp_path: Any) -> None:
    theatre = Theatre(robot=GOOD)
    with pytest.raises(StageError, match=r"bridge: .*absent.toml: cannot be read"):
        theatre.stage(bridge=["--no-ros", "--config", str(tmp_path / "absent.toml")]).run()


KILLED = """
import os, signal, sys
signal.signal(signal.SIGINT, signal.SIG_IGN)  # as in the background of a shell without job control
from queue import SimpleQueue
from igtl_gateway_lab.stage.live import start_program

deaf = "import json, os, threading; print(json.dumps({'pid': os.getpid()}), flush=True); threading.Event().wait()"
events = SimpleQueue()
program = start_program("deaf", [sys.executable, "-c", deaf], events)
print(events.get()[1]["pid"], flush=True)
os._exit(9)
"""


@pytest.mark.skipif(sys.platform != "linux", reason="the kernel's doing")
def test_a_stage_that_is_killed_takes_its_programs_with_it() -> None:
    told = subprocess.run([sys.executable, "-c", KILLED], capture_output=True, text=True, check=False, timeout=LIMIT_S)
    assert told.returncode == 9, told.stderr
    status, pause = Path(f"/proc/{told.stdout.strip()}/stat"), threading.Event()
    for _ in range(int(LIMIT_S / 0.02)):
        # its parent might not have collected its exit status yet
        if not status.exists() or status.read_text().rpartition(")")[2].split()[0] == "Z":
            return
        pause.wait(0.02)
    raise AssertionError(f"{status.parent} goes on")
