"""``slice`` on the command line: a file that others read and that verifies."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from mcap.reader import make_reader
from rosbags.highlevel import AnyReader

from igtl_gateway.cli import main
from igtl_gateway.record.sessionfile.reader import SessionFile
from igtl_gateway.record.sessionfile.writer import SessionWriter
from tests.files import BytesRead
from tests.places import FIXTURES


@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("star", ["--start", "5", "--end", "6.5"]),
        ("star", ["--start", "2", "--streams", "TRANSFORM/*"]),
        ("paper-types", ["--end", "2.5", "--streams", "STRING/*"]),
        ("every-type", ["--start", "3", "--end", "5"]),
    ],
)
def test_a_slice_verifies_and_other_tools_read_it(
    name: str, options: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "part.mcap"
    source = FIXTURES / f"{name}.mcap"
    assert main(["slice", str(source), "-o", str(out), *options, "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert main(["verify", str(out)]) == 0
    assert main(["info", str(out)]) == 0
    with SessionFile.open(out) as part, SessionFile.open(source) as whole:
        assert part.session["slice_of"] == source.name
        assert part.session["config"] == whole.session["config"]
        start_ns = int(part.session["slice_start_ns"])
        assert sum(e.stamp_ns >= start_ns for e in part.entries()) == told["inputs"] + told["outputs"] > 0
        qos = {(one.topic, one.kind): one.qos for one in whole.channels}
        assert all(qos[one.topic, one.kind] == one.qos for one in part.channels)
        assert part.entry_count < whole.entry_count
        count = part.entry_count
    with AnyReader([out]) as reader:
        assert sum(1 for _ in reader.messages()) == count
    with out.open("rb") as stream:
        assert sum(1 for _ in make_reader(stream, validate_crcs=True).iter_messages()) == count


def test_a_part_of_a_split_recording_is_cut_with_what_it_brings_of_the_time_before(tmp_path: Path) -> None:
    with SessionFile.open(FIXTURES / "star.mcap") as file:
        entries = list(file.entries())
        middle, end = (next(at for at in range(here, 900) if entries[at].kind.is_input) for here in (400, 800))
        before = [entry for entry in entries[:middle] if entry.kind.is_input]
        part = tmp_path / "part_1.mcap"
        writer = SessionWriter(part, {**file.session, "part": "1"}, prologue=before)
        for entry in entries[middle:end]:
            writer.write(entry)
        writer.close({})
    assert main(["verify", str(part)]) == 0
    out = tmp_path / "slice.mcap"
    assert main(["slice", str(part), "-o", str(out), "--start", "1"]) == 0
    assert main(["verify", str(out)]) == 0
    with SessionFile.open(out) as file:
        assert "part" not in file.session and next(file.entries()).seq == 1


def test_equal_slices_are_equal_files(tmp_path: Path) -> None:
    for name in ("one.mcap", "two.mcap"):
        assert main(["slice", str(FIXTURES / "paper-types.mcap"), "-o", str(tmp_path / name), "--end", "2"]) == 0
    assert (tmp_path / "one.mcap").read_bytes() == (tmp_path / "two.mcap").read_bytes()


@pytest.mark.parametrize(
    ("options", "told"),
    [
        (["--start", "2", "--end", "1"], "--end: found +1.000 s, expected after +2.000 s"),
        (["--start", "2", "--end", "2"], "--end: found +2.000 s, expected after +2.000 s"),
        (["--start", "100"], "--start: found +100.000 s, expected at most +"),
        (["--start", "100", "--end", "101"], "--start: found +100.000 s, expected at most +"),
        (["--start", "soon"], "--start: found 'soon'"),
        (["--end", "0"], "--end: found +0.000 s, expected after +0.000 s"),
    ],
)
def test_what_makes_no_window_is_refused(
    options: list[str], told: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "part.mcap"
    assert main(["slice", str(FIXTURES / "paper-types.mcap"), "-o", str(out), *options]) == 2
    assert told in capsys.readouterr().err
    assert not out.exists()


def test_no_file_is_replaced_unasked_and_never_the_recording_itself(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    source = tmp_path / "whole.mcap"
    data = (FIXTURES / "paper-types.mcap").read_bytes()
    source.write_bytes(data)
    other = tmp_path / "other.mcap"
    other.write_bytes(b"mine")
    assert main(["slice", str(source), "-o", str(other)]) == 2
    assert other.read_bytes() == b"mine"
    assert main(["slice", str(source), "-o", str(source), "--overwrite"]) == 2
    assert source.read_bytes() == data
    assert main(["slice", str(source), "-o", str(other), "--overwrite"]) == 0
    assert capsys.readouterr().out.startswith(f"{other}: ")


def test_what_is_before_the_window_is_read_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    source = FIXTURES / "star.mcap"
    size = source.stat().st_size
    with SessionFile.open(source) as file:
        share = 2e9 / (file.end_ns - file.start_ns)
    read = BytesRead(monkeypatch)
    assert main(["slice", str(source), "-o", str(tmp_path / "late.mcap"), "--start", str((1 - share) * 2 / share)]) == 0
    # the state follows from all of the session before, so that is read; the window is read to compare, and to write
    assert read.count < size * (1 + 2 * share) + (1 << 20)


def without_end(path: Path, ledger: dict[str, Any]) -> None:
    """A recording whose bridge was killed before its last output was recorded."""
    with SessionFile.open(FIXTURES / "paper-types.mcap") as file:
        entries = list(file.entries())
        while entries[-1].kind.is_input:
            entries.pop()
        writer = SessionWriter(path, file.session)
        for entry in entries[:-1]:
            writer.write(entry)
        writer.close(ledger)


@pytest.mark.parametrize(
    "ledger", [{"cut_off": True}, {"recovered": {"by": "a", "from": "b", "whole": False, "lost": [], "more_lost": 0}}]
)
def test_a_part_of_a_recording_without_its_end_verifies_as_the_whole(
    ledger: dict[str, Any], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    whole, part = tmp_path / "whole.mcap", tmp_path / "part.mcap"
    without_end(whole, ledger)
    assert main(["verify", str(whole)]) == 0
    assert "not verified: 1 output that the recording has lost" in capsys.readouterr().out
    assert main(["slice", str(whole), "-o", str(part), "--start", "1"]) == 0
    capsys.readouterr()
    assert main(["verify", str(part)]) == 0
    assert "not verified: 1 output that the recording has lost" in capsys.readouterr().out


def test_a_loss_that_nothing_declares_is_a_difference(tmp_path: Path) -> None:
    whole = tmp_path / "whole.mcap"
    without_end(whole, {})
    assert main(["verify", str(whole)]) == 1


def test_a_name_without_a_stream_is_reported(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    part = str(tmp_path / "part.mcap")
    assert (
        main(["slice", str(FIXTURES / "star.mcap"), "-o", part, "--streams", "TRANSFORM/*", "--streams", "ToolToBas"])
        == 0
    )
    assert (
        "--streams ToolToBas: matches no recorded stream; did you mean 'TRANSFORM/ToolToBase'?"
        in capsys.readouterr().err
    )
