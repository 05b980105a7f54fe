"""Runs over a small cohort: tables, restart, killed programs, files that take too long."""

from __future__ import annotations

import os
import shutil
import signal
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("pyarrow", reason='needs pyarrow: pip install "igtl-gateway[cohort]"')

from igtl_gateway.addons.cohort import running, task
from igtl_gateway.addons.cohort.columns import TABLES
from igtl_gateway.addons.cohort.jobs import run_job
from igtl_gateway.addons.cohort.results import Results
from igtl_gateway.addons.cohort.run import RunPlace, RunSettings
from igtl_gateway.addons.cohort.running import RunSummary, run_cohort
from igtl_gateway.addons.cohort.sources import locate
from igtl_gateway.base.errors import GatewayError
from tests.places import FIXTURES

SMALL = ("acquisition", "paper-types", "crtk")
#: What differs from run to run.
_OF_THE_RUN = ("seconds",)


@pytest.fixture
def cohort(tmp_path: Path) -> Path:
    """Twelve files: nine sessions, one cut off, one of other content, one empty; names with odd characters."""
    folder = tmp_path / "sessions"
    (folder / "ä\nb").mkdir(parents=True)
    for number in range(9):
        shutil.copy(FIXTURES / f"{SMALL[number % 3]}.mcap", folder / f"{number}.mcap")
    (folder / "ä\nb" / "<b>cut'.mcap").write_bytes((FIXTURES / "crtk.mcap").read_bytes()[:100_000])
    (folder / "text.mcap").write_text("not MCAP")
    (folder / "empty.mcap").touch()
    return folder


def run(
    folder: Path,
    out: Path,
    verb: str = "info",
    *,
    workers: int = 2,
    timeout_s: float = 60,
    memory: int = 1 << 30,
    progress: Callable[[RunSummary], None] = lambda summary: None,
) -> RunSummary:
    settings: dict[str, Any] = {}
    work = RunSettings(verb, settings, (), memory, timeout_s)
    return run_cohort(work, locate([str(folder)]), Results(out), RunPlace(workers), progress)


def in_this_process(work: RunSettings, todo: Any, where: RunPlace) -> Any:
    """The replies without threads and programs, one after the other."""
    for file, content, segment in todo:
        job = {
            "name": file.name,
            "size": file.size,
            "e_tag": "",
            "verb": work.verb,
            "settings": {},
            "limits": [],
            "content": content,
        }
        yield (file, content, segment), run_job(job)


def rows(out: Path) -> dict[str, list[dict[str, Any]]]:
    """The rows of all tables, without what differs from run to run."""
    results = Results(out)
    return {
        table: [
            {name: value for name, value in row.items() if name not in _OF_THE_RUN}
            for row in results.read(table).to_pylist()
        ]
        for table in TABLES
    }


@pytest.mark.slow
def test_a_cohort_is_tables_and_a_second_run_does_nothing(
    cohort: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "out"
    first = run(cohort, out)
    assert dict(first.ends) == {"ok": 9, "broken": 1, "unsupported": 2}
    before = rows(out)
    assert len(before["tasks"]) == 12
    assert [row["file"] for row in before["recordings"]] == sorted(row["file"] for row in before["recordings"])
    assert {row["entries"] for row in before["recordings"] if row["file"].endswith("/1.mcap")} == {121}
    [broken] = [row for row in before["tasks"] if row["status"] == "broken"]
    assert broken["file"].endswith("ä\nb/<b>cut'.mcap")
    assert broken["error"].startswith("was cut off"), "the file is in another column"

    with monkeypatch.context() as patched:
        patched.setattr(running, "_here", None)  # it would fail
        second = run(cohort, out)
    assert (second.before, second.done) == (12, 0)

    # what a run leaves that was killed while it wrote
    (out / "parts" / "000009").mkdir()
    (out / "parts" / "000009" / "tasks.parquet").write_bytes(b"PAR1 torn")
    (out / ".cohort.json.part").write_text("{")
    assert rows(out) == before

    # touched but equal: read once, not done; changed: done, and its old rows are gone; a removed file stays
    os.utime(cohort / "0.mcap", ns=(1, 1))
    shutil.copy(FIXTURES / "crtk.mcap", cohort / "1.mcap")
    third = run(cohort, out, workers=1)
    assert (third.before, dict(third.ends)) == (10, {"unchanged": 1, "ok": 1})
    after = rows(out)
    assert len(after["tasks"]) == 12
    assert sum(row["file"].endswith("/1.mcap") for row in after["recordings"]) == 1
    assert len(list((out / "parts").iterdir())) == 1
    fourth = run(cohort, out)
    assert fourth.before == 12


@pytest.mark.slow
def test_killed_programs_give_the_tables_of_a_serial_run(
    cohort: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    here = tmp_path / "here"
    with monkeypatch.context() as patched:
        patched.setattr(running, "_replies", in_this_process)
        run(cohort, here, "lint")
    started: list[int] = []

    class Program(task.JobProgram):
        def __init__(self, memory: int) -> None:
            super().__init__(memory)
            started.append(self.pid)

    monkeypatch.setattr(task, "JobProgram", Program)
    killed: list[int] = []

    def kill(summary: RunSummary) -> None:
        if summary.done in (3, 6) and started[-1] not in killed:
            killed.append(started[-1])
            os.kill(started[-1], signal.SIGKILL)

    run(cohort, tmp_path / "killed", "lint", workers=2, progress=kill)
    assert killed
    assert rows(tmp_path / "killed") == rows(here)


@pytest.mark.slow
@pytest.mark.parametrize("times", [task.TRIES, 2 * task.TRIES])
def test_a_killed_file_is_tried_again_alone(
    cohort: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, times: int
) -> None:
    asked: list[str] = []

    class Program(task.JobProgram):
        def ask(self, job: Mapping[str, Any], timeout_s: float) -> dict[str, Any] | None:
            asked.append(Path(job["name"]).name)
            if asked[-1] == "2.mcap" and asked.count("2.mcap") <= times:
                os.kill(self.pid, signal.SIGKILL)
            return super().ask(job, timeout_s)

    monkeypatch.setattr(task, "JobProgram", Program)
    summary = run(cohort, tmp_path / "out")
    good = times == task.TRIES
    assert dict(summary.ends) == {"ok": 8 + good, "broken": 1, "unsupported": 2} | ({} if good else {"killed": 1})
    assert asked[-1] == "2.mcap"


def test_a_file_that_takes_too_long_is_a_row(cohort: Path, tmp_path: Path) -> None:
    for path in cohort.glob("*.mcap"):
        if path.name != "2.mcap":
            path.unlink()
    run(cohort / "2.mcap", tmp_path / "time", timeout_s=0.05)
    [row] = rows(tmp_path / "time")["tasks"]
    assert (row["status"], row["error"]) == ("timeout", "took more than 0.05 s (--timeout)")
    again = run(cohort / "2.mcap", tmp_path / "time")
    assert dict(again.ends) == {"ok": 1}


def test_a_file_that_is_too_large_is_a_row(cohort: Path, tmp_path: Path) -> None:
    star = cohort / "star.mcap"
    shutil.copy(FIXTURES / "star.mcap", star)
    run(star, tmp_path / "out", "review", workers=1, memory=16 << 20)
    [row] = rows(tmp_path / "out")["tasks"]
    assert (row["status"], row["error"]) == ("memory", "needs more memory than a worker may have (--memory-mib)")


def test_two_runs_into_one_folder_are_refused(cohort: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    with Results(out).locked(), pytest.raises(GatewayError, match="another run is writing to it"):
        run(cohort, out)
