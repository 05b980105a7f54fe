"""Why runs differ: each planted cause is named."""

from __future__ import annotations

from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest

from igtl_gateway.addons.resim import causes, engine
from igtl_gateway.addons.resim.causes import likely_cause
from igtl_gateway.addons.resim.engine import ResimOptions, Run, RunResult
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


class Fake:
    """Runs of which some differ from the first one, by the number of the try and of the run in it."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, differs: Callable[[int, int], bool]) -> None:
        self.tries: list[int] = []
        self._differs = differs
        monkeypatch.setattr(causes, "run", self._run)
        monkeypatch.setattr(causes, "compare", self._compare)

    def _run(self, _recording: Path, _programs: Any, options: ResimOptions, _folder: Path, *, on_run: Any) -> None:
        self.tries.append(0)
        for number in range(1, options.runs + 1):
            self.tries[-1] = number
            on_run(Run(number, Path(f"run-{number}")))

    def _compare(self, result: RunResult, **_: Any) -> Verdict:
        number = result.runs[1].number
        return Verdict(2, 0, unequal_run=number if self._differs(len(self.tries), number) else 0)

    def cause(self, tmp_path: Path) -> str:
        race = [StreamVerdict("/out", 9, 9, different=1, first=Difference("/out", 1, 0, "differs"))]
        verdict = Verdict(6, 0, unequal_run=6, between_runs=race)
        return likely_cause(tmp_path, [program("planted", "race")], ResimOptions(), verdict, tmp_path)


def test_runs_that_are_equal_by_chance_do_not_name_a_cause(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A race that shows in every eighth run: no try may take the runs before it for the effect of its change."""
    fake = Fake(monkeypatch, lambda _try, number: number % 8 == 0)
    assert fake.cause(tmp_path) == "threads that race, or something outside of the session"
    assert fake.tries == [16, 8, 8, 8, 8, 8]


def test_a_rare_difference_that_one_thing_causes_is_still_found(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    fake = Fake(monkeypatch, lambda try_, number: try_ != 3 and number % 8 == 0)
    assert fake.cause(tmp_path) == "the order of a set or of hashes of strings"
    assert fake.tries == [16, 8, 1 + 35]


def test_a_difference_that_is_too_rare_has_no_likely_cause(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    fake = Fake(monkeypatch, lambda _try, number: number == 20)
    assert fake.cause(tmp_path) == "not found, as it is too rare: 1 of 24 more runs differ"


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
