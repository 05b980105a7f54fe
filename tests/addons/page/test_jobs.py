from __future__ import annotations

import shutil
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from igtl_gateway.addons.page import jobs as page_jobs
from igtl_gateway.addons.page.jobs import ACTIONS, CANCELLED, DONE, FAILED, MAX_RUNNING, NOTHING, RUNNING, Job, Jobs
from tests.places import FIXTURES
from tests.timing import WAIT_S


def wait(condition: Callable[[], bool]) -> None:
    until = time.monotonic() + WAIT_S
    while not condition():
        assert time.monotonic() < until
        time.sleep(0.02)


def test_work_is_done_fails_and_is_cancelled(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    shutil.copy(FIXTURES / "paper-types.mcap", path)
    jobs = Jobs()
    assert jobs.start("verify", "a.mcap", path) == (True, "verify of a.mcap has begun")
    assert jobs.start("verify", "a.mcap", path)[1] == "verify of a.mcap runs already"
    assert jobs.start("review", "none.mcap", tmp_path / "none.mcap")[0]
    assert jobs.start("lint", "a.mcap", path)[0]
    assert jobs.start("export", "a.mcap", path)[1].startswith(f"{MAX_RUNNING} jobs run already")
    assert jobs.cancel(3)[0] and not jobs.cancel(99)[0]
    wait(lambda: all(job["state"] != RUNNING for job in jobs.rows()))
    assert [(job["action"], job["state"]) for job in jobs.rows()] == [
        ("lint", CANCELLED),
        ("review", FAILED),
        ("verify", DONE),
    ]
    assert any("none.mcap" in line for line in jobs.lines(2)) and jobs.lines(99) == []
    assert jobs.start("remove", "a.mcap", path)[1].startswith("found 'remove', expected one of")


def test_a_review_without_a_cloud_is_not_applicable(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    shutil.copy(FIXTURES / "lego.mcap", path)
    jobs = Jobs()
    assert jobs.start("review", "a.mcap", path)[0]
    wait(lambda: jobs.rows()[0]["state"] != RUNNING)
    (job,) = jobs.rows()
    assert job["state"] == NOTHING and job["last"].startswith("found no point cloud")


def test_a_review_of_a_file_whose_name_has_such_words_has_failed(tmp_path: Path) -> None:
    path = tmp_path / "found no point cloud.mcap"
    path.write_bytes(b"no recording")
    jobs = Jobs()
    assert jobs.start("review", path.name, path)[0]
    wait(lambda: jobs.rows()[0]["state"] != RUNNING)
    assert jobs.rows()[0]["state"] == FAILED


def test_each_action_is_a_verb() -> None:
    for words, _addon in ACTIONS.values():
        assert words(Path("/x/a.mcap"))[1] == "/x/a.mcap"


def test_the_progress_of_a_verification(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "a.mcap"
    shutil.copy(FIXTURES / "lego.mcap", path)
    shown: list[str] = []
    take = Job._take

    def taken(job: Job, line: str) -> None:
        take(job, line)
        shown.append(job.facts()["progress"])

    monkeypatch.setattr(Job, "_take", taken)
    code = "import sys; print('progress 34 %', file=sys.stderr); print('verified: all 3 outputs equal')"
    monkeypatch.setattr(page_jobs, "python_command", lambda _: [sys.executable, "-c", code])
    jobs = Jobs()
    assert jobs.start("verify", "a.mcap", path)[0]
    wait(lambda: jobs.rows()[0]["state"] != RUNNING)
    assert "34 %" in shown and jobs.lines(1) == ["verified: all 3 outputs equal"]
    assert jobs.rows()[0]["progress"] == "" and jobs.rows()[0]["state"] == DONE
