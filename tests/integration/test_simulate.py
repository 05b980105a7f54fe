"""``simulate``, live: a bridge, a ROS 2 node and an OpenIGTLink program, each a process, by one command."""

from __future__ import annotations

import json
import signal
import sys
from pathlib import Path

import pytest

from igtl_gateway.cli import main
from tests.integration.bridge import Program, environment, free_port

ros = pytest.mark.ros


def programs_with(mark: str) -> list[str]:
    """Command lines of the processes that have a word in their environment."""
    found = []
    for entry in Path("/proc").iterdir():
        try:
            if entry.name.isdigit() and mark.encode() in (entry / "environ").read_bytes():
                found.append((entry / "cmdline").read_bytes().replace(b"\0", b" ").decode())
        except OSError:
            continue  # ended, or of another user
    return found


def simulate(*words: str, mark: str) -> Program:
    return Program([sys.executable, "-m", "igtl_gateway", "simulate", *words], environment(IGTL_TEST_MARK=mark))


@ros
def test_the_acquisition_goes_through_the_whole_chain_by_one_command(tmp_path: Path) -> None:
    mark, record = f"mark-{tmp_path}", tmp_path / "a.mcap"
    program = simulate("acquisition", "--duration", "1.3", "--record", str(record), "--json", mark=mark)
    try:
        program.wait_until(lambda: bool(program.lines), "outcome")
        result = program.end(None)
    finally:
        program.close()
    assert result.code == 0, result.err
    told = json.loads(result.out)
    assert told["good"] and told["end"] == "over" and told["warnings"] == []
    planner, robot = told["actors"]["planner"], told["actors"]["robot"]
    assert planner["facts"]["steps"] == 6 and planner["facts"]["lesion_off_centre_mm"] < 0.1
    # nothing is lost either way, not even the first message of a stream
    assert sum(planner["received"].values()) == sum(robot["sent"].values())
    assert sum(robot["received"].values()) == sum(planner["sent"].values()) == 4
    assert told["verified"]["good"] and told["verified"]["equal"] == told["verified"]["outputs"] > 10
    assert main(["verify", str(record)]) == 0
    assert programs_with(mark) == []


@ros
def test_ctrl_c_ends_every_program_with_a_summary(tmp_path: Path) -> None:
    mark = f"mark-{tmp_path}"
    program = simulate("acquisition", "--duration", "60", "--listen", ":0", mark=mark)
    try:
        program.wait_until(lambda: any("begun" in line for line in program.lines), "beginning")
        assert len(programs_with(mark)) >= 4
        result = program.end(signal.SIGINT)
    finally:
        program.close()
    assert result.code == 1
    assert "planner      NOT DONE" in result.out and "robot        NOT DONE" in result.out
    assert "verified: all" in result.out
    assert "acquisition: FAILED (interrupted)" in result.out
    assert "Traceback" not in result.out + result.err
    assert programs_with(mark) == []


def test_one_side_alone_says_for_whom_it_waits(tmp_path: Path) -> None:
    mark = f"mark-{tmp_path}"
    place = f"127.0.0.1:{free_port()}"
    program = simulate("acquisition", "--side", "igtl", "--connect", place, mark=mark)
    try:
        waits = f"planner      waits for a server at {place}"
        program.wait_until(lambda: waits in program.lines, "whom it waits for")
        result = program.end(signal.SIGINT)
    finally:
        program.close()
    assert result.code == 1
    assert "acquisition: FAILED (interrupted), 0 s" in result.out
    assert programs_with(mark) == []
