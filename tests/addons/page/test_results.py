from __future__ import annotations

import os
from pathlib import Path

import pytest

from igtl_gateway.addons.page.results import NAME, Results


def test_results_outlive_the_page_and_end_with_the_bytes(tmp_path: Path) -> None:
    results = Results(tmp_path)
    results.add("a.mcap", (5, 7), "verify", "done")
    results.add("a.mcap", (5, 7), "review", "failed")
    again = Results(tmp_path)
    assert again.of("a.mcap", (5, 7)) == {"verify": "done", "review": "failed"}
    assert again.of("a.mcap", (6, 7)) == {} and again.of("b.mcap", (5, 7)) == {}
    again.add("a.mcap", (6, 8), "lint", "done")
    assert Results(tmp_path).of("a.mcap", (6, 8)) == {"lint": "done"}


@pytest.mark.parametrize("text", ["", "{", "[]", '{"a.mcap": 5}', '{"a.mcap": {"mark": ["x", 1], "results": {}}}', "["])
def test_a_file_that_is_not_ours(tmp_path: Path, text: str) -> None:
    (tmp_path / NAME).write_text(text * (2_000 if text == "[" else 1))
    results = Results(tmp_path)
    assert results.of("a.mcap", (1, 1)) == {}
    results.add("a.mcap", (1, 1), "verify", "done")
    assert Results(tmp_path).of("a.mcap", (1, 1)) == {"verify": "done"}


def test_a_fifo_of_somebody_is_not_waited_for(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / NAME)
    assert Results(tmp_path).of("a.mcap", (1, 1)) == {}


def test_a_folder_that_cannot_be_written(tmp_path: Path) -> None:
    results = Results(tmp_path / "absent")
    results.add("a.mcap", (1, 1), "verify", "done")
    assert results.of("a.mcap", (1, 1)) == {"verify": "done"}
    assert Results(None).of("a.mcap", (1, 1)) == {}
