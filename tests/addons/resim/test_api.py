"""``igtl_gateway.resim`` and the fixture ``igtl_resim``."""

from __future__ import annotations

import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest

import igtl_gateway
from igtl_gateway.addon.reading import SessionFile
from igtl_gateway.addons.resim import api
from igtl_gateway.base.errors import ConfigError
from tests.addons.resim import sessions
from tests.addons.resim.runs import PROGRAMS
from tests.testing.outside import run_pytest

ros = [pytest.mark.ros, pytest.mark.skipif(not find_spec("rclpy"), reason="needs ROS 2")]

TESTS = """
import shutil
import sys

PLANNER = [sys.executable, "planner.py"]

def test_as_before(igtl_resim):
    found = igtl_resim("in.mcap", [*PLANNER, "none"], runs=2, baseline="good.mcap")
    assert found.is_deterministic and found.outputs.is_file()
    shutil.copy(found.outputs, "kept.mcap")

def test_a_regression(igtl_resim):
    igtl_resim("in.mcap", [*PLANNER, "deg"], runs=1, baseline="good.mcap", tolerance_mm=1)

def test_within_the_tolerance(igtl_resim):
    igtl_resim("in.mcap", [*PLANNER, "deg"], runs=1, baseline="good.mcap", tolerance_deg=1.1)

def test_a_crash(igtl_resim):
    igtl_resim("in.mcap", PLANNER, runs=1)

def test_a_race(igtl_resim):
    igtl_resim("in7.mcap", [sys.executable, "planted.py", "timer"], runs=2)

def test_a_race_that_is_permitted(igtl_resim):
    found = igtl_resim("in7.mcap", [sys.executable, "planted.py", "timer"], runs=2, permit_races=True)
    assert found.is_deterministic and found.race.startswith("a timer races /in: /out, message 21 at ")

def test_no_baseline(igtl_resim):
    igtl_resim("in.mcap", PLANNER, baseline="none.mcap")

def test_no_input(igtl_resim):
    igtl_resim("in.mcap", [sys.executable, "-c", NODE], runs=1)

NODE = "import rclpy; rclpy.init(); rclpy.spin(rclpy.create_node('idle'))"
"""


def _folder(tmp_path: Path) -> Path:
    """A folder with the planner, a recording of 600 poses, and the outputs of a good run."""
    recording = sessions.write(tmp_path / "in.mcap", sessions.poses(600))
    rows = [(7_000_000 * number, *row[1:]) for number, row in enumerate(sessions.texts(40), 1)]
    sessions.write(tmp_path / "in7.mcap", rows)
    for name in ("planner.py", "planted.py"):
        (tmp_path / name).write_bytes((PROGRAMS / name).read_bytes())
    (tmp_path / "runs").mkdir()
    found = igtl_gateway.resim(
        recording, [sys.executable, "planner.py", "none"], runs=1, cwd=tmp_path, folder=tmp_path / "runs"
    )
    assert (
        str(found)
        == f"1 run; {recording.name} has none of the outputs to compare with\n  inputs: /pose (600)\n  outputs: /plan"
    )
    found.outputs.rename(tmp_path / "good.mcap")
    with SessionFile.open(tmp_path / "good.mcap") as file:
        assert {channel.topic: channel.count for channel in file.channels}["/plan"] == 600
    return tmp_path


class TestTheFixture:
    pytestmark = ros

    def test_a_part_of_a_recording(self, tmp_path: Path) -> None:
        path = sessions.write(tmp_path / "in.mcap", sessions.poses(600))
        planner = [sys.executable, str(PROGRAMS / "planner.py"), "none"]
        found = igtl_gateway.resim(path, planner, start=2.0, end="2.5", runs=1)
        assert found.result.runs[0].delivered == {"/pose": 50}

    def test_in_a_project(self, tmp_path: Path) -> None:
        folder = _folder(tmp_path)
        (folder / "test_it.py").write_text(TESTS, "utf-8")
        result = run_pytest(folder)
        assert "5 failed, 3 passed, 1 warning" in result.stdout, result.stdout + result.stderr
        assert "AssertionError: NOT DETERMINISTIC: a timer races /in: /out, message 21 at 0.140000 s" in result.stdout
        assert "UserWarning: a timer races /in: /out, message 21 at 0.140000 s" in result.stdout
        assert (
            "AssertionError: DIFFERENT from good.mcap in 1 of 1 stream (1 run): "
            "/plan, message 500 at 4.990000 s: transform.qw is" in result.stdout
        )
        assert "/plan: 600 messages: 101 differ; at most 1°" in result.stdout
        assert "AssertionError: CANNOT BE JUDGED: planner.py: ended with exit code 1" in result.stdout
        assert "IndexError: list index out of range" in result.stdout
        assert "expected the outputs of a good run: igtl-gateway resim in.mcap --record none.mcap" in result.stdout
        assert "AssertionError: CANNOT BE JUDGED: no program published a message" in result.stdout
        assert "igtl_gateway/" not in result.stdout  # no internal frames


@pytest.mark.parametrize(
    ("arguments", "line"),
    [
        ({"runs": 0}, "runs: found 0, expected 1 or more"),
        ({"tolerance_mm": -1.0}, "tolerance_mm: found -1.0, expected 0 or more"),
        ({"latency_ms": float("nan")}, "latency_ms: found nan, expected 0 to 86400000, a day"),
        ({"lead_s": 1e300}, r"lead_s: found 1e\+300, expected 0 to 86400, a day"),
        ({"clocks": "libc"}, "clocks: found 'libc', expected one of shifted, session, real"),
        ({"cpu_limit_s": 0.0}, "cpu_limit_s: found 0.0, expected more than 0"),
    ],
)
def test_arguments_out_of_range(arguments: dict[str, Any], line: str) -> None:
    with pytest.raises(ConfigError, match=line):
        igtl_gateway.resim("none.mcap", "true", **arguments)


@pytest.mark.parametrize(
    ("arguments", "line"),
    [
        ({"start": "soon"}, "^start: found 'soon', expected seconds from the beginning"),
        ({"start": 7}, r"^start: found \+7.000 s, expected at most \+5.990 s"),
        ({"start": 2, "end": "2"}, r"^end: found \+2.000 s, expected after \+2.000 s"),
        ({"end": "mark:slip"}, "^end: found mark:slip, expected a recording with marks"),
    ],
)
def test_a_part_that_is_not_in_the_recording(tmp_path: Path, arguments: dict[str, Any], line: str) -> None:
    path = sessions.write(tmp_path / "in.mcap", sessions.poses(600))
    with pytest.raises(ConfigError, match=line):
        igtl_gateway.resim(path, "true", **arguments)


def test_programs_that_are_none() -> None:
    with pytest.raises(ConfigError, match="found no program, expected one behind --"):
        igtl_gateway.resim("none.mcap")
    with pytest.raises(ConfigError, match="programs: found '', expected a string or a list of strings"):
        igtl_gateway.resim("none.mcap", "")


def test_one_topic_is_a_list_of_one() -> None:
    """The letters of a string were topics."""
    assert api._globs("/tool") == api._globs(["/tool"]) == ("/tool",)


def test_without_the_add_on() -> None:
    code = (
        "import igtl_gateway, igtl_gateway.base.addons as addons\n"
        "addons.is_present = lambda name: False\n"
        "try: igtl_gateway.resim\n"
        "except igtl_gateway.base.errors.MissingAddon as error: print(error)\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.startswith("found no add-on 'resim', which this needs") and done.stdout.count("\n") == 1
