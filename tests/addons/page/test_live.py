"""The interface of a bridge for its page, with a bridge in this process and without a browser."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from unittest.mock import MagicMock

import pytest

import igtl_gateway
from igtl_gateway.addons.page import live
from igtl_gateway.addons.page.live import BridgePage
from igtl_gateway.addons.page.source import BridgeSource, Poller
from igtl_gateway.app.note_rate import Event
from igtl_gateway.gateway.log.entry import Kind
from igtl_gateway.gateway.log.note import Level, Note
from tests.timing import WAIT_S


class Watch:
    refused = 0


class Session:
    """What the page needs of a session."""

    def __init__(self, bridge: Any) -> None:
        self.bridge = bridge
        self.watch = Watch()


@contextmanager
def page_of(bridge: Any, stopped: list[bool]) -> Iterator[tuple[BridgePage, BridgeSource]]:
    page = BridgePage(("127.0.0.1", 0), (), None, None, lambda: stopped.append(True), lambda *_: None)
    try:
        page.update(Session(bridge))
        yield page, BridgeSource(f"http://{page._server.address}", page._token)
    finally:
        page.close()


def wait(condition: Callable[[], object]) -> None:
    until = time.monotonic() + WAIT_S
    while not condition():
        assert time.monotonic() < until
        time.sleep(0.01)


def test_each_button(tmp_path: Path) -> None:
    recording, stopped, long = tmp_path / "a.mcap", list[bool](), "😀" * 1_000
    with igtl_gateway.Bridge(listen=["127.0.0.1:0"], ros=False, record=recording, record_wait=True) as bridge:
        recorder = bridge._bridge.recorder
        assert recorder
        with page_of(bridge._bridge, stopped) as (_, source):
            assert source.press("mark", "early") == (False, "nothing is recorded; start the recording first")
            assert source.press("pause", "") == (False, "the recording is stopped; start it first")
            assert source.press("start", "")[0]
            wait(lambda: not recorder.rests)
            assert source.press("mark", f"slip: {long}") == (True, "the mark is set")
            assert not source.press("mark", "\ud800")[0]
            since_ns = time.monotonic_ns() - 10**9
            assert source.press("mark", "before", since_ns - 3_600 * 10**9)[1].startswith("mark: found 1 h ")
            assert source.press("mark", "+cut") == (True, "the phase cut begins")
            assert source.press("mark", "-cut") == (True, "the phase cut ends")
            assert source.press("pause", "")[0] and source.press("resume", "")[0]
            assert source.press("split", "")[1].startswith("the recording has one file")
            assert source.press("snapshot", "")[1].startswith("no snapshots")
            assert source.press("stop", "")[0]
            wait(lambda: recorder.rests)
            assert source.press("format", "")[1].startswith("found 'format', expected one of mark, end, start")
            assert source.press("end", "")[0] and stopped == [True]
            assert BridgeSource(source._url, "another token").press("end", "") == (False, "the bridge does not answer")
    with igtl_gateway.open(recording) as found:
        assert [(mark.label, mark.text) for mark in found.marks] == [("slip", long), ("cut", "")]
        presses = [note.text.partition(" was")[0] for note in found.notes if note.code == "page"]
    assert presses == ["pause", "resume", "split", "snapshot", "stop"]


def test_a_sample_is_made_for_a_reader_only_and_once_for_each_change(monkeypatch: pytest.MonkeyPatch) -> None:
    made: list[object] = []

    def sample(bridge: object) -> dict[str, Any]:
        made.append(bridge)
        return {"totals": {}}

    monkeypatch.setattr(live, "sample_of", sample)
    monkeypatch.setattr(live, "Child", MagicMock())  # the reader is this test
    monkeypatch.setattr(live, "_STILL_S", 60.0)
    with (
        igtl_gateway.Bridge(listen=["127.0.0.1:0"], ros=False) as bridge,
        page_of(bridge._bridge, []) as (page, source),
    ):
        session = Session(bridge._bridge)
        event = Event(1, Kind.EDGE_NOTE, Note(Level.INFO, "x", "x"), ())
        for _ in range(20):
            page.update(session, [event])
        assert made == []
        samples = source.samples()
        next(samples)
        for _ in range(3):
            for _ in range(20):  # without a note, at most one each second
                page.update(session)
            page.update(session, [event])
            assert "uptime_s" in next(samples)["facts"]
        assert len(made) == 4
        assert source.press("format", "")[0] is False and next(samples)  # a press shows at once
        page.close()
        assert list(samples) == []


def test_a_sample_is_of_the_bridges_own_collection(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(live, "Child", MagicMock())
    monkeypatch.setattr(live, "sample_of", lambda _: {"totals": {}})
    bridge = MagicMock()
    with page_of(bridge, []) as (page, _):
        first, again = page.facts()["facts"], page.facts()["facts"]
        assert first["at_ns"] == again["at_ns"] and not bridge.collect.called
        page._at_ns -= 2 * 10**9  # a terminal holds the bridge up
        assert page.facts()["facts"]["at_ns"] > first["at_ns"] and bridge.collect.call_count == 1


def test_a_bridge_that_does_not_answer_is_none_and_is_asked_again() -> None:
    found: list[object] = []
    source = BridgeSource("http://127.0.0.1:9", "x")
    poller = Poller(source, found.append)
    wait(lambda: len(found) >= 2)
    poller.close()
    assert found[:2] == [None, None]


def test_many_notes_do_not_hide_what_was_done() -> None:
    with (
        igtl_gateway.Bridge(listen=["127.0.0.1:0"], ros=False) as bridge,
        page_of(bridge._bridge, []) as (page, source),
    ):
        notes = [Note(Level.INFO, "mark", "mark slip"), *(Note(Level.WARN, "stamp_still", "x") for _ in range(500))]
        page.update(Session(bridge._bridge), [Event(1, Kind.EDGE_NOTE, note, ()) for note in notes])
        found = next(source.samples())
        assert [note["text"] for note in found["done"]] == ["mark slip"] and len(found["notes"]) == 60


def test_a_line_leaves_out_what_is_as_it_was(monkeypatch: pytest.MonkeyPatch) -> None:
    lines: list[bytes] = []
    loads = json.loads

    def kept(line: bytes | str) -> Any:
        if isinstance(line, bytes):  # others read JSON, too
            lines.append(line)
        return loads(line)

    with (
        igtl_gateway.Bridge(listen=["127.0.0.1:0"], ros=False) as bridge,
        page_of(bridge._bridge, []) as (page, source),
    ):
        monkeypatch.setattr(json, "loads", kept)
        session, event = Session(bridge._bridge), Event(1, Kind.EDGE_NOTE, Note(Level.INFO, "mark", "mark slip"), ())
        page.update(session, [event])
        samples = source.samples()
        first = next(samples)
        page._sampled_ns = 0
        page.update(session)
        second = next(samples)
    assert second["notes"] == first["notes"] != []
    assert [b"slip" in line for line in lines] == [True, False]


def test_no_mark_is_taken_after_a_failure(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(live, "Child", MagicMock())
    bridge = MagicMock()
    bridge.recorder.rests, bridge.recorder.failure = True, "no space left on device"
    with page_of(bridge, []) as (_, source):
        assert source.press("mark", "slip") == (False, "nothing is recorded; start the recording first")
    bridge.mark.assert_not_called()
