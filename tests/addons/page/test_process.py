"""The page in a real browser, beside a bridge and a folder: seen, clicked, and killed."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import closing, suppress
from pathlib import Path
from typing import Any
from urllib.request import HTTPCookieProcessor, OpenerDirector, build_opener

import pytest

import igtl_gateway
from igtl_gateway.addon import GatewayError
from igtl_gateway.addons.page import disk, process
from igtl_gateway.addons.page.process import Page
from igtl_gateway.addons.page.source import BridgeSource
from tests.addons.page.browser import CHROMIUM, Browser
from tests.integration.bridge import Bridge, RawPeer, children, free_port, sending, string
from tests.places import FIXTURES
from tests.timing import WAIT_S

needs_browser = pytest.mark.skipif(CHROMIUM is None, reason="needs a Chromium: apt-get install chromium")


def two_streams() -> bytes:
    return string("hello", "Room") + string("<b>bold</b>", "\u202e<script>")


@needs_browser
def test_a_session_is_run_from_the_page(tmp_path: Path) -> None:
    recording = tmp_path / "now.mcap"
    bridge = Bridge("--no-ros", "--record", str(recording), "--record-wait", "--page")
    try:
        link = bridge.wait_events(lambda event: event["event"] == "page", "page")[0]["link"]
        with sending(bridge.port, two_streams), Browser() as page:
            page.open(link)
            # Now: links, streams, in words
            page.wait("document.querySelector('#now h1').textContent === 'All 2 streams arrive'")
            assert {"Room", "\ufffd<script>"} <= set(page.text().split())
            assert "token" not in page.run("location.href") and page.run("document.cookie") == ""
            # Recording: no mark before there is one; start, a mark by the keyboard, a phase, a pause by clicks
            page.press("2")
            page.wait("[...document.querySelectorAll('#mark-actions .btn')].every((each) => each.disabled)")
            assert "Nothing is recorded: press Start first" in page.text()
            page.click("button", "Start recording")
            # a second click at once does nothing more
            page.run("document.querySelector('[data-key=start]').click()")
            page.wait("document.querySelector('#recording h1').textContent === 'Recording'")
            assert page.run("document.querySelector('[data-key=start]').innerText") == "Start recording"
            page.wait(
                "/00:00:0[2-9]/.test(document.querySelector('#recording').innerText)"
            )  # a mark is of this session
            page.press("m")
            page.wait("document.activeElement.id === 'mark-label'")
            page.type("suture-1")
            page.wait("document.querySelector('#mark-more').textContent.includes('when M was pressed')")
            page.run("pressedM -= 1500")  # a person has written
            page.press("Enter")
            page.wait("document.querySelector('#recording .notes').textContent.includes('mark suture-1 (1.')")
            page.wait("document.activeElement === document.body")  # the next M is a key again
            page.press("m")
            page.wait("document.activeElement.id === 'mark-label'")
            page.type("approach")
            page.click("button", "Begin a phase")
            page.click("button", "End “approach”")
            page.click("button", "Pause")
            page.wait("document.querySelector('#recording h1').textContent === 'Paused: nothing is recorded'")
            assert "every message is kept" not in page.text()
            page.press("1")
            page.wait("document.querySelector('#trouble').textContent.includes('The recording is paused')")
            page.press("3")
            page.wait("document.querySelector('#sessions table').textContent.includes('paused')")
            page.press("2")
            page.click("button", "Resume")
            page.wait("document.querySelector('#recording h1').textContent === 'Recording'")
            # Stop: open phases end, the file is closed, and the bridge goes on
            page.click("#mark-label")
            page.type("closing")
            page.click("button", "Begin a phase")
            page.wait("document.querySelector('#phases').textContent.includes('closing')")
            page.click("button", "Stop recording …")
            assert page.run("document.querySelector('dialog').textContent.includes('phase ends here: closing')")
            page.click("dialog button", "Stop")
            page.wait("document.querySelector('#recording h1').textContent === 'Not recording'")
            assert not recording_is_open(recording)
            page.click("button", "Show now.mcap in Sessions")
            page.wait("document.querySelector('#sessions tr.opened').textContent.includes('now.mcap')")
            page.press("2")
            # End, and the page reports that its program has ended
            page.click("button", "Shut down the bridge …")
            page.click("dialog button", "Shut down")
            page.wait("!document.querySelector('#lost').hidden")
            page.wait("document.body.matches('.stale') && document.querySelector('#pill').textContent === 'No answer'")
            assert [
                text for text in page.complaints if "ERR_CONNECTION" not in text and "Failed to load" not in text
            ] == []
        assert bridge.end(None).code == 0
    finally:
        bridge.close()
    with igtl_gateway.open(recording) as found:
        assert [mark.label for mark in found.marks] == ["suture-1", "approach", "closing"]
        assert {(mark.who, mark.is_open) for mark in found.marks} == {("page", False)}
        pressed = [note.text for note in found.notes if note.code == "page"]
    assert pressed == [f"{what} was pressed on the page" for what in ("pause", "resume", "stop")]


def recording_is_open(path: Path) -> bool:
    """Return whether a recording was not closed."""
    with suppress(GatewayError), igtl_gateway.open(path):
        return False
    return True


def test_the_bridge_goes_on_without_its_page(tmp_path: Path) -> None:
    bridge = Bridge("--no-ros", "--record", str(tmp_path / "now.mcap"), "--page")
    try:
        bridge.wait_events(lambda event: event["event"] == "page", "page")
        (page,) = (
            number
            for number in children(bridge.process.pid)
            if b"addons.page" in Path(f"/proc/{number}/cmdline").read_bytes()
        )
        os.kill(page, signal.SIGKILL)
        bridge.wait_code("page", level="WARN")
        with RawPeer(bridge.port) as peer:
            peer.send(string("hello"))
            bridge.wait_code("link_up")
        assert bridge.end().code == 0
    finally:
        bridge.close()
    assert sum(event.get("code") == "page" for event in bridge.events) == 1


def test_the_parameter_of_ros_opens_the_page() -> None:
    pytest.importorskip("rclpy")
    bridge = Bridge("--ros-args", "-p", "page:=true")
    try:
        link = bridge.wait_events(lambda event: event["event"] == "page", "page")[0]["link"]
        browser = build_opener(HTTPCookieProcessor())
        assert b"<!doctype html>" in browser.open(link).read()
        facts = read_until(browser, link, lambda state: bool(state["bridge"]))
        assert facts["bridge"]["ros"] and facts["bridge"]["recording"] is None
        assert bridge.end().code == 0
    finally:
        bridge.close()


def read_until(browser: OpenerDirector, link: str, wanted: Callable[[dict[str, Any]], bool]) -> dict[str, Any]:
    """The state of a page, once it is as wanted."""
    until = time.monotonic() + WAIT_S
    while not wanted(state := json.loads(browser.open(link.partition("?")[0] + "api/state").read())):
        assert time.monotonic() < until, state
        time.sleep(0.05)
    return state


def test_a_port_in_use_is_a_note(tmp_path: Path) -> None:
    bridge = Bridge("--no-ros", "--page", "--page-address", "203.0.113.1:80", "--allow", "203.0.113.0/24")
    try:
        assert "203.0.113.1" in bridge.wait_code("page", level="WARN")["text"]
        assert bridge.end().code == 0
    finally:
        bridge.close()


@needs_browser
def test_a_folder_without_a_bridge(tmp_path: Path) -> None:
    shutil.copy(FIXTURES / "lego.mcap", tmp_path / "old.mcap")
    command = [sys.executable, "-m", "igtl_gateway", "page", str(tmp_path)]
    served = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    try:
        assert served.stdout
        link, spectators = (served.stdout.readline().split()[-1] for _ in range(2))
        with Browser((820, 1100), dark=True) as page:
            page.open(link)
            page.click("button.link", "old.mcap")
            page.click("button", "Verify")
            page.wait("document.querySelector('#sessions .jobs').textContent.includes('good')", 120)
            page.click("button", "Replay …")
            port = free_port()
            page.click("[data-key=place]")
            page.type(f"127.0.0.1:{port}")
            page.click("#replay button", "Start")
            page.wait("document.querySelector('#replay .transport').textContent.includes('Pause')", 60)
            with RawPeer(port) as peer:
                assert peer.receive(type_name="TRANSFORM").device
                page.run("document.querySelector('[role=slider]').focus()")
                page.press("Home")
                page.press("ArrowRight")
                page.click("#replay button", "Pause")
                page.click("#replay button", "Step")
                page.wait("document.querySelector('#replay').textContent.includes('127.0.0.1')")
            page.click("#replay button", "Stop")
            page.wait("document.querySelector('#replay .btn.primary').textContent.startsWith('▶ Start')", 30)
            assert page.complaints == []
            # those who only look
            page.open(spectators)
            page.wait("document.querySelector('#role').offsetParent")
            page.press("4")
            page.wait("document.querySelector('#replay [data-key=plot]')")  # the buttons are there; a plot only reads
            page.wait(
                "[...document.querySelectorAll('#replay .btn')].every((each) => each.disabled === "
                "(each.dataset.key !== 'plot'))"
            )
    finally:
        served.send_signal(signal.SIGINT)
        assert served.wait(WAIT_S) == 0


#: What the page needs of a bridge without peers.
_FACTS = {
    "peers": [],
    "watched": [],
    "totals": {},
    "drops": {},
    "version": "0",
    "uptime_s": 1.0,
    "at_ns": 1,
    "refused": 0,
}


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
        counts = {"entries_since_start": written, "left_out_since_start": left_out, "dropped_since_start": dropped}
        state = {"failure": "", "queued_entries": 0, "paused": False, "rests": not file, "stalled_s": 0.0}
        path = str(self._folder / "today.mcap")
        recorder = counts | state | {"file": file and str(self._folder / file), "path": path}
        how = {"path": path, "snapshot_s": 0, "triggers": [], "split": False, "sealed": False, "phases": []}
        self._given.append({"facts": _FACTS | {"relay": False, "ros": False, "recorder": recorder}, "recording": how})
        self._is_given.release()
        assert self._is_taken.acquire(timeout=WAIT_S)

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
    found: dict[str, Any] = json.loads(page.state()[1])["bridge"]["recording"]
    return found


def test_many_browsers_cost_what_one_costs(source: Source, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(process, "_FRESH_NS", 3_600 * 10**9)
    with closing(Page(None, source)) as page:
        looks: list[int] = []

        def rows() -> list[int]:
            looks.append(1)
            return looks.copy()

        monkeypatch.setattr(page.jobs, "rows", rows)
        source.report("today.mcap", 0, dropped=0)
        first = page.state()
        assert all(page.state() is first for _ in range(100)) and looks == [1]
        assert not page.act("cancel", {"number": 1})[0] and page.state()[0] == first[0] + 1
        source.report("today.mcap", 1, dropped=0)
        assert page.state()[0] == first[0] + 2 and looks == [1, 1, 1]


def test_size_and_counts_are_of_the_file_that_is_written(source: Source, tmp_path: Path) -> None:
    folder = tmp_path / "a"
    (folder / "today.mcap").write_bytes(bytes(100))
    with closing(Page(folder, source)) as page:
        source.report("today.mcap", 40, dropped=2)
        assert recording_of(page)["losing"]
        source.report("", 40, dropped=2)
        (folder / "today_2.mcap").write_bytes(bytes(7))
        source.report("today_2.mcap", 3, dropped=1)
        found = recording_of(page)
        assert (found["name"], found["bytes"], found["entries"], found["dropped"]) == ("today_2.mcap", 7, 3, 1)
        source.report("", 3, dropped=1)
        found = recording_of(page)
        assert (found["name"], found["bytes"], found["entries"]) == ("today_2.mcap", 7, 3)


def test_a_recording_is_closed_as_soon_as_the_bridge_has_closed_it(
    source: Source, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The file stayed `recording` in the list, with all buttons off, until a look at it: for 90 s."""
    folder = tmp_path / "a"
    (folder / "today.mcap").write_bytes(bytes(100))
    (folder / "other.mcap").write_bytes(bytes(100))
    looked = {"closed": False, "recording": True, "problem": "is being recorded", "read": True}
    found = [{"name": name, "bytes": 100, "modified_ns": 1, **looked} for name in ("today.mcap", "other.mcap")]
    with closing(Page(folder, source)) as page:
        assert page.recordings
        monkeypatch.setattr(page.recordings, "rows", lambda: [dict(row) for row in found])
        source.report("today.mcap", 4)
        assert page.sessions()[0]["recording"] and recording_of(page)["written"] == "today.mcap"
        source.report("today_2.mcap", 4)  # Stop, and Start
        today, other = page.sessions()
        assert (today["closed"], today["recording"], today["problem"]) == (True, False, "")
        assert today["duration_s"] >= 0 and other["recording"]  # another program writes that one
        found[0] |= {"read": True, "recording": False, "closed": False, "problem": "was cut off"}
        assert page.sessions()[0]["problem"] == "was cut off"  # what a look at it has found


def test_a_recording_has_its_begin_before_it_was_read(source: Source, tmp_path: Path) -> None:
    folder = tmp_path / "a"
    (folder / "today.mcap").write_bytes(bytes(100))
    with closing(Page(folder, source)) as page:
        begun = page._clock.utc_ns()
        source.report("today.mcap", 4)
        source.report("", 4)
        (row,) = page.sessions()
        assert begun <= row["start_ns"] <= page._clock.utc_ns()


def test_a_disk_that_does_not_answer_does_not_stop_the_page(
    source: Source, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    go_on = threading.Event()

    def ask(*_paths: Path) -> tuple[int, int, int | None]:
        assert go_on.wait(WAIT_S)
        return 7, 1, 9

    monkeypatch.setattr(disk, "_WAIT_S", 0.01)
    monkeypatch.setattr(disk, "_SILENT_NS", 1)
    with closing(Page(tmp_path / "a", source)) as page:
        page._disk = disk.DiskLook(ask)
        source.report("today.mcap", 4)
        source.report("today.mcap", 5)
        assert recording_of(page)["stands"] and recording_of(page)["entries"] == 5
        go_on.set()
        for number in range(1_000):
            source.report("today.mcap", number)
            if not recording_of(page)["stands"]:
                break
        assert recording_of(page)["bytes"] == 7


def test_a_folder_that_is_gone_is_named_and_the_rest_goes_on(source: Source, tmp_path: Path) -> None:
    folder = tmp_path / "a"
    with closing(Page(folder, source)) as page:
        source.report("today.mcap", 4)
        folder.rmdir()
        source.report("today.mcap", 5)
        assert recording_of(page)["free"] is None and recording_of(page)["entries"] == 5
        assert page.sessions() == []
