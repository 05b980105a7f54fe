"""What sources name: files, folders, globs, links, odd names."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from igtl_gateway.addons.cohort.sources import locate
from igtl_gateway.base.errors import ConfigError


def test_files_folders_and_globs_name_each_file_once(tmp_path: Path) -> None:
    names = ["a.mcap", "b[1].mcap", "deep/er/c.mcap"]
    for name in names:
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).touch()
    (tmp_path / "folder.mcap").mkdir()
    (tmp_path / "notes.txt").touch()
    expected = [str(tmp_path / name) for name in names]
    assert [each.name for each in locate([str(tmp_path)])] == expected
    assert [each.name for each in locate([f"{tmp_path}/**/*.mcap", str(tmp_path / "a.mcap")])] == expected
    assert [each.name for each in locate([str(tmp_path / "b[1].mcap")])] == expected[1:2]


def test_a_source_that_names_nothing_is_an_error_but_a_missing_file_is_a_row(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="found no session"):
        locate([str(tmp_path)])
    with pytest.raises(ConfigError, match="found no session"):
        locate([str(tmp_path / "*.mcap")])
    assert [each.mark for each in locate([str(tmp_path / "missing.mcap")])] == ["absent"]


def test_names_that_are_not_text_are_shown_escaped(tmp_path: Path) -> None:
    path = os.fsdecode(bytes(tmp_path) + b"/\xff.mcap")
    Path(path).touch()
    [found] = locate([str(tmp_path)])
    assert found.name == path
    assert found.shown.endswith("/\\udcff.mcap")
