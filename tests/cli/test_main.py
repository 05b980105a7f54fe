"""The command line as a user meets it: help, wrong use, files of the wrong kind."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest

from igtl_gateway.cli import VERBS, main

FIXTURE = Path(__file__).parents[2] / "fixtures" / "paper-types.mcap"


def outcome(capsys: pytest.CaptureFixture[str], *arguments: str) -> tuple[int, str, str]:
    """Exit code, standard output and standard error of a call."""
    try:
        code = main(arguments)
    except SystemExit as end:
        code = int(end.code or 0)
    told = capsys.readouterr()
    return code, told.out, told.err


def test_without_a_verb_there_is_help(capsys: pytest.CaptureFixture[str]) -> None:
    code, out, _ = outcome(capsys)
    assert code == 2
    assert all(verb in out for verb in VERBS)


@pytest.mark.parametrize("verb", VERBS)
def test_every_verb_has_help_with_examples(verb: str, capsys: pytest.CaptureFixture[str]) -> None:
    code, out, _ = outcome(capsys, verb, "--help")
    assert code == 0
    assert "examples:" in out and f"igtl-gateway {verb}" in out


def test_an_unknown_verb_is_usage(capsys: pytest.CaptureFixture[str]) -> None:
    code, _, err = outcome(capsys, "fly")
    assert code == 2
    assert "'fly'" in err


def bad_file(kind: str, folder: Path) -> Path:
    """A file that is no sound recording."""
    path = folder / f"{kind}.mcap"
    data = FIXTURE.read_bytes()
    contents = {
        "empty": b"",
        "text": b"this is a text\n" * 50,
        "foreign": b"\x89PNG\r\n\x1a\n" + bytes(500),
        "truncated": data[: len(data) // 2],
        "flipped": data[:3000] + bytes(byte ^ 0xFF for byte in data[3000:3100]) + data[3100:],
        "short": data[:6],
    }
    if kind == "folder":
        path.mkdir()
    elif kind in contents:
        path.write_bytes(contents[kind])
    return path


BAD = ("missing", "empty", "folder", "text", "foreign", "truncated", "short")


@pytest.mark.parametrize(
    ("verb", "kind"),
    # damage in the middle is met while reading on, so a replay meets it behind its first peer: see test_replay
    [(verb, kind) for verb in ("info", "verify") for kind in (*BAD, "flipped")] + [("replay", kind) for kind in BAD],
)
def test_bad_files_end_in_one_clear_line(
    verb: str, kind: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = bad_file(kind, tmp_path)
    options = ("--to", "igtl", "--listen", "127.0.0.1:0") if verb == "replay" else ()
    code, _, err = outcome(capsys, verb, str(path), *options)
    assert code in (1, 2)
    lines = err.strip().splitlines()
    assert len(lines) == 1, err
    assert lines[0].startswith(f"igtl-gateway {verb}: ") and str(path) in lines[0]


def test_json_is_for_programs(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    copy = tmp_path / "copy.mcap"
    shutil.copy(FIXTURE, copy)
    for verb, key in (("info", "streams"), ("verify", "good")):
        code, out, err = outcome(capsys, verb, str(copy), "--json")
        assert code == 0 and not err
        assert key in json.loads(out)
