"""OpenIGTLink programs: the same recording gives the same outputs in each of 5 runs."""

from __future__ import annotations

import json
import math
import shutil
import socket
import subprocess
import sys
from collections.abc import Iterable
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest

from igtl_gateway.addon import ConfigError, __version__
from igtl_gateway.addon.igtl import Message, Transform, decode, encode, ns_to_ticks
from igtl_gateway.addon.reading import Entry, Kind, SessionFile
from igtl_gateway.addon.settings import Config
from igtl_gateway.addon.writing import SessionWriter
from igtl_gateway.addons.resim import igtl_peer
from igtl_gateway.addons.resim.engine import Program, ResimOptions, RunResult, run
from igtl_gateway.addons.resim.igtl_peer import IgtlRole
from igtl_gateway.addons.resim.verdict import Verdict, compare
from igtl_gateway.cli import main
from tests.addons.resim.runs import PROGRAMS, RUNS
from tests.addons.resim.sessions import MS, START_NS
from tests.peers import reference

COUNT = 40
PERIOD_NS = 20 * MS
needs_pyigtl = pytest.mark.skipif(not find_spec("pyigtl"), reason="needs pyigtl")


def pose(x: float, y: float = 0.0, angle: float = 0.0) -> Transform:
    """A matrix on the wire, column by column; mm."""
    c, s = math.cos(angle), math.sin(angle)
    return Transform((c, s, 0.0, -s, c, 0.0, 0.0, 0.0, 1.0, x, y, 3.0))


def write(path: Path, rows: Iterable[tuple[int, Kind, str, Any, int]]) -> Path:
    """Write a session of OpenIGTLink messages: ns since the start, direction, device, content, link."""
    facts = {"config": json.dumps(Config().to_dict()), "igtl_gateway_version": __version__}
    writer = SessionWriter(path, facts, overwrite=True)
    last_ns = 0
    number = 0
    for number, (ns, kind, device, content, link) in enumerate(sorted(rows, key=lambda row: row[0]), 1):
        last_ns = max(last_ns + 1, START_NS + ns)
        type_ = type(content).__name__.upper()
        data = b"".join(bytes(part) for part in encode(Message(type_, device, content, ns_to_ticks(last_ns))))
        writer.write(Entry(number, last_ns, kind, f"{type_}/{device}", type_, (data,), (link,)))
    end = Entry(number + 1, last_ns + 400 * MS, Kind.ROS_IN, "/end", "std_msgs/msg/Empty", (b"\0\1\0\0\0",))
    writer.write(end)  # the last answer comes before the end of the session
    writer.close({})
    return path


def recording(path: Path, *, x_mm: float = 1.0, y_mm: float = 0.0, links: tuple[int, ...] = (1,)) -> Path:
    """A tool that the gateway sent to a peer, and the peer's answers, which are this much away."""
    rows: list[tuple[int, Kind, str, Any, int]] = []
    for link in links:
        for number in range(COUNT):
            ns, x = number * PERIOD_NS, 10.0 * link + number / 4
            rows.append((ns, Kind.IGTL_OUT, "Tool", pose(x, angle=number / 8), link))
            rows.append((ns + 5 * MS, Kind.IGTL_IN, "Answer", pose(x + x_mm, y_mm, number / 8), link))
    return write(path, rows)


def python(name: str, *words: str, role: IgtlRole | None = None) -> Program:
    return Program((sys.executable, str(PROGRAMS / f"{name}.py"), *words), name, igtl=role or IgtlRole())


def judged(
    path: Path, folder: Path, program: Program, *, runs: int = RUNS, **options: Any
) -> tuple[RunResult, Verdict]:
    result = run(path, [program], ResimOptions(runs=runs, **options), folder)
    return result, compare(result, reference=path)


def answers(path: Path, device: str = "Answer") -> list[tuple[int, Any]]:
    """Session time in ns since the start, and content, of what a program sent."""
    with SessionFile.open(path) as file:
        return [
            (entry.stamp_ns - START_NS, decode(entry.data()).content)
            for entry in file.entries()
            if entry.kind is Kind.IGTL_IN and entry.channel.endswith(f"/{device}")
        ]


@needs_pyigtl
def test_a_client_with_pyigtl(tmp_path: Path) -> None:
    path = recording(tmp_path / "in.mcap")
    result, verdict = judged(path, tmp_path, python("igtl_answer"))
    assert verdict.line() == f"deterministic: {RUNS} of {RUNS} runs equal; equal to in.mcap"
    assert result.roles and result.roles.inputs == {"link1/TRANSFORM/Tool": COUNT}
    assert result.roles.outputs == result.roles.expected == ["TRANSFORM/Answer"]
    assert [line for line in result.runs[0].remarks if igtl_peer.WEAKER in line]
    found = answers(result.runs[0].outputs)
    assert len(found) == COUNT
    # it looks every 10 ms, in session time
    assert all(0 <= ns - number * PERIOD_NS <= 20 * MS for number, (ns, _) in enumerate(found))


@needs_pyigtl
@pytest.mark.parametrize("kind", ["talks", "apart"])
def test_what_it_does_beside_its_answers_does_not_count(kind: str, tmp_path: Path) -> None:
    """It prints more than a pipe holds; a thread of its own computes in real time."""
    _, verdict = judged(recording(tmp_path / "in.mcap"), tmp_path, python("igtl_answer", kind), runs=2)
    assert verdict.line() == "deterministic: 2 of 2 runs equal; equal to in.mcap"


@needs_pyigtl
def test_what_differs_from_the_recording_is_measured(tmp_path: Path) -> None:
    path = recording(tmp_path / "in.mcap", x_mm=1.5)
    _, verdict = judged(path, tmp_path, python("igtl_answer"), runs=1)
    assert verdict.exit_code == 1
    assert "TRANSFORM/Answer, message 1 at 0.005" in verdict.line()
    assert "(0.5 mm)" in verdict.line()


@needs_pyigtl
def test_a_client_that_is_silent_on_a_stream(tmp_path: Path) -> None:
    """The peer of the recording sent a second tool, and a peer of another link a third."""
    rows: list[tuple[int, Kind, str, Any, int]] = [
        (7 * MS, Kind.IGTL_IN, "Second", pose(1.0), 1),
        (8 * MS, Kind.IGTL_IN, "Third", pose(1.0), 2),
    ]
    for number in range(COUNT):
        rows.append((number * PERIOD_NS, Kind.IGTL_OUT, "Tool", pose(10.0 + number / 4, angle=number / 8), 1))
        answer = pose(11.0 + number / 4, 0.0, number / 8)
        rows.append((number * PERIOD_NS + 5 * MS, Kind.IGTL_IN, "Answer", answer, 1))
    path = write(tmp_path / "in.mcap", rows)
    _, verdict = judged(path, tmp_path, python("igtl_answer", role=IgtlRole(link=1)), runs=1)
    assert verdict.exit_code == 1
    silent = "TRANSFORM/Second: no program published a message of it"
    assert verdict.line() == f"DIFFERENT from in.mcap in 1 of 2 streams (1 run): {silent}"


@needs_pyigtl
def test_a_random_answer_is_not_deterministic(tmp_path: Path) -> None:
    path = recording(tmp_path / "in.mcap")
    _, verdict = judged(path, tmp_path, python("igtl_answer", "random"), runs=2)
    assert verdict.line().startswith("NOT DETERMINISTIC: run 2 differs from run 1: TRANSFORM/Answer, message 1 at ")
    assert " mm)" in verdict.line()


@needs_pyigtl
def test_a_server_with_pyigtl(tmp_path: Path) -> None:
    path = recording(tmp_path / "in.mcap", x_mm=0.0, y_mm=-2.0)
    program = python("igtl_serve", "{port}", role=IgtlRole(is_server=True))
    result, verdict = judged(path, tmp_path, program)
    assert verdict.line() == f"deterministic: {RUNS} of {RUNS} runs equal; equal to in.mcap"
    clock = [float(content.text) for _, content in answers(result.runs[0].outputs, "Clock")]
    assert clock == pytest.approx([0.1 * number for number in range(1, len(clock) + 1)], abs=0.02)
    assert len(clock) >= 6


@needs_pyigtl
@pytest.mark.ros
@pytest.mark.skipif(not find_spec("rclpy"), reason="needs ROS 2")
def test_beside_a_client_and_a_node(tmp_path: Path) -> None:
    path = recording(tmp_path / "in.mcap", links=(1, 2))
    clients = [python("igtl_answer", role=IgtlRole(link=2)), python("igtl_serve", "{port}", role=IgtlRole(True, 0, 1))]
    node = Program((sys.executable, str(PROGRAMS / "single.py")), "single")
    result = run(path, [*clients, node], ResimOptions(runs=RUNS, without=("/in",)), tmp_path)
    verdict = compare(result)
    assert verdict.line() == f"deterministic: {RUNS} of {RUNS} runs equal"
    streams = result.runs[0].streams
    assert {"TRANSFORM/Answer", "STRING/Clock", "/out"} <= set(streams)
    assert streams["TRANSFORM/Answer"].messages == 2 * COUNT


@needs_pyigtl
def test_the_command_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = recording(tmp_path / "in.mcap")
    program = ["--", sys.executable, str(PROGRAMS / "igtl_answer.py")]
    good = tmp_path / "good.mcap"
    assert main(["resim", str(path), "--igtl-client", "--runs", "2", "--record", str(good), *program]) == 0
    text = capsys.readouterr().out
    assert "input     link1/TRANSFORM/Tool  40 messages" in text
    assert "output    TRANSFORM/Answer      also recorded" in text
    assert f"igtl_answer.py: {igtl_peer.WEAKER}" in text
    arguments = ["resim", str(path), "--igtl-client", "--runs", "1", "--baseline", str(good)]
    assert main([*arguments, *program]) == 0
    assert capsys.readouterr().out.splitlines()[-1] == "1 run; equal to good.mcap"
    assert main([*arguments, *program, "random"]) == 1
    assert "DIFFERENT from good.mcap in 1 of 1 stream (1 run): TRANSFORM/Answer" in capsys.readouterr().out
    assert main([*arguments, *program, "close"]) == 2
    assert "CANNOT BE JUDGED: igtl_answer.py: closed its connection at " in capsys.readouterr().out


@pytest.mark.parametrize(
    ("options", "text"),
    [
        (("--link", "1"), "--link: has no effect without --igtl-client or --igtl-server"),
        (("--igtl-client", "--link", "-1"), "--link: found -1, expected 1 or more"),
        (("--igtl-server", "70000"), "--igtl-server: found 70000, expected 0 to 65535"),
        (("--igtl-client", "--link", "7"), "true: found link 7, expected one of the links with messages: 1"),
        (("--igtl-client", "--real-clock"), "found real clocks and an OpenIGTLink program"),
        (("--igtl-client", "--recipe", "none.toml"), "expected igtl in the recipe"),
    ],
)
def test_wrong_options(options: tuple[str, ...], text: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = recording(tmp_path / "in.mcap")
    program = () if "--recipe" in options else ("--", "true")
    assert main(["resim", str(path), *options, *program]) != 0
    assert text in capsys.readouterr().err


@needs_pyigtl
def test_the_link_is_chosen(tmp_path: Path) -> None:
    path = recording(tmp_path / "in.mcap", links=(1, 2))
    result, verdict = judged(path, tmp_path, python("igtl_answer", role=IgtlRole(link=2)), runs=1)
    assert verdict.line() == "1 run; equal to in.mcap"
    assert result.roles and result.roles.inputs == {"link2/TRANSFORM/Tool": COUNT}
    for link, text in ((0, "found no choice of a link"), (3, "found link 3")):
        with pytest.raises(ConfigError, match=f"{text}, expected one of the links with messages: 1, 2"):
            judged(path, tmp_path, python("igtl_answer", role=IgtlRole(link=link)), runs=1)
    both = [Program(("true",), igtl=IgtlRole(link=1))] * 2
    text = r"true \(program 2\): found link 1, which true \(program 1\) has, expected another link"
    with pytest.raises(ConfigError, match=text):
        run(path, both, ResimOptions(), tmp_path)


def test_programs_in_cpp_with_debians_library(tmp_path: Path) -> None:
    if missing := reference.available():
        pytest.skip(missing)
    source = PROGRAMS / "igtl_answer.cpp"
    program = tmp_path / "answer"
    command = ["g++", *reference.COMPILE, "-o", str(program), str(source), *reference.LINK]
    subprocess.run(command, check=True)
    path = recording(tmp_path / "in.mcap", y_mm=0.0)
    for role in (IgtlRole(), IgtlRole(is_server=True)):
        words = (str(program), "server" if role.is_server else "client", "{port}")
        result, verdict = judged(path, tmp_path, Program(words, igtl=role))
        assert verdict.line() == f"deterministic: {RUNS} of {RUNS} runs equal; equal to in.mcap"
        assert [ns for ns, _ in answers(result.runs[0].outputs)] == [number * PERIOD_NS for number in range(COUNT)]


@pytest.mark.parametrize(
    ("kind", "text"),
    [
        ("never", "igtl_answer: made no socket, or is linked statically within 2 s (the wall limit)"),
        ("elsewhere", "igtl_answer: did not connect to 127.0.0.1:"),
        ("twice", "igtl_answer: opened a second connection at 0.010000 s of the session, expected one"),
        ("spawns", "igtl_answer: started another process, which still runs: sleep 1000"),
        ("close", "igtl_answer: closed its connection at 0.000000 s of the session"),
        ("garbage", "igtl_answer: sent what is no OpenIGTLink message at 0.000000 s of the session: header"),
        ("flood", "igtl_answer: flooded the session with messages"),
        ("hang", "igtl_answer: did not come to rest within 2 s of CPU time (the CPU limit)"),
        ("sleep", "igtl_answer: did not come to rest within 2 s (the wall limit)"),
        (
            "crc",
            "igtl_answer: sent what is no OpenIGTLink message at 0.000000 s of the session: STRING: found CRC 0000",
        ),
    ],
)
@needs_pyigtl
def test_bad_programs(kind: str, text: str, tmp_path: Path) -> None:
    path = recording(tmp_path / "in.mcap")
    marker = tmp_path / "orphan"
    program = python("igtl_answer", kind, str(marker))
    _, verdict = judged(path, tmp_path, program, wall_s=2.0 if "wall limit" in text else 30.0, cpu_s=2.0)
    assert verdict.exit_code == 2
    assert verdict.fault.startswith(text)
    assert "\n" not in verdict.fault
    found = subprocess.run(["ps", "-eo", "args"], capture_output=True, text=True, check=True).stdout
    assert str(marker) not in found


@needs_pyigtl
def test_what_it_sent_before_its_end_is_kept(tmp_path: Path) -> None:
    result, verdict = judged(recording(tmp_path / "in.mcap"), tmp_path, python("igtl_answer", "is killed"))
    assert verdict.fault == "igtl_answer: was ended by signal 9"
    assert len(answers(result.runs[0].outputs, "Flood")) == 3


@needs_pyigtl
def test_other_sockets_of_a_program_are_named(tmp_path: Path) -> None:
    path = recording(tmp_path / "in.mcap")
    for kind in ("datagrams", "elsewhere too"):
        result, verdict = judged(path, tmp_path, python("igtl_answer", kind), runs=1)
        assert verdict.exit_code == 0
        assert (
            "igtl_answer: has a socket of its own: what it receives there comes in real time" in result.runs[0].remarks
        )


@needs_pyigtl
def test_programs_that_the_library_does_not_reach(tmp_path: Path) -> None:
    path = recording(tmp_path / "in.mcap")
    for name, words, role, what in (
        ("igtl_answer", (), IgtlRole(), "connected"),
        ("igtl_serve", ("{port}",), IgtlRole(is_server=True), "listens"),
    ):
        program = python(name, *words, role=role)
        alone = replace(program, command=("env", "-u", "LD_PRELOAD", *program.command))
        _, verdict = judged(path, tmp_path, alone, wall_s=300.0)
        assert (
            verdict.fault
            == f"{name}: {what} without session time: it is linked statically, or LD_PRELOAD did not reach it"
        )


def test_a_statically_linked_client_is_refused(tmp_path: Path) -> None:
    if not shutil.which("gcc"):
        pytest.skip("needs gcc")
    source, program = tmp_path / "static.c", tmp_path / "static"
    source.write_text(
        "#include <arpa/inet.h>\n#include <stdlib.h>\n#include <sys/socket.h>\n#include <unistd.h>\n"
        "int main(int n, char **words) {\n"
        "    struct sockaddr_in to = {AF_INET, htons(atoi(words[n - 1])), {htonl(INADDR_LOOPBACK)}, {0}};\n"
        "    int made = socket(AF_INET, SOCK_STREAM, 0);\n"
        "    connect(made, (struct sockaddr *)&to, sizeof to);\n    sleep(60);\n}\n"
    )
    if subprocess.run(["gcc", "-static", "-o", program, source], capture_output=True, check=False).returncode:
        pytest.skip("needs the static libc")
    _, verdict = judged(recording(tmp_path / "in.mcap"), tmp_path, Program((str(program), "{port}"), igtl=IgtlRole()))
    assert (
        verdict.fault
        == "static: connected without session time: it is linked statically, or LD_PRELOAD did not reach it"
    )


def test_a_port_in_use(tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as other:
        port = other.getsockname()[1]
        with pytest.raises(ConfigError, match=f"igtl_answer: found port {port}, expected a free one"):
            judged(recording(tmp_path / "in.mcap"), tmp_path, python("igtl_answer", role=IgtlRole(port=port)))
