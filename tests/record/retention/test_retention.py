"""Retention: what it deletes, what it never touches, and what a wrong clock does."""

from __future__ import annotations

import fcntl
import json
import os
import random
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
from rosbags.rosbag2 import Reader

from igtl_gateway.base.clock import ManualClock, SystemClock
from igtl_gateway.base.errors import ConfigError
from igtl_gateway.config.configuration import Config
from igtl_gateway.config.notations import RetentionRule, retention
from igtl_gateway.gateway.log.note import Note
from igtl_gateway.record.host import in_process
from igtl_gateway.record.options import RecordOptions
from igtl_gateway.record.recorder import Recorder
from igtl_gateway.record.retention.retention import Retention, choose
from igtl_gateway.record.retention.retention_log import LOG_NAME
from igtl_gateway.record.retention.stored import RecordingFolder, StoredFiles, StoredRecording
from igtl_gateway.record.seal.keys import SigningKey
from igtl_gateway.record.sessionfile.reader import SessionFile
from igtl_gateway.replay.verify import DeclaredLosses, verify
from tests.places import ROOT
from tests.record import samples
from tests.record.test_parts import RULE, record, session, streams
from tests.tables import table

DAY_NS = 86_400 * 10**9
NOW_NS = 1_800_000_000 * 10**9


@pytest.fixture(scope="module")
def models(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A file ``one.mcap`` and a folder ``long`` of parts."""
    folder = tmp_path_factory.mktemp("models")
    record(folder / "one.mcap", session(1))
    record(folder / "long.mcap", session(4), split_s=1.0)
    return folder


@pytest.fixture
def folder(tmp_path: Path, models: Path) -> Path:
    """Recordings of 40, 20 and 1 day, a split one of 50 to 46 days, and files that are not recordings."""
    place = tmp_path / "recordings"
    shutil.copytree(models / "long", place / "long")
    for number, path in enumerate(sorted((place / "long").glob("*.mcap"))):
        age(path, 50 - number)
    for name, days in (("old.mcap", 40.0), ("ältere\u202e Aufnahme", 20.0), ("new.mcap", 1.0)):
        age(shutil.copy(models / "one.mcap", place / name), days)
    data = (models / "one.mcap").read_bytes()
    for name, content in (
        ("foreign.mcap", b"not a recording"),
        ("empty.mcap", b""),
        ("open.mcap", data[:-200]),
        ("odd.mcap", bytes(random.Random(1).randbytes(1000))),
        (".hidden.mcap", data),
        ("notes.txt", b"mine"),
    ):
        age(write(place / name, content), 900)
    (tmp_path / "elsewhere.mcap").write_bytes(data)
    age(tmp_path / "elsewhere.mcap", 900)
    (place / "link.mcap").symlink_to(tmp_path / "elsewhere.mcap")
    (place / "linked").symlink_to(tmp_path)
    os.mkfifo(place / "fifo.mcap")
    (place / "a" / "b").mkdir(parents=True)
    age(write(place / "a" / "b" / "deep.mcap", data), 900)
    return place


class SetClock(ManualClock):
    """A clock that is set by hand: the monotonic clock goes on."""

    def set_by_hand(self, utc_ns: int) -> None:
        self._start_ns += utc_ns - self._now_ns
        self._now_ns = utc_ns


def write(path: Path, data: bytes) -> Path:
    path.write_bytes(data)
    return path


def age(path: Path | str, days: float) -> None:
    time_ns = NOW_NS - int(days * DAY_NS)
    os.utime(path, ns=(time_ns, time_ns))


def names(folder: Path) -> set[str]:
    return {str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_symlink() or not path.is_dir()}


def test_rules_are_read_or_refused_with_the_place() -> None:
    assert retention("30 d, 200 GB") == RetentionRule("30 d, 200 GB", 30 * 86_400, 200 * 10**9)
    assert retention("1.5TiB").size == 3 << 39 and retention("2 w").age_s == 14 * 86_400
    for text in (
        "30",
        "30 y",
        "0 d",
        "-1 d",
        "1 d, 2 d",
        "1e9 d",
        "nan GB",
        "200 gb",
        "",
        "1 d,",
        "٣ d",
        "9" * 40 + " d",
    ):
        with pytest.raises(ConfigError, match="expected"):
            retention(text)


def test_old_recordings_are_deleted_and_nothing_else(folder: Path) -> None:
    before = names(folder)
    clock = ManualClock(NOW_NS)
    preview = Retention(folder, retention("30 d"), clock).preview()
    assert names(folder) == before, "a preview changes nothing"
    report = Retention(folder, retention("30 d"), clock).apply()
    assert report.deleted == preview.deleted and not report.kept and not report.problem
    gone = {"old.mcap", "long/metadata.yaml", *(f"long/{path}" for path in ("long_0.mcap", "long_1.mcap"))}
    gone |= {name for name in before if name.startswith("long/")}
    assert before - names(folder) == gone and names(folder) - before == {LOG_NAME}
    assert not (folder / "long").exists()
    assert (folder / LOG_NAME).stat().st_mode & 0o777 == 0o600
    lines = [json.loads(line) for line in (folder / LOG_NAME).read_text().splitlines()]
    assert [line["event"] for line in lines] == ["rule", *["delete"] * len(report.deleted)]
    assert {line["file"] for line in lines[1:]} == {each.recording.name for each in report.deleted}


def test_parts_go_from_the_first_on_and_the_rest_is_a_recording(folder: Path) -> None:
    Retention(folder, retention("48.5 d"), ManualClock(NOW_NS)).apply()
    rest = sorted(path.name for path in (folder / "long").glob("*.mcap"))
    assert rest[0] == "long_2.mcap"
    with SessionFile.open(folder / "long") as whole:
        assert whole.session["part"] == "2"
        report = verify(
            whole.entries(), Config(), DeclaredLosses.of(whole.session, whole.ledger), before=whole.prologue()
        )
        assert report.good and report.outputs
    with Reader(folder / "long") as bag:  # an independent reader of the side file
        assert bag.message_count == sum(1 for _ in bag.messages())


def test_a_part_that_must_stay_keeps_those_behind_it(folder: Path) -> None:
    def hindrance(recording: StoredRecording) -> str:
        return "not confirmed" if recording.name == "long/long_1.mcap" else ""

    report = Retention(folder, retention("1 h"), ManualClock(NOW_NS), hindrance).apply()
    assert {path.name for path in (folder / "long").glob("*.mcap")} >= {"long_1.mcap", "long_2.mcap", "long_3.mcap"}
    assert not (folder / "long" / "long_0.mcap").exists()
    assert {each.kept for each in report.kept} == {"not confirmed", "an earlier part is kept"}


def test_size_deletes_the_oldest_until_the_rest_fits() -> None:
    def row(number: int, size: int) -> StoredRecording:
        return StoredRecording(Path("/x"), f"{number}.mcap", size, (0, number, size, 0), number * DAY_NS)

    generator = random.Random(19)
    for _ in range(200):
        rows = [row(number, generator.randrange(1, 100)) for number in generator.sample(range(20_000, 20_100), 9)]
        most, open_bytes = generator.randrange(1, 600), generator.randrange(0, 80)
        chosen = choose(StoredFiles(rows, open_bytes), RetentionRule("", size=most), NOW_NS, lambda _: "")
        gone = [each.recording for each in chosen]
        rest = sorted((each for each in rows if each not in gone), key=lambda each: each.modified_ns)
        assert all(old.modified_ns < new.modified_ns for old in gone for new in rest)
        left = open_bytes + sum(each.size for each in rest)
        assert left <= most or not rest
        assert not gone or left + gone[-1].size > most, "no more than necessary"


@pytest.mark.parametrize("now_ns", [0, 86_400 * 10**9, NOW_NS - 3000 * DAY_NS])
def test_a_clock_that_is_behind_deletes_nothing_by_age(folder: Path, now_ns: int) -> None:
    assert not Retention(folder, retention("1 h"), ManualClock(now_ns)).apply().deleted


def test_a_clock_that_jumps_ahead_waits_an_hour(folder: Path) -> None:
    clock = SetClock(NOW_NS)
    how = Retention(folder, retention("60 d"), clock)
    assert not how.apply().deleted
    clock.set_by_hand(NOW_NS + 20_000 * DAY_NS)  # while it runs
    assert how.apply().clock and not how.apply().deleted
    again = Retention(folder, retention("60 d"), clock)  # after a restart, and another one
    assert again.apply().clock and Retention(folder, retention("60 d"), clock).apply().clock
    clock.advance(3601 * 10**9)
    assert len(again.apply().deleted) >= 3 and not (folder / "new.mcap").exists()
    assert Retention(folder, retention("60 d"), clock, trust_clock=True).preview().clock == ""


def test_files_that_change_or_are_locked_stay(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    search = RecordingFolder.search

    def changed(self: RecordingFolder) -> StoredFiles:
        found = search(self)
        write(folder / "old.mcap", b"another file")
        return found

    monkeypatch.setattr(RecordingFolder, "search", changed)
    with open(folder / "ältere\u202e Aufnahme", "rb") as locked:
        fcntl.flock(locked, fcntl.LOCK_EX)
        report = Retention(folder, retention("12 h"), ManualClock(NOW_NS)).apply()
    assert {each.recording.name: each.kept for each in report.kept} == {
        "old.mcap": "it has just changed",
        "ältere\u202e Aufnahme": "another process is recording to it",
    }
    assert (folder / "old.mcap").read_bytes() == b"another file"


def test_what_stays_leaves_no_file_open(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A pass each minute for weeks: a descriptor a pass would end the recorder."""
    search = RecordingFolder.search

    def changed(self: RecordingFolder) -> StoredFiles:
        found = search(self)
        for each in found.closed:
            os.utime(each.path)
        return found

    monkeypatch.setattr(RecordingFolder, "search", changed)
    kept = Retention(folder, retention("12 h"), ManualClock(NOW_NS))
    kept.apply()
    before = set(os.listdir("/proc/self/fd"))
    assert "it has just changed" in {each.kept for each in kept.apply().kept}
    assert set(os.listdir("/proc/self/fd")) == before


def test_without_a_log_nothing_is_deleted(folder: Path) -> None:
    (folder / LOG_NAME).mkdir()
    report = Retention(folder, retention("1 h"), ManualClock(NOW_NS)).apply()
    assert "without its log" in report.problem and not report.deleted and (folder / "old.mcap").exists()


def test_the_recorder_deletes_its_own_parts_by_size_and_never_the_open_one(tmp_path: Path) -> None:
    (tmp_path / "key").touch(0o600)
    (tmp_path / "key").write_bytes(SigningKey.generate().private_pem())
    shutil.copy(ROOT / "fixtures" / "crtk.mcap", tmp_path / "unsealed.mcap")
    notes: list[Note] = []
    entries = session(6)
    recorder = Recorder(
        tmp_path / "long.mcap",
        samples.SESSION,
        qos_of=lambda _topic, _type: None,
        on_note=notes.append,
        clock=SystemClock(),
        host=in_process,
        options=RecordOptions(split_s=1.0, seal=tmp_path / "key", retention=RetentionRule("", size=1)),
        rule=RULE,
    )
    for entry in entries:
        recorder(entry)
    summary = recorder.close({"streams": {}})
    assert not summary.failure and not sum(summary.dropped.values())
    assert (tmp_path / "unsealed.mcap").exists()
    # a busy machine may be late
    assert {note.code for note in notes} - {"record_late", "record_on_time"} == {"retention_deleted", "retention_kept"}
    assert not list((tmp_path / "long").glob("*.mcap")) and not summary.files
    lines = (tmp_path / LOG_NAME).read_text().splitlines()
    assert len(lines) > 5


def stored(name: str, size: int, days: float, part: int = -1) -> StoredRecording:
    return StoredRecording(Path("/r"), name, size, (0, 0, size, 0), NOW_NS - int(days * DAY_NS), part=part)


@table(
    ("older", "parts", "open_bytes", "deleted"),
    [
        # sizes of older recordings, of closed parts of the session that runs, and of its open file; what is deleted
        ((30, 30), (10, 10), 10, []),  # all together fit
        ((30, 30), (10, 10), 30, ["old0.mcap"]),  # it grows at the cost of the oldest
        ((30, 20), (50, 50, 30), 10, ["run/run_0.mcap", "run/run_1.mcap"]),  # beyond half: at its own cost
        ((10,), (500, 500), 0, ["run/run_0.mcap", "run/run_1.mcap"]),
        ((10, 40), (), 5_000, []),  # an open file cannot give way, and others do not
        ((40, 40), (), 5_000, ["old0.mcap"]),  # more than the other half
        ((), (60, 60), 10, ["run/run_0.mcap"]),  # alone it has all
        ((60,), (30, 30), 0, ["old0.mcap"]),  # both beyond half: it has what the older one leaves
        ((60,), (60, 60), 10, ["old0.mcap", "run/run_0.mcap"]),
    ],
)
def test_a_session_that_runs_takes_half_of_the_size_from_others_at_most(
    older: tuple[int, ...], parts: tuple[int, ...], open_bytes: int, deleted: list[str]
) -> None:
    closed = [stored(f"old{number}.mcap", size, 10 - number) for number, size in enumerate(older)]
    closed += [stored(f"run/run_{number}.mcap", size, 1 - number / 100, number) for number, size in enumerate(parts)]
    rule = RetentionRule("", size=100)
    by_thread = StoredFiles(closed, open_bytes, running_bytes=open_bytes)
    by_lock = replace(by_thread, running=frozenset({Path("/r/run")}))
    for found, is_running in ((by_thread, lambda each: each.part >= 0), (by_lock, lambda _each: False)):
        choices = choose(found, rule, NOW_NS, lambda _recording: "", is_running)
        assert [each.recording.name for each in choices if not each.kept] == deleted


def test_no_more_is_deleted_than_necessary_whatever_runs() -> None:
    """The youngest that was deleted of each kind would not have fitted."""
    generator = random.Random(23)
    for _ in range(400):
        days = generator.sample(range(1, 100), 10)
        rows = [stored(f"{number}.mcap", generator.randrange(1, 60), day) for number, day in enumerate(days)]
        own = set(rows[: generator.randrange(0, 10)])
        size = generator.randrange(1, 300)
        chosen = choose(StoredFiles(rows), RetentionRule("", size=size), NOW_NS, lambda _: "", own.__contains__)
        gone = [each.recording for each in chosen]
        left = sum(each.size for each in rows if each not in gone)
        assert left <= size
        assert gone == sorted(gone, key=lambda each: each.modified_ns)
        if last := [each for each in gone if each in own][-1:]:
            assert left + last[0].size > size


def test_snapshots_and_parts_of_a_session_that_runs_leave_the_older_recordings(tmp_path: Path) -> None:
    shutil.copy(ROOT / "fixtures" / "crtk.mcap", tmp_path / "yesterday.mcap")
    size = (tmp_path / "yesterday.mcap").stat().st_size
    for options in ({"split_bytes": 1 << 20}, {"split_s": 1.0}, {"snapshot_s": 100.0}):
        notes: list[Note] = []
        recorder = Recorder(
            tmp_path / f"{next(iter(options))}.mcap",
            samples.SESSION,
            qos_of=lambda _topic, _type: None,
            on_note=notes.append,
            clock=SystemClock(),
            host=in_process,
            options=RecordOptions(retention=RetentionRule("", size=2 * size + 100_000), **options),
            rule=RULE,
        )
        for number, entry in enumerate(streams(4, 100, picture_bytes=6 << 20)):
            recorder(entry)
            if options.get("snapshot_s") and number % 100 == 99:
                recorder.snapshot().result(30)
        recorder.close({"streams": {}})
        assert (tmp_path / "yesterday.mcap").exists(), options


def test_the_verb_shows_and_deletes(folder: Path) -> None:
    def retain(*words: str) -> tuple[int, str]:
        done = subprocess.run(
            [sys.executable, "-m", "igtl_gateway", "keep", str(folder), *words],
            check=False,
            capture_output=True,
            text=True,
        )
        return done.returncode, done.stdout + done.stderr

    now_ns = SystemClock().utc_ns()
    os.utime(folder / "old.mcap", ns=(now_ns - 40 * DAY_NS,) * 2)
    code, text = retain("--retention", "30 d", "--dry-run")
    assert code == 0 and "would delete old.mcap" in " ".join(text.split()) and (folder / "old.mcap").exists()
    code, text = retain("--retention", "30 d", "--json")
    assert code == 0 and "old.mcap" in [row["file"] for row in json.loads(text)["deleted"]]
    assert not (folder / "old.mcap").exists()
    assert retain("--retention", "30 x")[0] == 2
