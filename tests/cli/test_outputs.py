"""A file that a verb writes: refused in one sentence where it cannot be, and whole where it can."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from igtl_gateway.cli.outputs import check_target, written
from igtl_gateway.errors import ConfigError, GatewayError


def read_only() -> Path | None:
    """A folder in which no user, not even root, can create a file."""
    return next((path for path in map(Path, ("/proc", "/sys")) if path.is_dir()), None)


def test_a_new_file_is_there_when_it_is_whole(tmp_path: Path) -> None:
    out = tmp_path / "out.rrd"
    check_target(out, overwrite=False)
    with written(out) as partial:
        partial.write_bytes(b"all of it")
        assert not out.exists()
    assert [(path.name, path.read_bytes()) for path in tmp_path.iterdir()] == [("out.rrd", b"all of it")]


def test_what_was_there_stays_where_the_work_fails(tmp_path: Path) -> None:
    out = tmp_path / "out.rrd"
    out.write_bytes(b"old")
    with pytest.raises(GatewayError, match="no such stream"), written(out) as partial:
        partial.write_bytes(b"half")
        raise GatewayError("no such stream")
    assert [(path.name, path.read_bytes()) for path in tmp_path.iterdir()] == [("out.rrd", b"old")]


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
    for path in (fifo, tmp_path):
        with pytest.raises(ConfigError, match="exists already"):
            check_target(path, overwrite=False)
        with pytest.raises(GatewayError, match="not a regular file"):
            check_target(path, overwrite=True)


def test_a_folder_that_is_not_ours_ends_view_in_a_sentence(tmp_path: Path) -> None:
    """As the outside test did it: a real command, a place that cannot be written, no traceback."""
    pytest.importorskip("rerun", reason="rerun is not installed (extra 'view')")
    place = read_only()
    if place is None:
        pytest.skip("found no folder that takes no files (/proc, /sys)")
    fixture = Path(__file__).parents[2] / "fixtures" / "paper-types.mcap"
    for option in ("--save", "--screenshot"):
        command = [sys.executable, "-m", "igtl_gateway", "view", str(fixture), option, str(place / "out.rrd")]
        ended = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
        assert ended.returncode == 1
        assert ended.stdout == ""
        assert ended.stderr.startswith(f"igtl-gateway view: cannot write to {place}/out.rrd: ")
        assert ended.stderr.count("\n") == 1


def test_a_disk_that_takes_no_more_ends_view_in_a_sentence(tmp_path: Path) -> None:
    pytest.importorskip("rerun", reason="rerun is not installed (extra 'view')")
    resource = pytest.importorskip("resource")
    fixture = Path(__file__).parents[2] / "fixtures" / "paper-types.mcap"
    command = [sys.executable, "-m", "igtl_gateway", "view", str(fixture), "--save", str(tmp_path / "out.rrd")]
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
