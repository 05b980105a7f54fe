"""How often notes are reported: a peer can cause one with each of its messages."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable

import pytest

from igtl_gateway.app.entry_watch import EntryWatch
from igtl_gateway.app.note_rate import Event, NoteRate
from igtl_gateway.base.stamp import NS_PER_MS, NS_PER_S
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.gateway.log.note import Level, Note
from tests.tables import table
from tools.note_codes import NOTES


def event(ms: int, code: str = "bad_crc", text: str = "refused", links: tuple[int, ...] = (1,)) -> Event:
    return Event(ms * NS_PER_MS, Kind.NOTE, Note(Level.ERROR, code, text, "TRANSFORM/Tool"), links)


def reported(rate: NoteRate, events: list[Event], every_ms: int = 100) -> list[Event]:
    """What is reported of these events, by a program that looks ten times a second, and at its end."""
    found: list[Event] = []
    look_ns = 0
    for one in events:
        while look_ns < one.stamp_ns:
            look_ns += every_ms * NS_PER_MS
            found += rate.due(look_ns)
        if shown := rate.take(one):
            found.append(shown)
    return found + rate.due(None)


def test_the_same_note_is_reported_once_and_then_counted() -> None:
    found = reported(NoteRate(), [event(number) for number in range(3_500)])
    assert [one.stamp_ns // NS_PER_S for one in found] == [0, 0, 3]
    assert sum(1 + one.more for one in found) == 3_500


PERIODS = {  # ms from one note to the next → seconds of the reports
    250: [0, 0, 10, 110, 499],
    1_000: [0, 1, 10, 110, 499],
    5_000: [0, 5, 10, 110, 495],
}


@table("period", PERIODS)
def test_a_note_that_comes_periodically_is_reported_ever_more_rarely_and_counted(period: int) -> None:
    events = [event(at_ms) for at_ms in range(0, 500_000, period)]
    found = reported(NoteRate(), events)
    assert [one.stamp_ns // NS_PER_S for one in found] == PERIODS[period]
    assert sum(1 + one.more for one in found) == len(events)


@table(("period_s", "code"), [(70, "bad_crc"), (2, "mark"), (2, "link_up"), (2, "trigger")])
def test_a_note_that_is_rare_or_news_is_reported_each_time(period_s: int, code: str) -> None:
    events = [event(1_000 * period_s * number, code) for number in range(100)]
    assert reported(NoteRate(), events, 1_000) == events


def test_what_only_drives_the_gateway_is_never_reported() -> None:
    assert (
        reported(NoteRate(), [event(250 * number, code) for code in ("tick", "command_unwritten") for number in (0, 9)])
        == []
    )


def test_the_notes_of_another_peer_and_of_another_stream_are_their_own() -> None:
    events = [event(number % 3, links=(number,)) for number in range(50)]
    assert reported(NoteRate(), sorted(events, key=lambda one: one.stamp_ns)) == sorted(
        events, key=lambda one: one.stamp_ns
    )


def test_a_note_that_came_once_more_is_reported_when_all_is_quiet() -> None:
    rate = NoteRate()
    assert rate.take(event(0)) and not rate.take(event(10)) and not rate.take(event(20))
    assert rate.due(900 * NS_PER_MS) == []
    (late,) = rate.due(1_000 * NS_PER_MS)
    assert (late.stamp_ns, late.more) == (20 * NS_PER_MS, 1)
    assert rate.due(None) == []


FLOODS: dict[str, Callable[[int], tuple[str, tuple[int, ...]]]] = {
    "the same text": lambda number: ("refused", (1,)),
    "another string each time": lambda number: (f"found {number}", (1,)),
    "another link each time": lambda number: ("refused", (number,)),
    "150 strings": lambda number: (f"found {number % 150}", (1,)),
    "300 strings": lambda number: (f"found {number % 300}", (number % 7,)),
}


@pytest.mark.parametrize("flood", FLOODS)
def test_no_code_floods_the_log(flood: str) -> None:
    """Ten seconds of 2,000 notes a second, of each kind: one burst and a few in a second, and all are counted."""
    rate = NoteRate()
    events = [event(number // 2, "bad_crc", *FLOODS[flood](number)) for number in range(20_000)]
    found = reported(rate, events)
    assert len(found) <= 100 + 3 * 11 + 200  # at the end, what was held back of each that is distinguished
    assert sum(1 + one.more for one in found) == 20_000
    in_a_second = Counter(one.stamp_ns // NS_PER_S for one in found if one.stamp_ns < 9 * NS_PER_S)
    assert max((number for second, number in in_a_second.items() if second), default=0) <= 5


def test_every_code_is_limited_by_itself() -> None:
    rate = NoteRate()
    names = sorted({code for group in NOTES.values() for code in group})
    events = [event(number, name, f"text {number}") for number in range(300) for name in names]
    found = Counter(one.note.code for one in reported(rate, events))
    assert set(found) == set(names) - {"ask_clock", "tick", "command_unwritten"}
    assert max(found.values()) <= 102


def test_what_a_bridge_counts_is_exact_while_it_reports_little() -> None:
    watch = EntryWatch(NoteRate())
    note = Note(Level.ERROR, "bad_crc", "refused", "TRANSFORM/Tool")
    for number in range(5_000):
        watch(Entry(number + 1, number, Kind.NOTE, "", "", (note.pack(),), (1,)))
    events = watch.take(5_000) + watch.take()
    assert watch.refused == watch.counts[Kind.NOTE] == 5_000
    assert [one.more for one in events] == [0, 4_998]
