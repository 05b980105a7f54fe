"""Programs of every kind: the same recording gives the same outputs in each of 5 runs."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path

import pytest

from tests.addons.resim import sessions
from tests.addons.resim.runs import RUNS, judged, strings

pytestmark = [pytest.mark.ros, pytest.mark.skipif(not find_spec("rclpy"), reason="needs ROS 2")]


def test_a_node_with_one_thread(tmp_path: Path) -> None:
    recording = sessions.write(tmp_path / "in.mcap", sessions.texts(200))
    result, verdict = judged(recording, tmp_path, "single")
    assert verdict.line() == f"deterministic: {RUNS} of {RUNS} runs equal"
    assert result.roles and result.roles.inputs == {"/in": 200}
    said = strings(result.runs[0].outputs, "/out")
    assert len([text for text in said if text.startswith("got")]) == 200
    times = [int(text.rpartition(" ")[2]) for text in said if text.startswith("tick")]
    start_ns = result.runs[0].start_ns
    assert times == [start_ns + 10**9 * (number + 1) for number in range(len(times))]
    assert len(times) >= 3
