"""No line of a verb is wider than the terminal: each verb on recordings, on a pipe and in a terminal.

Strategy: one table of commands; each new verb needs a row.  Paths, and what is for programs, may be longer.
"""

from __future__ import annotations

import fcntl
import os
import pty
import shutil
import struct
import subprocess
import sys
import termios
from pathlib import Path

import pytest

from igtl_gateway.cli import main
from igtl_gateway.cli.verbs import available
from tests.places import FIXTURES

#: Commands in their order; ``A`` and ``B`` are recordings, ``OUT`` is a folder.
COMMANDS = [
    "info A", "info B", "info OUT", "info OUT/a_bag", "info OUT/cut.mcap", "info OUT/none.mcap", "info OUT/text.mcap",
    "verify A", "verify OUT/none.mcap", "verify A --seal", "diff A B", "diff A OUT/a.mcap", "doctor A", "doctor B",
    "doctor OUT/cut.mcap", "lint A", "slice A -o OUT/sliced.mcap --start 1", "slice A -o OUT/none.mcap --streams Robt",
    "recover OUT/cut.mcap -o OUT/recovered.mcap", "mark OUT/a.mcap --label slip --at 1", "info OUT/a.mcap",
    "mark OUT/a.mcap --remove nope", "keep OUT --retention 30d --dry-run", "retain OUT --retention 30d --dry-run",
    "export A --to csv -o OUT/csv", "export A --to mrb -o OUT/a.mrb", "export A --to rosbag2 -o OUT/a_bag",
    "import OUT/a_bag -o OUT/imported.mcap", "info OUT/a_bag", "sync B", "sync A", "merge x=A y=B -o OUT/merged.mcap",
    "info OUT/merged.mcap", "deidentify A -o OUT/anonymous.mcap", "view A -o OUT/a.rrd",
    "review A", "resim A --runs 1 -- true", "cohort info OUT/cohort -o OUT/results --workers 1",
    "lerobot", "bridge --types", "bench --list", "simulate acquisition -o OUT/simulated.mcap", "nope",
    "seal keys show A",
    "replay OUT/none.mcap --to igtl", "replay A --to igtl --streams Robt", "decode OUT/none", "upload OUT",
    "page OUT/none",
    "zenoh-router --nope", "demo --nope", "completion nope", "keys show A", "--version", "--help", "--help-all",
    *(f"{verb} --help" for verb in ("bridge", "doctor", "export", "import", "info", "replay", "slice", "sync", "view")),
]  # fmt: skip


@pytest.fixture(name="out")
def _out(tmp_path: Path) -> Path:
    (tmp_path / "cohort").mkdir()
    for name in ("a.mcap", "cohort/a.mcap"):
        shutil.copy(FIXTURES / "acquisition.mcap", tmp_path / name)
    (tmp_path / "cut.mcap").write_bytes((FIXTURES / "acquisition.mcap").read_bytes()[:40_000])
    (tmp_path / "text.mcap").write_text("no recording")
    return tmp_path


def commanded(command: str, out: Path) -> list[str]:
    words = {"A": str(FIXTURES / "acquisition.mcap"), "B": str(FIXTURES / "paper-types.mcap")}
    return [
        "=".join(words.get(part, part).replace("OUT", str(out)) for part in word.split("=")) for word in command.split()
    ]


def too_wide(text: str, columns: int) -> list[str]:
    """Lines above the width, without those that one word makes so long."""
    return [
        line
        for line in text.splitlines()
        if len(line) > columns and max(map(len, line.split())) + len(line) - len(line.lstrip()) < columns - 20
    ]


@pytest.mark.slow
@pytest.mark.parametrize("columns", [60, 80, 120])
def test_no_line_is_wider_than_the_terminal(
    columns: int, out: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", str(columns))
    monkeypatch.chdir(out)  # so that its paths are short
    found = {}
    for command in COMMANDS:
        if columns < 80 and "--help" in command:
            continue  # examples are commands
        words = [word.replace(f"{out}/", "") for word in commanded(command, out)]
        try:
            main(words)
        except SystemExit:
            pass
        printed = "".join(capsys.readouterr())
        assert printed, command
        if wide := too_wide(printed, columns):
            found[command] = wide
    assert not found


def test_each_verb_has_a_row() -> None:
    tested = {command.split()[0] for command in COMMANDS}
    assert {name for name, verb in available().items() if verb.module} <= tested


def test_a_terminal_of_80_columns_has_no_longer_line(out: Path) -> None:
    ours, theirs = pty.openpty()
    fcntl.ioctl(theirs, termios.TIOCSWINSZ, struct.pack("HHHH", 24, 80, 0, 0))
    environment = {key: value for key, value in os.environ.items() if key not in ("COLUMNS", "LINES")}
    command = [sys.executable, "-m", "igtl_gateway", "info", "a.mcap"]
    with subprocess.Popen(command, stdout=theirs, stderr=theirs, stdin=theirs, cwd=out, env=environment) as process:
        os.close(theirs)
        printed = b""
        while True:
            try:
                part = os.read(ours, 1 << 16)
            except OSError:  # Linux: the last program has closed the terminal
                break
            if not part:
                break
            printed += part
        assert process.wait() == 0
    os.close(ours)
    lines = printed.decode().replace("\r", "").splitlines()
    assert len(lines) > 20 and max(map(len, lines)) <= 80
