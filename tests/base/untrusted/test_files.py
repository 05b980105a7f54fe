"""Opening files of others: ordinary ones only, and never out of the folder."""

from __future__ import annotations

import io
import os
from pathlib import Path

import pytest

from igtl_gateway.base.errors import DamagedRecording, LimitExceeded, UnsupportedRecording
from igtl_gateway.base.untrusted import files, limits
from igtl_gateway.base.untrusted.files import open_file, read_bytes, sibling_file
from igtl_gateway.base.untrusted.limits import FileLimits
from tests.tables import table


def test_an_ordinary_file_opens(tmp_path: Path) -> None:
    path = tmp_path / "a.bin"
    path.write_bytes(b"abc")
    with open_file(path) as stream:
        assert stream.read() == b"abc"
    assert read_bytes(path) == b"abc"


def test_a_fifo_is_refused_and_not_waited_for(tmp_path: Path) -> None:
    path = tmp_path / "pipe"
    os.mkfifo(path)
    with pytest.raises(UnsupportedRecording, match="found a FIFO, expected a file"):
        open_file(path)


@pytest.mark.parametrize(
    ("name", "fault"),
    [("/dev/zero", "a device"), ("/", "a folder"), ("/nowhere", "No such file"), ("a\0b", "null byte")],
)
def test_what_is_no_file_is_refused(name: str, fault: str) -> None:
    with pytest.raises(UnsupportedRecording, match=fault):
        open_file(Path(name))


def test_a_small_file_that_is_large_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.toml"
    path.write_bytes(b"x" * 11)
    with limits.limits_in_force(FileLimits(free=10)), pytest.raises(LimitExceeded, match="free=10"):
        read_bytes(path)


@table("name", ["", ".", "..", "../a.raw", "/etc/passwd", "sub/a.raw", "a\\b", "a\0b", "out"])
def test_a_reference_stays_in_the_folder(tmp_path: Path, name: str) -> None:
    (tmp_path / "out").symlink_to("/etc/passwd")
    with pytest.raises(DamagedRecording, match="reference"):
        sibling_file(tmp_path / "a.mhd", name)


def test_a_reference_to_a_file_beside(tmp_path: Path) -> None:
    (tmp_path / "a.raw").touch()
    (tmp_path / "b.raw").symlink_to(tmp_path / "a.raw")
    os.mkfifo(tmp_path / "pipe")
    assert sibling_file(tmp_path / "a.mhd", "a.raw") == tmp_path / "a.raw"
    assert sibling_file(tmp_path / "a.mhd", "b.raw") == tmp_path / "b.raw"
    with pytest.raises(UnsupportedRecording, match="FIFO"):
        sibling_file(tmp_path / "a.mhd", "pipe")


def test_a_reference_to_links_in_a_circle_is_one_line(tmp_path: Path) -> None:
    (tmp_path / "a.raw").symlink_to("a.raw")
    with pytest.raises(UnsupportedRecording, match="symbolic links"):
        sibling_file(tmp_path / "a.mhd", "a.raw")


def test_holes_of_a_sparse_file_cost_nothing(tmp_path: Path) -> None:
    path = tmp_path / "sparse"
    with path.open("wb") as stream:
        stream.write(b"x" * 10_000)
        stream.seek(1 << 34)
        stream.write(b"y")
    assert files.stored_bytes(path, 1 << 34) < 1 << 20
    assert files.stored_bytes(path, 3) == 3
    with path.open("rb") as stream:
        assert files.next_data(stream, 5) == 5
        assert (1 << 34) - (1 << 20) < files.next_data(stream, 1 << 20) <= 1 << 34
        assert files.next_data(stream, (1 << 34) + 1) == (1 << 34) + 1
    assert files.next_data(io.BytesIO(b"abc"), 1) == 1
    assert files.stored_bytes(tmp_path / "none", 7) == 7
