"""The recordings of a folder: found by their contents, looked at once, and never what is another's."""

from __future__ import annotations

import fcntl
import os
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from igtl_gateway.record.retention import stored
from igtl_gateway.record.retention.stored import RecordingFolder, StoredRecording, identity_of, open_unlinked
from igtl_gateway.record.seal.keys import SigningKey
from igtl_gateway.record.sessionfile.reader import SessionFile
from igtl_gateway.record.sessionfile.sealing import SealSeries
from igtl_gateway.record.sessionfile.writer import SessionWriter
from tests.record import samples
from tests.record.test_parts import record, session
from tests.tables import table

ENTRIES = samples.every_kind(3)


@pytest.fixture(scope="module")
def one(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return samples.write(tmp_path_factory.mktemp("one") / "one.mcap", ENTRIES)


@pytest.fixture(scope="module")
def split(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("split")
    record(folder / "long.mcap", session(4), split_s=1.0)
    return folder / "long"


def closed(folder: Path) -> dict[str, StoredRecording]:
    return {each.name: each for each in RecordingFolder(folder).search().closed}


def test_a_recording_has_any_name(one: Path, tmp_path: Path) -> None:
    for name in ("a.mcap", "ältere\u202e Aufnahme", "b.txt"):
        shutil.copy(one, tmp_path / name)
    found = closed(tmp_path)
    assert sorted(found) == ["a.mcap", "b.txt", "ältere\u202e Aufnahme"]
    row = found["a.mcap"]
    state = (tmp_path / "a.mcap").stat()
    assert (row.path, row.parent, row.size) == (tmp_path / "a.mcap", tmp_path, state.st_size)
    assert (row.identity, row.modified_ns) == (identity_of(state), state.st_mtime_ns)
    assert (row.end_ns, row.part, row.sealed) == (ENTRIES[-1].stamp_ns, -1, False)


def test_parts_lie_in_a_folder_of_theirs(split: Path, tmp_path: Path) -> None:
    shutil.copytree(split, tmp_path / "long")
    found = closed(tmp_path)
    assert [found[f"long/long_{number}.mcap"].part for number in range(len(found))] == list(range(len(found)))
    assert found["long/long_1.mcap"].parent == tmp_path / "long"
    with SessionFile.open(tmp_path / "long" / "long_1.mcap") as file:
        assert found["long/long_1.mcap"].end_ns == file.end_ns


def test_a_sealed_one_states_it(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    writer = SessionWriter(path, samples.SESSION, sealer=SealSeries(SigningKey.generate(), lambda: 5).next_file(path))
    writer.write(samples.ros(1))
    writer.close({"streams": {}})
    assert closed(tmp_path)["a.mcap"].sealed


@table(
    ("session", "ledger"),
    [
        ({"slice_of": "a.mcap"}, {}),
        ({"imported_format": "nrrd"}, {}),
        ({"deidentified": "1"}, {}),
        ({}, {"recovered": 1}),
    ],
)
def test_what_a_user_made_of_a_recording_is_the_users(
    session: dict[str, str], ledger: dict[str, int], tmp_path: Path
) -> None:
    writer = SessionWriter(tmp_path / "a.mcap", samples.SESSION | session)
    writer.write(samples.ros(1))
    writer.close({"streams": {}} | ledger)
    assert closed(tmp_path) == {}


def _link(one: Path, folder: Path) -> None:
    (folder / "a.mcap").symlink_to(one)


def _linked_folder(one: Path, folder: Path) -> None:
    (folder / "a").symlink_to(one.parent)


def _deep(one: Path, folder: Path) -> None:
    (folder / "a" / "b").mkdir(parents=True)
    shutil.copy(one, folder / "a" / "b" / "c.mcap")


def _hidden(one: Path, folder: Path) -> None:
    (folder / "a").mkdir()
    for name in (".a.mcap", "a/.b.mcap"):
        shutil.copy(one, folder / name)


def _fifo(_one: Path, folder: Path) -> None:
    os.mkfifo(folder / "a.mcap")


def _other(_one: Path, folder: Path) -> None:
    for name, data in (("a", b""), ("b", b"text"), ("c", b"\x89MCAP0\r\n" * 2), ("d", bytes(5000))):
        (folder / name).write_bytes(data)


@pytest.mark.parametrize("make", [_link, _linked_folder, _deep, _hidden, _fifo, _other], ids=lambda make: make.__name__)
def test_what_is_not_looked_at(make: Callable[[Path, Path], None], one: Path, tmp_path: Path) -> None:
    make(one, tmp_path)
    found = RecordingFolder(tmp_path).search()
    assert found.closed == [] and found.open_bytes == 0 and found.complete


def test_an_open_recording_counts_with_its_size(one: Path, split: Path, tmp_path: Path) -> None:
    """And whether a recorder is writing it now."""
    data = one.read_bytes()[:-200]
    (tmp_path / "killed.mcap").write_bytes(data)
    shutil.copytree(split, tmp_path / "long")
    part = tmp_path / "long" / "long_9.mcap"
    part.write_bytes(data)
    folder = RecordingFolder(tmp_path)
    found = folder.search()
    assert (found.open_bytes, found.running_bytes, found.running) == (2 * len(data), 0, frozenset())
    with part.open("rb") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        found = folder.search()
    assert (found.open_bytes, found.running_bytes) == (2 * len(data), len(data))
    assert found.running == {tmp_path / "long"}
    with (tmp_path / "killed.mcap").open("rb") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        found = folder.search()
    assert found.running_bytes == len(data) and not found.running, "a folder of its own it has not"


def test_a_file_is_read_again_only_if_it_has_changed(
    one: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shutil.copy(one, tmp_path / "a.mcap")
    shutil.copy(one, tmp_path / "b.mcap")
    looked: list[str] = []
    parsed = stored._parsed

    def counted(path: Path, *rest: object) -> object:
        looked.append(path.name)
        return parsed(path, *rest)  # type: ignore[arg-type]

    monkeypatch.setattr(stored, "_parsed", counted)
    folder = RecordingFolder(tmp_path)
    first = folder.search()
    assert folder.search() == first and looked == ["a.mcap", "b.mcap"]
    os.utime(tmp_path / "b.mcap", ns=(5, 5))
    second = folder.search()
    assert looked == ["a.mcap", "b.mcap", "b.mcap"] and [each.modified_ns for each in second.closed][1] == 5
    (tmp_path / "a.mcap").unlink()
    assert [each.name for each in folder.search().closed] == ["b.mcap"]


def test_a_folder_with_too_many_files_is_not_complete(
    one: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(stored, "MOST_FILES", 2)
    for name in "ab":
        shutil.copy(one, tmp_path / name)
    assert RecordingFolder(tmp_path).search().complete
    shutil.copy(one, tmp_path / "c")
    found = RecordingFolder(tmp_path).search()
    assert not found.complete and [each.name for each in found.closed] == ["a", "b"]


def test_a_folder_that_is_not_there(tmp_path: Path) -> None:
    with pytest.raises(OSError):
        RecordingFolder(tmp_path / "gone").search()


def test_links_are_not_opened(one: Path, tmp_path: Path) -> None:
    with open_unlinked(one) as stream:
        assert stream.read(5) == b"\x89MCAP"
    _link(one, tmp_path)
    with pytest.raises(OSError):
        open_unlinked(tmp_path / "a.mcap")
