"""The log of the retention: lines that are only added, for its owner only, and what it states of a file."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from igtl_gateway.base.untrusted import limits
from igtl_gateway.record.retention.retention_log import LOG_NAME, RetentionLog

NOW_NS = 1_800_000_000_123_456_789


@pytest.mark.parametrize("make", [os.mkfifo, os.mkdir, lambda path: os.symlink("/dev/zero", path)])
def test_a_log_that_is_no_file_states_nothing_and_gets_no_line(tmp_path: Path, make: Callable[[Path], None]) -> None:
    make(tmp_path / LOG_NAME)
    log = RetentionLog(tmp_path)
    assert not log.has_deleted("a.mcap")
    for change in (log.check, lambda: log.add(1, "delete", file="a.mcap"), lambda: log.mark(1)):
        with pytest.raises(OSError):
            change()


def test_a_log_is_read_from_its_end_as_far_as_the_limit_goes(tmp_path: Path) -> None:
    log = RetentionLog(tmp_path)
    log.add(1, "delete", file="first.mcap")
    os.truncate(log.path, 10_000_000_000)  # a hole: the file takes no room
    log.add(2, "delete", file="last.mcap")
    log.add(3, "not deleted", file="kept.mcap")
    with limits.limits_in_force(replace(limits.current_limits(), free=100_000)):
        found = [log.has_deleted(name) for name in ("first.mcap", "last.mcap", "kept.mcap")]
    assert found == [False, True, False]


def test_lines_are_objects_with_the_time_and_what_happened(tmp_path: Path) -> None:
    log = RetentionLog(tmp_path)
    log.add(NOW_NS, "rule", rule="30 d")
    log.add(NOW_NS + 1, "delete", file="ältere\u202e\nAufnahme", size=5, path=Path("a"))
    assert log.path == tmp_path / "igtl-gateway-retention.jsonl"
    assert log.path.stat().st_mode & 0o777 == 0o600
    lines = log.path.read_bytes().decode("ascii").splitlines()
    assert [json.loads(line) for line in lines] == [
        {"time": "2027-01-15T08:00:00.123456789Z", "event": "rule", "rule": "30 d"},
        {
            "time": "2027-01-15T08:00:00.123456790Z",
            "event": "delete",
            "file": "ältere\u202e\nAufnahme",
            "size": 5,
            "path": "a",
        },
    ]
    assert log.has_deleted("ältere\u202e\nAufnahme")


@pytest.mark.parametrize("name", ["a.mcap", "sub/a.mcap", 'a".mcap', "a\\.mcap"])
def test_a_name_is_found_whole(tmp_path: Path, name: str) -> None:
    log = RetentionLog(tmp_path)
    log.add(1, "delete", file=f"x{name}")
    log.add(1, "delete", file=f"{name}x")
    log.add(1, "not deleted", file=name, why='"event": "delete"')
    assert not log.has_deleted(name)
    log.add(1, "delete", file=name)
    assert log.has_deleted(name)


def test_an_event_in_a_name_is_no_event(tmp_path: Path) -> None:
    """A file may have any name; what it contains is written with escapes."""
    log = RetentionLog(tmp_path)
    log.add(1, "rule", file='a", "event": "delete')
    assert not log.has_deleted('a", "event": "delete')


def test_the_time_of_the_last_pass(tmp_path: Path) -> None:
    log = RetentionLog(tmp_path)
    assert log.last_pass_ns() == 0
    with pytest.raises(OSError):
        log.mark(NOW_NS)
    log.check()
    assert log.path.read_bytes() == b""
    log.mark(NOW_NS)
    assert log.last_pass_ns() == NOW_NS
    assert not log.has_deleted("a.mcap")


def test_the_time_of_a_link_is_its_own(tmp_path: Path) -> None:
    """A link in place of the log must not make another clock of it."""
    (tmp_path / "elsewhere").touch()
    os.utime(tmp_path / "elsewhere", ns=(5, 5))
    (tmp_path / LOG_NAME).symlink_to(tmp_path / "elsewhere")
    assert RetentionLog(tmp_path).last_pass_ns() != 5


def test_a_folder_that_is_not_there(tmp_path: Path) -> None:
    log = RetentionLog(tmp_path / "gone")
    assert (log.last_pass_ns(), log.has_deleted("a.mcap")) == (0, False)
    with pytest.raises(OSError):
        log.check()
