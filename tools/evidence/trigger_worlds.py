"""Random sessions with triggers of the black box, and the judge: every trigger has its windows, or a note why not.

    .venv/bin/python tools/evidence/trigger_worlds.py --triggers 10000 --seed 1

A world is a session of some seconds at 50 messages a second, which goes through the recorder as fast as it can, and
marks at random times, some within 1 ms of the end of a window, and some of an earlier moment.  The manner of a world is
what is in its way: nothing, a slow disk, a disk that is full for a while, a memory that is too small, kill −9 of the
bridge or of the recorder.

The judge has the entries of the session, of a killed bridge those that it had handed over.  A window is complete if a
file has all of them, from its first nanosecond to its last; the file must verify.  A trigger without that must have a
reason: in its row of the ledger, or in a note of the recorder.  No more triggers may be without a row than notes were
dropped, unless the recorder was killed.
"""

from __future__ import annotations

import argparse
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from random import Random
from struct import Struct
from typing import Any
from unittest.mock import patch

from igtl_gateway.base.clock import Clock, SystemClock
from igtl_gateway.base.errors import DamagedRecording, UnsupportedRecording
from igtl_gateway.config.configuration import Config
from igtl_gateway.config.triggers import Trigger, trigger
from igtl_gateway.gateway import LINK_UP, LINKS_TOPIC, Session, make_core
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.gateway.log.marks import MarkNote
from igtl_gateway.gateway.log.note import Level, Note
from igtl_gateway.record import host as hosts
from igtl_gateway.record.host import WorkerHost, in_process, in_thread
from igtl_gateway.record.options import RecordOptions
from igtl_gateway.record.recorder import Recorder
from igtl_gateway.record.selection import StateInputRule
from igtl_gateway.record.sessionfile import layout
from igtl_gateway.record.sessionfile.reader import SessionFile
from igtl_gateway.record.sessionfile.writer import SessionWriter
from igtl_gateway.record.triggers import INCOMPLETE
from igtl_gateway.record.worker import WorkerSettings
from igtl_gateway.replay.verify import DeclaredLosses, verify
from igtl_gateway.wire import Message, encode
from igtl_gateway.wire.text import String

NS = 1_000_000_000
START_NS = 1_700_000_000 * NS
HZ = 50
KEPT_S = 3.0
#: Share of the marks that come up to 5 s late.
LATE = 0.2
RULE_TEXTS = ("mark=a,before=2,after=1", "mark=b,before=0.5,after=0.2", "mark=c,after=0", "mark=d,before=0,after=2.5")
RULES = tuple(map(trigger, RULE_TEXTS))
MANNERS = ("plain", "slow", "full", "small", "kill bridge", "kill recorder")
#: Manners of the small number in the gate.
QUICK = MANNERS[:4]
#: Codes of notes that state why a trigger has no complete window.
_REASONS = ("record_failed", "record_drop")
#: What a reason contains → how the table names it.
_NAMES = {
    "the recorder's process has ended": "the recorder was killed: it is in a note",
    "was not closed": "the recorder was killed: it is in a note",
    "no file: ": "no file, the disk was full: in its row or a note",
    "memory had them no more": "memory had no room for the window: in its row",
    "the disk or the machine was too slow": "entries of the window are missing, the disk or the machine was too slow: "
    "in its row",
    "the recording ended": "the recording ended within the window: in its row",
    "are not in the recording": "they were dropped with other entries: `record_drop` has the count",
}
_RULE = StateInputRule(frozenset({LINKS_TOPIC}))
_SESSION = {"config": "{}"}
_DEADLINE_S = 60.0
#: A bridge that will be killed pauses after this number of entries, s; where it writes how many it has handed over.
_BATCH, _PAUSE_S = 20, 0.005
_FED_NAME, _FED = "fed", Struct("=Q")


@dataclass(slots=True)
class Outcome:
    """The triggers of some worlds, judged.

    Attributes:
        triggers: all of them.
        whole: with complete windows in a file that verifies.
        explained: with a reason.
        silent: with neither, and what is wrong; each is a defect.
        files: that were read.
    """

    triggers: int = 0
    whole: int = 0
    explained: int = 0
    silent: list[str] = field(default_factory=list)
    files: int = 0
    reasons: Counter[str] = field(default_factory=Counter)

    def add(self, other: Outcome) -> None:
        self.triggers += other.triggers
        self.whole += other.whole
        self.explained += other.explained
        self.silent += other.silent
        self.files += other.files
        self.reasons += other.reasons


def trigger_times(chosen: Random, count: int) -> list[tuple[int, Trigger]]:
    """Return times (UTC ns) and rules of triggers, many of them near the end of a window or of its linger."""
    at_ns = START_NS + NS
    found: list[tuple[int, Trigger]] = []
    ends = [at_ns]
    for _ in range(count):
        rule = chosen.choice(RULES)
        match chosen.randrange(4):
            case 0:  # at the end of a window, or where one that begins there ends
                at_ns = chosen.choice(ends[-3:]) + chosen.choice((0, 1, 2)) * NS + chosen.randrange(-(10**6), 10**6)
            case 1:  # a burst
                at_ns = found[-1][0] + chosen.randrange(1, 10**6) if found else at_ns
            case _:
                at_ns = (found[-1][0] if found else at_ns) + chosen.randrange(0, 5 * NS)
        at_ns = max(at_ns, START_NS + 1, found[-1][0] + 1 if found else 0)
        found.append((at_ns, rule))
        ends.append(at_ns + round(rule.after_s * NS))
    return found


def entries_of(chosen: Random, times: Sequence[tuple[int, Trigger]]) -> Iterator[Entry]:
    """Yield a session: one peer that sends strings, and the marks."""
    session = Session(make_core(Config(), fast_path=False))
    up = Note(Level.INFO, LINK_UP, "a peer", data={"peer": "127.0.0.1:1"}).pack()
    yield from session.input(START_NS, Kind.LINK, (up,), links=(1,))
    now_ns, end_ns = START_NS, times[-1][0] + chosen.randrange(0, 6 * NS)
    waiting, padding = list(times), "x" * 2_000
    while now_ns < end_ns or waiting:
        now_ns += NS // HZ + chosen.randrange(-(10**6), 10**6)
        while waiting and waiting[0][0] <= now_ns:
            at_ns, rule = waiting.pop(0)
            ago_ns = chosen.randrange(1, 5 * NS) if chosen.random() < LATE else 0
            note = MarkNote(rule.pattern, f"{at_ns}", ago_ns=ago_ns).note()
            yield from session.input(at_ns, Kind.EDGE_NOTE, (note.pack(),))
        data = encode(Message("STRING", "Chat", String(padding.encode())))
        frame = b"".join(bytes(part) for part in data)
        yield from session.input(
            now_ns, Kind.IGTL_IN, (frame,), channel="STRING/Chat", type_name="STRING", links=(1,), source_ns=now_ns
        )


def options_of(manner: str) -> RecordOptions:
    small = manner == "small"
    return RecordOptions(
        snapshot_s=KEPT_S,
        triggers=RULES,
        snapshot_bytes=(150 << 10) if small else 64 << 20,
        queue_entries=300 if manner == "slow" else 200_000,
    )


@contextmanager
def obstacle(manner: str, chosen: Random, now: Callable[[], float]) -> Iterator[None]:
    """Context manager: what is in the way of the files of this process.

    Args:
        now: returns which part of the session has passed, 0 to 1.
    """
    real, start = SessionWriter.write, SessionWriter.__init__
    first = chosen.random() * 0.8
    last = first + chosen.random() * 0.4

    def slow(writer: SessionWriter, entry: Entry) -> None:
        if chosen.random() < 0.0005:
            time.sleep(0.1)
        real(writer, entry)

    def refused() -> OSError:
        return OSError(28, os.strerror(28))

    def full(writer: SessionWriter, entry: Entry) -> None:
        if first < now() < last:
            raise writer._failed(refused())
        real(writer, entry)

    def begin(writer: SessionWriter, *args: object, **more: object) -> None:
        if first < now() < last and chosen.random() < 0.7:
            raise refused()
        start(writer, *args, **more)  # type: ignore[arg-type]

    with ExitStack() as stack:
        if manner == "slow":
            stack.enter_context(patch.object(SessionWriter, "write", slow))
        if manner == "full":
            stack.enter_context(patch.object(SessionWriter, "write", full))
            stack.enter_context(patch.object(SessionWriter, "__init__", begin))
        yield


def _noting(found: list[int]) -> hosts.Host:
    """Return a host that adds the number of the recorder's process."""

    def host(settings: WorkerSettings, clock: Clock) -> WorkerHost:
        start = hosts._start

        def noted(options: RecordOptions) -> Any:
            child, *rest = start(options)
            found.append(child.pid)
            return child, *rest

        with patch.object(hosts, "_start", noted):
            return in_process(settings, clock)

    return host


def play(folder: Path, manner: str, seed: int, count: int, clock: Clock) -> tuple[list[Note], list[Entry], int]:
    """Record a world in this process; return the recorder's notes, all entries, and the number of dropped marks."""
    chosen = Random(seed)
    times = trigger_times(chosen, count)
    entries = list(entries_of(chosen, times))
    notes: list[Note] = []
    fed, processes = 0, list[int]()
    recorder = Recorder(
        folder / "box.mcap", _SESSION, qos_of=lambda _topic, _type: None, on_note=notes.append, clock=clock,
        options=options_of(manner), rule=_RULE, host=_noting(processes) if manner.startswith("kill") else in_thread,
    )  # fmt: skip
    at = 0.3 + 0.7 * chosen.random() if manner == "kill recorder" else 2.0
    with obstacle(manner, chosen, lambda: fed / len(entries)):
        for fed, entry in enumerate(entries):
            recorder(entry)
            if fed / len(entries) >= at:
                at = 2.0
                time.sleep(chosen.random() * 0.05)
                os.kill(processes[0], signal.SIGKILL)
            elif fed % 100 == 0:
                time.sleep(chosen.random() * 0.02)  # the recorder comes near
        summary = recorder.close({"streams": {}})
    return notes, entries, summary.dropped.get(Kind.EDGE_NOTE.value, 0)


def judge(
    folder: Path,
    notes: Sequence[Note],
    entries: Sequence[Entry],
    dropped: int | None,
) -> Outcome:
    """Return how each trigger ended.

    Args:
        folder: has the files.
        notes: of the recorder.
        entries: of the session.
        dropped: marks that were, and so have not triggered; None: unknown, the recorder was killed.
    """
    outcome = Outcome()
    rows: list[tuple[dict[str, object], Path, set[int]]] = []
    reasons_of_notes = "; ".join(note.text for note in notes if note.code in _REASONS)
    rows += [(row, Path(), set()) for note in notes for row in note.data.get("triggers", ()) if note.code == INCOMPLETE]
    for path in sorted(folder.glob("*.mcap")):
        try:
            with SessionFile.open(path) as file:
                content = list(file.entries())
                ledger = file.ledger or {}
                report = verify(content, Config(), DeclaredLosses.of(file.session, file.ledger), before=file.prologue())
        except (DamagedRecording, UnsupportedRecording):  # also one that is still empty
            reasons_of_notes += f"; {path.name} was not closed"
            continue
        outcome.files += 1
        if not report.good:
            outcome.silent.append(f"{path.name} does not verify: {report.differences[:1]}")
        numbers = {entry.seq for entry in content}
        rows += [(row, path, numbers) for row in ledger.get(layout.TRIGGERS_KEY, ())]
    unseen = 0
    for entry in entries:
        if entry.kind is not Kind.EDGE_NOTE:
            continue
        mark = MarkNote.of(Note.of(entry.data()))
        assert mark
        rule = next(rule for rule in RULES if rule.pattern == mark.label)
        outcome.triggers += 1
        unseen += not _judge_one(entry, entry.stamp_ns - mark.ago_ns, rule, rows, entries, reasons_of_notes, outcome)
    if dropped is not None and unseen > dropped:
        outcome.silent.append(f"{unseen} triggers without a row, though {dropped} marks were dropped")
    return outcome


def _judge_one(
    entry: Entry,
    at_ns: int,
    rule: Trigger,
    rows: Sequence[tuple[dict[str, object], Path, set[int]]],
    entries: Sequence[Entry],
    reasons_of_notes: str,
    outcome: Outcome,
) -> bool:
    """Judge a trigger; return whether there is a row of it."""
    begin_ns, end_ns = at_ns - round((rule.before_s or 0) * NS), at_ns + round(rule.after_s * NS)
    if rule.before_s is None:  # all that memory has
        begin_ns = min(begin_ns, entry.stamp_ns - round(KEPT_S * NS))
    own = [each for each in rows if each[0]["rule"] == str(rule) and each[0]["at_ns"] <= at_ns <= each[0]["last_ns"]]  # type: ignore[operator]
    wrong = ""
    for row, path, numbers in own:
        if not row["missing"] and entry.seq in numbers:  # else it is of a mark that has not come late
            lacking = [each.seq for each in entries if begin_ns <= each.stamp_ns <= end_ns and each.seq not in numbers]
            if not lacking:
                outcome.whole += 1
                return True
            wrong = f"{path.name}: {rule} at {at_ns}: complete, but entries {lacking[:3]} … of {len(lacking)} lack"
    explained = next((str(row["missing"]) for row, _, _ in own if row["missing"]), "")
    if not own:  # the recorder did not see it, or its file was not closed
        explained = reasons_of_notes
    if explained and not wrong:
        outcome.explained += 1
        outcome.reasons[next((name for part, name in _NAMES.items() if part in explained), explained)] += 1
    else:
        outcome.silent.append(wrong or f"{rule} at {at_ns}: no file and no note")
    return bool(own)


def world(manner: str, seed: int, count: int) -> Outcome:
    """Play a world in a temporary folder, and judge it."""
    with tempfile.TemporaryDirectory(prefix="igtl-worlds-") as name:
        folder = Path(name)
        if manner != "kill bridge":
            notes, entries, dropped = play(folder, manner, seed, count, SystemClock())
            return judge(folder, notes, entries, None if manner == "kill recorder" else dropped)
        words = [sys.executable, __file__, "--play", str(folder), "--seed", str(seed), "--triggers", str(count)]
        with subprocess.Popen(words, stdout=subprocess.PIPE, text=True) as bridge:
            assert bridge.stdout
            chosen = Random(seed)
            entries = list(entries_of(chosen, trigger_times(chosen, count)))
            recorder = int(bridge.stdout.readline())
            time.sleep(Random(seed).random() * len(entries) / _BATCH * _PAUSE_S)
            bridge.kill()
        deadline = time.monotonic() + _DEADLINE_S
        while Path(f"/proc/{recorder}/stat").exists() and time.monotonic() < deadline:
            if Path(f"/proc/{recorder}/stat").read_text().rpartition(") ")[2].startswith("Z"):
                break
            time.sleep(0.02)
        (fed,) = _FED.unpack((folder / _FED_NAME).read_bytes())
        return judge(folder, (), entries[:fed], 0)


def run(triggers: int, seed: int, manners: Sequence[str] = MANNERS, each: int = 80) -> Outcome:
    """Play worlds until they have that many triggers."""
    outcome = Outcome()
    number = 0
    while outcome.triggers < triggers:
        outcome.add(world(manners[number % len(manners)], seed + number, min(each, triggers - outcome.triggers)))
        number += 1
        if outcome.silent:
            outcome.silent[-1] += f" (manner {manners[(number - 1) % len(manners)]}, seed {seed + number - 1})"
            break
    return outcome


def _play_until_killed(folder: Path, seed: int, count: int) -> None:
    chosen = Random(seed)
    entries = list(entries_of(chosen, trigger_times(chosen, count)))
    processes = list[int]()
    recorder = Recorder(
        folder / "box.mcap", _SESSION, qos_of=lambda _topic, _type: None, on_note=lambda _note: None,
        clock=SystemClock(), options=options_of("kill bridge"), rule=_RULE, host=_noting(processes),
    )  # fmt: skip
    file = (folder / _FED_NAME).open("wb", buffering=0)
    file.write(_FED.pack(0))
    print(processes[0], flush=True)
    for number, entry in enumerate(entries, 1):
        recorder(entry)
        os.pwrite(file.fileno(), _FED.pack(number), 0)
        if number % _BATCH == 0:
            time.sleep(_PAUSE_S)
    time.sleep(_DEADLINE_S)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--triggers", type=int, default=1_000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--manner", choices=MANNERS, action="append")
    parser.add_argument("--play", type=Path, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.play:
        _play_until_killed(options.play, options.seed, options.triggers)
        return 0
    found = run(options.triggers, options.seed, options.manner or MANNERS)
    print("| triggers | how they ended |", "| --- | --- |", sep="\n")
    print(f"| {found.whole:,} | all of their windows in {found.files:,} files, which verify |")
    for reason, number in found.reasons.most_common():
        print(f"| {number:,} | {reason} |")
    print(f"| {len(found.silent)} | without file and without reason |")
    print(*found.silent, sep="\n")
    return bool(found.silent)


if __name__ == "__main__":
    sys.exit(main())
