"""The bridge's lines for people; what the program does is in ``integration/test_cli_bridge``."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import pytest

from igtl_gateway.app.entry_watch import EntryWatch
from igtl_gateway.app.note_rate import Event, NoteRate
from igtl_gateway.base.clock import ManualClock
from igtl_gateway.cli.bridge_output import JsonOutput, TextOutput
from igtl_gateway.cli.bridge_run import _Show
from igtl_gateway.config.configuration import Config
from igtl_gateway.gateway import TICK
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.gateway.log.note import Level, Note


def test_the_node_has_a_lowest_level(capsys: pytest.CaptureFixture[str]) -> None:
    out = TextOutput(terminal=False, logs=lambda level: level >= Level.WARN)
    out.events([Event(0, Kind.NOTE, Note(level, level.name, level.name), ()) for level in Level])
    assert capsys.readouterr().out == "? WARN\n! ERROR\n"


def test_a_device_name_writes_no_lines_and_no_escape_sequences(capsys: pytest.CaptureFixture[str]) -> None:
    name = "\x1b[2J\x9b31m\rTool\n= 10.0.0.9:18944 connected\x7f"
    note = Note(Level.WARN, "stale", f"{name} is too old", f"STRING/{name}")
    TextOutput(terminal=False).events([Event(0, Kind.NOTE, note, (3,))])
    shown = r"\x1b[2J\x9b31m\x0dTool\x0a= 10.0.0.9:18944 connected\x7f"
    assert capsys.readouterr().out == f"? {shown} is too old [link 3]\n"


@pytest.mark.parametrize("code", ["peer_no_clock", "peer_clock_step", "clock_step"])
def test_each_clock_that_was_set_has_a_line(code: str, capsys: pytest.CaptureFixture[str]) -> None:
    out = TextOutput(terminal=False)
    for text in ("the first", "another"):
        out.events([Event(0, Kind.NOTE, Note(Level.WARN, code, text), ())])
    assert capsys.readouterr().out == "? the first\n? another\n"


def test_ticks_drive_the_gateway_and_tell_people_nothing(capsys: pytest.CaptureFixture[str]) -> None:
    for out, lines in ((TextOutput(terminal=False), 1), (JsonOutput(ManualClock(0)), 1)):
        watch = EntryWatch(NoteRate())
        for number in range(40):
            watch(Entry(number, number, Kind.EDGE_NOTE, payload=(Note(Level.INFO, TICK, "a deadline").pack(),)))
        watch(Entry(41, 41, Kind.LINK, payload=(Note(Level.INFO, "link_up", "connected").pack(),), links=(1,)))
        out.events(watch.take(50))
        shown = capsys.readouterr().out.splitlines()
        assert len(shown) == lines and "connected" in shown[0]


def test_an_event_that_is_told_is_in_the_state_already() -> None:
    calls: list[str] = []
    out = SimpleNamespace(events=lambda _: calls.append("told"), status=lambda *_: None)
    bridge = SimpleNamespace(hub=SimpleNamespace(now_ns=lambda: 0), take_reports=list, collect=lambda: None)

    def take(_now_ns: int) -> list[Event]:
        calls.append("taken")
        return []

    watch = SimpleNamespace(take=take)
    session: Any = SimpleNamespace(bridge=bridge, watch=watch, sample=lambda: calls.append("state"))
    show = _Show(cast(Any, out), None, [], ManualClock(), cast(Any, SimpleNamespace(page=None)))
    show._session = session
    show.update(session)
    assert calls == ["taken", "state", "told"]


def test_an_address_of_ipv6_has_brackets(capsys: pytest.CaptureFixture[str]) -> None:
    options: Any = SimpleNamespace(
        listen=[("::1", 0)], tls_listen=(), connect=[("fe80::7", 18945)], tls_connect=(), record=None,
        recording=SimpleNamespace(triggers=()), limits=SimpleNamespace(bodies=()),
    )  # fmt: skip
    bridge: Any = SimpleNamespace(addresses=[("::1", 18944)], options=options, ros=None, native_off="")
    TextOutput(terminal=False).started(bridge, Config(), [], None)
    shown = capsys.readouterr().out
    assert "server on [::1]:18944\n" in shown and "client of [fe80::7]:18945, reconnects" in shown
