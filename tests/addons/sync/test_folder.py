"""``igtl-gateway sync`` of a folder: a row for each recording and pair, whatever the others are."""

from __future__ import annotations

import json
import math
import shutil
from pathlib import Path

import numpy as np
import pytest

from igtl_gateway.cli import FAILURE, USAGE, main
from igtl_gateway.wire.text import String
from igtl_gateway.wire.transform import Transform
from tests.addons.lerobot.sessions import Sent, write_session
from tests.tables import table

PROBE, ARM = "TRANSFORM/ProbeToBase", "TRANSFORM/ArmToBase"


def at(seconds: float, size: float) -> Transform:
    """A pose that moves without a period."""
    matrix = np.eye(4)
    matrix[0, 3] = size * (math.sin(2.1 * seconds) + 0.7 * math.sin(3.7 * seconds + 1) + math.sin(0.21 * seconds**2))
    return Transform.from_rows(matrix.tolist())


def session(path: Path, late_s: float, size: float = 20.0) -> Path:
    """A recording of 15 s in which the stamps of the arm are late."""
    path.parent.mkdir(parents=True, exist_ok=True)
    sent: list[Sent] = []
    for number in range(300):
        seconds = number / 20
        sent += [(seconds, PROBE, at(seconds, 20.0)), (seconds, ARM, at(seconds, size))]
    return write_session(path, sent, ahead_s={ARM: late_s})


@pytest.fixture(scope="module")
def study(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Recordings that are late, early, still, of one stream, and damaged; in and below a folder."""
    folder = tmp_path_factory.mktemp("sync") / "study"
    session(folder / "b late.mcap", 0.12)
    session(folder / "monday" / "a early.mcap", -0.05)
    session(folder / "c still.mcap", 0.0, 0.0)
    write_session(folder / "d words.mcap", [(0.0, "STRING/Note", String(b"go"))])
    data = bytearray((folder / "b late.mcap").read_bytes())
    data[len(data) // 2] ^= 0xFF
    (folder / "e damaged.mcap").write_bytes(data)
    (folder / "f empty.mcap").write_bytes(b"")
    (folder / "notes.txt").write_text("no recording", "utf-8")
    return folder


def test_each_recording_has_its_rows(study: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["sync", str(study), PROBE, ARM, "--json"]) == FAILURE
    told = json.loads(capsys.readouterr().out)
    assert (told["recordings"], told["good"]) == (6, False)
    rows = {row["recording"]: row for row in told["lags"]}
    assert list(rows) == [
        "b late.mcap", "c still.mcap", "d words.mcap", "e damaged.mcap", "f empty.mcap", "monday/a early.mcap",
    ]  # fmt: skip
    for name, late_s in (("b late.mcap", 0.12), ("monday/a early.mcap", -0.05)):
        row = rows[name]
        assert (row["fixed"], row["stream"], row["verdict"]) == (PROBE, ARM, "measured")
        assert row["lag_s"] == pytest.approx(late_s, abs=0.003)
        assert row["low_s"] - 0.001 <= late_s <= row["high_s"] + 0.001
    verdicts = [rows[name]["verdict"] for name in ("c still.mcap", "d words.mcap", "e damaged.mcap", "f empty.mcap")]
    assert verdicts == ["still", "no_pair", "unreadable", "unreadable"]
    assert not any(row["reason"].startswith(str(study)) for row in told["lags"])


def test_the_table_of_a_terminal(study: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["sync", str(study), PROBE, ARM]) == FAILURE
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == f"behind {PROBE}:"
    assert "+120." in lines[2] and "measured" in lines[2]
    assert lines[-1] == f"{study}: 6 recordings, 6 rows: 2 measured, 1 no_pair, 1 still, 2 unreadable"


def test_all_rows_with_a_lag_are_success(study: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    shutil.copytree(study / "monday", tmp_path / "good" / "monday")
    assert main(["sync", str(tmp_path / "good")]) == 0
    assert capsys.readouterr().out.splitlines()[-1].endswith("good: 1 recording, 1 row: 1 measured")


@table("words", [["--plot", "x.svg"], ["--with", "x.mcap"], ["--apply", "-o", "x.mcap"]])
def test_what_needs_one_recording(words: list[str], study: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["sync", str(study), PROBE, ARM, *words]) == USAGE
    assert f"{words[0]}: found it with a folder, expected one recording" in capsys.readouterr().err


def test_a_folder_without_recordings_is_an_error(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["sync", str(tmp_path)]) != 0
    assert "found a directory" in capsys.readouterr().err
