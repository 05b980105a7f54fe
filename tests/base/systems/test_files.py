"""Files where systems differ: locks, ordinary files only, removal under the lock."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from igtl_gateway.base.systems.files import OpenFolder, lock, open_plain, remove_locked, set_mode, unlock


def test_one_writer_or_many_readers(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    one, two = open_plain(path, os.O_RDWR | os.O_CREAT), open_plain(path)
    try:
        lock(one)
        for shared in (False, True):
            with pytest.raises(BlockingIOError):
                lock(two, shared=shared)
        unlock(one)
        lock(one, shared=True)
        lock(two, shared=True)
        with pytest.raises(BlockingIOError):
            lock(two)
    finally:
        os.close(one)
        os.close(two)


@pytest.mark.parametrize("make", [os.mkfifo, os.mkdir, lambda path: os.symlink(__file__, path)])
def test_only_ordinary_files_are_opened(tmp_path: Path, make: object) -> None:
    assert callable(make)
    make(path := tmp_path / "a")
    with pytest.raises(OSError):
        open_plain(path)


def test_a_new_file_is_for_its_owner_and_is_removed_under_its_lock(tmp_path: Path) -> None:
    path = tmp_path / "a"
    handle = open_plain(path, os.O_RDWR | os.O_CREAT)
    assert path.stat().st_mode & 0o777 == 0o600
    set_mode(handle, 0o640)
    assert path.stat().st_mode & 0o777 == 0o640
    lock(handle)
    remove_locked(path, handle)
    assert not path.exists()
    with pytest.raises(OSError):
        os.fstat(handle)


def test_a_folder_stays_the_same_one_when_a_link_takes_its_place(tmp_path: Path) -> None:
    for name in ("one", "two"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "a").write_text(name)
    folder = OpenFolder(tmp_path / "one")
    (tmp_path / "one").rename(tmp_path / "old")
    (tmp_path / "one").symlink_to("two")
    folder.remove_locked("a", folder.open("a"))
    folder.close()
    assert not (tmp_path / "old" / "a").exists() and (tmp_path / "two" / "a").exists()
    with pytest.raises(OSError):
        OpenFolder(tmp_path / "one")
