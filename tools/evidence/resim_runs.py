"""Counts the different outputs of many re-simulations: one row for each kind of program of tests/addons/resim/programs.

``python tools/evidence/resim_runs.py`` runs each kind 1,000 times, in turns of 100, and prints the table.
The load is that of the machine beside the runs (mean of the last minute); start it beside work of your own, or with
``--load 4``, which keeps four processes busy.  ``--share 20`` lets 20 programs in Python share the start of their
interpreter (`tools/evidence/resim_forks.py`).  Exit code 1 if any run differs or could not be judged.
"""

from __future__ import annotations

import argparse
import hashlib
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any
from unittest.mock import patch

sys.path.insert(0, str(Path(__file__).parents[2]))

from igtl_gateway.addons.resim import engine
from igtl_gateway.addons.resim.engine import Clocks, Program, ResimOptions, Run, run
from igtl_gateway.addons.resim.igtl_peer import IgtlRole
from igtl_gateway.addons.resim.processes import Process
from igtl_gateway.addons.resim.verdict import compare, is_judged
from igtl_gateway.cli import main as gateway
from tests.addons.resim import sessions, test_coordinator, test_igtl_peer
from tests.addons.resim.runs import PROGRAMS, compiled, program
from tests.peers import reference
from tests.places import FIXTURES
from tools.evidence.resim_forks import Forked, Start

#: Scenario → its ROS actors.
SCENARIOS = {"ultrasound": "navigator", "lego": "lego_robot", "star": "star_sensors star_robot"}
#: Scenario → seconds of its recording in which all actors have inputs.
SECONDS = {"ultrasound": ("0", "4"), "lego": ("22", "27"), "star": ("1.5", "2.5")}
#: What an actor imports.
LAB = "igtl_gateway_lab.cli.stage"
SERVER = IgtlRole(is_server=True)
HEADER = "| kind | runs | messages | hashes | wrong turns | load | s a run |\n|---|---|---|---|---|---|---|"


@dataclass(slots=True)
class Row:
    """A kind of program: how to make its recording, its programs, and what came of them so far."""

    name: str
    record: Callable[[Path], Path]
    programs: Callable[[Path], Sequence[Program]]
    options: ResimOptions = field(default_factory=ResimOptions)
    runs: int = 0
    messages: int = 0
    seconds: float = 0.0
    load: float = 0.0
    hashes: Counter[str] = field(default_factory=Counter)
    wrong: list[str] = field(default_factory=list)

    def text(self) -> str:
        each = f"{self.load / self.runs:.1f} | {self.seconds / self.runs:.1f}" if self.runs else "- | -"
        return f"| {self.name} | {self.runs} | {self.messages} | {len(self.hashes)} | {len(self.wrong)} | {each} |"

    def turn(self, count: int, folder: Path) -> None:
        """Run `count` times; the files of a turn that is not all equal stay in the folder."""

        def take(one: Run) -> None:
            self.runs, self.seconds = self.runs + 1, self.seconds + one.seconds
            self.load += os.getloadavg()[0]
            streams = [stream for name, stream in sorted(one.streams.items()) if is_judged(name)]
            self.messages += sum(stream.messages for stream in streams)
            if not one.fault:
                self.hashes[
                    hashlib.sha256(repr([(each.topic, each.digest) for each in streams]).encode()).hexdigest()
                ] += 1

        folder.mkdir()
        recording = self.record(folder / "in.mcap")
        options = replace(self.options, runs=count)
        before = set(self.hashes)
        result = run(recording, self.programs(folder), options, folder, on_run=take)
        verdict = compare(result)
        if not verdict.is_deterministic:
            self.wrong.append(f"{self.name}: {verdict.line()} ({folder})")
        elif before and set(self.hashes) != before:
            self.wrong.append(f"{self.name}: equal to each other, but not to the turn before ({folder})")
        else:
            shutil.rmtree(folder)


def texts(count: int) -> Callable[[Path], Path]:
    return lambda path: sessions.write(path, sessions.texts(count))


def goals(path: Path) -> Path:
    return test_coordinator.record_action(path, test_coordinator.recorded_goals(), 20)


def transforms(path: Path) -> Path:
    rows = [(ns, "/tf", sessions.TF, sessions.transforms(each)) for ns, _, _, each in sessions.poses(600)]
    return sessions.write(path, rows)


def pairs(path: Path) -> Path:
    return sessions.write(path, [*sessions.poses(60), *sessions.images(12)])


def scenario(name: str) -> Callable[[Path], Path]:
    """The first seconds, in which all actors have inputs."""

    def record(path: Path) -> Path:
        start, end = SECONDS[name]
        words = ["slice", str(FIXTURES / f"{name}.mcap"), "-o", str(path), "--start", start, "--end", end]
        if code := gateway(words):
            raise SystemExit(code)
        return path

    return record


def named(*lines: str) -> Callable[[Path], Sequence[Program]]:
    return lambda folder: [program(*line.split()) for line in lines]


def pyigtl(role: IgtlRole, *words: str) -> Callable[[Path], Sequence[Program]]:
    return lambda folder: [test_igtl_peer.python(*words, role=role)]


def in_c(folder: Path) -> Sequence[Program]:
    return [Program((str(compiled("echo", folder)),), "echo")]


def in_cpp(role: IgtlRole) -> Callable[[Path], Sequence[Program]]:
    def programs(folder: Path) -> Sequence[Program]:
        command = ["g++", *reference.COMPILE, "-o", str(folder / "answer"), str(PROGRAMS / "igtl_answer.cpp")]
        subprocess.run([*command, *reference.LINK], check=True)
        words = (str(folder / "answer"), "server" if role.is_server else "client", "{port}")
        return [Program(words, igtl=role)]

    return programs


def rows() -> list[Row]:
    found = []
    if find_spec("rclpy"):
        found += [
            Row("one thread", texts(20), named("single")),
            Row("several threads", texts(20), named("multithreaded")),
            Row("tf2", transforms, named("frames")),
            Row("image and pose", pairs, named("pairs")),
            Row("lifecycle", texts(60), named("lifecycle", "manager")),
            Row("service", texts(25), named("caller", "switch"), ResimOptions(latency_ns=1_000_000)),
            Row("action, several threads", texts(12), named("fibonacci server", "fibonacci client")),
            Row("action, one thread", texts(12), named("fibonacci server single", "fibonacci client single")),
            Row("action that only the recording has", goals, named("fibonacci client"), ResimOptions(lead_ns=10**9)),
            Row("action that only the recording asks", goals, named("fibonacci server"), ResimOptions(lead_ns=10**9)),
            Row("C on rcl", texts(400), in_c),
        ]
        as_they_are = ResimOptions(lead_ns=1_000_000_000, clocks=Clocks.SESSION)
        found += [
            Row(each, scenario(each), named(*(f"actor {each} {actor}" for actor in actors.split())), as_they_are)
            for each, actors in SCENARIOS.items()
        ]
    if find_spec("pyigtl"):
        found.append(Row("pyigtl client", test_igtl_peer.recording, pyigtl(IgtlRole(), "igtl_answer")))
        found.append(Row("pyigtl server", test_igtl_peer.recording, pyigtl(SERVER, "igtl_serve", "{port}")))
    if not reference.available():
        found.append(Row("C++ client", test_igtl_peer.recording, in_cpp(IgtlRole())))
        found.append(Row("C++ server", test_igtl_peer.recording, in_cpp(SERVER)))
    return found


def sharing(count: int) -> Callable[..., Process]:
    """What starts a process: programs in Python as forks, `count` of one interpreter."""
    left = 0

    def start(name: str, command: Sequence[str], *rest: Any) -> Process:
        nonlocal left
        if command[0] != sys.executable:
            return Process(name, command, *rest)
        if not left:
            if hasattr(Forked, "start"):
                Forked.start.close()
            Forked.start, left = Start(LAB), count
        left -= 1
        return Forked(name, command, *rest)

    return start


def main() -> int:
    os.environ.pop("PYTHONDONTWRITEBYTECODE", None)  # a node would compile its 200 modules in each run
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--runs", type=int, default=1000, help="of each kind (default: 1000)")
    parser.add_argument("--turn", type=int, default=100, help="runs of a kind before the next one (default: 100)")
    parser.add_argument("--only", default="", help="only kinds whose name matches this pattern")
    parser.add_argument("--load", type=int, default=0, help="processes to keep busy meanwhile (default: 0)")
    parser.add_argument("--share", type=int, default=0, help="programs that share an interpreter's start (default: 0)")
    options = parser.parse_args()
    if options.share:
        patch.object(engine, "Process", sharing(options.share)).start()
    found = [row for row in rows() if re.search(options.only, row.name)]
    place = Path(tempfile.mkdtemp(prefix="resim-runs-"))
    busy = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(options.load)]
    try:
        for first in range(0, options.runs, options.turn):
            for row in found:
                row.turn(min(options.turn, options.runs - first), place / f"{row.name}-{first}".replace(" ", "-"))
                print(row.text(), *row.wrong, sep="\n  ", flush=True)
            print(
                f"\n{time.strftime('%H:%M:%S')}\n\n{HEADER}", *(row.text() for row in found), "", sep="\n", flush=True
            )
    finally:
        for each in busy:
            each.kill()
    return int(any(row.wrong or len(row.hashes) != 1 for row in found))


if __name__ == "__main__":
    sys.exit(main())
