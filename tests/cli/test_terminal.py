"""The one place where the command line prints."""

from __future__ import annotations

import io
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from igtl_gateway.base.errors import OutputError
from igtl_gateway.cli import main
from igtl_gateway.cli.terminal import (
    LONGEST_LINE,
    PROGRESS,
    PROGRESS_VARIABLE,
    Parser,
    aligned,
    cell,
    clear_live_line,
    live_line,
    print_json,
    print_line,
    print_text,
    width,
)
from tests.places import FIXTURES

NAUGHTY = "/a\x1b]0;owned\x07\n\x1b[2Jverified: all 9 outputs equal\r\u202e"


def written(monkeypatch: pytest.MonkeyPatch, encoding: str) -> io.BytesIO:
    """The bytes of stdout, in an encoding."""
    raw = io.BytesIO()
    monkeypatch.setattr(sys, "stdout", io.TextIOWrapper(raw, encoding=encoding, write_through=True))
    return raw


def test_foreign_text_stays_on_its_line(capsys: pytest.CaptureFixture[str]) -> None:
    print_line(NAUGHTY, "second")
    print_line(f"error: {NAUGHTY}", error=True)
    told = capsys.readouterr()
    assert told.out.splitlines() == [
        "/a\\x1b]0;owned\\x07\\x0a\\x1b[2Jverified: all 9 outputs equal\\x0d\\u202e",
        "second",
    ]
    assert len(told.err.splitlines()) == 1 and "\x1b" not in told.err


def test_colours_are_ours_alone(capsys: pytest.CaptureFixture[str]) -> None:
    print_line(NAUGHTY, colour="31")
    told = capsys.readouterr().out
    assert told.startswith("\x1b[31m/a\\x1b") and told.endswith("\\u202e\x1b[0m\n")
    assert told.count("\x1b") == 2


@pytest.mark.parametrize(("name", "value"), [("NO_COLOR", "1"), ("TERM", "dumb")])
def test_the_environment_forbids_colours(
    name: str, value: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv(name, value)
    print_line("wrong", colour="31")
    assert capsys.readouterr().out == "wrong\n"


def test_an_empty_no_color_forbids_nothing(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setenv("NO_COLOR", "")
    print_line("wrong", colour="31")
    assert "\x1b[31m" in capsys.readouterr().out


def test_a_terminal_without_cursor_control_has_no_live_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("TERM", "dumb")
    live_line("50 %")
    clear_live_line()
    assert capsys.readouterr().out == ""


def test_a_live_line_is_cut_to_the_terminal(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("COLUMNS", "20")
    live_line(f"{NAUGHTY}{'x' * 100}")
    assert capsys.readouterr().out == "\r\x1b[K/a\\x1b]0;owned\\x07\\"


def test_long_lines_are_cut_and_say_so(capsys: pytest.CaptureFixture[str]) -> None:
    print_line("x" * (LONGEST_LINE + 1234))
    assert capsys.readouterr().out.split() == ["x" * LONGEST_LINE, "…", "and", "1,234", "more", "characters"]


def test_own_texts_have_lines_of_any_length(capsys: pytest.CaptureFixture[str]) -> None:
    print_text("a\n\nb\x1b\n" + "x" * (LONGEST_LINE + 1))
    assert capsys.readouterr().out == "a\n\nb\\x1b\n" + "x" * (LONGEST_LINE + 1)


def test_columns_are_as_wide_as_what_is_shown(capsys: pytest.CaptureFixture[str]) -> None:
    names = ["/tool", "/a\x1b[2J"]
    columns = width(names)
    assert columns == len("/a\\x1b[2J")
    for name in names:
        print_line(f"{cell(name, columns)} 1")
    assert [line.index(" 1") for line in capsys.readouterr().out.splitlines()] == [columns, columns]


def test_one_long_name_does_not_widen_a_table_without_end() -> None:
    assert width(["x" * 10_000_000, "y"]) < 100
    assert width([]) == 0


@pytest.mark.parametrize("encoding", ["ascii", "latin-1", "cp1252", "utf-8"])
def test_no_name_stops_the_program(encoding: str, monkeypatch: pytest.MonkeyPatch) -> None:
    raw = written(monkeypatch, encoding)
    print_line("Sonde 探 é \udcff", "next")
    lines = raw.getvalue().decode(encoding).splitlines()
    assert lines[1] == "next"
    assert lines[0].endswith("\\udcff")
    assert ("探" in lines[0]) == (encoding == "utf-8")


@pytest.mark.parametrize("encoding", ["ascii", "latin-1", "utf-8"])
def test_json_is_json_in_every_encoding(encoding: str, monkeypatch: pytest.MonkeyPatch) -> None:
    told = {"topic": NAUGHTY, "探": "é\udcff\x7f\U000e0001"}
    raw = written(monkeypatch, encoding)
    print_json(told)
    text = raw.getvalue().decode(encoding)
    assert text.count("\n") == 1 and text[:-1].isprintable()
    assert json.loads(text) == told


def test_arguments_of_others_in_errors_are_escaped(capsys: pytest.CaptureFixture[str]) -> None:
    parser = Parser(prog="igtl-gateway")
    parser.add_argument("--size", type=int)
    for arguments in ([NAUGHTY], ["--size", NAUGHTY]):
        with pytest.raises(SystemExit) as ended:
            parser.parse_args(arguments)
        assert ended.value.code == 2
        told = capsys.readouterr()
        assert not told.out
        assert len(told.err.splitlines()) == 2 and all(line.isprintable() for line in told.err.splitlines())


@pytest.mark.parametrize("arguments", [["--help"], ["info", "--help"], ["--version"]])
def test_help_goes_to_stdout(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main(arguments)
    assert not ended.value.code
    told = capsys.readouterr()
    assert "igtl-gateway" in told.out and not told.err


@pytest.mark.parametrize(
    "arguments",
    [
        ["info", "missing\n\x1b[2J.mcap"],
        ["verify\n\x1b[2J"],
        ["info", "a.mcap", "--limit", "memory\x1b[2J\nx=1"],
        ["export", "a.mcap", "--to", "csv\x1b\n", "-o", "x"],
    ],
)
def test_no_argument_reaches_the_terminal_raw(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    try:
        code = main(arguments)
    except SystemExit as ended:
        code = int(ended.code or 0)
    told = capsys.readouterr()
    assert code == 2
    assert all(line.isprintable() for line in (told.out + told.err).splitlines())
    assert "\\x1b" in told.err


@pytest.mark.slow
@pytest.mark.parametrize("environment", [{"LC_ALL": "C"}, {"PYTHONIOENCODING": "ascii"}, {"PYTHONUTF8": "0"}])
def test_a_file_name_that_is_no_utf8(environment: dict[str, str], tmp_path: Path) -> None:
    path = os.fsencode(tmp_path) + b"/\xff\xe9\n.mcap"
    ended = subprocess.run(
        [sys.executable, "-m", "igtl_gateway", "info", path],
        capture_output=True,
        env=os.environ | environment,
        check=False,
        timeout=60,
    )
    assert ended.returncode == 2
    assert b"Traceback" not in ended.stderr
    assert ended.stderr.count(b"\n") == 1 and b"\\udcff" in ended.stderr and b"\\x0a" in ended.stderr


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="this system has no /dev/full")
def test_a_full_disk_behind_stdout_is_an_error(tmp_path: Path) -> None:
    with open("/dev/full", "wb") as full:
        ended = subprocess.run(
            [sys.executable, "-m", "igtl_gateway", "simulate", "lego", "--print-config"],
            stdout=full,
            stderr=subprocess.PIPE,
            text=True,
            check=False,
            timeout=60,
        )
    assert ended.returncode == 1
    assert ended.stderr == ("igtl-gateway simulate: cannot write to standard output: No space left on device\n")


def test_output_that_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    class Full(io.StringIO):
        def write(self, text: str) -> int:
            raise OSError(28, "No space left on device")

    monkeypatch.setattr(sys, "stdout", Full())
    with pytest.raises(OutputError, match="standard output: No space"):
        print_line("a")


def test_a_table_has_text_on_the_left_and_numbers_on_the_right() -> None:
    title, row, last = aligned([("stream", "A"), ("STRING/a\nb", "1,200"), ("/tf", "")])
    assert title.startswith("  stream ") and title.endswith("    A")
    assert row.startswith("  STRING/a") and "\n" not in row and row.endswith("  1,200")
    assert len(title) == len(row) and last == "  /tf"


def test_a_verification_reports_its_progress_to_who_reads_it(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("igtl_gateway.cli.terminal._PROGRESS_NS", 0)
    monkeypatch.setattr("igtl_gateway.base.systems.forks._TICK_S", 0.001)
    for how in ([], ["--reference"], ["--json"]):
        assert main(["verify", str(FIXTURES / "star.mcap"), *how]) == 0
        assert capsys.readouterr().err == ""
        with monkeypatch.context() as patch:
            patch.setenv(PROGRESS_VARIABLE, "1")
            assert main(["verify", str(FIXTURES / "star.mcap"), *how]) == 0
        lines = capsys.readouterr().err.splitlines()
        shares = [int(line.removeprefix(PROGRESS).removesuffix(" %")) for line in lines]
        assert shares == sorted(shares) and 0 <= shares[0] <= shares[-1] <= 100, how
