"""A file that a verb writes: refused in one sentence where it cannot be, and whole where it can."""

from __future__ import annotations

import os
import stat
import subprocess
import sys
from pathlib import Path

import pytest

from igtl_gateway.base.errors import ConfigError, GatewayError, RecordingError, UnsupportedRecording
from igtl_gateway.record.sessionfile.new_file import create_file
from igtl_gateway.record.sessionfile.whole_files import check_target, is_unfinished, replaced, written, written_folder
from tests.places import ROOT


def read_only() -> Path | None:
    """A folder in which no user, not even root, can create a file."""
    return next((path for path in map(Path, ("/proc", "/sys")) if path.is_dir()), None)


def names(folder: Path) -> list[str]:
    """All that is in a folder, hidden files, too."""
    return sorted(os.listdir(folder))


def test_a_new_file_is_there_when_it_is_whole(tmp_path: Path) -> None:
    out = tmp_path / "out.rrd"
    with written(out) as place:
        assert place.name == out.name and not place.exists()
        place.write_bytes(b"all of it")
        place.chmod(0o644)  # as another library makes it
        assert not out.exists()
    assert names(tmp_path) == ["out.rrd"] and out.read_bytes() == b"all of it"
    assert stat.S_IMODE(out.stat().st_mode) == 0o600


@pytest.mark.parametrize(
    "error", [GatewayError("no such stream"), KeyboardInterrupt(), OSError(28, "full"), Exception()]
)
def test_what_was_there_stays_where_the_work_fails(tmp_path: Path, error: BaseException) -> None:
    out = tmp_path / "out.rrd"
    out.write_bytes(b"old")
    with pytest.raises((Exception, KeyboardInterrupt)), written(out, overwrite=True) as place:
        place.write_bytes(b"half")
        raise error
    assert names(tmp_path) == ["out.rrd"] and out.read_bytes() == b"old"


def test_errors_name_the_file_and_not_the_hidden_one(tmp_path: Path) -> None:
    out = tmp_path / "out.mcap"
    with pytest.raises(GatewayError) as found, written(out) as place:
        raise GatewayError(f"cannot write {place}: no room")
    assert str(found.value) == f"cannot write {out}: no room"
    with pytest.raises(GatewayError, match=f"^cannot write to {out}: .*No such file"), written(out) as place:
        (place / "below").write_bytes(b"")
    with pytest.raises(BrokenPipeError), written(out):
        raise BrokenPipeError(32, "Broken pipe")  # of standard output: not about this file


def test_a_full_disk_is_the_reason_for_a_folder_that_is_there(tmp_path: Path) -> None:
    with pytest.raises(GatewayError) as found, written_folder(tmp_path):
        raise OSError(28, "No space left on device")
    assert str(found.value) == f"cannot write to {tmp_path}: No space left on device"


def test_without_a_file_nothing_happens(tmp_path: Path) -> None:
    out = tmp_path / "out"
    out.write_bytes(b"old")
    with written(out, overwrite=True):
        pass
    with written_folder(tmp_path / "folder") as place:
        place.rmdir()
    assert names(tmp_path) == ["out"] and out.read_bytes() == b"old"


def test_a_file_of_another_program_is_not_replaced(tmp_path: Path) -> None:
    """It came after the check: only the move can notice it."""
    out = tmp_path / "out"
    with pytest.raises(ConfigError, match="exists already"), written(out) as place:
        place.write_bytes(b"ours")
        out.write_bytes(b"theirs")
    assert names(tmp_path) == ["out"] and out.read_bytes() == b"theirs"


@pytest.mark.parametrize("target", ["file", "none"])
def test_a_link_is_replaced_itself(tmp_path: Path, target: str) -> None:
    (tmp_path / "file").write_bytes(b"of somebody else")
    link = tmp_path / "link"
    link.symlink_to(tmp_path / target)
    with pytest.raises(ConfigError, match="exists already"), written(link):
        pytest.fail("a link is a file that exists")
    with written(link, overwrite=True) as place:
        place.write_bytes(b"ours")
    assert not link.is_symlink() and link.read_bytes() == b"ours"
    assert (tmp_path / "file").read_bytes() == b"of somebody else" and not (tmp_path / "none").exists()


def test_a_file_that_is_being_recorded_is_not_replaced(tmp_path: Path) -> None:
    out = tmp_path / "out.mcap"
    with create_file(out):
        with pytest.raises(GatewayError, match="another process is recording to it"), written(out, overwrite=True):
            pytest.fail("it is being recorded")
        with pytest.raises(RecordingError, match="another process is recording to it"), replaced(out):
            pytest.fail("it is being recorded")


def test_a_recording_takes_the_place_when_it_has_begun(tmp_path: Path) -> None:
    out = tmp_path / "out.mcap"
    out.write_bytes(b"old")
    with replaced(out) as place:
        file = place.open("wb")
        file.write(b"new")
        file.flush()
        assert out.read_bytes() == b"old"
    file.write(b", and more")
    file.close()
    assert names(tmp_path) == ["out.mcap"] and out.read_bytes() == b"new, and more"


def test_what_a_killed_program_left_is_removed_and_nothing_else(tmp_path: Path) -> None:
    program = (
        "import os, sys, pathlib\n"
        "from igtl_gateway.record.sessionfile.whole_files import written\n"
        "with written(pathlib.Path(sys.argv[1])) as place:\n"
        "    place.write_bytes(b'half')\n"
        "    os.kill(os.getpid(), 9)\n"
    )
    ended = subprocess.run([sys.executable, "-c", program, str(tmp_path / "out")], timeout=60, check=False)
    assert ended.returncode == -9
    [left] = names(tmp_path)
    assert left.startswith(".igtl-gateway-") and is_unfinished(tmp_path / left / "out")
    (tmp_path / ".igtl-gateway-1-0.part").mkdir()  # killed before it had a lock
    (tmp_path / ".igtl-gateway-file.part").write_bytes(b"a file of somebody")
    with written(tmp_path / "other") as place:
        assert left not in names(tmp_path)
        place.write_bytes(b"")
        with written(tmp_path / "second") as second:  # the first one is at work: it stays
            second.write_bytes(b"")
        assert place.exists()
    assert names(tmp_path) == [".igtl-gateway-file.part", "other", "second"]


def test_a_new_folder_is_there_when_it_is_whole(tmp_path: Path) -> None:
    out = tmp_path / "out"
    with written_folder(out) as place:
        (place / "a").write_bytes(b"a")
        (place / "below").mkdir()
        (place / "below" / "b").write_bytes(b"b")
        assert not out.exists()
    assert names(tmp_path) == ["out"] and names(out) == ["a", "below"]
    with pytest.raises(UnsupportedRecording, match="a directory with files in it"), written_folder(out):
        pytest.fail("it has files")
    with pytest.raises(ValueError), written_folder(tmp_path / "other") as place:
        (place / "a").write_bytes(b"")
        raise ValueError
    assert names(tmp_path) == ["out"]


def test_a_folder_that_is_there_is_filled_at_the_end(tmp_path: Path) -> None:
    with pytest.raises(ValueError), written_folder(tmp_path) as place:
        (place / "a").write_bytes(b"")
        raise ValueError
    assert names(tmp_path) == []
    for name in ("a", "b"):
        with written_folder(tmp_path, overwrite=name == "b") as place:
            (place / name).write_bytes(name.encode())
            assert name not in names(tmp_path)
    with written_folder(tmp_path, overwrite=True) as place:
        (place / "a").write_bytes(b"new")
    assert names(tmp_path) == ["a", "b"] and (tmp_path / "a").read_bytes() == b"new"
    with pytest.raises(GatewayError, match="it is not a folder"), written_folder(tmp_path / "a"):
        pytest.fail("it is a file")


def test_a_place_that_takes_no_file(tmp_path: Path) -> None:
    place = read_only()
    if place is None:
        pytest.skip("found no folder that takes no files (/proc, /sys)")
    with pytest.raises(GatewayError, match=f"cannot write to {place}/out.rrd: "), written(place / "out.rrd"):
        pytest.fail("nothing can be written here")
    with pytest.raises(GatewayError, match="there is no folder"):
        check_target(tmp_path / "none" / "out.rrd", overwrite=True)
    with pytest.raises(GatewayError, match="File name too long"):
        check_target(tmp_path / ("x" * 300), overwrite=False)


def test_what_is_no_ordinary_file_is_not_replaced(tmp_path: Path) -> None:
    fifo = tmp_path / "fifo"
    os.mkfifo(fifo)
    for path, what in ((fifo, "a FIFO"), (tmp_path, "a folder")):
        for overwrite in (False, True):
            with pytest.raises(GatewayError, match=f"it is {what}, expected a file or a new name"):
                check_target(path, overwrite=overwrite)


@pytest.mark.slow
def test_a_folder_that_is_not_ours_ends_view_in_a_sentence(tmp_path: Path) -> None:
    """As the outside test did it: a real command, a place that cannot be written, no traceback."""
    pytest.importorskip("rerun", reason="rerun is not installed (extra 'view')")
    place = read_only()
    if place is None:
        pytest.skip("found no folder that takes no files (/proc, /sys)")
    fixture = ROOT / "fixtures" / "paper-types.mcap"
    for option, name in (("-o", "out.rrd"), ("-o", "out.png")):
        command = [sys.executable, "-m", "igtl_gateway", "view", str(fixture), option, str(place / name)]
        ended = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
        assert ended.returncode == 1
        assert ended.stdout == ""
        assert ended.stderr.startswith(f"igtl-gateway view: cannot write to {place / name}: ")
        assert ended.stderr.count("\n") == 1


@pytest.mark.slow
def test_a_disk_that_takes_no_more_ends_view_in_a_sentence(tmp_path: Path) -> None:
    pytest.importorskip("rerun", reason="rerun is not installed (extra 'view')")
    resource = pytest.importorskip("resource")
    fixture = ROOT / "fixtures" / "paper-types.mcap"
    command = [sys.executable, "-m", "igtl_gateway", "view", str(fixture), "-o", str(tmp_path / "out.rrd")]
    ended = subprocess.run(
        command,
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
        env={**os.environ, "PYTHONDONTWRITEBYTECODE": "1"},  # a truncated one would outlive the test
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, 20_000)),
    )
    assert ended.returncode == 1
    assert "Traceback" not in ended.stderr
    assert f"igtl-gateway view: cannot write to {tmp_path}/out.rrd: " in ended.stderr
    assert [*tmp_path.iterdir()] == []
