"""A folder that is replaced: at any moment either of the two is there, and what a killed program left is repaired."""

from __future__ import annotations

import errno
import os
from pathlib import Path

import pytest

from igtl_gateway.base.errors import GatewayError
from igtl_gateway.base.systems.files import exchange, lock, open_plain
from igtl_gateway.record.sessionfile import replaced_folder as home
from igtl_gateway.record.sessionfile.replaced_folder import replaced_folder


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """An older folder with two files."""
    path = tmp_path / "set"
    (path / "below").mkdir(parents=True)
    (path / "kept").write_text("kept")
    (path / "below" / "changed").write_text("old")
    return path


def replace(path: Path) -> None:
    """A newer folder: one file is a link to the old one, the other is new."""
    with replaced_folder(path) as place:
        assert place.name == path.name and not any(place.iterdir())
        (place / "below").mkdir()
        os.link(path / "kept", place / "kept")
        (place / "below" / "changed").write_text("new")


def content(path: Path) -> list[str]:
    assert sorted(os.listdir(path.parent)) == [path.name], "nothing else is left"
    return [(path / "kept").read_text(), (path / "below" / "changed").read_text()]


@pytest.mark.parametrize("can", [True, False])
def test_it_is_replaced_as_a_whole(can: bool, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    if not can:
        monkeypatch.setattr(home, "exchange", lambda one, two: False)
    replace(folder)
    assert content(folder) == ["kept", "new"]


@pytest.mark.parametrize("number", [0, 1, 2])
def test_a_rename_that_fails_changes_nothing(number: int, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    calls, rename = iter(range(9)), os.rename

    def refuse(old: Path, new: Path) -> None:
        if next(calls) == number:
            raise OSError(errno.EIO, "Input/output error")
        rename(old, new)

    monkeypatch.setattr(home, "exchange", lambda one, two: False)
    monkeypatch.setattr(os, "rename", refuse)
    with pytest.raises(GatewayError, match=f"^cannot write to {folder}: Input/output error"):
        replace(folder)
    if number == 2:  # the newer one is there; the older one could not be put where it is removed
        assert (folder / "below" / "changed").read_text() == "new"
    else:
        assert content(folder) == ["kept", "old"]


def test_what_a_killed_program_left(folder: Path) -> None:
    before = folder.with_name(".set.igtl-gateway-before")
    folder.rename(before)  # killed between the two renames
    part = folder.with_name(".igtl-gateway-1-0.part")
    (part / "set").mkdir(parents=True)
    (part / ".igtl-gateway.lock").touch()
    folder.with_name(".set.igtl-gateway-lock").touch()
    replace(folder)
    assert content(folder) == ["kept", "new"]
    before.mkdir()  # another program wrote a new one meanwhile: nothing is removed
    with pytest.raises(GatewayError, match=f"found {before}, too, of a program that was killed"):
        replace(folder)
    assert before.is_dir() and folder.is_dir()


def test_one_at_a_time(folder: Path) -> None:
    name = folder.with_name(".set.igtl-gateway-lock")
    handle = open_plain(name, os.O_RDWR | os.O_CREAT)
    lock(handle)
    with pytest.raises(GatewayError, match=f"^{folder}: another program is writing to it; wait for its end$"):
        replace(folder)
    os.close(handle)
    replace(folder)
    assert content(folder) == ["kept", "new"]


def test_what_cannot_be_replaced(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    link = folder.with_name("link")
    link.symlink_to(folder)
    cases = {
        folder.with_name("sett"): "No such folder; did you mean .*set",
        folder / "kept": "it is not a folder, expected one",
        link: "it is not a folder, expected one",
        Path("/proc"): "cannot write to /proc",
    }
    for path, text in cases.items():
        with pytest.raises(GatewayError, match=text), replaced_folder(path):
            raise AssertionError("it began")
    access = os.access
    monkeypatch.setattr(os, "access", lambda path, mode: Path(path).name != "below" and access(path, mode))
    with pytest.raises(GatewayError, match=f"{folder / 'below'} is read-only"):
        replace(folder)
    assert sorted(os.listdir(folder.parent)) == ["link", folder.name]
    monkeypatch.undo()
    monkeypatch.chdir(folder / "below")
    with pytest.raises(GatewayError, match="the working directory is in it"):
        replace(folder)


def test_where_nothing_can_be_written(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(path: Path, flags: int) -> int:
        raise PermissionError(errno.EACCES, "Permission denied", str(path))

    monkeypatch.setattr(home, "open_plain", refuse)
    with pytest.raises(
        GatewayError, match=f"^cannot write to {folder}: Permission denied, in the folder {folder.parent}"
    ):
        replace(folder)
    monkeypatch.undo()
    assert content(folder) == ["kept", "old"]


def test_two_folders_are_exchanged_or_it_is_said_that_they_cannot_be(tmp_path: Path) -> None:
    one, two = (tmp_path / name for name in ("one", "two"))
    for path in (one, two):
        path.mkdir()
        (path / path.name).touch()
    done = exchange(one, two)
    assert os.listdir(one) == ["two" if done else "one"]
    with pytest.raises(FileNotFoundError):
        if not exchange(one, tmp_path / "none"):
            raise FileNotFoundError
