"""Which parts of a folder of tables count, and lists of them that are refused."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from igtl_gateway.addon import ConfigError, GatewayError
from igtl_gateway.addons.cohort.columns import SCHEMA_VERSION
from igtl_gateway.addons.cohort.parts import MANIFEST, Parts, files_of, parts_of, unreadable
from tests.tables import table


def listed(folder: Path, **facts: Any) -> Path:
    (folder / MANIFEST).write_text(json.dumps({"schema_version": SCHEMA_VERSION, "parts": []} | facts))
    return folder


@table(
    ("facts", "parts"),
    [
        ({}, Parts([], False)),
        ({"parts": ["000001", "12345678901234567890"]}, Parts(["000001", "12345678901234567890"], False)),
        ({"parts": ["000001"], "joined": True}, Parts(["000001"], True)),
        ({"parts": ["000001"], "joined": 1}, Parts(["000001"], False)),
        ({"parts": ["000001", "000002"], "joined": True}, Parts(["000001", "000002"], False)),  # several are not joined
        ({"parts": [], "joined": True}, Parts([], False)),
        ({"more": [1]}, Parts([], False)),
        ({"parts": ["000001"] * 20_000}, Parts(["000001"] * 20_000, False)),
    ],
)
def test_which_parts_count(facts: dict[str, Any], parts: Parts, tmp_path: Path) -> None:
    assert parts_of(listed(tmp_path, **facts)) == parts


@table(
    ("facts", "reason"),
    [
        ({"schema_version": 1}, "found tables of version 1, expected 2; use another folder"),
        ({"schema_version": None}, "found tables of version None"),
        ({"parts": "000001"}, "found parts '000001', expected a list of numbers"),
        ({"parts": [1]}, "found parts [1], expected a list of numbers"),
        ({"parts": ["../evil"]}, "expected a list of numbers"),
        ({"parts": ["00001"]}, "expected a list of numbers"),
        ({"parts": ["000001\n"]}, "expected a list of numbers"),
        ({"parts": ["٠٠٠٠٠١"]}, "expected a list of numbers"),
        ({"parts": None}, "found parts None"),
        ({"parts": ["000001"] * 20_001}, "found 20,001 parts, expected at most 20,000"),
    ],
)
def test_lists_that_are_refused(facts: dict[str, Any], reason: str, tmp_path: Path) -> None:
    with pytest.raises(ConfigError) as error:
        parts_of(listed(tmp_path, **facts))
    assert str(error.value).startswith(str(tmp_path / MANIFEST)) and reason in str(error.value)


@table(("text", "reason"), [("[]", "found tables of version None"), ("{", "found invalid JSON"), ("\udcff", "JSON")])
def test_what_is_no_list(text: str, reason: str, tmp_path: Path) -> None:
    (tmp_path / MANIFEST).write_bytes(text.encode("utf-8", "surrogateescape"))
    with pytest.raises(GatewayError, match=reason):
        parts_of(tmp_path)


def test_a_folder_without_a_list(tmp_path: Path) -> None:
    with pytest.raises(GatewayError):
        parts_of(tmp_path)


def test_whether_parts_still_count(tmp_path: Path) -> None:
    """A run that joins its parts leaves others behind; who reads meanwhile begins again."""
    parts = parts_of(listed(tmp_path, parts=["000001", "000002"]))
    assert parts.count_in(tmp_path)
    assert parts.count_in(listed(tmp_path, parts=["000002", "000003", "000001"]))
    assert not parts.count_in(listed(tmp_path, parts=["000002", "000003"]))


def test_a_part_has_no_file_for_a_table_without_rows(tmp_path: Path) -> None:
    for part in ("000002", "000001"):
        (tmp_path / "parts" / part).mkdir(parents=True)
    first = tmp_path / "parts" / "000001" / "tasks.parquet"
    second = tmp_path / "parts" / "000002" / "tasks.parquet"
    first.touch()
    assert files_of(tmp_path, ["000002", "000001", "000003"], "tasks") == [first]
    second.touch()
    assert files_of(tmp_path, ["000002", "000001"], "tasks") == [second, first]
    (tmp_path / "parts" / "000001" / "marks.parquet").mkdir()
    assert files_of(tmp_path, ["000001"], "marks") == []


def test_a_file_of_another_version_is_named_with_the_remedy(tmp_path: Path) -> None:
    error = unreadable(tmp_path / "a", "no column")
    assert (
        str(error) == f"{tmp_path / 'a'}: found no table of this version (no column); remove the folder and run again"
    )
