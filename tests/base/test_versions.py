"""base/versions.py: what stands in for newer Pythons gives what these have."""

from __future__ import annotations

import subprocess
import sys
from datetime import datetime
from pathlib import Path

import pytest

from igtl_gateway.base.versions import add_note, iso_time, spelled_out
from tests.tables import table

#: Text → what Python 3.11 reads.
TIMES = {
    "2026-03-14T09:00:00Z": "2026-03-14T09:00:00+00:00",
    "2026-03-14": "2026-03-14T00:00:00",
    "20260314": "2026-03-14T00:00:00",
    "2026-03-14T09": "2026-03-14T09:00:00",
    "20260314T090102": "2026-03-14T09:01:02",
    "2026-03-14 09:01:02,5": "2026-03-14T09:01:02.500000",
    "2026-03-14T09:01:02.123456789+02:30": "2026-03-14T09:01:02.123456+02:30",
    "2026-03-14T09:01:02-0800": "2026-03-14T09:01:02-08:00",
    "2026-03-14T09:01+05": "2026-03-14T09:01:00+05:00",
    "2026-03-14T09:01:02+01:02:03.5": "2026-03-14T09:01:02+01:02:03.500000",
    "2026-W11-6": "2026-03-14T00:00:00",
    "2026W11": "2026-03-09T00:00:00",
}
WRONG = ("", "now", "2026-3-14", "2026-03-14T", "2026-13-14", "2026-03-14T25", "2026-03-14T09:61", "2026-W54-1")


@table(("text", "expected"), TIMES.items())
def test_times(text: str, expected: str) -> None:
    assert iso_time(text) == spelled_out(text) == datetime.fromisoformat(expected)


@pytest.mark.parametrize("text", WRONG)
def test_no_times(text: str) -> None:
    for read in (iso_time, spelled_out):
        with pytest.raises(ValueError):
            read(text)


def test_notes() -> None:
    error = ValueError("wrong")
    add_note(error, "in line 1")
    add_note(error, "and 2")
    assert vars(error)["__notes__"] == ["in line 1", "and 2"]


#: Begins as if it ran on Python 3.10: what base/versions.py has for it is a branch there.
OLDER = """
import sys
real = sys.version_info
sys.version_info = (3, 10, 12)
sys.modules["tomli"] = __import__("tomllib")
from igtl_gateway.base import versions
"""


def run(text: str, folder: Path) -> str:
    done = subprocess.run([sys.executable, "-c", text], cwd=folder, capture_output=True, text=True, check=True)
    return done.stdout.strip()


def test_a_program_does_not_import_from_its_folder(tmp_path: Path) -> None:
    (tmp_path / "json.py").write_text("raise SystemExit('taken from the folder')")
    (tmp_path / "shown.py").write_text("import json, sys; print(json.dumps(sys.argv[1:]), __name__)")
    started = """
import pathlib, subprocess
print(subprocess.run([*versions.python_command(PROGRAM), "a b"], capture_output=True, text=True).stdout.strip())
"""
    of_a_file = f"PROGRAM = pathlib.Path({str(tmp_path / 'shown.py')!r})"
    begin = OLDER.replace("import sys\n", "import sys; sys.path.pop(0)\n", 1)
    expected = '["a b"] __main__'
    for head in (begin, begin.replace("(3, 10, 12)", "real")):
        assert run(f"{head}import pathlib\n{of_a_file}{started}", tmp_path) == expected
        assert '"a": 1' in run(
            f"{head}import subprocess\nprint(subprocess.run(versions.python_command('json.tool'), input='{{\"a\":1}}', "
            "capture_output=True, text=True).stdout)",
            tmp_path,
        )


def test_enumerations_and_blobs_of_python_3_10(tmp_path: Path) -> None:
    text = """
import sqlite3
class Colour(versions.StrEnum):
    RED = "red"
base = sqlite3.connect(":memory:")
base.execute("CREATE TABLE t(b BLOB)")
base.execute("INSERT INTO t VALUES (x'0102')")
versions.limit_values(base, 10)
print(f"{Colour.RED} {Colour.RED:>4}", str(Colour.RED), Colour("red").value, versions.read_blob(base, "t", "b", 1))
"""
    assert run(OLDER + text, tmp_path) == "red  red red red b'\\x01\\x02'"
    assert run(OLDER.replace("(3, 10, 12)", "real") + text, tmp_path) == "red  red red red b'\\x01\\x02'"
