"""The verb: exit codes, the report for CI, a recipe, and what is refused before a program starts."""

from __future__ import annotations

import json
import sys
from importlib.util import find_spec
from pathlib import Path
from xml.etree import ElementTree

import pytest

from igtl_gateway import cli
from igtl_gateway.addons.resim import library
from tests.addons.resim import sessions
from tests.addons.resim.runs import PROGRAMS

ros = [pytest.mark.ros, pytest.mark.skipif(not find_spec("rclpy"), reason="needs ROS 2")]


@pytest.fixture(name="recording")
def _recording(tmp_path: Path) -> Path:
    return sessions.write(tmp_path / "in.mcap", sessions.poses(510))


def recipe(folder: Path, *arguments: str) -> Path:
    """A recipe with the planner."""
    path = folder / "programs.toml"
    command = json.dumps([sys.executable, str(PROGRAMS / "planner.py"), *arguments])
    path.write_text(f'[[program]]\nname = "planner"\ncommand = {command}\n', "utf-8")
    return path


def outcomes(path: Path) -> list[str]:
    """The outcome of each test case of a report."""
    return [case[0].tag if len(case) else "passed" for case in ElementTree.parse(path).iter("testcase")]


class TestWithRos:
    pytestmark = ros

    def test_exit_codes_and_reports(self, recording: Path, capsys: pytest.CaptureFixture[str]) -> None:
        folder = recording.parent
        good, report = folder / "good.mcap", folder / "report.xml"
        words = ["resim", str(recording), "--runs", "1", "--junit", str(report), "--overwrite", "--recipe"]
        assert cli.main([*words, str(recipe(folder, "none")), "--record", str(good)]) == 0
        assert outcomes(report) == ["passed", "skipped"]  # nothing to compare with
        assert "in.mcap has none of the outputs to compare with" in capsys.readouterr().out
        words[2:2] = ["--baseline", str(good)]
        assert cli.main([*words, str(recipe(folder, "none"))]) == 0
        assert outcomes(report) == ["passed", "passed"]
        assert cli.main([*words, str(recipe(folder, "mm"))]) == 1
        assert outcomes(report) == ["passed", "failure"]
        assert cli.main([*words, str(recipe(folder, "mm")), "--tolerance", "1.01mm"]) == 0
        assert "equal to good.mcap within the tolerance (11 messages)" in capsys.readouterr().out
        assert cli.main([*words, str(recipe(folder))]) == 2  # it needs an argument
        assert outcomes(report) == ["error"]
        assert "CANNOT BE JUDGED: planner: ended with exit code 1: IndexError" in capsys.readouterr().out
        nothing = folder / "nothing.mcap"
        assert cli.main([*words, str(recipe(folder)), "--record", str(nothing)]) == 2
        assert not nothing.exists()  # the next try needs no --overwrite


def test_what_is_refused_before_a_start(recording: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = recording.parent
    (folder / "there.xml").write_text("", "utf-8")
    (folder / "link.mcap").symlink_to(recording)
    (folder / "b").write_bytes(recording.read_bytes())
    (folder / "script").write_text("#!/no/such/interpreter\n", "utf-8")
    (folder / "script").chmod(0o700)
    over = ["--overwrite", "--record"]
    for words, line in (
        (
            ["--recipe", str(recipe(folder)), "--", "true"],
            "found --recipe and a program behind --, expected one of them",
        ),
        (["--recipe", str(folder / "none.toml")], "none.toml: "),
        (["--baseline", str(folder / "none.mcap"), "--", "true"], "none.mcap: No such file or directory"),
        (["--junit", str(folder / "there.xml"), "--", "true"], "there.xml: exists already, expected a new file"),
        (["--lead", "1e300", "--", "true"], "--lead: found 1e+300, expected 0 to 86400, a day"),
        (["--", "./"], "program: cannot be started: Permission denied: ./"),
        (["--", ""], "found no program, expected one behind --"),
        (["--", str(folder / "script")], "script: cannot be started: found no interpreter of its first line: "),
        (["--tolerance", "1mm,2mm", "--", "true"], "--tolerance: found '1mm,2mm', expected numbers with units"),
        (["--tolerance", "1mm,,1deg", "--", "true"], "--tolerance: found '', expected numbers with units"),
        ([*over, str(recording), "--", "true"], "as a file to read and to write, expected two files"),
        ([*over, str(folder / "link.mcap"), "--", "true"], "as a file to read and to write, expected two files"),
        (
            [*over, str(folder / "b"), "--baseline", str(folder / "b"), "--", "true"],
            "as a file to read and to write, expected two files",
        ),
        (["--build", "make", "--", "true"], "--build: has no effect without --bisect"),
    ):
        assert cli.main(["resim", str(recording), *words]) == 2
        captured = capsys.readouterr()
        assert line in captured.err and captured.err.count("\n") == 1 and not captured.out


def test_what_cannot_be_judged_is_2(
    recording: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """1 is for runs that differ: a fault of files, programs or this machine is 2, with one line."""
    folder = recording.parent
    cut = folder / "cut.mcap"
    cut.write_bytes(recording.read_bytes()[:3000])
    (folder / "script").write_text("", "utf-8")
    inside = folder / "inside.toml"
    inside.write_text('[[program]]\ncommand = "nothing-of-this-name"\nfolder = "."\n', "utf-8")
    for words, line in (
        ([str(cut), "--", "true"], "cut.mcap: was cut off after 3,000 bytes"),
        ([str(recording), "--record", str(folder / "none" / "a.mcap"), "--", "true"], "there is no folder"),
        ([str(recording), "--", "nothing-of-this-name"], "cannot be started: No such file or directory"),
        ([str(recording), "--", str(folder / "script")], "cannot be started: Permission denied"),
        ([str(recording), "--recipe", str(inside)], "cannot be started: found no such program"),
    ):
        assert cli.main(["resim", *words]) == 2
        captured = capsys.readouterr()
        assert line in captured.err and captured.err.count("\n") == 1 and not captured.out
    monkeypatch.setattr(library, "_NAME", "_of_another_build")
    assert cli.main(["resim", str(recording), "--", "true"]) == 2
    assert "found no _of_another_build" in capsys.readouterr().err


def test_the_report_has_no_name_of_another_format(recording: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit, match="2"):
        cli.main(["resim", str(recording), "--junit", "report.mcap", "--", "true"])
    line = "found 'report.mcap', the name of a recording (MCAP), expected a report (XML): *.xml"
    assert line in capsys.readouterr().err
