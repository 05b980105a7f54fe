"""The page's process without a browser: what it shows of a bridge that records one file after the other."""

from __future__ import annotations

import json
import threading
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest

from igtl_gateway.addons.page.process import Page
from igtl_gateway.addons.page.source import BridgeSource

_FACTS = {"peers": [], "watched": [], "totals": {}, "drops": {}, "version": "0", "uptime_s": 1.0, "refused": 0}


class Source(BridgeSource):
    """A bridge that reports what a test gives it."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._given: list[dict[str, Any]] = []
        self._is_taken = threading.Semaphore(0)
        self._is_given = threading.Semaphore(0)
        self._over = False

    def samples(self) -> Iterator[dict[str, Any]]:
        while self._is_given.acquire() and not self._over:
            yield self._given.pop()
            self._is_taken.release()

    def report(self, file: str, written: int, left_out: int = 0, dropped: int = 0) -> None:
        """Report a recorder that writes a file, "": none; the counts of entries and losses so far."""
        counts = {"entries_since_start": written, "left_out_since_start": left_out, "dropped_entries": dropped}
        state = {"failure": "", "queued_entries": 0, "paused": False, "rests": not file}
        path = str(self._folder / "today.mcap")
        recorder = counts | state | {"file": file and str(self._folder / file), "path": path}
        how = {"path": path, "snapshot_s": 0, "triggers": [], "split": False, "sealed": False, "phases": []}
        self._given.append({"facts": _FACTS | {"relay": False, "ros": False, "recorder": recorder}, "recording": how})
        self._is_given.release()
        assert self._is_taken.acquire(timeout=10)

    def end(self) -> None:
        self._over = True
        self._is_given.release()


@pytest.fixture
def source(tmp_path: Path) -> Iterator[Source]:
    (tmp_path / "a").mkdir()
    found = Source(tmp_path / "a")
    yield found
    found.end()


def recording_of(page: Page) -> dict[str, Any]:
    found: dict[str, Any] = json.loads(page.state())["bridge"]["recording"]
    return found


def test_size_and_counts_are_of_the_file_that_is_written(source: Source, tmp_path: Path) -> None:
    folder = tmp_path / "a"
    (folder / "today.mcap").write_bytes(bytes(100))
    with closing(Page(folder, source)) as page:
        source.report("today.mcap", 40, dropped=2)
        source.report("", 40, dropped=2)
        (folder / "today_2.mcap").write_bytes(bytes(7))
        source.report("today_2.mcap", 3, dropped=3)
        found = recording_of(page)
        assert (found["name"], found["bytes"], found["entries"], found["dropped"]) == ("today_2.mcap", 7, 3, 1)
        source.report("", 3, dropped=3)
        found = recording_of(page)
        assert (found["name"], found["bytes"], found["entries"]) == ("today_2.mcap", 7, 3)


def test_a_recording_has_its_begin_before_it_was_read(source: Source, tmp_path: Path) -> None:
    folder = tmp_path / "a"
    (folder / "today.mcap").write_bytes(bytes(100))
    with closing(Page(folder, source)) as page:
        begun = page._clock.utc_ns()
        source.report("today.mcap", 4)
        source.report("", 4)
        (row,) = page.sessions()
        assert begun <= row["start_ns"] <= page._clock.utc_ns()


def test_a_folder_that_is_gone_is_named_and_the_rest_goes_on(source: Source, tmp_path: Path) -> None:
    folder = tmp_path / "a"
    with closing(Page(folder, source)) as page:
        source.report("today.mcap", 4)
        folder.rmdir()
        source.report("today.mcap", 5)
        assert recording_of(page)["free"] is None and recording_of(page)["entries"] == 5
        assert page.sessions() == []
