"""The files of ``deploy/``: the unit of systemd, and the container."""

from __future__ import annotations

import json
import re
import shlex
import shutil
import subprocess
import sys
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
