"""Creating a file: the obstacles have names, and the file of another recording stays as it is."""

from __future__ import annotations

import errno
import fcntl
from pathlib import Path

import pytest

from igtl_gateway.base.errors import DiskRefused, RecordingError
from igtl_gateway.base.systems.files import sync_folder
from igtl_gateway.record.sessionfile.new_file import cannot_begin, create_file, os_error_text


def test_a_new_file_is_locked(tmp_path: Path) -> None:
    with create_file(tmp_path / "a"), (tmp_path / "a").open() as other:
        with pytest.raises(BlockingIOError):
            fcntl.flock(other, fcntl.LOCK_SH | fcntl.LOCK_NB)
    sync_folder(tmp_path)


def test_an_existing_file_is_not_emptied(tmp_path: Path) -> None:
    path = tmp_path / "a"
    with create_file(path) as file:
        file.write(b"messages")
    with pytest.raises(RecordingError, match="exists already"):
        create_file(path)
    assert path.read_bytes() == b"messages"


def test_obstacles(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match="it is a folder"):
        create_file(tmp_path)
    with pytest.raises(RecordingError, match="there is no folder"):
        create_file(tmp_path / "none" / "a")


def test_the_disk_is_distinguished_from_a_wrong_path(tmp_path: Path) -> None:
    full = cannot_begin(tmp_path / "a", OSError(errno.ENOSPC, "No space left on device"))
    assert isinstance(full, DiskRefused) and "No space left" in str(full)
    assert not isinstance(cannot_begin(tmp_path / "a", OSError(errno.ENAMETOOLONG, "too long")), DiskRefused)
    assert not isinstance(cannot_begin(tmp_path / "a", ValueError("embedded null byte")), DiskRefused)
    assert os_error_text(ValueError("embedded null byte")) == "embedded null byte"
