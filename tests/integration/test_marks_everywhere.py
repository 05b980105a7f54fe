"""Marks, those of the session and those added later, through every verb that makes or reads recordings."""

from __future__ import annotations

import json
import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import igtl_gateway
from igtl_gateway.addons.merge.merging import Source, merge
from igtl_gateway.addons.merge.offsets import ClockOffset, Piece
from igtl_gateway.base.errors import ConfigError
from igtl_gateway.cli import main
from igtl_gateway.gateway.log.entry import Kind
from igtl_gateway.gateway.log.marks import BEGIN, END, Mark, MarkNote, OpenPhases
from igtl_gateway.gateway.log.note import Note
from igtl_gateway.record.prologue import Prologue
from igtl_gateway.record.selection import StateInputRule
from igtl_gateway.record.sessionfile.added_marks import write_marks
from igtl_gateway.record.sessionfile.merged import Method
from igtl_gateway.record.sessionfile.reader import SessionFile
from igtl_gateway.record.sessionfile.writer import SessionWriter
from igtl_gateway.replay.recorded_marks import marks_of
from tests import marked
from tests.places import FIXTURES
from tests.tables import table

S = 1_000_000_000
NAMES = ("star", "paper-types", "every-type", "acquisition", "lego", "ultrasound", "crtk", "brain")
#: How far the clock of the second recorder is ahead.
AHEAD_NS = 1_700_000_000

_times = st.integers(0, 11_900).map(lambda ms: ms / 1000)
_ago_ms = st.just(0) | st.integers(0, 4_000)
_made = st.lists(st.tuples(_times, st.sampled_from("abc"), st.sampled_from(("", BEGIN, END)), _ago_ms), max_size=12)
_added = st.lists(st.tuples(_times, st.none() | _times, st.sampled_from(("late", "a"))), max_size=4)


def _marks(path: Path) -> tuple[Mark, ...]:
    with SessionFile.open(path) as file:
        return marks_of(file)


def _said(path: Path) -> set[tuple[str, int, int | None]]:
    return {(mark.label, mark.time_ns, None if mark.is_open else mark.end_ns) for mark in _marks(path)}


def _is_in(mark: Mark, start_ns: int, end_ns: int) -> bool:
    return mark.time_ns < end_ns and start_ns <= mark.last_ns


@contextmanager
def _reader() -> Iterator[int]:
    """Context manager: a peer that reads and sends nothing; yields its port."""
    with socket.create_server(("127.0.0.1", 0)) as server:

        def read() -> None:
            peer, _ = server.accept()
            with peer:
                while peer.recv(1 << 16):
                    pass

        thread = threading.Thread(target=read)
        thread.start()
        yield server.getsockname()[1]
        thread.join(20)


def _recording(
    path: Path, made: list[tuple[float, str, str, int]], added: list[tuple[float, float | None, str]]
) -> Path:
    notes, phases = [], OpenPhases()
    for at, label, phase, ago_ms in sorted(made):
        noted = MarkNote(label, f"{at}", phase=phase, ago_ns=min(ago_ms * 1_000_000, round(at * S)))
        with suppress(ConfigError):  # as an edge refuses it
            phases.check(noted)
            notes.append((at, noted))
            phases.follow(noted.note())
    marked.write(path, marked.entries(notes, every=20)[0])
    with SessionFile.open(path) as file:
        start_ns, end_ns = file.start_ns, file.end_ns
    rows = []
    for at, until, label in added:
        at_ns = start_ns + round(at * S)
        until_ns = None if until is None else max(at_ns, start_ns + round(until * S))
        rows.append(Mark(label, "", "", at_ns, until_ns, is_added=True))
    write_marks(path, rows, start_ns, end_ns)
    return path


@given(_made, _added, st.tuples(st.integers(0, 5000), st.integers(6000, 11_900)), st.floats(0.5, 0.99))
@settings(max_examples=5)
def test_marks_survive(
    tmp_path_factory: pytest.TempPathFactory,
    made: list[tuple[float, str, str, int]],
    added: list[tuple[float, float | None, str]],
    window_ms: tuple[int, int],
    left: float,
) -> None:
    folder = tmp_path_factory.mktemp("marks")
    whole = _recording(folder / "whole.mcap", made, added)
    marks = _marks(whole)
    with SessionFile.open(whole) as file:
        start_ns, end_ns = (file.start_ns + each * 1_000_000 for each in window_ms)
        entries, session = list(file.entries()), file.session

    part = folder / "part.mcap"
    times = [f"{each / 1000}" for each in window_ms]
    assert main(["slice", str(whole), "-o", str(part), "--start", times[0], "--end", times[1]]) == 0
    assert main(["verify", str(part)]) == 0
    sliced = {(mark.label, mark.time_ns) for mark in _marks(part)}
    assert {(mark.label, mark.time_ns) for mark in marks if _is_in(mark, start_ns, end_ns)} <= sliced

    other = folder / "crtk.mcap"
    other.symlink_to(FIXTURES / "crtk.mcap")
    both = folder / "both.mcap"
    offset = ClockOffset(Method.GIVEN, (Piece(0, AHEAD_NS),))
    merge([Source("", other), Source("", whole)], both, given={"whole": offset})
    moved = {(label, at - AHEAD_NS, until and until - AHEAD_NS) for label, at, until in _said(whole)}
    assert _said(both) == moved

    cut = folder / "cut.mcap"
    cut.write_bytes(whole.read_bytes()[: int(whole.stat().st_size * left)])
    if (side := whole.with_name("whole.mcap.marks.jsonl")).exists():
        cut.with_name("cut.mcap.marks.jsonl").write_bytes(side.read_bytes())
    assert main(["recover", str(cut), "-o", str(folder / "again.mcap")]) in (0, 1)
    with SessionFile.open(folder / "again.mcap") as file:
        last_ns = file.end_ns
    again = {(mark.label, mark.time_ns) for mark in _marks(folder / "again.mcap")}
    noted = [(entry.stamp_ns, MarkNote.of(Note.of(entry.data()))) for entry in entries if entry.kind is Kind.EDGE_NOTE]
    lost = {(mark.label, at_ns - mark.ago_ns) for at_ns, mark in noted if mark and at_ns > last_ns}
    assert again == {(mark.label, mark.time_ns) for mark in marks if mark.time_ns <= last_ns} - lost

    split = folder / "split"
    split.mkdir()
    middle = next(at for at, entry in enumerate(entries) if entry.stamp_ns >= start_ns and entry.kind.is_input)
    prologue = Prologue(StateInputRule())
    for entry in entries[:middle]:
        prologue.observe(entry)
    for number, (some, before) in enumerate(((entries[:middle], []), (entries[middle:], prologue.entries()))):
        writer = SessionWriter(split / f"split_{number}.mcap", {**session, "part": f"{number}"}, prologue=before)
        for entry in some:
            writer.write(entry)
        writer.close({})
    if side.exists():
        (split / "marks.jsonl").write_bytes(side.read_bytes())
    assert _marks(split) == marks


@table("name", NAMES)
def test_every_verb_on_every_fixture(name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with SessionFile.open(FIXTURES / f"{name}.mcap") as file:
        seconds = (file.end_ns - file.start_ns) / S
    part = seconds / 10
    notes = [
        (part, MarkNote("first", "one", "Kim", BEGIN)),
        (2 * part, MarkNote("first", phase=END)),
        (3 * part, MarkNote("slip", "two")),
    ]
    source = marked.write(tmp_path / "source.mcap", marked.entries(notes, name)[0], name)

    def run(*words: str | Path, codes: tuple[int, ...] = (0,)) -> str:
        capsys.readouterr()
        code = main([str(word) for word in words])
        found = capsys.readouterr()
        assert code in codes, (words, found.err)
        return found.out

    run("mark", source, "--at", "mark:slip", "--until", f"{4 * part}", "--label", "repair")
    labels = ["first", "slip", "repair"]
    run("verify", source)
    assert [mark["label"] for mark in json.loads(run("info", source, "--json"))["marks"]] == labels
    with igtl_gateway.open(source) as opened:
        assert [mark.label for mark in opened.marks] == labels
        assert opened.between("mark:repair", "mark:repair").duration == pytest.approx(part, abs=1e-6)
    for verb, words in {
        "slice": ("--start", "mark:first", "--end", "mark:repair"),
        "recover": (),
        "deidentify": ("--keep-times",),
    }.items():
        out = tmp_path / f"{verb}.mcap"
        run(verb, source, "-o", out, *words)
        assert len(_marks(out)) == 3
        if verb != "recover":
            run("verify", out)
    other = FIXTURES / ("crtk.mcap" if name != "crtk" else "star.mcap")
    run("merge", other, source, "-o", tmp_path / "both.mcap", "--offset", "source=0")
    assert [mark.label for mark in _marks(tmp_path / "both.mcap")] == labels
    assert [mark["label"] for mark in json.loads(run("info", tmp_path / "both.mcap", "--json"))["marks"]] == labels
    with _reader() as port:
        words = ("--to", "igtl", "--connect", f"127.0.0.1:{port}", "--as-fast-as-possible")
        run("replay", source, *words, "--start", "mark:first")
    run("view", source, "-o", tmp_path / "source.rrd", "--no-review")
    run("cohort", "lint", source, "-o", tmp_path / "cohort", codes=(0, 1))
    answer = run("cohort", "query", "SELECT label FROM marks ORDER BY time", "-o", tmp_path / "cohort", "--json")
    assert all(label in answer for label in labels)
