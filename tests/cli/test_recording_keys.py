"""The options of a recording, and what steers it from outside."""

from __future__ import annotations

import argparse
import os
import signal
import threading
from pathlib import Path
from typing import Any

import pytest

from igtl_gateway.app.bridge_options import bridge_options
from igtl_gateway.base.clock import ManualClock
from igtl_gateway.base.errors import ConfigError
from igtl_gateway.cli import recording_keys
from igtl_gateway.cli.settings import add_settings, given, settled
from igtl_gateway.config.settings import all_settings
from igtl_gateway.gateway.log.marks import MarkNote
from igtl_gateway.gateway.log.note import Note
from igtl_gateway.record.host import in_thread
from igtl_gateway.record.options import RecordOptions
from igtl_gateway.record.recorder import Recorder
from igtl_gateway.record.reports import PAUSED, RESUMED, SNAPSHOT
from igtl_gateway.record.selection import Selection
from igtl_gateway.record.sessionfile.reader import SessionFile
from tests.record import samples

DEADLINE_S = 30.0


def parsed(*arguments: str) -> RecordOptions:
    parser = argparse.ArgumentParser()
    add_settings(parser, all_settings())
    options = parser.parse_args(arguments)
    return bridge_options(settled(options, {}), ros=True, node_name="gateway", given=given(options, all_settings()))[
        1
    ].recording


def test_without_options_it_is_as_everywhere() -> None:
    assert parsed("--record", "a.mcap") == RecordOptions()


def test_every_option_arrives() -> None:
    assert parsed(
        *("--record", "a.mcap", "--compression", "zstd", "--flush-interval", "0.25", "--fsync", "flush"),
        *("--split-size", "100", "--split-duration", "60", "--overwrite", "--on-record-failure", "stop"),
        *("--record-include", "IMAGE/*", "/tf", "--record-exclude", "Camera"),
    ) == RecordOptions(
        compression="zstd",
        flush_s=0.25,
        fsync="flush",
        split_bytes=100 << 20,
        split_s=60.0,
        overwrite=True,
        stop_on_failure=True,
        selection=Selection(("IMAGE/*", "/tf"), ("Camera",)),
    )
    assert parsed("--record", "a.mcap", "--snapshot", "30").snapshot_s == 30.0


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--snapshot", "30"], "--snapshot: found no --record FILE, expected it"),
        (["--record-all", "--split-size", "1"], "--record-all and --split-size: found no --record FILE"),
        (
            ["--record", "a", "--snapshot", "5", "--split-size", "1"],
            "--snapshot: found --split-size or --split-duration, expected neither",
        ),
    ],
)
def test_what_makes_no_sense_is_refused(arguments: list[str], words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        parsed(*arguments)


class Bench:
    """A recorder and its messages."""

    def __init__(self, path: Path, **options: Any) -> None:
        self.notes: list[Note] = []
        self._changed = threading.Condition()
        self.recorder = Recorder(
            path,
            samples.SESSION,
            qos_of=lambda _topic, _type: None,
            on_note=self._on_note,
            clock=ManualClock(),
            host=in_thread,
            options=RecordOptions(**options),
        )

    def _on_note(self, note: Note) -> None:
        with self._changed:
            self.notes.append(note)
            self._changed.notify_all()

    def wait(self, *codes: str) -> None:
        with self._changed:
            assert self._changed.wait_for(lambda: len(self.notes) >= len(codes), DEADLINE_S)
        assert [note.code for note in self.notes] == list(codes)


def test_a_signal_pauses_and_resumes(tmp_path: Path) -> None:
    bench = Bench(tmp_path / "a.mcap")
    before = signal.getsignal(signal.SIGUSR2)
    with recording_keys.recording_controls(bench.recorder, print):
        os.kill(os.getpid(), signal.SIGUSR2)
        bench.wait(PAUSED)
        os.kill(os.getpid(), signal.SIGUSR2)
        bench.wait(PAUSED, RESUMED)
    assert signal.getsignal(signal.SIGUSR2) == before
    bench.recorder.close({})


def test_a_signal_writes_a_snapshot(tmp_path: Path) -> None:
    bench = Bench(tmp_path / "a.mcap", snapshot_s=5.0)
    with recording_keys.recording_controls(bench.recorder, print) as told:
        assert told == "SIGUSR1 saves the last 5 s"
        os.kill(os.getpid(), signal.SIGUSR1)
        bench.wait(SNAPSHOT)
    assert Path(bench.notes[0].data["path"]).is_file()
    bench.recorder.close({})


def test_without_a_recording_there_is_nothing_to_steer() -> None:
    with recording_keys.recording_controls(None, print) as told:
        assert told == ""


def test_what_the_user_says_is_in_the_recording(tmp_path: Path) -> None:
    assert parsed("--record", "a", "--custom-data", "operator=Kim", "note=a=b").custom == (
        ("operator", "Kim"),
        ("note", "a=b"),
    )
    bench = Bench(tmp_path / "a.mcap", custom=(("operator", "Kim"),))
    bench.recorder.close({})
    with SessionFile.open(tmp_path / "a.mcap") as file:
        assert file.session["custom_data"] == '{"operator": "Kim"}'


def test_a_line_is_a_mark_or_the_reason_why_not(capsys: pytest.CaptureFixture[str]) -> None:
    found: list[tuple[str, int]] = []
    recording_keys._mark("suture: first", 7, lambda *line: found.append(line))
    assert found == [("suture: first", 7)]
    recording_keys._mark(": first", 7, lambda line, _: found.append((MarkNote.parse(line, "keyboard").label, 0)))
    assert capsys.readouterr().err.startswith("! mark: found label ''")
