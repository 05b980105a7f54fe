"""Files of patients are private: every output of every verb, under any umask, and the memory of the recorder."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from igtl_gateway.cli import main
from igtl_gateway.clock import ManualClock
from igtl_gateway.record.options import RecordOptions
from igtl_gateway.record.recorder import Recorder
from tests.record import samples

FIXTURES = Path(__file__).parents[2] / "fixtures"
SMALL = FIXTURES / "paper-types.mcap"

CORPUS = next((Path(__file__).parents[1] / "wire" / "corpus").glob("TRANSFORM_v1_s1.bin"))

#: What writes files: words of the command line; OUT is a new name in an empty folder.
WRITERS = (
    ("keys", "new", "OUT"),
    ("slice", SMALL, "OUT.mcap", "--end", "1"),
    ("recover", SMALL, "-o", "OUT.mcap"),
    ("export", SMALL, "--to", "csv", "-o", "OUT"),
    ("export", SMALL, "--to", "rosbag2", "-o", "OUT"),
    ("deidentify", SMALL, "-o", "OUT.mcap"),
    ("decode", CORPUS, "--reencode", "OUT.igtl"),
)


def _modes(folder: Path) -> dict[str, int]:
    return {str(path.relative_to(folder)): path.stat().st_mode & 0o777 for path in folder.rglob("*")}


@pytest.mark.parametrize("umask", [0o000])
@pytest.mark.parametrize("words", WRITERS, ids=lambda words: "-".join(map(str, words[:4:3])))
def test_outputs_are_private(tmp_path: Path, words: tuple[object, ...], umask: int) -> None:
    before = os.umask(umask)
    try:
        assert main([str(word).replace("OUT", str(tmp_path / "out")) for word in words]) < 2  # 1: lossy
        assert os.umask(umask) == umask  # as it was
    finally:
        os.umask(before)
    found = _modes(tmp_path)
    assert found
    assert {path: mode for path, mode in found.items() if mode & 0o077} == {}


def test_a_mode_is_for_files_and_directories(tmp_path: Path) -> None:
    words = ["export", str(SMALL), "--to", "csv", "-o", str(tmp_path / "out"), "--file-mode", "0640"]
    assert main(words) < 2
    assert set(_modes(tmp_path).values()) == {0o640, 0o750}
    assert main(["slice", str(SMALL), str(tmp_path / "a.mcap"), "--end", "1", "--file-mode", "0644"]) == 0
    assert (tmp_path / "a.mcap").stat().st_mode & 0o777 == 0o644
    for wrong in ("640x", "0400", "0755", "9999", "06400"):
        assert main([*words[:-1], wrong]) == 2


@pytest.mark.parametrize("mode", [0o600, 0o640])
def test_a_recording_of_the_api_is_private(tmp_path: Path, mode: int) -> None:
    shared = {path.name for path in Path("/dev/shm").iterdir()} if Path("/dev/shm").is_dir() else set()
    before = os.umask(0)
    try:
        recorder = Recorder(
            tmp_path / "out.mcap",
            samples.SESSION,
            qos_of=lambda _topic, _type: None,
            on_note=lambda _note: None,
            clock=ManualClock(),
            options=RecordOptions(split_s=1.0, file_mode=mode),
        )
        for number in range(1, 20):
            recorder(samples.ros(number))
        if Path("/dev/shm").is_dir():
            new = {path.name for path in Path("/dev/shm").iterdir()} - shared
            assert not [name for name in new if "igtl" in name]  # the queue has no name
        recorder.close({})
    finally:
        os.umask(before)
    found = _modes(tmp_path)
    assert {found.pop("out")} == {0o700 if mode == 0o600 else 0o750}
    assert set(found.values()) == {mode}


def test_an_overwritten_recording_becomes_private(tmp_path: Path) -> None:
    path = tmp_path / "out.mcap"
    path.touch(0o666)
    path.chmod(0o666)
    code = "import sys; from igtl_gateway.cli import main; sys.exit(main())"
    words = ["slice", str(SMALL), str(path), "--end", "1", "--overwrite"]
    subprocess.run([sys.executable, "-c", code, *words], check=True, capture_output=True)
    assert path.stat().st_mode & 0o777 == 0o600
