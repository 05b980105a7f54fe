"""The files of ``deploy/``: the unit of systemd, and the container."""

from __future__ import annotations

import json
import re
import shlex
import shutil
import subprocess
import sys
import textwrap
from pathlib import Path

import pytest

from igtl_gateway.cli import parser_of_all_verbs
from tests.places import ROOT

UNIT = ROOT / "deploy" / "igtl-gateway.service"
PROGRAM = "/opt/igtl-gateway/bin/igtl-gateway"
needs_systemd = pytest.mark.skipif(not shutil.which("systemd-analyze"), reason="no systemd-analyze here")


def setting(name: str) -> str:
    (value,) = re.findall(f"(?m)^{name}=(.*)$", UNIT.read_text("utf-8"))
    return str(value)


def analysed(unit: Path, *words: str) -> str:
    done = subprocess.run(
        ["systemd-analyze", *words, str(unit)], capture_output=True, text=True, timeout=60, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout + done.stderr


@pytest.fixture
def unit(tmp_path: Path) -> Path:
    """The unit, with a program that exists here."""
    copy = tmp_path / UNIT.name
    copy.write_text(UNIT.read_text("utf-8").replace(PROGRAM, sys.executable), "utf-8")
    return copy


@needs_systemd
def test_systemd_finds_no_fault_in_the_unit(unit: Path) -> None:
    assert [line for line in analysed(unit, "verify").splitlines() if UNIT.name in line] == []


@needs_systemd
def test_the_unit_is_confined(unit: Path) -> None:
    found = re.search(r"exposure level for .*: ([0-9.]+) ", analysed(unit, "security", "--offline=true", "--no-pager"))
    assert found and float(found[1]) < 3


def test_the_command_of_the_unit_is_one_of_the_program() -> None:
    program, *words = shlex.split(setting("ExecStart"))
    assert program == PROGRAM
    parser, _ = parser_of_all_verbs()
    options = parser.parse_args([word for word in words if not word.startswith("$")])
    assert (options.verb, options.record) == ("bridge", "/var/lib/igtl-gateway/{time}.mcap")
    assert setting("RestartPreventExitStatus") == "2"


def test_the_container_copies_what_exists_and_runs_a_command_of_the_program() -> None:
    text = (ROOT / "deploy" / "Containerfile").read_text("utf-8")
    copied = [name for line in re.findall(r"(?m)^COPY (?!--)(.*) \S+$", text) for name in line.split()]
    assert copied and [name for name in copied if not (ROOT / name).exists()] == []
    assert "\nUSER 10001" in text.rpartition("FROM ")[2]
    (words,) = re.findall(r"(?m)^CMD (.*)$", text)
    parser, _ = parser_of_all_verbs()
    assert parser.parse_args(json.loads(words)).record == "/recordings/{time}.mcap"


def test_the_container_of_a_user_may_write_its_recordings() -> None:
    """podman makes no folder on the host, and a user's is that of root in the container, which runs as another user."""
    page = (ROOT / "docs" / "how-to" / "deploy.md").read_text("utf-8")
    before, _, command = page.partition("$ podman run ")
    assert before.endswith("$ mkdir recordings\n")
    words = shlex.split(command.partition("\n")[0])
    assert "./recordings:/recordings" in words and "keep-id" == words[words.index("--userns") + 1]


def test_the_node_of_the_compose_file_ends_in_silence() -> None:
    pytest.importorskip("rclpy", reason="no ROS 2 here: install the extra 'ros' or source a ROS 2")
    text = (ROOT / "deploy" / "compose.yaml").read_text("utf-8").partition("- |\n")[2].partition("\nvolumes:")[0]
    # rclpy itself is not silent if the signal comes while its executor is made
    once = "timer = node.create_timer(0.01, lambda: (timer.cancel(), print('spins', flush=True))); rclpy.spin(node)"
    program = textwrap.dedent(text).replace("rclpy.spin(node)", once)
    command = [sys.executable, "-c", program]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as node:
        assert node.stdout and node.stdout.readline() == "spins\n"
        node.terminate()
        assert node.communicate(timeout=60) == ("", "")
