"""``cohort verify`` of one long recording: its segments are tasks, here and on a cluster of Dask."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("pyarrow", reason='needs Arrow: pip install "igtl-gateway[cohort]"')

from igtl_gateway.addons.cohort import segments, task
from igtl_gateway.addons.cohort.jobs import SEGMENT
from igtl_gateway.addons.cohort.results import Results
from igtl_gateway.addons.cohort.run import RunPlace, RunSettings
from igtl_gateway.addons.cohort.running import run_cohort
from igtl_gateway.addons.cohort.sources import locate
from igtl_gateway.app.verification import verify_recording
from igtl_gateway.base.buffers import join
from igtl_gateway.base.stamp import ns_to_ticks
from igtl_gateway.gateway import LINK_UP, Gateway, Session
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.gateway.log.note import Level, Note
from igtl_gateway.wire import Message, encode
from igtl_gateway.wire.transform import Transform
from tools.recheck import CONFIG, START_NS, written

pytestmark = pytest.mark.slow

#: Inputs of the recording: enough for two segments.
INPUTS = 34_000


def _entries() -> list[Entry]:
    session = Session(Gateway(CONFIG))
    found = session.input(START_NS, Kind.LINK, (Note(Level.INFO, LINK_UP, "up").pack(),), links=(1,))
    pose = Transform((1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0, 1.0, 2.0, 3.0))
    for number in range(INPUTS):
        now_ns = START_NS + (number + 1) * 1_000_000
        message = join(encode(Message("TRANSFORM", "Tool", pose, ns_to_ticks(now_ns))))
        found += session.input(now_ns, Kind.IGTL_IN, (message,), links=(1,))
    return found


@pytest.fixture(scope="module")
def recordings(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    folder, entries = tmp_path_factory.mktemp("long"), _entries()
    at = next(at for at in range(len(entries) - 500, 0, -1) if entries[at].kind is Kind.ROS_OUT)
    data = bytearray(entries[at].data())
    data[-3] ^= 1
    changed = [*entries[:at], replace(entries[at], payload=(bytes(data),)), *entries[at + 1 :]]
    return {
        "right": written(folder / "right.mcap", CONFIG, entries, chunk_bytes=200_000),
        "wrong": written(folder / "wrong.mcap", CONFIG, changed, chunk_bytes=200_000),
    }


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch) -> list[Mapping[str, Any]]:
    """The settings of the tasks."""
    monkeypatch.setattr(segments, "_BYTES", 1 << 20)
    found: list[Mapping[str, Any]] = []

    class Program(task.JobProgram):
        kills = 0

        def ask(self, job: Mapping[str, Any], timeout_s: float) -> dict[str, Any] | None:
            found.append(job["settings"])
            if SEGMENT in job["settings"] and Program.kills:
                Program.kills -= 1
                os.kill(self.pid, signal.SIGKILL)
            return super().ask(job, timeout_s)

    monkeypatch.setattr(task, "JobProgram", Program)
    return found


@pytest.fixture(params=["here", "Dask"])
def place(request: pytest.FixtureRequest) -> Iterator[RunPlace]:
    if request.param == "here":
        yield RunPlace(2)
        return
    distributed = pytest.importorskip("distributed", reason='needs Dask: pip install "igtl-gateway[cohort]"')
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, processes=False, protocol="tcp", dashboard_address=None, silence_logs=50
    ) as cluster:
        yield RunPlace(1, cluster.scheduler_address)


def _row(path: Path, out: Path, place: RunPlace) -> dict[str, Any]:
    summary = run_cohort(RunSettings("verify", {}), locate([str(path)]), Results(out), place, lambda _: None)
    assert dict(summary.ends) == {"ok": 1}
    (row,) = Results(out).read("verifications").to_pylist()
    return dict(row)


@pytest.mark.parametrize(("name", "kills"), [("right", 10), ("wrong", 1)])
def test_segments_have_the_result_of_the_file(
    name: str,
    kills: int,
    recordings: dict[str, Path],
    asked: list[Mapping[str, Any]],
    place: RunPlace,
    tmp_path: Path,
) -> None:
    task.JobProgram.kills = kills  # type: ignore[attr-defined]
    path = recordings[name]
    row = _row(path, tmp_path / "out", place)
    whole = verify_recording(path)
    names = ("good", "inputs", "outputs", "equal", "differing", "lost", "missing", "orphans", "late", "recorded_by")
    assert {each: row[each] for each in names} == {each: getattr(whole, each) for each in names}
    assert row["first_difference"] == (None if name == "right" else str(whole.differences[0]))
    assert sum(SEGMENT in each for each in asked) == 2 + kills
    assert any(not each for each in asked) == (name == "wrong"), "what differs is verified as a whole"
