"""The recordings that offline work is measured with, and the rows of the table."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from igtl_gateway.app.verification import verify_recording
from igtl_gateway.base.clock import SystemClock
from igtl_gateway.base.stamp import NS_PER_S
from igtl_gateway.cli import main
from igtl_gateway.record.sessionfile.reader import SessionFile
from igtl_gateway_lab.bench import offline, recordings
from igtl_gateway_lab.bench.processes import BenchError
from igtl_gateway_lab.bench.works import WORKS, WorkContext
from tools.evidence import long_session
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
    monkeypatch.setattr(offline, "_RECEIVED_BYTES", 4096)  # more than one read, which a rate needs
    info, replay = WORKS["offline"].run(WorkContext(tmp_path, SystemClock(), lambda _line: None, duration_s=1.0))
    assert info["stream"] == "info, A" and info["other"] == "no-such-program info, absent" and "cpu_ratio" not in info
    assert info["cpu_s"] > 0 and info["peak_mb"] > 1
    assert replay["stream"] == "replay --to igtl, A" and replay["sent_per_s"] > 0
    table = offline.about([info | {"bounds": {"cpu_ratio <= 1": False}}, replay])
    assert len(table) == 4 and "not cpu_ratio <= 1" in table[2] and "a second" in table[3]
    assert not list(tmp_path.glob("*.out"))


def test_a_row_names_the_package_that_it_lacks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(offline, "_MADE", {"A": (recordings.small, 1.0), "A/10": (recordings.small, 0.1)})
    lacks = offline.Job("resim", ("A/10",), "resim {file}", needs="no_such_package")
    sealed = offline.Job("seal", "A", "seal {file} --key {key} -o {out}.mcap", before="seal keys new {key}")
    monkeypatch.setattr(offline, "_JOBS", (lacks, sealed))
    absent, seal, _ = offline.measure(tmp_path, 0.5, SystemClock(), lambda _line: None)
    assert absent == {"case": "offline", "stream": "resim, A/10", "entries": 206, "absent": "no_such_package"}
    assert seal["cpu_s"] > 0
    assert "| resim, A/10 (no_such_package is absent) |  |" in offline.about([absent, seal])[2]


def test_each_verb_has_a_row() -> None:
    verbs = {"resim of a light node", "export --to parquet", "merge with C", "deidentify", "seal", "verify --reference"}
    assert verbs <= {name.rpartition(", ")[0] for name in offline.streams()}


def test_it_needs_no_ros(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(offline, "measure", lambda *_: [{"case": "offline", "stream": "info, A", "cpu_s": 1.0}])
    monkeypatch.setitem(sys.modules, "rclpy", None)
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    monkeypatch.setenv("COLUMNS", "60")
    assert main(["bench", "--case", "offline"]) == 0
    printed = capsys.readouterr().out.splitlines()
    assert printed[2].startswith("| info, A | 1.0 |") and printed[2].count("|") == printed[0].count("|") > 11
    assert main(["bench", "--case", "transform", "--count", "1"]) == 1
    assert "rclpy" in capsys.readouterr().err


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


def test_a_session_of_hours_is_made_of_parts_and_verifies(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(long_session, "_PART_S", 1)
    entries = long_session.write(tmp_path / "a.mcap", 3 / 3600)
    found = verify_recording(tmp_path / "a.mcap")
    assert found.good and entries > 11_950
    with SessionFile.open(tmp_path / "a.mcap") as file:
        assert file.end_ns - file.start_ns > 2.9 * NS_PER_S
