"""The verb: exit codes, the report for CI, a recipe, and what is refused before a program starts."""

from __future__ import annotations

import json
import shlex
import sys
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from xml.etree import ElementTree

import pytest

from igtl_gateway import cli
from igtl_gateway.addon.reading import Qos, SessionFile
from igtl_gateway.addons.resim import library
from igtl_gateway.addons.resim.inputs import Inputs, RecordedInput
from tests.addons.resim import sessions
from tests.addons.resim.runs import PROGRAMS
from tests.tables import table

SAMPLER = ["--", sys.executable, str(PROGRAMS / "sampler.py"), "echo"]
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

    def test_samples_of_a_timer(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
    ) -> None:
        """A live recording whose timer began at another moment than that of a run."""
        monkeypatch.chdir(tmp_path)
        command = ["--runs", "2", *SAMPLER]
        live = sessions.live(tmp_path / "a.mcap", 40, SAMPLER[1:], 17)
        assert cli.main(["resim", str(live), *command]) == 1
        printed = capsys.readouterr().out
        assert "SAMPLED BY A TIMER: /sample: the timer began at another moment in a.mcap" in printed
        steps = [shlex.split(line) for line in printed.splitlines() if line.startswith("    igtl-gateway ")]
        keep, again, view = steps
        stay = next(line for line in printed.splitlines() if line.startswith("outputs that differ stay until"))
        assert stay.endswith(f" rm -r {Path(view[3]).parent}")
        assert view[:3] == ["igtl-gateway", "view", str(live)] and Path(view[3]).is_file()
        assert cli.main([*keep[1:-4], "--runs", "1", *keep[-4:]]) == 1, "it differs from the recording as before"
        assert cli.main([*again[1:-4], "--runs", "1", *again[-4:]]) == 0, "and not from the baseline"

    def test_a_window_of_several_recordings(self, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
        live = [str(sessions.live(tmp_path / f"{lead}.mcap", 40, SAMPLER[1:], lead)) for lead in (17, 23)]
        assert cli.main(["resim", *live, "--start", "0.1", "--end", "0.3", "--runs", "2", *SAMPLER]) == 1
        rows = [line.split() for line in capsys.readouterr().out.splitlines()[1:3]]
        assert [row[1:6] for row in rows] == [["sampled", "by", "a", "timer", "20"]] * 2

    def test_a_part_proposes_a_baseline_of_the_part(self, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
        live = str(sessions.live(tmp_path / "a.mcap", 40, SAMPLER[1:], 17))
        words = ["resim", live, "--start", "0.1", "--end", "0.3", "--runs", "1", *SAMPLER]
        assert cli.main(words) == 1
        printed = capsys.readouterr().out
        assert "without what came before: compare with a baseline of the same part" in printed
        assert "--record a-part.mcap --start 0.1 --end 0.3 -- " in " ".join(printed.split())

    def test_what_a_timer_samples_explains_nothing_else(
        self, tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        live = sessions.live(tmp_path / "a.mcap", 40, SAMPLER[1:], 17)
        assert cli.main(["resim", str(live), "--runs", "2", *SAMPLER, "higher"]) == 1
        printed = capsys.readouterr().out
        assert "DIFFERENT from a.mcap in 2 of 2 streams" in printed
        assert "/plan, message 1 at 0.000000 s: transform.z is 0.1 and 0.2 (100 mm)" in printed


def test_a_table_of_several_recordings(recording: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = recording.parent
    (folder / "broken.mcap").write_bytes(recording.read_bytes()[:100])
    paths = [str(recording), str(folder / "broken.mcap"), str(folder / "none.mcap")]
    assert cli.main(["resim", *paths, "--runs", "1", "--", "true"]) == 1
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].split() == ["recording", "verdict", "inputs", "outputs"]
    assert [line.split()[:4] for line in lines[1:4]] == [[path, "cannot", "be", "judged"] for path in paths]
    assert lines[4].startswith(f"{recording}: CANNOT BE JUDGED: true: ended with exit code 0")
    assert lines[-1] == "0 of 3 recordings as expected"
    for option, value in (("--record", "x.mcap"), ("--junit", "x.xml"), ("--bisect", "a..b")):
        assert cli.main(["resim", *paths, option, str(folder / value), "--", "true"]) == 2
        assert f"{option}: found 3 recordings, expected one" in capsys.readouterr().err


@table(
    ("name", "content", "programs"),
    [
        ("a.launch.py", 'x = [Node(package="a", executable="b"), Node(package="c", executable="d")]', "ros2 run c d"),
        ("a.launch.py", "def (", ""),
        ("a_launch.xml", '<launch><node pkg="a" exec="b"/></launch>', "ros2 run a b"),
        ("a.launch.xml", "<launch>", ""),
        ("a.launch.yaml", "launch:", ""),
        ("bringup.py", "def generate_launch_description():\n    pass", ""),
    ],
)
def test_a_launch_file_is_no_program(
    recording: Path, capsys: pytest.CaptureFixture[str], name: str, content: str, programs: str
) -> None:
    path = recording.with_name(name)
    path.write_text(content, "utf-8")
    for command in ((sys.executable, str(path)), ("ros2", "launch", str(path))):
        if name == "bringup.py" and command[0] == "ros2":
            continue
        assert cli.main(["resim", str(recording), "--", *command]) == 2
        error = capsys.readouterr().err
        assert f"found the launch file {name}, expected its programs, each behind a -- of its own" in error
        assert f" -- {programs}" in error or not programs
    assert cli.main(["resim", str(recording), "--", "ros2", "launch", "demo", "talker"]) == 2
    assert "found ros2 launch demo talker, expected its programs" in capsys.readouterr().err


def test_a_program_without_its_dashes(recording: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["resim", str(recording), "python", "a.py"]) == 2
    assert f"if python a.py is one: igtl-gateway resim {recording} -- python a.py" in capsys.readouterr().err


def all_of(inputs: Inputs) -> list[RecordedInput]:
    return [inputs.pop() for _ in iter(inputs.peek, None)]


def test_a_window_begins_with_what_was_latched(tmp_path: Path) -> None:
    rows = [*sessions.texts(20, "/map"), *sessions.poses(100)]
    path = sessions.write(tmp_path / "a.mcap", rows, qos={"/map": Qos(1, True, True)})
    since_ns = sessions.START_NS + 500 * sessions.MS
    with SessionFile.open(path) as file:
        every, found = all_of(Inputs(file)), all_of(Inputs(file, since_ns=since_ns))
    before = [each for each in every if each.time_ns < since_ns and each.topic == "/map"]
    assert found[0] == replace(before[-1], time_ns=since_ns)
    assert found[1:] == [each for each in every if each.time_ns >= since_ns]


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
