"""Each file of a recording has the same metadata and is named once."""

from __future__ import annotations

import json
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest

from igtl_gateway.base.clock import ManualClock
from igtl_gateway.base.errors import RecordingError
from igtl_gateway.record.new_files import NewFiles
from igtl_gateway.record.options import RecordOptions
from igtl_gateway.record.seal.keys import SigningKey
from igtl_gateway.record.selection import Selection
from igtl_gateway.record.sessionfile import layout
from igtl_gateway.record.sessionfile.reader import SessionFile
from igtl_gateway.record.sessionfile.sealing import Sealer, SealSeries
from tests.record import samples


def files_of(options: RecordOptions) -> NewFiles:
    return NewFiles(samples.SESSION, options, ManualClock(samples.START_NS), lambda *_: None)


def test_metadata_and_entries_are_in_the_file(tmp_path: Path) -> None:
    files = files_of(RecordOptions(selection=Selection(exclude=("/a",)), custom=(("b", "1"), ("a", "2"))))
    writer = files.open(tmp_path / "a.mcap", {layout.PART_KEY: "3"}, [samples.igtl(1)])
    writer.write(samples.igtl(2))
    writer.close({})
    with SessionFile.open(tmp_path / "a.mcap") as file:
        session = file.session
        assert [entry.seq for entry in file.entries()] == [2], "the first one is its prologue"
    assert session[layout.PART_KEY] == "3" and session["host"] == samples.SESSION["host"]
    assert session[layout.CUSTOM_KEY] == '{"a": "2", "b": "1"}'
    assert json.loads(session[layout.EXCLUDE_KEY]) == ["/a"]


def test_the_bridge_learns_each_file_once(tmp_path: Path) -> None:
    files, announced = files_of(RecordOptions()), list[list[str]]()
    paths = [tmp_path / f"{name}.mcap" for name in "abc"]
    for path in paths[:2]:
        files.open(path, {}, ()).close({})
    assert files.take_begun() == [*map(str, paths[:2])] and files.take_begun() == []
    files.announce_by(announced.append)
    files.open(paths[2], {}, ()).close({})
    assert announced == [[str(paths[2])]] and files.take_begun() == []
    assert files.all == set(paths)


def test_a_seal_of_a_part_names_the_one_of_the_part_before_if_that_has_its_end(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("cryptography")
    key, sealers, next_file = tmp_path / "key", list[Sealer](), SealSeries.next_file
    key.touch(0o600)
    key.write_bytes(SigningKey.generate().private_pem())

    def noticed(series: SealSeries, *arguments: Any, **more: Any) -> Sealer:
        sealers.append(next_file(series, *arguments, **more))
        return sealers[-1]

    monkeypatch.setattr(SealSeries, "next_file", noticed)
    files = files_of(RecordOptions(seal=key, split_s=9.0))
    for name in "abcd":
        writer = files.open(tmp_path / name, {}, ())
        if name == "b":
            (tmp_path / name).unlink()
            with pytest.raises(RecordingError):
                writer.flush()
        writer.close({})
    with pytest.raises(RecordingError):
        files.open(tmp_path / "a", {}, ())
    files.open(tmp_path / "e", {}, ()).close({})
    assert [each.part.number for each in sealers] == [0, 1, 0, 1, 2, 2]
    for one, two in pairwise(sealers[:4]):
        assert two.part.previous == one.last_digest
    assert sealers[5].part.previous == sealers[3].last_digest
    alone = files_of(RecordOptions(seal=key))
    for name in "fg":
        alone.open(tmp_path / name, {}, ()).close({})
    assert [each.part.number for each in sealers[6:]] == [0, 0]


def test_a_key_that_cannot_be_used_is_refused(tmp_path: Path) -> None:
    pytest.importorskip("cryptography")
    with pytest.raises(RecordingError, match="cannot seal the recording: "):
        files_of(RecordOptions(seal=tmp_path / "nothing"))
