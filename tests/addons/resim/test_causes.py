"""Why runs differ: each planted cause is named."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path

import pytest

from igtl_gateway.addons.resim.causes import likely_cause
from igtl_gateway.addons.resim.engine import ResimOptions
from tests.addons.resim import sessions
from tests.addons.resim.runs import judged, program

pytestmark = [pytest.mark.ros, pytest.mark.skipif(not find_spec("rclpy"), reason="needs ROS 2")]


@pytest.mark.parametrize(
    ("what", "cause"),
    [
        ("wall", "the wall clock, such as time.time()"),
        ("hashed", "the order of a set or of hashes of strings"),
        ("chance", "random numbers without a seed"),
        ("race", "threads that race, or something outside of the session"),
        ("nothing", ""),
    ],
)
def test_the_cause_is_named(tmp_path: Path, what: str, cause: str) -> None:
    recording = sessions.write(tmp_path / "in.mcap", sessions.texts(40))
    _, verdict = judged(recording, tmp_path, f"planted {what}")
    found = likely_cause(recording, [program("planted", what)], ResimOptions(), verdict, tmp_path)
    assert found == cause
    verdict.cause = found
    assert verdict.line().endswith(cause)
