"""What the log of the node has: each cause once, and all states."""

from __future__ import annotations

from igtl_gateway.app.ros_log import RosLog
from igtl_gateway.base.stamp import NS_PER_S
from igtl_gateway.gateway import TICK
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.gateway.log.note import Level, Note


def entry(number: int, note: Note, *links: int) -> Entry:
    return Entry(number, number, Kind.NOTE, "", note.code, (note.pack(),), links=links)


def test_faults_are_logged_once_and_states_always() -> None:
    lines: list[tuple[Level, str, int]] = []
    log = RosLog(lambda *line: lines.append(line))
    stale = Note(Level.WARN, "stale", "Tool is too old", "TRANSFORM/Tool")
    other = Note(Level.WARN, "stale", "Probe is too old", "TRANSFORM/Probe")
    state = Note(Level.INFO, "link_up", "connected")
    for second, note in enumerate((stale, state, stale, other, state)):
        number = second * NS_PER_S
        log.add(entry(number, note, 3) if note is state else entry(number, note))
    assert lines == []
    log.flush()
    assert lines == [
        (Level.WARN, "Tool is too old", 0),
        (Level.INFO, "connected [link 3]", 1 * NS_PER_S),
        (Level.WARN, "Probe is too old", 3 * NS_PER_S),
        (Level.INFO, "connected [link 3]", 4 * NS_PER_S),
    ]


def test_each_reason_is_logged_and_a_text_without_its_stream_gets_it() -> None:
    lines: list[str] = []
    log = RosLog(lambda _level, text, _stamp_ns: lines.append(text))
    for number, reason in enumerate(("too many", "foreign", "foreign")):
        log.add(entry(number, Note(Level.WARN, "refused", f"refused: {reason}", data={"reason": reason})))
    log.add(entry(3, Note(Level.ERROR, "wire_error", "found version 4", "STRING/Tool"), 7))
    log.add(entry(4, Note(Level.INFO, "stream", "found a stream", "STRING/Tool")))
    log.flush()
    assert lines == [
        "refused: too many",
        "refused: foreign",
        "found version 4 [STRING/Tool, link 7]",
        "found a stream",
    ]


def test_a_flood_costs_no_memory() -> None:
    lines: list[str] = []
    log = RosLog(lambda _level, text, _stamp_ns: lines.append(text))
    for number in range(3000):
        log.add(entry(number, Note(Level.ERROR, "bad", f"device {number}", f"STRING/{number}")))
    log.flush()
    assert lines == [*(f"device {number}" for number in range(100)), "device 999"]


def test_ticks_are_not_logged() -> None:
    lines: list[str] = []
    log = RosLog(lambda _level, text, _stamp_ns: lines.append(text))
    for number in range(4):
        log.add(entry(number, Note(Level.INFO, TICK, "a deadline has come")))
    log.flush()
    assert lines == []
