"""The recordings that offline work is measured with, and the rows of the table."""

from __future__ import annotations

from pathlib import Path

import pytest

from igtl_gateway.base.clock import SystemClock
from igtl_gateway.cli import main
from igtl_gateway.record.sessionfile.reader import SessionFile
from igtl_gateway_lab.bench import offline, recordings
from igtl_gateway_lab.bench.processes import BenchError
from igtl_gateway_lab.bench.works import WORKS, WorkContext
from tools.evidence.offline_table import BEGIN, END, PAGE, with_table


@pytest.mark.parametrize(("name", "least"), [("small", 4_000), ("pictures", 50), ("mixed", 100)])
def test_made_recordings_verify_and_are_equal(name: str, least: int, tmp_path: Path) -> None:
    made = getattr(recordings, name)
    first, second = tmp_path / "first.mcap", tmp_path / "second.mcap"
    assert made(first, 1.0) == made(second, 1.0) >= least
    assert first.read_bytes() == second.read_bytes()
    assert main(["verify", str(first)]) == 0


def test_mixed_has_both_sides_and_calls(tmp_path: Path) -> None:
    path = tmp_path / "mixed.mcap"
    recordings.mixed(path, 31.0)
    with SessionFile.open(path) as file:
        found = {(entry.kind.name, entry.type) for entry in file.entries()}
    assert {("IGTL_IN", "TRANSFORM"), ("IGTL_OUT", "IMAGE"), ("IGTL_OUT", "SENSOR"), ("IGTL_OUT", "POINT")} <= found
    assert {("LINK", ""), ("ROS_IN", "sensor_msgs/msg/JointState")} <= found


def test_a_row_for_each_verb_with_what_is_absent(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(offline, "_MADE", {"A": (recordings.small, 1)})
    monkeypatch.setattr(offline, "_JOBS", (offline.Job("info", "A", "info {file}", "no-such-program info {file}"),))
    info, replay = WORKS["offline"].run(WorkContext(tmp_path, SystemClock(), lambda _line: None, duration_s=1.0))
    assert info["stream"] == "info, A" and info["other"] == "no-such-program info, absent" and "cpu_ratio" not in info
    assert info["cpu_s"] > 0 and info["peak_mb"] > 1
    assert replay["stream"] == "replay --to igtl, A" and replay["sent_per_s"] > 0
    table = offline.about([info | {"bounds": {"cpu_ratio <= 1": False}}, replay])
    assert len(table) == 4 and "not cpu_ratio <= 1" in table[2] and "a second" in table[3]
    assert not list(tmp_path.glob("*.out"))


def test_a_verb_that_fails_is_an_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(offline, "_MADE", {"A": (recordings.small, 1)})
    monkeypatch.setattr(offline, "_JOBS", (offline.Job("info", "A", "info {file}.absent"),))
    with pytest.raises(BenchError, match=r"info .*: exit code 2"):
        offline.measure(tmp_path, 0.2, SystemClock(), lambda _line: None)


def test_the_table_replaces_the_one_of_the_page() -> None:
    page = f"before\n{BEGIN}old\n{END}after\n"
    written = with_table(page, "| a |\n|---|\n\nload 1\n", "`bench` at abc;")
    assert written == f"before\n{BEGIN}\n`bench` at abc;\nload 1\n\n| a |\n|---|\n\n{END}after\n"
    assert with_table(written, "| a |\n|---|\n\nload 1\n", "`bench` at abc;") == written
    assert PAGE.read_text("utf-8").count(BEGIN) == 1
