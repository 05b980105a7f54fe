"""The lines of a run's progress."""

from __future__ import annotations

from collections import Counter

import pytest

from igtl_gateway.addons.cohort.progress import Progress, state_line
from igtl_gateway.addons.cohort.running import RunSummary
from igtl_gateway.base.clock import ManualClock
from igtl_gateway.base.stamp import NS_PER_S


def test_bar_rate_and_time_left() -> None:
    summary = RunSummary(2000, 200, Counter(ok=790, broken=10))
    assert state_line(summary, 100) == (
        "[############............] 1,000 of 2,000 files, 8.0/s, 2 min 5 s left, 10 without result"
    )
    assert state_line(RunSummary(5), 0, columns=40) == "0 of 5 files, 0.0/s"
    assert state_line(RunSummary(5), 0) == "[........................] 0 of 5 files, 0.0/s"


def test_without_a_terminal_a_line_now_and_then(capsys: pytest.CaptureFixture[str]) -> None:
    clock = ManualClock()
    with Progress(clock=clock) as progress:
        for _ in range(70):
            clock.advance(NS_PER_S)
            progress(RunSummary(100, 0, Counter(ok=1)))
    assert len(capsys.readouterr().err.splitlines()) == 2
