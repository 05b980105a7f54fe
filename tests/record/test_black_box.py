"""The black box: its windows, and what its files state."""

from __future__ import annotations

import os
import signal
from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import pytest

from igtl_gateway.base.buffers import join
from igtl_gateway.base.clock import ManualClock, SystemClock
from igtl_gateway.base.quantities import duration_text
from igtl_gateway.cli import main
from igtl_gateway.config.triggers import trigger
from igtl_gateway.convert.common_msgs import DiagnosticArray
from igtl_gateway.convert.rosmsg import DiagnosticStatus, Header
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.gateway.log.marks import MarkNote
from igtl_gateway.gateway.log.note import Level, Note
from igtl_gateway.record.black_box import MAX_PER_MINUTE, BlackBox
from igtl_gateway.record.host import in_thread
from igtl_gateway.record.options import RecordOptions
from igtl_gateway.record.prologue import Prologue
from igtl_gateway.record.recorder import Recorder
from igtl_gateway.record.reports import FAILED
from igtl_gateway.record.sessionfile.reader import SessionFile
from igtl_gateway.record.sessionfile.schemas import RosTypes
from igtl_gateway.record.sessionfile.writer import SessionWriter
from igtl_gateway.record.triggers import INCOMPLETE, SAVED, TRIGGERED, Triggers
from igtl_gateway.wire import Message, encode
from igtl_gateway.wire.text import Status
from tests.record import samples
from tests.record.notes import TimelessNotes
from tests.record.test_parts import RULE, session, wait_until
from tests.record.test_recorder import workers
from tests.tables import table
from tools.evidence import aborted_goals
from tools.evidence.trigger_worlds import QUICK, run

NS = 1_000_000_000


def _status(code: int) -> Entry:
    return Entry(1, 7, Kind.IGTL_IN, "STATUS/Arm", "STATUS", (join(encode(Message("STATUS", "Arm", Status(code)))),))


def _play(path: Path, entries: list[Entry], *rules: str) -> list[Note]:
    notes: list[Note] = []
    recorder = Recorder(
        path, samples.SESSION, qos_of=lambda _topic, _type: None, on_note=notes.append, clock=ManualClock(),
                options=RecordOptions(snapshot_s=2.0, triggers=tuple(map(trigger, rules))), rule=RULE, host=in_thread,
    )  # fmt: skip
    for entry in entries:
        recorder(entry)
    recorder.close({"streams": {}})
    return notes


def _with_marks(*seconds: float, labels: str = "slip", late_s: float = 0) -> list[Entry]:
    """A session of 10 s with marks, which come late."""
    names = iter(labels.split() * len(seconds))
    found: list[Entry] = []
    waiting = [samples.START_NS + round(each * NS) for each in seconds]
    for entry in session(10):
        while waiting and waiting[0] <= entry.stamp_ns and entry.kind.is_input:
            note = MarkNote(next(names), ago_ns=round(late_s * NS)).note()
            found.append(Entry(0, waiting.pop(0), Kind.EDGE_NOTE, payload=(note.pack(),)))
        found.append(entry)
    return [
        Entry(number, each.stamp_ns, each.kind, each.channel, each.type, each.payload, each.links, each.source_ns)
        for number, each in enumerate(found, 1)
    ]


@table(
    ("seconds", "spans"),
    [
        ((3.0,), [(1.0, 4.0)]),  # two seconds before, one after
        ((3.0, 3.5), [(1.0, 4.5)]),  # within: extended
        ((3.0, 5.9), [(1.0, 6.9)]),  # its own window begins within the first
        ((3.0, 6.3), [(1.0, 4.0), (4.3, 7.3)]),  # apart
        ((0.5,), [(0.0, 1.5)]),
    ],
)
def test_windows_that_overlap_are_one_file(
    seconds: tuple[float, ...], spans: list[tuple[float, float]], tmp_path: Path
) -> None:
    entries = _with_marks(*seconds)
    notes = _play(tmp_path / "box.mcap", entries, "mark=slip,after=1")
    assert [note.code for note in notes if note.code != TRIGGERED] == [SAVED] * len(spans)
    found = sorted(tmp_path.glob("*.mcap"))
    assert len(found) == len(spans)
    for path, (first, last) in zip(found, spans, strict=True):
        with SessionFile.open(path) as file:
            content = list(file.entries())
            rows = file.ledger["triggers"] if file.ledger else []
        begin, end = (samples.START_NS + round(each * NS) for each in (first, last))
        numbers = [each.seq for each in content]
        assert numbers == list(range(numbers[0], numbers[-1] + 1)), "nothing lacks"
        assert {each.seq for each in entries if begin <= each.stamp_ns <= end} <= set(numbers)
        assert content[0].stamp_ns >= begin and content[-1].stamp_ns <= end + 100
        assert rows and not any(row["missing"] for row in rows)


def test_no_more_files_than_the_bound_begin_in_a_minute(tmp_path: Path) -> None:
    moments = [0.5 + number / 20 for number in range(180)]
    entries = _with_marks(*moments)
    _play(tmp_path / "box.mcap", entries, "mark=slip,before=0,after=0.001")
    found = sorted(tmp_path.glob("*.mcap"))
    assert MAX_PER_MINUTE <= len(found) <= MAX_PER_MINUTE + 1
    count = 0
    for path in found:
        with SessionFile.open(path) as file:
            rows = file.ledger["triggers"] if file.ledger else []
            count += sum(row["count"] for row in rows)
            assert not any(row["missing"] for row in rows)
        assert main(["verify", str(path)]) == 0
    assert count == len(moments), "each has its window"


@table(
    ("seconds", "first", "last"),
    [
        ((3.0,), 2.5, 4.0),  # not all that memory has, which is two seconds
        ((3.0, 3.2), 1.2, 4.2),  # the second rule wants all: the file is written again
        ((3.0, 4.3), 2.3, 5.3),  # also after the end of the first window
        ((3.0, 6.2), 2.5, 4.0),  # apart
    ],
)
def test_a_file_begins_with_the_window(seconds: tuple[float, ...], first: float, last: float, tmp_path: Path) -> None:
    entries = _with_marks(*seconds, labels="short long")
    _play(tmp_path / "box.mcap", entries, "mark=short,before=0.5,after=1", "mark=long,after=1")
    path = min(tmp_path.glob("*.mcap"))
    with SessionFile.open(path) as file:
        content = list(file.entries())
        assert file.ledger and not any(row["missing"] for row in file.ledger["triggers"])
        prologue = file.prologue()
    begin, end = (samples.START_NS + round(each * NS) for each in (first, last))
    assert {each.seq for each in content} == {
        each.seq for each in entries if begin <= each.stamp_ns <= end + 100 and each.seq <= content[-1].seq
    }
    assert begin <= content[0].stamp_ns < begin + NS // 5 and end - NS // 5 < content[-1].stamp_ns
    assert prologue and prologue[-1].stamp_ns < begin, "what the window needs of the time before it"
    assert main(["verify", str(path)]) == 0


@table(
    ("seconds", "late_s", "rule", "first", "missing"),
    [
        ((5.0,), 1.2, "mark=slip,before=0.5,after=0.3", 3.3, ""),
        ((5.0,), 1.2, "mark=slip,before=1.5,after=0.3", 3.0, "650 ms of its window: memory had them no more"),
        ((5.0,), 1.2, "mark=slip,after=0.3", 3.0, ""),  # all that memory has
        ((5.0,), 2.5, "mark=slip,after=0.3", 3.0, "300 ms of its window: memory had them no more"),
        ((5.0,), 4.0, "mark=slip,before=0.5,after=0.3", 3.0, "800 ms of its window: memory had them no more"),
        ((5.0, 5.1), 1.2, "mark=slip,before=0.5,after=0.3", 3.3, ""),
    ],
)
def test_a_mark_that_comes_late_has_the_window_of_its_moment(
    seconds: tuple[float, ...],
    late_s: float,
    rule: str,
    first: float,
    missing: str,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    _play(tmp_path / "box.mcap", _with_marks(*seconds, late_s=late_s), rule)
    (path,) = tmp_path.glob("*.mcap")
    with SessionFile.open(path) as file:
        content = [(entry.stamp_ns - samples.START_NS) / NS for entry in file.entries()]
        (row,) = file.ledger["triggers"] if file.ledger else []
    assert first <= content[0] < first + 0.1
    assert content[-1] == pytest.approx(seconds[-1]), "it goes on to the mark"
    assert (row["missing"], row["at_ns"]) == (missing, samples.START_NS + round((5.0 - late_s) * NS))
    assert main(["info", str(path)]) == 0
    assert f"mark slip ({duration_text(late_s * 1e9)} before)" in capsys.readouterr().out


@table(
    ("after", "missing"),
    [
        (2.8, 0),  # the window is 3 s to 6 s
        (2.9, 2),  # what is missing may have been at its begin
        (4.0, 2),
        (6.0, 2),  # ... or at its end
        (6.1, 0),
    ],
)
def test_a_gap_that_touches_the_window_is_in_its_row(after: float, missing: int, tmp_path: Path) -> None:
    """Entries every 100 ms; two are missing behind the one at ``after``."""
    entries, seq = list[Entry](), 0
    for number in range(100):
        seq += 1
        entries.append(replace(samples.igtl(seq), stamp_ns=samples.START_NS + number * NS // 10))
        if number == 50:
            seq += 1
            payload = (MarkNote("slip").note().pack(),)
            entries.append(Entry(seq, entries[-1].stamp_ns, Kind.EDGE_NOTE, payload=payload))
        seq += 2 * (number == round(after * 10))
    _play(tmp_path / "box.mcap", entries, "mark=slip,before=2,after=1")
    (path,) = tmp_path.glob("*.mcap")
    with SessionFile.open(path) as file:
        (row,) = file.ledger["triggers"] if file.ledger else []
    assert row["missing"] == ("2 entries: the disk or the machine was too slow" if missing else "")


def test_info_states_why_the_file_is_there(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    _play(tmp_path / "box.mcap", _with_marks(3.0, 3.5, 9.9), "mark=slip,after=1")
    first, last = sorted(tmp_path.glob("*.mcap"))
    assert main(["info", str(first)]) == 0
    text = capsys.readouterr().out
    assert "  black box by mark slip: mark slip\n" in text
    assert "2.000 s, 2 times  mark slip: mark slip\n" in text
    assert main(["info", str(last)]) == 0
    assert "INCOMPLETE: 900 ms after it: the recording ended" in capsys.readouterr().out
    assert main(["verify", str(first)]) == 0


def test_info_lists_triggers_by_their_time(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    entries = _with_marks(5.0, labels="slip")
    late = MarkNote("late", ago_ns=6 * NS).note()
    entries.append(Entry(len(entries) + 1, entries[-1].stamp_ns + 1, Kind.EDGE_NOTE, payload=(late.pack(),)))
    _play(tmp_path / "box.mcap", entries, "mark=slip,after=9", "mark=late,after=1")
    (path,) = tmp_path.glob("*.mcap")
    assert main(["info", str(path)]) == 0
    lines = capsys.readouterr().out.partition("  triggers\n")[2].splitlines()[:2]
    assert [line.split()[3] for line in lines] == ["late:", "slip:"]


@pytest.mark.parametrize("is_open", [False, True], ids=["no window", "a window"])
def test_a_killed_recorder_leaves_a_file_that_is_named(is_open: bool, tmp_path: Path) -> None:
    notes = TimelessNotes()
    recorder = Recorder(
        tmp_path / "box.mcap", samples.SESSION, qos_of=lambda _topic, _type: None, on_note=notes.append, rule=RULE,
        clock=SystemClock(), options=RecordOptions(snapshot_s=20.0, triggers=(trigger("mark=slip,after=60"),)),
    )  # fmt: skip
    for entry in _with_marks(*[3.0] * is_open):
        recorder(entry)
    if is_open:
        wait_until(lambda: bool(recorder._state.window))
    (worker,) = workers(os.getpid())
    os.kill(worker, signal.SIGKILL)
    wait_until(lambda: any(note.code == FAILED for note in notes))
    files = tuple(tmp_path.glob("*.mcap"))
    end = f"igtl-gateway recover repairs {files[0]}" if is_open else "what was in memory is lost"
    assert notes[-1].text.endswith(f"; {end}")
    summary = recorder.close({})
    assert len(files) == is_open and summary.files == files
    assert summary.size == sum(path.stat().st_size for path in files)


_TWO = (trigger("mark=slip,after=1"), trigger("mark=late,before=1,after=60"))


@pytest.mark.parametrize(
    ("options", "count"),
    [
        pytest.param(RecordOptions(snapshot_s=20.0, triggers=_TWO), 2, id="a closed and an open window"),
        pytest.param(RecordOptions(snapshot_s=20.0), 1, id="a snapshot"),
        pytest.param(RecordOptions(split_s=3.0), 5, id="parts, and their side file"),
        pytest.param(RecordOptions(), 2, id="a file that was stopped, and the next one"),
    ],
)
def test_the_summary_of_a_killed_recorder_has_the_files_that_are_there(
    options: RecordOptions, count: int, tmp_path: Path
) -> None:
    notes = TimelessNotes()
    recorder = Recorder(
        tmp_path / "box.mcap", samples.SESSION, qos_of=lambda _topic, _type: None, on_note=notes.append, rule=RULE,
        clock=SystemClock(), options=options,
    )  # fmt: skip
    entries = _with_marks(2.0, 8.0, labels="slip late")
    for entry in entries[:-1]:
        recorder(entry)
    if options.snapshot_s and not options.triggers:
        recorder.snapshot().result(20)
    elif not (options.snapshot_s or options.split_s):
        recorder.stop().result(20)
        recorder.start()
    recorder(entries[-1])

    def found() -> set[Path]:
        return {path for path in tmp_path.rglob("*") if path.is_file()}

    wait_until(lambda: len(found()) == count and len(recorder._files) >= count - bool(options.split_s))
    (worker,) = workers(os.getpid())
    os.kill(worker, signal.SIGKILL)
    wait_until(lambda: any(note.code == FAILED for note in notes))
    summary = recorder.close({})
    assert set(summary.files) == found() and len(summary.files) == count
    assert summary.size == sum(path.stat().st_size for path in found())
    assert summary.path == tmp_path / ("box" if options.split_s else "box.mcap")


def test_notes_about_the_end_of_the_recorder_are_no_losses(tmp_path: Path) -> None:
    """The bridge hands each note over as an entry."""
    entries = _with_marks(9.99)
    notes: list[Note] = []

    def on_note(note: Note) -> None:
        notes.append(note)
        number = len(entries) + len(notes)
        recorder(Entry(number, entries[-1].stamp_ns + number, Kind.EDGE_NOTE, payload=(note.pack(),)))

    recorder = Recorder(
        tmp_path / "box.mcap", samples.SESSION, qos_of=lambda _topic, _type: None, on_note=on_note, clock=ManualClock(),
        options=RecordOptions(snapshot_s=2.0, triggers=(trigger("mark=slip,after=1"),)), rule=RULE, host=in_thread,
    )  # fmt: skip
    for entry in entries:
        recorder(entry)
    summary = recorder.close({"streams": {}})
    assert [note.code for note in notes] == [TRIGGERED, INCOMPLETE] and not summary.dropped


def box(folder: Path, notes: list[Note], clock: ManualClock, seconds: float) -> Recorder:
    """A black box that a mark triggers, with a second after it."""
    return Recorder(
        folder / "box.mcap", samples.SESSION, qos_of=lambda _topic, _type: None, on_note=notes.append, clock=clock,
        options=RecordOptions(snapshot_s=seconds, triggers=(trigger("mark=slip,after=1"),)), rule=RULE, host=in_thread,
    )  # fmt: skip


def test_a_window_ends_where_nothing_comes(tmp_path: Path) -> None:
    notes: list[Note] = []
    clock = ManualClock()
    recorder = box(tmp_path, notes, clock, seconds=2.0)
    for entry in _with_marks(9.99)[:-1]:
        recorder(entry)

    def saved() -> bool:
        clock.advance(NS // 10)
        return any(note.code == SAVED for note in notes)

    wait_until(saved)
    recorder.close({})


@table(
    ("late", "codes"),
    [
        (NS // 2, [SAVED, INCOMPLETE]),  # of the window of the file that is closed
        (2 * NS, [SAVED]),
    ],
)
def test_what_comes_after_its_file_was_closed_is_told(late: int, codes: list[str], tmp_path: Path) -> None:
    notes: list[Note] = []
    clock = ManualClock()
    recorder = box(tmp_path, notes, clock, seconds=2.0)
    entries = _with_marks(9.99)
    for entry in entries:
        recorder(entry)

    def saved() -> bool:
        clock.advance(NS // 10)
        return any(note.code == SAVED for note in notes)

    wait_until(saved)
    last = entries[-1]
    recorder(Entry(last.seq + 1, last.stamp_ns + late, Kind.IGTL_IN, "STATUS/Arm", "STATUS", _status(1).payload))
    recorder.close({})
    assert [note.code for note in notes if note.code != TRIGGERED] == codes


class Looks(deque[Entry]):
    """Memory that counts how often it is looked through from its begin."""

    passes = 0

    def __iter__(self) -> Iterator[Entry]:
        self.passes += 1
        return super().__iter__()


def _memory(folder: Path, rule: str, files: list[Path]) -> tuple[BlackBox, Looks]:
    """A black box with a session of 10 s in memory."""
    types, rules = RosTypes(), (trigger(rule),)

    def open_file(path: Path, facts: dict[str, str], prologue: Sequence[Entry]) -> SessionWriter:
        files.append(path)
        return SessionWriter(path, facts, qos_of=lambda _topic, _type: None, prologue=prologue, types=types)

    found = BlackBox(
        folder / "box.mcap", open_file, Prologue(RULE), seconds=20, max_bytes=1 << 30, rules=rules,
        triggers=Triggers(rules, types), clock=ManualClock(), counters=dict, on_note=lambda _note: None,
    )  # fmt: skip
    found._entries = looks = Looks()
    for entry in session(10):
        found.write(entry)
    looks.passes = 0
    return found, looks


def test_a_message_that_triggers_a_thousand_times_looks_through_memory_as_one_that_does_once(tmp_path: Path) -> None:
    counts = []
    for number in (1, 1_000):
        found, looks = _memory(tmp_path, "diagnostics", [])
        statuses = tuple(DiagnosticStatus(2, f"motor {each}", "hot") for each in range(number))
        cdr = DiagnosticArray(Header(), statuses).pack()
        found.write(
            Entry(10_000, samples.START_NS + 10 * NS, Kind.ROS_IN, "/diagnostics", DiagnosticArray.TYPE, (cdr,))
        )
        counts.append(looks.passes)
        found.close({})
    assert counts[0] == counts[1]


def test_marks_of_ever_earlier_moments_have_the_file_written_again_twice(tmp_path: Path) -> None:
    files: list[Path] = []
    found, _ = _memory(tmp_path, "mark=slip,before=0.1,after=1", files)
    first_ns = found._entries[0].stamp_ns
    for number in range(1, 51):
        note = MarkNote("slip", ago_ns=number * NS // 10).note()
        found.write(Entry(10_000 + number, samples.START_NS + 10 * NS + number, Kind.EDGE_NOTE, payload=(note.pack(),)))
    found.close({})
    assert len(files) == 3
    (path,) = tmp_path.glob("*.mcap")
    with SessionFile.open(path) as file:
        assert next(file.entries()).stamp_ns == first_ns, "the second time with all that memory has"
        assert file.ledger and not any(row["missing"].startswith("5") for row in file.ledger["triggers"])


@pytest.mark.parametrize("comes_back", [False, True], ids=["missing", "in time"])
def test_a_file_that_is_missing_is_a_failure_of_the_bridge(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, comes_back: bool
) -> None:
    refuses = True
    start = SessionWriter.__init__

    def begin(writer: SessionWriter, *words: object, **more: object) -> None:
        if refuses:
            raise OSError(28, "No space left on device")
        start(writer, *words, **more)  # type: ignore[arg-type]

    monkeypatch.setattr(SessionWriter, "__init__", begin)
    notes: list[Note] = []
    clock = ManualClock()
    recorder = box(tmp_path, notes, clock, seconds=20.0)
    for entry in _with_marks(3.0):
        recorder(entry)
        if not recorder.failure and entry.stamp_ns > samples.START_NS + 4 * NS and refuses:
            wait_until(lambda: "No space left" in recorder.failure)
            refuses = not comes_back
            clock.advance(2 * NS)
    summary = recorder.close({"streams": {}})
    if comes_back:
        assert (summary.failure, recorder.failure, len(summary.files)) == ("", "", 1)
    else:
        assert summary.failure.startswith("black box, mark slip: no file: ") and not summary.files


def _silent(count: int, manners: tuple[str, ...]) -> None:
    found = run(count, 1, manners, each=count // 4)
    assert found.triggers == count and not found.silent, found.silent


def test_no_trigger_is_lost_silently() -> None:
    _silent(32, QUICK)


@pytest.mark.slow
def test_no_trigger_is_lost_silently_with_kills() -> None:
    _silent(60, ("kill bridge", "kill recorder"))


@pytest.mark.parametrize("inputs", [0, 40])
def test_a_file_begins_with_an_input_also_where_an_output_triggers(inputs: int, tmp_path: Path) -> None:
    """An output would have no cause there; without any input, the file begins with what there is."""
    found, _ = _memory(tmp_path, "guard,before=0,after=1", [])
    kept = list(found._entries)[:inputs]
    found._entries = Looks(kept)
    last = next((entry.seq for entry in reversed(kept) if entry.kind.is_input), 500)
    stamp_ns = kept[-1].stamp_ns + 5 if kept else samples.START_NS
    note = Note(Level.WARN, "stale", "old", "TRANSFORM/a")
    found.write(Entry(500, stamp_ns, Kind.NOTE, payload=(note.pack(),)))
    assert found._window and found._window.first == last
    found.close({})


def test_a_file_whose_time_is_over_lacks_nothing_also_where_the_rest_is_not_recorded(tmp_path: Path) -> None:
    """The numbers go on with entries of streams that are left out: the recording has not ended."""
    found, _ = _memory(tmp_path, "mark=slip,before=1,after=1", [])
    notes: list[Note] = []
    found._on_note = notes.append
    last = found._entries[-1]
    found.write(Entry(last.seq + 1, last.stamp_ns + 1, Kind.EDGE_NOTE, payload=(MarkNote("slip").note().pack(),)))
    message = samples.igtl_bytes("TRANSFORM", "Left", 1, bytes(48))
    found.saw(Entry(last.seq + 2, last.stamp_ns + 100 * NS, Kind.IGTL_IN, "TRANSFORM/Left", "TRANSFORM", (message,)))
    assert [note.code for note in notes] == [TRIGGERED, SAVED]


@table(("aborts", "seed"), [(100, 1), (1_000, 2)], gate=lambda aborts, seed: aborts < 1_000)
def test_an_aborted_goal_has_one_file_with_what_led_to_it(aborts: int, seed: int) -> None:
    found = aborted_goals.run(aborts, seed)
    assert (found.wrong, found.whole, found.aborts) == ([], aborts, aborts)
