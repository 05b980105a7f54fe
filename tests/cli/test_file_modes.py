"""Files of patients are private: every output of every verb, under any umask, and the memory of the recorder."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from contextlib import nullcontext
from pathlib import Path

import pytest

from igtl_gateway.addons.cohort.results import Results
from igtl_gateway.addons.review import Review
from igtl_gateway.addons.review.output import write_csv
from igtl_gateway.base.clock import ManualClock
from igtl_gateway.cli import main
from igtl_gateway.record.options import RecordOptions
from igtl_gateway.record.recorder import Recorder
from tests.cli.writers import SMALL, WRITERS, sound_files
from tests.record import samples


def _modes(folder: Path) -> dict[str, int]:
    return {str(path.relative_to(folder)): path.stat().st_mode & 0o777 for path in folder.rglob("*")}


@pytest.fixture(scope="module")
def names(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    return sound_files(tmp_path_factory.mktemp("sound"))


@pytest.mark.slow
@pytest.mark.parametrize("words", WRITERS)
def test_outputs_are_private(
    tmp_path: Path, words: str, names: dict[str, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """With the umask 000 and without that of the command line: as for callers of the Python API."""
    monkeypatch.setattr("igtl_gateway.cli.files_with_mode", lambda mode, umask: nullcontext())
    monkeypatch.setattr("igtl_gateway.addons.sync.plot.lag_chart", lambda *_: "<svg/>")  # it takes five seconds
    for name, value in (("ENDPOINT_URL", "http://127.0.0.1:9"), ("ACCESS_KEY_ID", "a"), ("SECRET_ACCESS_KEY", "b")):
        monkeypatch.setenv(f"AWS_{name}", value)
    given = {"HERE": str(tmp_path), **names}
    if "HERE" in words:
        shutil.copyfile(SMALL, tmp_path / "copy.mcap")
        (tmp_path / "copy.mcap").chmod(0o600)
    before = os.umask(0)
    try:
        code = main([given.get(word, word.replace("OUT", str(tmp_path / "out"))) for word in words.split()])
        assert os.umask(0) == 0  # as it was
    finally:
        os.umask(before)
    found = _modes(tmp_path)
    assert set(found) - {"copy.mcap"}, code
    assert {path: mode for path, mode in found.items() if mode & 0o077} == {}


def test_tables_are_private(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("igtl_gateway.addons.review.output._csv_rows", lambda _: [{"a": 1}])
    before = os.umask(0)
    try:
        write_csv(tmp_path / "review.csv", Review.__new__(Review), overwrite=False)
        results = Results(tmp_path / "above" / "cohort")
        for number in "ab":
            with results.locked():
                results.add({"tasks": [{"task": number, "file": number, "verb": "info", "status": "ok"}]}, {})
        with results.locked():
            results.compact()
    finally:
        os.umask(before)
    found = _modes(tmp_path)
    assert len(found) > 5
    assert {path: mode for path, mode in found.items() if mode & 0o077} == {}


def test_a_mode_is_for_files_and_directories(tmp_path: Path) -> None:
    words = ["export", str(SMALL), "--to", "csv", "-o", str(tmp_path / "out"), "--file-mode", "0640"]
    assert main(words) < 2
    assert set(_modes(tmp_path).values()) == {0o640, 0o750}
    assert main(["slice", str(SMALL), "-o", str(tmp_path / "a.mcap"), "--end", "1", "--file-mode", "0644"]) == 0
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
    words = ["slice", str(SMALL), "-o", str(path), "--end", "1", "--overwrite"]
    subprocess.run([sys.executable, "-c", code, *words], check=True, capture_output=True)
    assert path.stat().st_mode & 0o777 == 0o600
