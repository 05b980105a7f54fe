"""Why runs differ: each planted cause is named."""

from __future__ import annotations

from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest

from igtl_gateway.addons.resim import causes, engine
from igtl_gateway.addons.resim.causes import likely_cause
from igtl_gateway.addons.resim.engine import ResimOptions, Run
from igtl_gateway.addons.resim.verdict import Difference, StreamVerdict, Verdict
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


def test_runs_that_are_equal_by_chance_do_not_name_a_cause(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A race that shows in every fifth run was the wall clock's."""
    found = iter([(3, True), (12, False), *[(3, False)] * 3, (3, True), (12, True)])

    def again(_recording: Path, _programs: Any, options: ResimOptions, _folder: Path, **_: Any) -> Verdict:
        runs, is_equal = next(found)
        assert options.runs == runs
        return Verdict(runs, 0, unequal_run=0 if is_equal else 2)

    monkeypatch.setattr(causes, "run", again)
    monkeypatch.setattr(causes, "compare", lambda verdict: verdict)
    race = [StreamVerdict("/out", 9, 9, different=1, first=Difference("/out", 1, 0, "differs"))]
    verdict = Verdict(6, 0, unequal_run=6, between_runs=race)
    cause = likely_cause(tmp_path, [program("planted", "race")], ResimOptions(), verdict, tmp_path)
    assert cause == "several: the wall clock, hashes, random numbers or addresses"
    assert not list(found)


def test_the_cause_is_not_looked_for_without_end(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    recording = sessions.write(tmp_path / "in.mcap", sessions.texts(40))
    _, verdict = judged(recording, tmp_path, "planted wall", runs=2)
    monkeypatch.setattr(causes, "MOST_S", 0)
    numbers: list[int] = []
    begin = engine.run

    def counted(*arguments: Any, on_run: Callable[[Run], None]) -> Any:
        def take(one: Run) -> None:
            numbers.append(one.number)
            on_run(one)

        return begin(*arguments, on_run=take)

    monkeypatch.setattr(causes, "run", counted)
    cause = likely_cause(recording, [program("planted", "wall")], ResimOptions(), verdict, tmp_path)
    assert (cause, numbers) == ("not found within 0 s", [1])
