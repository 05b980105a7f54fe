"""The commit that changed the outputs, in a small repository; the user's repository stays as it is."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from importlib.util import find_spec
from pathlib import Path

import pytest

from igtl_gateway import cli
from igtl_gateway.base.clock import SystemClock
from tests.addons.resim import sessions
from tests.places import ROOT

pytestmark = [pytest.mark.skipif(not shutil.which("git"), reason="needs git")]
ros = [pytest.mark.ros, pytest.mark.skipif(not find_spec("rclpy"), reason="needs ROS 2")]

NODE = """\
import rclpy
from geometry_msgs.msg import TransformStamped
from offset import OFFSET

rclpy.init()
node = rclpy.create_node("planner")
publisher = node.create_publisher(TransformStamped, "/plan", 10)

def take(pose):
    pose.transform.translation.x += OFFSET
    publisher.publish(pose)

node.create_subscription(TransformStamped, "/pose", take, 10)
try:
    rclpy.spin(node)
except KeyboardInterrupt:
    pass
"""
#: Of commits 1 to 8: offset in metres, and the script that builds.  Offsets of one size: a stale .pyc would be used.
BUILD = "cp offset.in nodes/offset.py"
COMMITS = [
    ("0.100", BUILD), ("0.100", BUILD + " # 2"), ("0.100", BUILD + " # 3"), ("0.100", "echo no compiler >&2; exit 3"),
    ("0.100", BUILD), ("0.101", BUILD), ("0.101", BUILD + " # 7"), ("0.101", BUILD + " # 8"),
]  # fmt: skip


def git(folder: Path, *words: str) -> str:
    identity = ("-c", "user.name=Ada", "-c", "user.email=ada@example.org", "-c", "commit.gpgsign=false")
    return subprocess.run(["git", *identity, *words], cwd=folder, capture_output=True, text=True, check=True).stdout


@pytest.fixture(name="place")
def _place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A repository with 8 commits, a change that is not committed, and the folder ``nodes`` as the current one."""
    top = tmp_path / "repository"
    (top / "nodes").mkdir(parents=True)
    git(top, "init", "-q", "-b", "main")
    (top / "nodes" / "planner.py").write_text(NODE, "utf-8")
    (top / ".gitignore").write_text("nodes/offset.py\n", "utf-8")
    for number, (offset, build) in enumerate(COMMITS, 1):
        (top / "offset.in").write_text(f"OFFSET = {offset}\n", "utf-8")
        (top / "build.sh").write_text(build + "\n", "utf-8")
        git(top, "add", ".")
        git(top, "commit", "-q", "--allow-empty", "-m", f"change {number}")
    (top / "offset.in").write_text("OFFSET = 9\n", "utf-8")
    (tmp_path / "tmp").mkdir()
    monkeypatch.setenv("TMPDIR", str(tmp_path / "tmp"))
    monkeypatch.setattr("tempfile.tempdir", None)
    monkeypatch.chdir(top / "nodes")
    sessions.write(tmp_path / "in.mcap", sessions.poses(30))
    return tmp_path


def state(place: Path) -> tuple[str, ...]:
    """The user's repository: refs, changes, files of git, and what is left in the temporary folder."""
    top = place / "repository"
    files = sorted(path.name for path in (top / ".git").iterdir())
    left = sorted(path.name for path in (place / "tmp").glob("igtl-*"))
    return (git(top, "for-each-ref"), git(top, "rev-parse", "HEAD"), git(top, "status", "--porcelain"), *files, *left)


def words(place: Path, span: str, *options: str) -> list[str]:
    program = [sys.executable, "planner.py"]
    return ["resim", str(place / "in.mcap"), "--runs", "1", "--bisect", span, *options, "--", *program]


class TestWithRos:
    pytestmark = ros

    def test_the_commit_is_found(self, place: Path, capsys: pytest.CaptureFixture[str]) -> None:
        before = state(place)
        assert cli.main(words(place, "HEAD~7..HEAD", "--build", "cd .. && sh build.sh")) == 1
        out = capsys.readouterr().out.splitlines()
        marks = {line.split(":")[0].rpartition(" ")[2]: line.split()[0] for line in out[:-2]}
        assert out[0].startswith("good") and out[0].endswith("change 1: 1 run")
        assert marks["1"] == "good" and marks["8"] == "bad" and marks["6"] == "bad" and marks["5"] == "good"
        assert [line for line in out if line.endswith("change 4: does not build: no compiler")]
        assert out[-2].startswith("FIRST CHANGED by ") and ": change 6 (Ada, 20" in out[-2]
        assert "/plan, message 1 at 0.000000 s: transform.x is 1.1 and 1.101 (1 mm)" in out[-1]
        assert state(place) == before

    def test_commits_that_do_not_build_before_it(self, place: Path, capsys: pytest.CaptureFixture[str]) -> None:
        # commits 5 and 6 do not build: the first changed one is 5, 6 or 7
        build = 'cd .. && case "$(git log -1 --format=%s)" in *5|*6) exit 1;; esac; cp offset.in nodes/offset.py'
        assert cli.main(words(place, "HEAD~7..HEAD", "--json", "--build", build)) == 2
        found = json.loads(capsys.readouterr().out)
        assert sorted(each["subject"] for each in found["possible"]) == ["change 5", "change 6", "change 7"]
        assert found["found"] is None and found["verdict"].startswith("NOT UNIQUE: one of these 3 commits")

    def test_equal_ends(self, place: Path, capsys: pytest.CaptureFixture[str]) -> None:
        assert cli.main(words(place, "HEAD~2..HEAD", "--build", "cd .. && sh build.sh")) == 0
        assert capsys.readouterr().out.splitlines()[-1].startswith("equal: ")


@pytest.mark.parametrize(
    ("span", "line"),
    [
        ("HEAD", "--bisect: found 'HEAD', expected GOOD..BAD"),
        ("HEAD...main", "--bisect: found 'HEAD...main', expected GOOD..BAD"),
        ("none..HEAD", "--bisect: found no commit 'none'"),
        ("HEAD..--all", "--bisect: found no commit '--all'"),
        ("HEAD..HEAD~2", "--bisect: found HEAD, which is not an ancestor of HEAD~2, expected one that is"),
        ("HEAD..main", "--bisect: found HEAD and main, which are one commit, expected two"),
        ("HEAD~4..HEAD~3", "cannot be the baseline: does not build: no compiler"),
    ],
)
def test_wrong_ends(place: Path, span: str, line: str, capsys: pytest.CaptureFixture[str]) -> None:
    before = state(place)
    assert cli.main(words(place, span, "--build", "cd .. && sh build.sh")) == 2
    assert line in capsys.readouterr().err
    assert state(place) == before


def test_what_cannot_be_combined(place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(words(place, "HEAD~1..HEAD", "--junit", str(place / "out.xml"))) == 2
    assert "--junit: cannot be combined with --bisect" in capsys.readouterr().err
    assert cli.main(["resim", str(place / "in.mcap"), "--build", "make", "--", "true"]) == 2
    assert "--build: has no effect without --bisect" in capsys.readouterr().err


def test_a_program_of_the_working_tree(place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    program = place / "repository" / "nodes" / "planner.py"
    assert cli.main([*words(place, "HEAD~1..HEAD")[:-1], str(program)]) == 2
    assert "a file of the working tree, expected nodes/planner.py as in a checkout" in capsys.readouterr().err


def test_outside_of_a_repository(
    place: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert cli.main(words(place, "HEAD~1..HEAD")) == 2
    assert "--bisect: git rev-parse: fatal: not a git repository" in capsys.readouterr().err


@pytest.mark.usefixtures("terminal_signals")
def test_an_interrupt_leaves_nothing(place: Path) -> None:
    before = state(place)
    build = f"echo $$ > {place}/pid; exec sleep 60"
    command = [sys.executable, "-m", "igtl_gateway", *words(place, "HEAD~7..HEAD", "--build", build)]
    env = os.environ | {"PYTHONPATH": str(ROOT)}
    with subprocess.Popen(command, env=env, stderr=subprocess.PIPE, text=True) as process:
        clock = SystemClock()
        end_ns = clock.monotonic_ns() + 60_000_000_000
        while not (place / "pid").exists() or not (place / "pid").read_text("utf-8").strip():
            assert clock.monotonic_ns() < end_ns and process.poll() is None
            time.sleep(0.05)
        process.send_signal(signal.SIGINT)
        _, error = process.communicate(timeout=30)
    assert "interrupted" in error and process.returncode == 2
    pid = int((place / "pid").read_text("utf-8"))
    end_ns = clock.monotonic_ns() + 10_000_000_000
    while _runs(pid):  # one that was just being started ends with its parent
        assert clock.monotonic_ns() < end_ns
    assert state(place) == before


def _runs(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return True
