"""Marks: what they may be, lines of text, phases, and the notes that they are."""

from __future__ import annotations

import json
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from igtl_gateway.base.errors import ConfigError
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.gateway.log.marks import (
    BEGIN,
    END,
    MAX_OPEN,
    Mark,
    MarkNote,
    OpenPhases,
    ago_ns,
    ago_of_stamp,
    is_phase,
    joined,
)
from igtl_gateway.gateway.log.note import Level, Note
from tests.tables import table

_SHOWN = st.characters(exclude_categories=("C", "Z"), exclude_characters=":")
LABELS = st.text(_SHOWN, min_size=1, max_size=64).map(lambda text: text.lstrip("+-") or "label")
TEXTS = st.text(_SHOWN | st.sampled_from(" :"), max_size=100)
MARKS = st.builds(
    MarkNote,
    LABELS,
    TEXTS,
    TEXTS.map(lambda text: text[:64]),
    st.sampled_from(("", BEGIN, END)),
    st.integers(0, 1 << 50),
)


@given(MARKS)
def test_a_mark_is_its_note_and_its_line(mark: MarkNote) -> None:
    assert MarkNote.of(Note.unpack(mark.note().pack())) == mark
    line = {"": "", BEGIN: "+", END: "-"}[mark.phase] + f"{mark.label}: {mark.text}"
    read = MarkNote.parse(line, mark.who)
    assert (read.label, read.text, read.phase) == (mark.label, mark.text.strip(), mark.phase)


@table(
    ("values", "words"),
    [
        (("",), "found label ''"),
        ((" a",), "outer blanks"),
        (("a:b",), "without ':'"),
        (("+a",), "without"),
        (("a" * 65,), "up to 64 printable characters"),
        (("a\x1b[2J",), "found label 'a\\x1b[2J', expected up to 64 printable characters"),
        (("a", "two\nlines"), "found text 'two\\nlines', expected up to 1,000 printable characters"),
        (("a", "x" * 1001), "found text 'xxxx"),
        (("a", "", "\udc80"), "found who"),
        ((7,), "found label 7"),
        (("a", "", "", "", -1), "found a time -1 ns before, expected 0 or more"),
        (("a", "", "", "", True), "found a time True ns before"),
        (("a", "", "", "middle"), "found phase 'middle', expected 'begin', 'end' or none"),
    ],
)
def test_a_bad_mark_is_named(values: tuple[Any, ...], words: str) -> None:
    with pytest.raises(ConfigError) as caught:
        MarkNote(*values)
    assert words in str(caught.value) and len(str(caught.value)) < 250
    with pytest.raises(ConfigError, match="found label ''"):
        MarkNote.parse("+ : text", "")


def test_phases_open_once_and_end_once() -> None:
    phases = OpenPhases()
    phases.follow(MarkNote("suture", phase=BEGIN).note())
    phases.check(MarkNote("suture"))
    with pytest.raises(ConfigError, match="found the phase 'suture' open already"):
        phases.check(MarkNote("suture", phase=BEGIN))
    with pytest.raises(ConfigError, match="found the end of 'sture', expected a phase that is open; did you mean 'sut"):
        phases.check(MarkNote("sture", phase=END))
    phases.follow(MarkNote("suture", phase=END).note())
    with pytest.raises(ConfigError, match="found the end of 'suture'"):
        phases.check(MarkNote("suture", phase=END))
    for number in range(2 * MAX_OPEN):
        phases.follow(MarkNote(f"{number}", phase=BEGIN).note())
    with pytest.raises(ConfigError, match=f"found {MAX_OPEN} open phases"):
        phases.check(MarkNote("one more", phase=BEGIN))


def _joined(*marks: tuple[int, MarkNote]) -> tuple[Mark, ...]:
    return joined(((time_ns, mark.note()) for time_ns, mark in marks), 100, 200)


def test_a_mark_is_of_the_moment_at_which_a_person_began_to_write() -> None:
    early = MarkNote("early", ago_ns=30)
    assert _joined(
        (110, early), (150, MarkNote("a", "", "me", BEGIN, 20)), (180, MarkNote("a", phase=END, ago_ns=15))
    ) == (
        Mark("early", "", "", 80),
        Mark("a", "", "me", 130, 165),
    )
    assert MarkNote("slip", "deep", ago_ns=2_540_000_000).note().text == "mark slip (2.54 s before): deep"
    assert [ago_ns(2.5), ago_ns(0)] == [2_500_000_000, 0]
    for wrong in (-0.1, float("nan"), float("inf"), True, "2", None, 86_400):
        with pytest.raises(ConfigError, match="expected the seconds since then, 0 to 86,400"):
            ago_ns(wrong)


@table(
    ("line", "label", "ago_s"),
    [
        ("slip @-8: deep", "slip", 8.0),
        ("+slip @ home   @-0.25", "slip @ home", 0.25),
        ("slip @-8 @-2", "slip @-8", 2.0),
        ("slip@-8", "slip@-8", 0.0),
        ("slip @8", "slip @8", 0.0),
        ("slip @-1e3", "slip @-1e3", 0.0),
        ("slip @-\u0661", "slip @-\u0661", 0.0),
        ("@-8", "@-8", 0.0),
    ],
)
def test_a_line_has_the_time_since_its_moment(line: str, label: str, ago_s: float) -> None:
    mark = MarkNote.parse(line, "", 500)
    assert (mark.label, mark.ago_ns) == (label, round(ago_s * 1e9) + 500)


def test_a_line_of_more_than_a_day_ago_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"found 99999\.0 s ago, expected the seconds since then, 0 to 86,400"):
        MarkNote.parse("slip @-99999", "")


def test_the_age_of_a_stamp() -> None:
    now_ns = 1_000_000 * 10**9
    assert [ago_of_stamp(at, now_ns) for at in (0, -5, now_ns - 7, now_ns, now_ns + 10**8)] == [0, 0, 7, 0, 0]
    with pytest.raises(
        ConfigError, match=r"found a stamp 500 ms ahead of the bridge's clock, expected one of the sess"
    ):
        ago_of_stamp(now_ns + 5 * 10**8, now_ns)
    with pytest.raises(ConfigError, match=r"found a stamp 12 days behind the bridge's clock"):
        ago_of_stamp(7, now_ns)


def test_two_notes_are_one_phase() -> None:
    begin, end = MarkNote("a", "why", "me", BEGIN), MarkNote("a", "how it went", "you", END)
    assert _joined((110, begin), (115, MarkNote("b")), (120, end)) == (
        Mark("a", "why; how it went", "me", 110, 120),
        Mark("b", "", "", 115),
    )
    assert _joined((110, begin)) == (Mark("a", "why", "me", 110, 200, is_open=True),)
    assert _joined((120, end)) == (Mark("a", "how it went", "you", 100, 120),)
    assert _joined((50, begin), (120, end)) == (Mark("a", "why; how it went", "me", 50, 120),)
    assert not _joined((50, begin), (60, end), (70, MarkNote("b")))
    assert _joined((110, begin), (130, begin)) == (
        Mark("a", "why", "me", 110, 130),
        Mark("a", "why", "me", 130, 200, is_open=True),
    )


@given(st.lists(st.tuples(st.integers(0, 300), MARKS), max_size=20))
def test_whatever_the_notes_are_the_marks_are_in_order(notes: list[tuple[int, MarkNote]]) -> None:
    found = _joined(*sorted(notes, key=lambda each: each[0]))
    assert [mark.time_ns for mark in found] == sorted(mark.time_ns for mark in found)
    assert all(mark.end_ns is None or mark.time_ns <= mark.end_ns for mark in found)


@table("data", [{}, {"label": 7}, {"label": "a", "text": []}, {"label": "a", "phase": "x"}, {"label": "a\n"}])
def test_a_note_of_another_shape_is_no_mark(data: dict[str, Any]) -> None:
    note = Note(Level.INFO, "mark", "text", data=data)
    assert MarkNote.of(note) is None
    assert not joined([(1, note)], 0, 2)
    assert not is_phase(Entry(1, 1, Kind.EDGE_NOTE, payload=(note.pack(),)))


def test_it_is_a_note_for_programs_that_do_not_know_marks() -> None:
    assert json.loads(MarkNote("a", "b", "c", BEGIN).note().pack()) == {
        "code": "mark",
        "data": {"label": "a", "phase": "begin", "text": "b", "who": "c"},
        "level": "INFO",
        "stream": "",
        "text": "mark a begins: b",
    }


@table(
    ("kind", "note", "is_one"),
    [
        (Kind.EDGE_NOTE, MarkNote("a", phase=BEGIN).note(), True),
        (Kind.EDGE_NOTE, MarkNote("a", phase=END).note(), True),
        (Kind.EDGE_NOTE, MarkNote("a").note(), False),
        (Kind.EDGE_NOTE, Note(Level.INFO, "tick", "mark"), False),
        (Kind.NOTE, MarkNote("a", phase=BEGIN).note(), False),
        (Kind.LINK, MarkNote("a", phase=BEGIN).note(), False),
        (Kind.IGTL_IN, MarkNote("a", phase=BEGIN).note(), False),
    ],
)
def test_which_entries_begin_or_end_a_phase(kind: Kind, note: Note, is_one: bool) -> None:
    assert is_phase(Entry(1, 1, kind, payload=(note.pack(),))) is is_one


def test_a_phase_without_an_end_is_open_and_none_is_added_here() -> None:
    rows = [mark.to_dict(100) for mark in _joined((110, MarkNote("a", phase=BEGIN)), (120, MarkNote("b")))]
    assert [(row["label"], row["open"], row["added"], row["end_s"]) for row in rows] == [
        ("a", True, False, 1e-7),
        ("b", False, False, None),
    ]
