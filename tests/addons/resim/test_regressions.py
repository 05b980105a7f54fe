"""Planted regressions of a planner: each is named exactly, by stream, number, session time, field, mm and degrees."""

from __future__ import annotations

from collections.abc import Callable
from importlib.util import find_spec

import pytest

from igtl_gateway.addons.resim.verdict import Verdict
from tests.addons.resim import sessions
from tests.addons.resim.runs import judged

pytestmark = [pytest.mark.ros, pytest.mark.skipif(not find_spec("rclpy"), reason="needs ROS 2")]

MESSAGES, PLANTED = 600, 500
PLACE = f"/plan, message {PLANTED} at {(PLANTED - 1) * 0.01:.6f} s: "
#: Regression → what the verdict has after the place, and the numbers of messages: different, missing, extra, late.
EXPECTED = {
    "mm": ("transform.x is -0.8497834172351858 and -0.8487834172351858 (1 mm)", "", (101, 0, 0, 0)),
    "deg": ("transform.qw is 0.274058", " (1°)", (101, 0, 0, 0)),
    "frame": ("header.frame_id is 'base' and 'tool'", "", (101, 0, 0, 0)),
    "lost": ("missing", "", (0, 1, 0, 0)),
    "late": ("10 ms late", "", (0, 0, 0, 1)),
    "nan": ("transform.y is -0.527131998452086 and nan", "", (1, 0, 0, 0)),
}


@pytest.fixture(scope="module", name="verdict_of")
def _verdict_of(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Verdict]:
    """A function that runs the planner with a regression: the verdict against its run without one."""
    folder = tmp_path_factory.mktemp("regressions")
    recording = sessions.write(folder / "in.mcap", sessions.poses(MESSAGES))
    result, verdict = judged(recording, folder, "planner none", runs=2)
    assert verdict.line() == "deterministic: 2 of 2 runs equal"
    baseline = result.runs[0].outputs.rename(folder / "good.mcap")

    def verdict_of(regression: str) -> Verdict:
        _, verdict = judged(recording, folder, f"planner {regression}", runs=1, reference=baseline)
        return verdict

    return verdict_of


@pytest.mark.parametrize("regression", EXPECTED)
def test_a_regression_is_named(verdict_of: Callable[[str], Verdict], regression: str) -> None:
    begin, end, counts = EXPECTED[regression]
    verdict = verdict_of(regression)
    assert verdict.exit_code == 1 and verdict.first
    text = verdict.first.text(verdict.start_ns)
    assert text.startswith(PLACE + begin) and text.endswith(end), text
    (stream,) = verdict.streams
    assert (stream.different, stream.missing, stream.extra, stream.late) == counts
    assert verdict.line() == f"DIFFERENT from good.mcap in 1 of 1 stream (1 run): {text}"


def test_no_regression_no_alarm(verdict_of: Callable[[str], Verdict]) -> None:
    assert verdict_of("none").line() == "1 run; equal to good.mcap"
