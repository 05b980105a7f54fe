"""What a worker writes into, without a worker: each kind on real files."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from igtl_gateway.base.clock import ManualClock
from igtl_gateway.base.errors import DiskRefused, RecordingError
from igtl_gateway.config.triggers import trigger
from igtl_gateway.gateway.log.note import Note
from igtl_gateway.record import new_files
from igtl_gateway.record.new_files import NewFiles
from igtl_gateway.record.options import RecordOptions
from igtl_gateway.record.output import Hooks, Output
from igtl_gateway.record.parts import PartsWriter
from igtl_gateway.record.reports import HELD
from igtl_gateway.record.ring import Ring
from igtl_gateway.record.selection import StateInputRule
from igtl_gateway.record.sessionfile.chunk_rows import RowStream
from igtl_gateway.record.sessionfile.reader import SessionFile
from igtl_gateway.record.sole_file import SoleFile
from tests.record import samples


class Bench:
    """An output with its hooks."""

    def __init__(self, path: Path, **options: Any) -> None:
        self.notes: list[Note] = []
        self.closed = 0
        self.row_streams: list[RowStream | None] = []
        chosen, clock = RecordOptions(**options), ManualClock(samples.START_NS)
        files = NewFiles(samples.SESSION, chosen, clock, lambda *_: None)
        hooks = Hooks(lambda: {"dropped_entries": 0}, self.notes.append, self._on_closed, lambda *_: None)
        self.output = Output(path, StateInputRule(), chosen, files, clock, self.row_streams, hooks)

    def _on_closed(self) -> None:
        self.closed += 1


def test_the_options_choose_what_is_written_into(tmp_path: Path) -> None:
    rules = (trigger("link_down"),)
    for number, (kind, options) in enumerate(
        ((SoleFile, {}), (PartsWriter, {"split_s": 9.0}), (Ring, {"snapshot_s": 9.0}))
    ):
        output = Bench(tmp_path / f"{number}.mcap", **options).output
        assert type(output.writer) is kind and output.box is None
        if kind is Ring:
            with pytest.raises(RecordingError, match="found a snapshot buffer, expected a recording"):
                output.in_files()
            assert (output.present, output.saved) == ("", (0, 0))
        else:
            assert output.in_files() is output.writer and output.present
    box = Bench(tmp_path / "box.mcap", snapshot_s=9.0, triggers=rules).output
    assert box.box is box.writer and box.window == ""


def test_a_file_follows_another_with_channels_of_its_own(tmp_path: Path) -> None:
    bench = Bench(tmp_path / "a.mcap")
    output, entry = bench.output, samples.igtl(1)
    output.writer.write(entry)
    if output.rows:
        bench.row_streams.append(output.rows.row_stream(entry))
        assert bench.row_streams != [None]
    assert output.close_present() == tmp_path / "a.mcap" and not output.present
    output.changed()
    assert output.rows is None
    path = output.begin()
    output.changed()
    assert output.present == str(path) != str(tmp_path / "a.mcap")
    assert set(bench.row_streams) <= {None}
    output.writer.close({})
    with SessionFile.open(path) as file:
        assert file.session["part"] == "1"


def test_one_that_waits_has_no_file_before_it_begins(tmp_path: Path) -> None:
    output = Bench(tmp_path / "a.mcap", waits=True).output
    assert not output.present and not [*tmp_path.iterdir()] and not output.rows
    assert output.begin() == tmp_path / "a.mcap"


@pytest.mark.parametrize("options", [{}, {"split_s": 9.0}])
def test_a_disk_that_refuses_is_tried_later(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, options: dict[str, Any]
) -> None:
    def refuse(*_arguments: object, **_more: object) -> None:
        raise DiskRefused("the disk is full")

    with monkeypatch.context() as patch:
        patch.setattr(new_files, "SessionWriter", refuse)
        with pytest.raises(DiskRefused):
            Bench(tmp_path / "a.mcap", stop_on_failure=True, **options)
        output = Bench(tmp_path / "b.mcap", **options).output
        assert output.refused == "the disk is full" and not output.present
        with pytest.raises(DiskRefused):
            output.begin()
    assert output.begin().exists()


def test_parts_report_that_they_are_closed_and_held(tmp_path: Path) -> None:
    bench = Bench(tmp_path / "a.mcap", split_s=1.0)
    output = bench.output
    output._report_held("a reason")
    assert [note.code for note in bench.notes] == [HELD] and "a reason" in bench.notes[0].text
    output.writer.write(samples.igtl(1))
    output.close_present()
    assert bench.closed == 1 and not output.present
