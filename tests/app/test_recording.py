"""What the services of a recording do and answer, on a real recorder."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from igtl_gateway.app import recording
from igtl_gateway.base.clock import ManualClock
from igtl_gateway.record.host import in_thread
from igtl_gateway.record.options import RecordOptions
from igtl_gateway.record.recorder import Recorder
from igtl_gateway.record.sessionfile.reader import SessionFile
from tests.record import samples


class Graph:
    """Takes services as the ROS edge does, and calls them."""

    def __init__(self) -> None:
        self.services: dict[str, Any] = {}

    def serve(self, name: str, type_name: str, answer: Any) -> bool:
        assert type_name == "std_srvs/srv/Trigger"
        self.services[name] = answer
        return True

    def call(self, name: str) -> tuple[bool, str]:
        response = self.services[name](SimpleNamespace(), SimpleNamespace(success=None, message=None))
        return response.success, response.message


@pytest.fixture
def recorders() -> Iterator[list[Recorder]]:
    started: list[Recorder] = []
    yield started
    for recorder in started:
        recorder.close({})


def start(recorders: list[Recorder], path: Path, **options: Any) -> tuple[Recorder, Graph]:
    recorder = Recorder(
        path,
        samples.SESSION,
        qos_of=lambda _topic, _type: None,
        on_note=lambda _note: None,
        clock=ManualClock(),
        host=in_thread,
        options=RecordOptions(**options),
    )
    recorders.append(recorder)
    graph = Graph()
    recording.serve_recording(graph, recorder)  # type: ignore[arg-type]
    return recorder, graph


def test_pause_and_resume(recorders: list[Recorder], tmp_path: Path) -> None:
    recorder, graph = start(recorders, tmp_path / "a.mcap")
    assert set(graph.services) == {f"~/{what}_recording" for what in ("start", "stop", "pause", "resume")}
    recorder(samples.ros(1))
    assert graph.call("~/pause_recording") == (True, "the recording is paused")
    recorder(samples.ros(2))
    assert graph.call("~/resume_recording") == (True, "the recording goes on")
    recorder(samples.ros(3))
    recorder.close({})
    with SessionFile.open(tmp_path / "a.mcap") as file:
        assert [entry.seq for entry in file.entries()] == [1, 3]


def test_the_next_file(recorders: list[Recorder], tmp_path: Path) -> None:
    recorder, graph = start(recorders, tmp_path / "a.mcap", split_s=1_000.0)
    assert graph.call("~/split_recording")[0]  # nothing to end yet
    for number in (1, 2):
        recorder(samples.ros(number))
    assert graph.call("~/split_recording") == (True, "the next message begins a new file")
    recorder(samples.ros(3))
    recorder.close({})
    with SessionFile.open(tmp_path / "a") as file:
        assert [part.entries for part in file.parts] == [2, 1]
    whole, _ = start(recorders, tmp_path / "b.mcap")
    assert recording.split(whole)[1] == "the recording has one file; start it with --split-size or --split-duration"


def test_a_recording_that_has_failed_says_so(recorders: list[Recorder], tmp_path: Path) -> None:
    folder = tmp_path / "folder"
    folder.mkdir()
    recorder, graph = start(recorders, folder / "a.mcap")
    shutil.rmtree(folder)  # without it, the recording cannot go on in another file
    recorder.close({})
    for name in graph.services:
        done, why = graph.call(name)
        assert not done and why


def test_snapshots(recorders: list[Recorder], tmp_path: Path) -> None:
    recorder, graph = start(recorders, tmp_path / "a.mcap", snapshot_s=10.0)
    assert set(graph.services) == {"~/snapshot"}
    recorder(samples.ros(1))
    done, path = graph.call("~/snapshot")
    assert done
    with SessionFile.open(path) as file:
        assert [entry.seq for entry in file.entries()] == [1]
    recorder.close({})
    assert graph.call("~/snapshot") == (False, "the recording has ended")
