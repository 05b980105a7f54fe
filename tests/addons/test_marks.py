"""Marks in the tools for many sessions and for training sets."""

from __future__ import annotations

from pathlib import Path

import pytest

import igtl_gateway
from igtl_gateway.addons.cohort.columns import TABLES
from igtl_gateway.addons.cohort.jobs import _lint
from igtl_gateway.addons.lerobot.episodes import spans_of
from igtl_gateway.addons.lerobot.recipe import Cuts, Recipe
from igtl_gateway.base.errors import ConfigError
from igtl_gateway.gateway.log.marks import BEGIN, MarkNote
from igtl_gateway.record.sessionfile.reader import SessionFile
from tests import marked

S = 1_000_000_000


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return marked.write(tmp_path_factory.mktemp("marks") / "out.mcap", marked.entries(every=10)[0])


def test_a_cohort_has_a_table_of_marks(recording: Path) -> None:
    with SessionFile.open(recording) as file:
        rows = _lint(file, {})["marks"]
    assert [(row["label"], row["end"] is None, row["is_open"]) for row in rows] == [
        ("suture-1", False, False),
        ("slip", True, False),
        ("suture-2", False, False),
        ("rest", False, True),
    ]
    assert {"task", "file", *rows[0]} == set(TABLES["marks"])


def test_episodes_are_phases_and_their_tasks_are_the_texts(recording: Path) -> None:
    with igtl_gateway.open(recording) as opened:
        recipe = Recipe(fps=30, task="suture", episodes=Cuts("marks", label="suture-*"))
        spans = spans_of(opened, recipe, "gateway", S)
        begin = opened.start_time
        assert [(span.start_ns + S - begin, span.end_ns + S - begin, span.task) for span in spans] == [
            (1 * S, 2 * S - 1, "first"),
            (3 * S, 4 * S - 1, "second"),
        ]
        with pytest.raises(ConfigError, match=r"episodes\.label: found no phase with a label like 'slip'"):
            spans_of(opened, Recipe(fps=30, task="x", episodes=Cuts("marks", label="slip")), "gateway", 0)


def test_phases_that_overlap_are_refused(tmp_path: Path) -> None:
    marks = ((1.0, MarkNote("a", phase=BEGIN)), (2.0, MarkNote("b", phase=BEGIN)))
    path = marked.write(tmp_path / "out.mcap", marked.entries(marks, every=20)[0])
    with (
        igtl_gateway.open(path) as opened,
        pytest.raises(ConfigError, match=r"found a phase at 2\.000 s before the end"),
    ):
        spans_of(opened, Recipe(fps=30, task="x", episodes=Cuts("marks")), "gateway", 0)
