"""A first start that is interrupted or killed, two at once, and a disk that is full or cannot be written."""

from __future__ import annotations

import shutil
import signal
import subprocess
import sys
import time
from collections import namedtuple
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from igtl_gateway.convert.interfaces import definition_folder
from igtl_gateway.edges.ros_interfaces import compiling
from tests.timing import WAIT_S

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="the packages are compiled for the ROS wheels only")

#: A first start, with a program in place of the compiler.
START = """
import sys
from pathlib import Path
from igtl_gateway.base.systems.signals import signals_in_thread
from igtl_gateway.edges.ros_interfaces import compiling

compiling.BUILD = Path(sys.argv[1])
compiling._check_compiler = lambda package: None
compiling.usable_cpus = lambda: 2
places = {name: Path("key") / name for name in ("igtl_msgs", "tf2_msgs")}
import signal
with signals_in_thread({signal.SIGINT: lambda: None}, "test", once=True):  # as a verb that runs until Ctrl-C
    print(compiling.compile_packages(places, [Path(folder) for folder in sys.argv[2:]], Path("/none")))
"""
#: It makes a part of each package, starts another program as compilers do, and goes on when there is a file GO.
COMPILER = """
import subprocess, sys, time
from pathlib import Path

name, _, _, work = sys.argv[1:]
result = Path(work) / "result" / name
result.mkdir(parents=True)
(result / "half").touch()
other = subprocess.Popen(["sleep", "1000"])
Path(GO).with_name(f"{name}.pid").write_text(str(other.pid))
print("0.5 0.1", flush=True)
while not Path(GO).exists():
    time.sleep(0.02)
other.kill()
(result / "whole").touch()
"""


@pytest.fixture
def go(tmp_path: Path) -> Path:
    return tmp_path / "go"


@pytest.fixture
def start(tmp_path: Path, go: Path) -> Iterator[Callable[[], subprocess.Popen[str]]]:
    """Function: begin a first start in the folder ``cache``."""
    program = tmp_path / "build.py"
    program.write_text(f"GO = {str(go)!r}\n{COMPILER}")
    running: list[subprocess.Popen[str]] = []

    def begin() -> subprocess.Popen[str]:
        command = [sys.executable, "-c", START, str(program), str(tmp_path / "cache")]
        running.append(subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True))
        return running[-1]

    yield begin
    for process in running:
        process.kill()
        process.communicate()


def eventually(condition: Callable[[], bool]) -> None:
    """Wait for a condition."""
    until = time.monotonic() + WAIT_S
    while not condition():
        assert time.monotonic() < until, "this did not happen"
        time.sleep(0.02)


def others(folder: Path) -> list[int]:
    """The programs that the compilers have started."""
    return [int(text) for path in folder.glob("*.pid") if (text := path.read_text())]


def is_running(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except FileNotFoundError:
        return False


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP], ids=lambda number: number.name)
def test_an_interrupt_leaves_nothing_and_the_next_start_compiles(
    number: signal.Signals, start: Callable[[], subprocess.Popen[str]], tmp_path: Path, go: Path
) -> None:
    first = start()
    eventually(lambda: len(others(tmp_path)) == 2)
    first.send_signal(number)
    _, error = first.communicate(timeout=WAIT_S)
    assert first.returncode != 0 and compiling.INTERRUPTED in error
    assert list((tmp_path / "cache").iterdir()) == []
    assert not any(map(is_running, others(tmp_path)))
    go.touch()
    second = start()
    output, error = second.communicate(timeout=WAIT_S)
    assert second.returncode == 0 and output.strip() == str(tmp_path / "cache"), error
    found = {str(path.relative_to(tmp_path / "cache")) for path in (tmp_path / "cache").rglob("*")}
    packages = {"key/igtl_msgs", "key/tf2_msgs"}
    assert found == {"key", *packages, *(f"{name}/{file}" for name in packages for file in ("half", "whole"))}


def test_a_start_beside_another_one_waits_for_it_and_names_it(
    start: Callable[[], subprocess.Popen[str]], tmp_path: Path, go: Path
) -> None:
    first = start()
    eventually(lambda: len(others(tmp_path)) == 2)
    second = start()
    assert (
        second.stderr
        and second.stderr.readline() == f"Waiting for process {first.pid} (-c): it compiles ROS messages.\n"
    )
    third = start()
    assert third.stderr and "Waiting for process" in third.stderr.readline()
    third.send_signal(signal.SIGINT)
    assert compiling.INTERRUPTED in third.communicate(timeout=WAIT_S)[1]
    go.touch()
    assert [process.wait(WAIT_S) for process in (first, second)] == [0, 0]
    assert "First start" not in second.stderr.read(), "it has compiled again"
    assert {path.name for path in (tmp_path / "cache").iterdir()} == {"key"}


def test_a_start_that_is_killed_blocks_no_other(
    start: Callable[[], subprocess.Popen[str]], tmp_path: Path, go: Path
) -> None:
    first = start()
    eventually(lambda: len(others(tmp_path)) == 2)
    second = start()
    assert second.stderr and "Waiting for process" in second.stderr.readline()
    first.kill()
    go.touch()
    assert second.wait(WAIT_S) == 0
    assert {path.name for path in (tmp_path / "cache").iterdir()} == {"key"}, "left by the killed one"


@pytest.mark.slow
@pytest.mark.skipif(not shutil.which("g++"), reason="no compiler here")
def test_the_compilation_of_a_killed_program_ends_and_leaves_nothing(tmp_path: Path) -> None:
    pytest.importorskip("ros_wheels_bootstrapper", reason="the packages are compiled for the ROS wheels only")
    work = tmp_path / "work"
    work.mkdir()
    command = [
        sys.executable,
        "-P",
        str(compiling.BUILD),
        "igtl_msgs",
        str(definition_folder("igtl_msgs")),
        sys.prefix,
        str(work),
    ]
    with subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, start_new_session=True
    ) as process:
        assert process.stdin and process.stdout
        while float(process.stdout.readline().split()[0]) < 0.12:  # several processes generate code
            pass
        process.stdin.close()
        process.wait(WAIT_S)
        assert process.returncode == -signal.SIGKILL
    eventually(lambda: not work.exists())


USAGE = namedtuple("USAGE", "total used free")


def test_a_full_disk_is_one_line_with_place_found_and_expected(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shutil, "disk_usage", lambda _: USAGE(10, 9, 1_500_000))
    with pytest.raises(ImportError) as error:
        compiling._folder_with_room("ROS message packages", [tmp_path / "a", tmp_path / "b"])
    assert str(error.value) == (
        f"ROS message packages must be compiled once: found {tmp_path}/a with 1.5 MB free, and {tmp_path}/b with "
        "1.5 MB free; expected a folder to write to with 25.0 MB free (XDG_CACHE_HOME=FOLDER names another)"
    )


def test_the_second_folder_is_taken_where_the_first_is_full(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shutil, "disk_usage", lambda path: USAGE(0, 0, 0 if path == tmp_path / "a" else 10**9))
    assert compiling._folder_with_room("p_msgs", [tmp_path / "a", tmp_path / "b"]) == tmp_path / "b"
    assert list((tmp_path / "b").iterdir()) == []


@pytest.mark.parametrize("text", ["OSError: [Errno 28] No space left on device: 'x'", "as: y.o: Disk quota exceeded"])
def test_a_disk_that_becomes_full_is_named(text: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    program = tmp_path / "build.py"
    program.write_text(f"import sys\nsys.exit('first\\n' + {text!r} + '\\ncompilation terminated.')")
    monkeypatch.setattr(compiling, "BUILD", program)
    monkeypatch.setattr(shutil, "disk_usage", lambda _: USAGE(0, 0, 10**9))
    monkeypatch.setattr(compiling, "_check_compiler", lambda _: None)
    with pytest.raises(ImportError) as error:
        compiling.compile_packages({"tf2_msgs": Path("key/tf2_msgs")}, [tmp_path / "cache"], tmp_path)
    assert str(error.value) == (
        f"tf2_msgs could not be compiled: the disk of {tmp_path}/cache is full: found 1.0 GB free, expected 25.0 MB"
    )
    assert list((tmp_path / "cache").iterdir()) == []


def test_when_the_compiler_fails_its_output_is_in_the_note(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    program = tmp_path / "build.py"
    program.write_text("import sys\nsys.exit('one\\ntwo\\nx.c:1: error: three\\nfour')")
    monkeypatch.setattr(compiling, "BUILD", program)
    monkeypatch.setattr(compiling, "_check_compiler", lambda _: None)
    with pytest.raises(ImportError) as error:
        compiling.compile_packages({"tf2_msgs": Path("key/tf2_msgs")}, [tmp_path / "cache"], tmp_path)
    assert str(error.value) == "tf2_msgs could not be compiled: x.c:1: error: three"
    assert vars(error.value)["__notes__"] == ["one\ntwo\nx.c:1: error: three\nfour"]
    assert list((tmp_path / "cache").iterdir()) == []
