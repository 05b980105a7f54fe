"""A live view never makes the hub wait, and reports what it could not draw."""

from __future__ import annotations

import threading
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("rerun", reason="rerun is not installed (extra 'view')")

from igtl_gateway.addons.view import stream, viewer
from igtl_gateway.addons.view.live import LiveView, LiveWindow
from igtl_gateway.addons.view.session import SessionView
from igtl_gateway.addons.view.viewer import Viewer
from igtl_gateway.cli import main
from igtl_gateway.config.configuration import Config
from igtl_gateway.convert.rosmsg import String
from igtl_gateway.gateway import LINK_UP, Session, make_core
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.gateway.log.note import Level, Note
from igtl_gateway.wire import Message, encode
from tests.timing import WAIT_S

from .conftest import START_NS, Drawn, messages, read_back


def live(path: Path, **options: Any) -> LiveView:
    return LiveView(stream.to_file(path, "live"), "base", **options)


def ended(view: LiveView, path: Path) -> Drawn:
    view.close()
    stream.close(view._recording)
    return read_back(path)


class Gate:
    """Holds the drawing at its first entry until it is opened."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.arrived, self.open = threading.Event(), threading.Event()
        take = SessionView.take

        def held(view: SessionView, entry: Entry) -> None:
            self.arrived.set()
            assert self.open.wait(WAIT_S)
            take(view, entry)

        monkeypatch.setattr(SessionView, "take", held)


def test_everything_that_it_was_told_is_drawn(tmp_path: Path) -> None:
    path = tmp_path / "live.rrd"
    view = live(path)
    for entry in messages(*(String(str(number)) for number in range(500))):
        view(entry)
    drawn = ended(view, path)
    assert [row["TextDocument:text"] for row in drawn.rows("topic")] == [[str(number)] for number in range(500)]
    assert (view.dropped, view.failure) == (0, "")


def test_what_comes_faster_than_it_can_draw_is_dropped_and_shown_as_one_gap(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    gate, path = Gate(monkeypatch), tmp_path / "live.rrd"
    view = live(path, max_entries=10)
    entries = messages(*(String("x") for _ in range(102)))
    view(entries[0])
    assert gate.arrived.wait(WAIT_S)
    for entry in entries[1:-1]:  # none of these calls waits for the drawing, which is held
        view(entry)
    assert view.dropped == 90
    caught_up = threading.Event()
    flush = view._view.flush

    def flushed() -> None:
        flush()
        if not view._shedding:
            caught_up.set()

    monkeypatch.setattr(view._view, "flush", flushed)
    gate.open.set()
    assert caught_up.wait(WAIT_S)
    view(entries[-1])
    drawn = ended(view, path)
    assert drawn.count("topic") == 12
    assert drawn.one("session/drops")["Scalars:scalars"] == [90.0]


def test_large_messages_are_bounded_by_their_bytes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    gate, path = Gate(monkeypatch), tmp_path / "live.rrd"
    view = live(path, max_bytes=10_000)
    entries = messages(*(String("x" * 3000) for _ in range(10)))
    view(entries[0])
    assert gate.arrived.wait(WAIT_S)
    for entry in entries[1:]:
        view(entry)
    gate.open.set()
    drawn = ended(view, path)
    assert (drawn.count("topic"), view.dropped) == (4, 6)


def test_a_fault_in_the_drawing_costs_the_picture_and_nothing_else(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(_view: SessionView, _entry: Entry) -> None:
        raise ZeroDivisionError("oops")

    monkeypatch.setattr(SessionView, "take", broken)
    path = tmp_path / "live.rrd"
    view = live(path)
    first, second = messages(String("a"), String("b"))
    view(first)
    view._thread.join(WAIT_S)
    view(second)  # does nothing any more
    assert (view.failure, view.dropped) == ("ZeroDivisionError: oops", 1)
    ended(view, path)


def test_a_relay_is_seen_by_what_its_messages_would_become(tmp_path: Path) -> None:
    from igtl_gateway.wire.text import String as IgtlString

    path = tmp_path / "live.rrd"
    view = live(path, through=Session(make_core(Config())))
    up = Note(Level.INFO, LINK_UP, "a peer").pack()
    data = b"".join(bytes(part) for part in encode(Message("STRING", "Greeting", IgtlString.of("hello"))))
    view(Entry(1, START_NS, Kind.LINK, payload=(up,), links=(1,)))
    view(Entry(2, START_NS + 10, Kind.IGTL_IN, "STRING/Greeting", "STRING", (data,), (1,)))
    drawn = ended(view, path)
    assert drawn.one("igtl/in/Greeting/string")["TextDocument:text"] == ["hello"]


@pytest.fixture
def server(monkeypatch: pytest.MonkeyPatch) -> list[Viewer]:
    """In place of windows servers without one are opened; they are listed here."""
    opened = []

    def window() -> Viewer:
        made = Viewer(["--serve-grpc", "--bind", "127.0.0.1", "--port", "auto"], [viewer._LISTENS])
        made.url = f"rerun+http://127.0.0.1:{made._found[0]}/proxy"
        opened.append(made)
        return made

    monkeypatch.setattr(Viewer, "window", window)
    return opened


def test_the_window_ends_with_the_bridge(server: list[Viewer]) -> None:
    window = LiveWindow(Config())
    for entry in messages(String("a"), String("b")):
        window(entry)
    assert window.close() == ""
    assert server[0].ended


def test_the_bridge_does_not_end_with_the_window(server: list[Viewer]) -> None:
    window = LiveWindow(Config(relay=True))
    first, *others = messages(*(String("x") for _ in range(50)))
    window(first)
    server[0].close()
    for entry in others:
        window(entry)
    assert window.close() == ""


def test_bridge_with_a_window(server: list[Viewer], capfd: pytest.CaptureFixture[str]) -> None:
    assert main(["bridge", "--no-ros", "--view", "--listen", "127.0.0.1:0", "--duration", "0.1"]) == 0
    assert len(server) == 1
    assert server[0].ended
    (line,) = capfd.readouterr().err.splitlines()
    assert "--view: other users of this machine can read what the window shows" in line


def test_bridge_with_a_window_that_cannot_start_leaves_none(server: list[Viewer]) -> None:
    assert main(["bridge", "--no-ros", "--view", "--listen", "203.0.113.1:0", "--allow", "any"]) != 0
    assert all(each.ended for each in server)
