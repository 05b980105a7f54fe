"""Episodes by the phases of a recording."""

from __future__ import annotations

from pathlib import Path

import pytest

import igtl_gateway
from igtl_gateway.addons.lerobot.episodes import spans_of
from igtl_gateway.addons.lerobot.recipe import Cuts, Recipe
from igtl_gateway.addons.lerobot.samples import JoinedStreams
from igtl_gateway.base.errors import ConfigError
from igtl_gateway.gateway.log.marks import BEGIN, MarkNote
from tests import marked

S = 1_000_000_000


def clock_ahead(offset_ns: int) -> JoinedStreams:
    """A clock that gateway time is ahead of."""
    joined = JoinedStreams((), "gateway")
    joined.offset_ns = offset_ns
    return joined


def test_episodes_are_phases_and_their_tasks_are_the_texts(tmp_path: Path) -> None:
    recording = marked.write(tmp_path / "out.mcap", marked.entries(every=10)[0])
    with igtl_gateway.open(recording) as opened:
        recipe = Recipe(fps=30, task="suture", episodes=Cuts("marks", label="suture-*"))
        spans = spans_of(opened, recipe, clock_ahead(S))
        begin = opened.start_time
        assert [(span.start_ns + S - begin, span.end_ns + S - begin, span.task) for span in spans] == [
            (1 * S, 2 * S - 1, "first"),
            (3 * S, 4 * S - 1, "second"),
        ]
        with pytest.raises(ConfigError, match=r"episodes\.label: found no phase with a label like 'slip'"):
            spans_of(opened, Recipe(fps=30, task="x", episodes=Cuts("marks", label="slip")), clock_ahead(0))


def test_phases_that_overlap_are_refused(tmp_path: Path) -> None:
    marks = ((1.0, MarkNote("a", phase=BEGIN)), (2.0, MarkNote("b", phase=BEGIN)))
    path = marked.write(tmp_path / "out.mcap", marked.entries(marks, every=20)[0])
    with (
        igtl_gateway.open(path) as opened,
        pytest.raises(ConfigError, match=r"found a phase at 2\.000 s before the end"),
    ):
        spans_of(opened, Recipe(fps=30, task="x", episodes=Cuts("marks")), clock_ahead(0))
