"""Marks beside a closed recording: the side file, the verb that writes it, and who reads it."""

from __future__ import annotations

import json
import os
import shutil
from pathlib import Path

import pytest

import igtl_gateway
from igtl_gateway.base.errors import DamagedRecording
from igtl_gateway.cli import main
from igtl_gateway.gateway.log.marks import Mark
from igtl_gateway.record.sessionfile.added_marks import added_marks, marks_file, write_marks
from igtl_gateway.record.sessionfile.reader import SessionFile
from tests import marked
from tests.places import FIXTURES
from tests.tables import table

HEAD = '{"igtl_gateway_marks": 1, "start_ns": 5, "end_ns": 9}'
LINE = {"label": "a", "text": "", "who": "", "time_ns": 6, "end_ns": None}


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    return Path(shutil.copy(FIXTURES / "star.mcap", tmp_path / "out.mcap"))


def test_marks_are_added_listed_and_removed(recording: Path, capsys: pytest.CaptureFixture[str]) -> None:
    content = recording.read_bytes()
    mark = ["mark", str(recording)]
    assert main([*mark, "--at", "1.5", "--label", "slip", "--text", "it slipped", "--who", "Kim"]) == 0
    assert main([*mark, "--at", "mark:slip", "--until", "2.5", "--label", "repair"]) == 0
    assert capsys.readouterr().out.splitlines() == [
        f"{recording}.marks.jsonl: added slip at 1.500 s",
        f"{recording}.marks.jsonl: added repair at 1.500 s to 2.500 s",
    ]
    assert main(["info", str(recording)]) == 0
    lines = capsys.readouterr().out.partition("  marks\n")[2].splitlines()[:3]
    assert [line.strip() for line in lines] == [
        "1.500 s  slip: it slipped (Kim) [added]",
        "1.500 s to 2.500 s  repair [added]",
        "[added] after the recording was closed: out.mcap.marks.jsonl, which no seal covers",
    ]
    with igtl_gateway.open(recording) as opened:
        assert [mark.label for mark in opened.marks] == ["slip", "repair"]
        assert opened.between("mark:repair", "mark:repair").duration == 1.0
    assert main([*mark, "--remove", "slip"]) == 0
    assert main([*mark, "--remove", "repair", "--json"]) == 0
    assert not marks_file(recording).exists() and recording.read_bytes() == content
    assert json.loads(capsys.readouterr().out.splitlines()[-1])["marks"] == 0


@table(
    ("words", "error"),
    [
        (["--label", "a"], "--label: found no --at, expected the time of the mark"),
        (["--at", "1", "--label", "a:b"], "mark: found label 'a:b'"),
        (["--at", "1e6", "--label", "a"], "--at: found 1000000.000 s from the start, expected 0 to "),
        (["--at", "2", "--until", "1", "--label", "a"], "--until: found 1.000 s before --at, expected a later time"),
        (["--at", "mark:x", "--label", "a"], "--at: found mark:x, expected a recording with marks"),
        (["--remove", "a"], "--remove: found mark:a, expected a recording with marks"),
        (["--remove", "a", "--at", "1"], "--remove: found --at, --until, --text or --who, expected none of them"),
    ],
)
def test_what_cannot_be_marked(
    words: list[str], error: str, recording: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["mark", str(recording), *words]) == 2
    assert error in capsys.readouterr().err
    assert not marks_file(recording).exists()


@table(
    ("lines", "error"),
    [
        ([], "found 0 lines"),
        (["x"], "line 1: found invalid JSON"),
        (['{"igtl_gateway_marks": 2, "start_ns": 5, "end_ns": 9}'], "line 1: found version 2, expected 1"),
        (['{"igtl_gateway_marks": 1, "start_ns": 4, "end_ns": 8}'], "found marks of a recording from 4 to 8 ns"),
        ([HEAD, "{}"], "line 2"),
        ([HEAD, json.dumps(LINE | {"label": "a\nb"})], "line 2: mark: found label"),
        ([HEAD, json.dumps(LINE | {"end_ns": 5})], "line 2: found an end before the begin"),
        ([HEAD, json.dumps(LINE | {"time_ns": -1})], "line 2"),
    ],
)
def test_a_bad_side_file_is_named_with_the_line(lines: list[str], error: str, tmp_path: Path) -> None:
    recording = tmp_path / "out.mcap"
    marks_file(recording).write_text("\n".join(lines))
    with pytest.raises(DamagedRecording) as caught:
        added_marks(recording, 5, 9)
    assert error in str(caught.value) and str(marks_file(recording)) in str(caught.value)


@pytest.mark.parametrize("kind", ["a FIFO", "a folder", "No such file", "symbolic links"])
def test_a_side_file_that_is_none_is_named(kind: str, recording: Path, capsys: pytest.CaptureFixture[str]) -> None:
    side = marks_file(recording)
    if kind == "a FIFO":
        os.mkfifo(side)
    elif kind == "a folder":
        side.mkdir()
    else:
        side.symlink_to(side.name if kind == "symbolic links" else "absent")
    new = recording.with_name("new.mcap")
    for words in (
        ["info"],
        ["slice", "-o", str(new)],
        ["deidentify", "-o", str(new)],
        ["view", "-o", str(new) + ".rrd"],
    ):
        code = main([*words, str(recording)])
        printed = "".join(capsys.readouterr())
        assert code != 0 and f"{side}: " in printed and kind in printed and not new.exists(), words


def test_info_shows_a_recording_with_a_bad_side_file(recording: Path, capsys: pytest.CaptureFixture[str]) -> None:
    marks_file(recording).write_text(HEAD + "\n")
    assert main(["info", str(recording)]) == 1
    out = capsys.readouterr().out
    assert "found marks of a recording from 5 to 9 ns" in out and "TRANSFORM/ToolToBase" in out
    assert main(["slice", str(recording), "-o", str(recording.with_name("x.mcap")), "--start", "1"]) == 1
    assert not recording.with_name("x.mcap").exists()


def test_written_marks_are_read(tmp_path: Path) -> None:
    recording = tmp_path / "out.mcap"
    marks = (Mark("ä", "t", "w", 6, 8, is_added=True), Mark("b", "", "", 7, is_added=True))
    write_marks(recording, marks[::-1], 5, 9)
    assert added_marks(recording, 5, 100) == added_marks(recording, 1, 9) == marks


def test_other_recordings_made_of_it_have_them(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A slice, a recovered file, and a de-identified one, whose label and maker are pseudonyms."""
    recording = marked.write(tmp_path / "out.mcap")
    for at, until, label in (("1.2", "1.4", "early"), ("3.5", "3.6", "later")):
        assert main(["mark", str(recording), "--at", at, "--until", until, "--label", label]) == 0
    marks = {}
    for name, words in {
        "part": ["slice", "--start", "3", "--end", "3.55"],
        "again": ["recover"],
        "clean": ["deidentify", "--keep-times"],
    }.items():
        out = tmp_path / f"{name}.mcap"
        assert main([words[0], str(recording), "-o", str(out), *words[1:]]) == 0
        with igtl_gateway.open(out) as opened:
            marks[name] = [mark for mark in opened.marks if mark.is_added]
    with igtl_gateway.open(recording) as opened:
        added = [mark for mark in opened.marks if mark.is_added]
    assert marks["part"] == added[1:] and marks["again"] == added
    assert [(mark.time_ns, mark.end_ns) for mark in marks["clean"]] == [(mark.time_ns, mark.end_ns) for mark in added]
    assert not {mark.label for mark in marks["clean"]} & {"early", "later"}
    assert main(["verify", str(tmp_path / "part.mcap")]) == 0


def test_a_slice_has_the_marks_of_its_window_where_no_message_is(tmp_path: Path) -> None:
    path = Path(shutil.copy(FIXTURES / "acquisition.mcap", tmp_path / "out.mcap"))
    with SessionFile.open(path) as file:
        write_marks(path, [Mark("last", "", "", file.end_ns)], file.start_ns, file.end_ns)
    assert main(["slice", str(path), "-o", str(tmp_path / "part.mcap"), "--start", "mark:last"]) == 0
    with igtl_gateway.open(tmp_path / "part.mcap") as part:
        assert [mark.label for mark in part.marks] == ["last"]
    assert main(["info", str(tmp_path / "part.mcap")]) == 0
