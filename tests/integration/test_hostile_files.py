"""Every hostile file of the table is given to the verbs that read its sort, with limits of time and memory.

In every run of the tests, every sixteenth file is given to the first verb of its sort; with ``HOSTILE_FILES=all``,
every file is given to all verbs of its sort.
"""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from tests.integration.hostile_files.case import VERBS, Danger, Hostile, file
from tests.integration.hostile_files.page import MARK, PAGE, page, results
from tests.integration.hostile_files.table import CASES, Outcome, Worker, judged, outcomes

_ALL = os.environ.get("HOSTILE_FILES") == "all"
_FILES = CASES if _ALL else CASES[::16]
#: Files that one process reads, so that several test workers share the table.
_PART = 50
_PARTS = [_FILES[start : start + _PART] for start in range(0, len(_FILES), _PART)]

pytestmark = pytest.mark.skipif(not Path("/proc/self/clear_refs").exists(), reason="needs the /proc of Linux")


@pytest.mark.slow
@pytest.mark.parametrize("part", range(len(_PARTS)))
def test_no_file_breaks_a_verb(part: int) -> None:
    found = list(outcomes(_PARTS[part], verbs=None if _ALL else 0))
    assert len({outcome.name for outcome in found}) == len(_PARTS[part])
    broken = [f"{each.name}: {each.verb}: {', '.join(each.faults)}: {each.why}" for each in found if each.faults]
    assert not broken, "\n".join(broken)
    expected = results()["answers"]
    first = {outcome.name: outcome for outcome in reversed(found)}
    wrong = {name: (each.code, each.answer) for name, each in first.items() if each.code != expected[name][0]}
    assert not wrong, "the exit codes differ from those on the page"
    assert all(each.answer for each in found if each.code), "every refusal has a message"


def test_names_and_sorts() -> None:
    assert len({case.name for case in CASES}) == len(CASES) > 400
    assert {case.sort for case in CASES} == VERBS.keys()
    for danger in Danger:
        assert sum(case.danger is danger for case in CASES) > 20


def test_the_page_is_that_of_the_table() -> None:
    assert PAGE.read_text("utf-8").partition(MARK)[2] == page(results())


def test_the_judge_can_fail() -> None:
    good = {"code": 0, "trace": "", "seconds": 0.1, "cpu": 0.1, "peak_mb": 100, "output": "fine\n", "errors": ""}
    assert judged("a", "info F", good).faults == ()
    for change, fault in (
        ({"trace": "Traceback (most recent call last):\nIndexError: x"}, "traceback"),
        ({"errors": "Exception ignored in: <x>"}, "traceback"),
        ({"peak_mb": 400}, "memory"),
        ({"cpu": 9.0}, "slow"),
        ({"output": "a\x1b[2J\n"}, "control characters"),
        ({"output": "a\nFORGED verified\n"}, "forged lines"),
        ({"code": 3}, "exit code"),
    ):
        assert judged("a", "info F", good | change).faults == (fault,)


@pytest.mark.slow
def test_a_worker_that_died_is_replaced(tmp_path: Path) -> None:
    worker = Worker(tmp_path)
    try:
        first: Outcome = worker.run("a", "--version", ["--version"])
        assert first.code in (0, None) and not first.errors
        assert worker._process
        worker._process.kill()
        worker._process.wait()
        assert worker.run("a", "info F", ["info", str(tmp_path / "none")]).code == 2
    finally:
        worker.close()


def test_a_file_that_is_found_out(tmp_path: Path) -> None:
    """A case that prints what it must not would be seen: ``decode`` gives bytes of the file as JSON, escaped."""
    case = Hostile("x", "stream", Danger.TERMINAL, "nothing", file("x.igtl", lambda: b"\x1b[2J\n" * 30))
    assert [each.faults for each in outcomes([case])] == [()] * len(VERBS["stream"])
