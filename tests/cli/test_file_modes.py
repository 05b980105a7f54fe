"""Files of patients are private: every output of every verb, under any umask, and the memory of the recorder."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from contextlib import nullcontext
from pathlib import Path

import pytest

from igtl_gateway.cli import main
from igtl_gateway.cli.review_output import write_csv
from igtl_gateway.clock import ManualClock
from igtl_gateway.cohort.results import Results
from igtl_gateway.record.options import RecordOptions
from igtl_gateway.record.recorder import Recorder
from igtl_gateway.review import Review
from igtl_gateway.seal.keys import SigningKey
from tests.record import samples

FIXTURES = Path(__file__).parents[2] / "fixtures"
SMALL = FIXTURES / "paper-types.mcap"

CORPUS = next((Path(__file__).parents[1] / "wire" / "corpus").glob("TRANSFORM_v1_s1.bin"))

#: A training set of a short session, with poses and pictures.
RECIPE = """
[dataset]
fps = 5
task = "none"
robot_type = "none"
[episodes]
by = "whole"
[[feature]]
name = "observation.state"
stream = "TRANSFORM/ProbeToTracker"
[[feature]]
name = "action"
stream = "TRANSFORM/ProbeToTracker"
"""

#: What writes files: words of the command line; OUT is a new name in an empty folder, HERE is that folder with a copy
#: of a recording.  ``cohort VERB`` and ``bridge`` write in other processes: ``test_tables_are_private``, and below.
WRITERS = (
    "keys new OUT",
    "slice SMALL OUT.mcap --end 1",
    "recover SMALL -o OUT.mcap",
    "recover HERE -o OUT",
    "merge SMALL IMAGES -o OUT.mcap --offset ultrasound=1",
    "deidentify SMALL -o OUT.mcap",
    "import BAG -o OUT.mcap",
    "decode CORPUS --reencode OUT.igtl",
    *(f"export SMALL --to {target} -o OUT" for target in ("csv", "rosbag2", "parquet", "arrow")),
    *(f"export IMAGES --to {target} -o OUT" for target in ("nrrd", "igs.mha", "ply", "vtk")),
    "export IMAGES --to lerobot --write-recipe OUT.toml",
    "export IMAGES --to lerobot --recipe RECIPE -o OUT",
    "seal SMALL --key KEY -o OUT.mcap",
    "sync MOVING --plot OUT.svg --max-lag 0.1",
    "view SMALL --save OUT.rrd",
    "retain HERE --retention 1h",
    "upload HERE --to s3://bucket --patience 0",
    "simulate TINY --out OUT.mcap",
    "cohort query SQL --out COHORT --csv OUT.csv",
    "cohort query SQL --out COHORT --parquet OUT.parquet",
    "cohort report --out COHORT --html OUT.html",
)


def _modes(folder: Path) -> dict[str, int]:
    return {str(path.relative_to(folder)): path.stat().st_mode & 0o777 for path in folder.rglob("*")}


@pytest.fixture(scope="module")
def names(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    folder = tmp_path_factory.mktemp("sound")
    (folder / "key").touch(0o600)
    (folder / "key").write_bytes(SigningKey.generate().private_pem())
    (folder / "recipe.toml").write_text(RECIPE)
    results = Results(folder / "cohort")
    with results.locked():
        results.add({"tasks": [{"task": "a", "file": "a", "verb": "info", "status": "ok"}]}, {})
    assert main(["export", str(SMALL), "--to", "rosbag2", "-o", str(folder / "bag")]) < 2
    fixtures = {"SMALL": SMALL, "IMAGES": FIXTURES / "ultrasound.mcap", "MOVING": FIXTURES / "acquisition.mcap"}
    made = {"KEY": "key", "RECIPE": "recipe.toml", "COHORT": "cohort", "BAG": "bag"}
    paths = {**fixtures, "CORPUS": CORPUS, **{name: folder / path for name, path in made.items()}}
    return {name: str(path) for name, path in paths.items()} | {"SQL": "SELECT * FROM tasks", "TINY": "paper-types"}


@pytest.mark.parametrize("words", WRITERS)
def test_outputs_are_private(
    tmp_path: Path, words: str, names: dict[str, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """With the umask 000 and without that of the command line: as for callers of the Python API."""
    monkeypatch.setattr("igtl_gateway.cli.files_with_mode", lambda mode, umask: nullcontext())
    monkeypatch.setattr("igtl_gateway.sync.plot.lag_chart", lambda *_: "<svg/>")  # it takes five seconds
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
    monkeypatch.setattr("igtl_gateway.cli.review_output._csv_rows", lambda _: [{"a": 1}])
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
