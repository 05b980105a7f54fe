"""Marks of recordings: they verify, name moments, and stay in every part."""

from __future__ import annotations

import json
from contextlib import suppress
from pathlib import Path
from random import Random

import pytest

import igtl_gateway
from igtl_gateway.base.errors import ConfigError
from igtl_gateway.cli import main
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.gateway.log.marks import BEGIN, END, Mark, MarkNote, OpenPhases
from igtl_gateway.record.prologue import Prologue
from igtl_gateway.record.selection import StateInputRule
from igtl_gateway.record.sessionfile.reader import SessionFile
from igtl_gateway.record.sessionfile.recovery import recover
from igtl_gateway.record.sessionfile.writer import SessionWriter
from igtl_gateway.replay.recorded_marks import carry_marks, find_mark, marked_moment, marks_of
from igtl_gateway.replay.slice import Slice
from igtl_gateway.replay.slice_state import SliceWindow
from igtl_gateway.replay.verify import verify
from tests import marked
from tests.tables import table

S = 1_000_000_000
LABELS = ["suture-1", "slip", "suture-2", "rest"]
FOUND = (Mark("a", "", "", 10, 20), Mark("b", "", "", 15), Mark("a", "", "", 30, 40), Mark("c#2", "", "", 50))


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return marked.write(tmp_path_factory.mktemp("marks") / "out.mcap")


def _marks(path: Path) -> tuple[Mark, ...]:
    with SessionFile.open(path) as file:
        return marks_of(file)


def test_a_phase_that_began_before_a_part_ends_in_it(tmp_path: Path) -> None:
    """Its begin is in the prologue, which comes before what was noted in the part."""
    prologue = Prologue(StateInputRule(frozenset()))
    for number, mark in enumerate((MarkNote("a", "why", "me", BEGIN), MarkNote("b", "", "me", BEGIN)), 1):
        prologue.observe(Entry(number, number * S, Kind.EDGE_NOTE, payload=(mark.note().pack(),)))
    writer = SessionWriter(tmp_path / "a.mcap", {}, prologue=prologue.entries())
    for number, mark in enumerate((MarkNote("a", "how", "me", END), MarkNote("a", "again", "me", BEGIN)), 11):
        writer.write(Entry(number, number * S, Kind.EDGE_NOTE, payload=(mark.note().pack(),)))
    writer.close({})
    assert _marks(tmp_path / "a.mcap") == (
        Mark("a", "why; how", "me", 1 * S, 11 * S),
        Mark("b", "", "me", 2 * S, 12 * S, is_open=True),
        Mark("a", "again", "me", 12 * S, 12 * S, is_open=True),
    )


@table(
    ("text", "option", "expected"),
    [
        ("mark:a", "--start", 10),
        ("mark:a", "--end", 20),
        ("mark:a#2", "--start", 30),
        ("mark:a#2", "end", 40),
        ("mark:b", "--end", 15),
        ("mark:c#2", "start", 50),
        ("0.000000002", "--start", 2),
    ],
)
def test_a_moment_by_its_mark(text: str, option: str, expected: int) -> None:
    assert marked_moment(text, 0, option, lambda: FOUND) == expected


@table(
    ("name", "words"),
    [
        ("", "found no mark '', expected one of a, b, c#2"),
        ("a#3", "found mark:a#3, expected at most mark:a#2"),
        ("a#0", "found no mark 'a#0'"),
        ("c#3", "did you mean 'c#2'?"),
    ],
)
def test_a_mark_that_is_not_there(name: str, words: str) -> None:
    with pytest.raises(ConfigError) as caught:
        find_mark(name, FOUND, "--start")
    assert words in str(caught.value)
    with pytest.raises(ConfigError, match="--start: found mark:x, expected a recording with marks: this one has none"):
        find_mark("x", (), "--start")


def test_marks_verify_and_info_and_python_have_them(recording: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["verify", str(recording)]) == 0
    capsys.readouterr()
    assert main(["info", str(recording)]) == 0
    lines = capsys.readouterr().out.partition("  marks\n")[2].splitlines()[:4]
    assert [line.strip() for line in lines[:3]] == [
        "1.000 s to 2.000 s  suture-1: first (nurse)",
        "1.500 s  slip: the needle slipped (nurse)",
        "3.000 s to 4.000 s  suture-2: second",
    ]
    assert lines[3].endswith(" s (open)  rest")
    assert main(["info", str(recording), "--json"]) == 0
    told = json.loads(capsys.readouterr().out)["marks"]
    with igtl_gateway.open(recording) as opened:
        assert [(mark.label, mark.time_ns, mark.end_ns) for mark in opened.marks] == [
            (each["label"], each["time_ns"], each["end_ns"]) for each in told
        ]
        assert [mark.label for mark in opened.marks] == LABELS
        part = opened.between("mark:suture-1", "mark:suture-1")
        assert part.duration == 1.0 and [mark.label for mark in part.marks] == LABELS[:2]
        assert opened["TRANSFORM/ToolToBase"].between("mark:slip", "mark:suture-2").count
        with pytest.raises(ConfigError, match=r"start: found no mark 'sutur-1', .*; did you mean 'suture-1'"):
            opened.between("mark:sutur-1")


def test_a_slice_by_a_mark(recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    part = tmp_path / "part.mcap"
    window = ["--start", "mark:suture-2", "--end", "mark:suture-2"]
    assert main(["slice", str(recording), "-o", str(part), *window]) == 0
    assert main(["verify", str(part)]) == 0
    assert main(["slice", str(recording), "-o", str(part), "--start", "mark:sutures"]) == 2
    assert "; did you mean 'suture-2' or 'suture-1'?" in capsys.readouterr().err
    with SessionFile.open(part) as file, SessionFile.open(recording) as whole:
        assert int(file.session["slice_start_ns"]) - whole.start_ns == 3 * S
        assert int(file.session["slice_end_ns"]) - whole.start_ns == 4 * S


@table("seed", range(8))
def test_a_slice_and_parts_keep_what_is_in_them(seed: int, tmp_path: Path) -> None:
    """Each mark of the window is in the slice, and each mark is in one of two parts, or in both if it is a phase."""
    folder, chosen = tmp_path / "parts", Random(seed)
    phases = ("", BEGIN, END)
    made = sorted((chosen.uniform(0, 11.9), chosen.choice("abc"), chosen.choice(phases)) for _ in range(16))
    notes, phases_open = [], OpenPhases()
    for at, label, phase in made:
        noted = MarkNote(label, f"{at}", phase=phase)
        with suppress(ConfigError):  # as an edge refuses it
            phases_open.check(noted)
            notes.append((at, noted))
            phases_open.follow(noted.note())
    entries, config = marked.entries(notes, every=10)
    window, globs = (chosen.uniform(0, 5), chosen.uniform(6, 11.9)), chosen.choice(((), ("TRANSFORM/*",)))
    whole = marked.write(folder.with_suffix(".mcap"), entries)
    kept = _marks(whole)
    start_ns, end_ns = (entries[0].stamp_ns + round(each * S) for each in window)
    part = list(Slice(lambda: entries, config, SliceWindow(start_ns, end_ns, globs)).entries())
    assert verify(part, config).good
    sliced = {(mark.label, mark.time_ns) for mark in _marks(marked.write(folder.with_name("slice.mcap"), part))}
    for mark in kept:
        if start_ns <= mark.time_ns < end_ns or (mark.end_ns and mark.time_ns < start_ns < mark.end_ns):
            assert (mark.label, mark.time_ns) in sliced

    folder.mkdir()
    middle = next(at for at, entry in enumerate(entries) if entry.stamp_ns >= start_ns and entry.kind.is_input)
    prologue = Prologue(StateInputRule())
    for entry in entries[:middle]:
        prologue.observe(entry)
    with SessionFile.open(whole) as file:
        session = file.session
    for number, (some, before) in enumerate(((entries[:middle], []), (entries[middle:], prologue.entries()))):
        writer = SessionWriter(folder / f"p_{number}.mcap", {**session, "part": f"{number}"}, prologue=before)
        for entry in some:
            writer.write(entry)
        writer.close({})
    assert _marks(folder) == kept
    in_parts = {(mark.label, mark.time_ns) for number in (0, 1) for mark in _marks(folder / f"p_{number}.mcap")}
    assert {(mark.label, mark.time_ns) for mark in kept} <= in_parts


def test_what_is_recovered_has_its_marks(recording: Path, tmp_path: Path) -> None:
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(recording.read_bytes()[: recording.stat().st_size * 3 // 4])
    whole = {(mark.label, mark.time_ns) for mark in _marks(recording)}
    recover(cut, tmp_path / "new.mcap")
    assert {(mark.label, mark.time_ns) for mark in _marks(tmp_path / "new.mcap")} <= whole
    with igtl_gateway.open(cut) as opened:
        assert opened.marks == _marks(tmp_path / "new.mcap")


@pytest.mark.parametrize("only_within", [None, True, False])
def test_marks_of_another_time_are_carried_only_where_that_is_asked_for(
    only_within: bool | None, recording: Path, tmp_path: Path
) -> None:
    """A slice has those of its window; what has all entries in another order has all of them."""
    out = tmp_path / "out.mcap"
    out.write_bytes(recording.read_bytes())
    with SessionFile.open(out) as file:
        start_ns, end_ns = file.start_ns, file.end_ns
    added = [
        Mark("before", "", "me", start_ns - 2 * S, None, is_added=True),
        Mark("ended before", "", "me", start_ns - 2 * S, start_ns - 1, is_added=True),
        Mark("into", "", "me", start_ns - 2 * S, start_ns, is_added=True),
        Mark("within", "", "me", start_ns + S, None, is_added=True),
        Mark("last", "", "me", end_ns, end_ns + S, is_added=True),
        Mark("behind", "", "me", end_ns + 1, None, is_added=True),
    ]
    more = {} if only_within is None else {"only_within": only_within}
    carry_marks(out, added, **more)
    found = {mark.label for mark in _marks(out)} - set(LABELS)
    inside = {"into", "within", "last"}
    assert found >= inside and (found == inside) is (only_within is not False)
