"""Programs that do what a re-simulation cannot go on with: one line each, exit code 2, and no process is left."""

from __future__ import annotations

import fcntl
import os
import platform
import random
import re
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest

from igtl_gateway.addon import ConfigError
from igtl_gateway.addon.reading import SessionFile
from igtl_gateway.addons.resim import coordinator, engine, frames
from igtl_gateway.addons.resim.coordinator import ProgramFault
from igtl_gateway.addons.resim.engine import Clocks, Program, ResimOptions, run, run_file
from igtl_gateway.addons.resim.verdict import compare
from igtl_gateway.base.clock import ManualClock
from tests.addons.resim import sessions
from tests.addons.resim.runs import PROGRAMS, compiled, judged, program, published, strings

pytestmark = [pytest.mark.ros, pytest.mark.skipif(not find_spec("rclpy"), reason="needs ROS 2")]


def processes_with(mark: str) -> list[str]:
    """Commands of running processes with a word in their environment, or in the command itself."""
    found = []
    for place in Path("/proc").glob("[0-9]*"):
        try:
            command = os.fsdecode((place / "cmdline").read_bytes())
            if mark.encode() in (place / "environ").read_bytes() or mark in command:
                found.append(command)
        except OSError:
            continue
    return found


@pytest.mark.parametrize(
    ("what", "line"),
    [
        (
            "asks",
            "/other: asked for, but the recording has no such topic; --without TOPIC runs the programs without it",
        ),
        (
            "mistypes",
            "/inn: asked for, but the recording has no such topic: did you mean '/in'?; --without TOPIC runs the",
        ),
        ("never_spins", "faulty: ended with exit code 0 before the session began: does it spin?"),
        ("ends", "faulty: ended with exit code 0"),
        ("raises", "faulty: ended with exit code 1: ValueError: found 3 wheels, expected 4: (faulty.py, line "),
        ("leaves", "faulty: ended with exit code 3"),
        ("is_stopped", "faulty: was ended by signal 15"),
        ("is_killed", "faulty: was ended by signal 9"),
        ("stops", "faulty: did not come to rest within 1 s (the wall limit)"),
        ("exits", "faulty: ended with exit code 4"),
        ("becomes", "faulty: ended with exit code 5"),
        (
            "becomes_a_sleeper",
            "faulty: replaced itself by another program (exec): sleep 1000; run each as a program of its",
        ),
        ("becomes_itself", "faulty: replaced itself by another program (exec): "),
        ("daemonizes", "faulty: started another process, which still runs: mark-"),
        ("crashes", "faulty: was ended by signal 11"),
        ("hangs", "faulty: did not come to rest within 1 s (the wall limit)"),
        ("loops", "faulty: did not come to rest within 1 s of CPU time (the CPU limit): thread 'python"),
        ("forks", "faulty: forked, and the copy uses ROS 2 (rmw_"),
        ("starts_a_node", "faulty: started another process that takes part: "),
        (
            "spawns",
            "faulty: started another process, which still runs: sleep 1000; run each as a program of its own (--re",
        ),
        ("floods", "faulty: flooded the session with messages, the last one of /out; expected at most 5,000"),
    ],
)
def test_a_fault_is_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, what: str, line: str) -> None:
    mark = f"mark-{os.getpid()}-{what}"
    monkeypatch.setenv("MARK_OF_THIS_TEST", mark)
    recording = sessions.write(tmp_path / "in.mcap", sessions.texts(40))
    cpu_s = 60.0 if what == "floods" else 1.0
    wall_s = 1.0 if "wall limit" in line else 30.0
    result, verdict = judged(
        recording, tmp_path, f"faulty {what}", runs=3, wall_s=wall_s, cpu_s=cpu_s, most_outputs=5000
    )
    assert verdict.exit_code == 2
    assert verdict.fault.startswith(line)
    assert "\n" not in verdict.line()
    assert len(result.runs) == 1
    assert processes_with(mark) == []
    if what not in ("asks", "mistypes", "never_spins", "floods", "daemonizes", "forks", "starts_a_node"):
        assert len(published(result.runs[0].outputs, "/out")) == 20  # the outputs so far
        assert result.runs[0].delivered == {"/in": 20}
        with SessionFile.open(recording) as file:
            times = [entry.stamp_ns for entry in file.entries() if entry.channel == "/in"]
        assert result.runs[0].end_ns == times[19]


def test_a_flood_at_one_time_ends_early(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(coordinator, "_MOST_AT_ONCE", 1000)
    recording = sessions.write(tmp_path / "in.mcap", sessions.texts(40))
    _, verdict = judged(recording, tmp_path, "faulty floods", runs=1)
    flood = "faulty: flooded the session with messages, the last one of /out; expected at most 1,000 at one time"
    assert verdict.fault == flood


def test_a_library_of_another_version_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As after an update whose C parts are not compiled yet."""
    version = frames.ABI_VERSION
    monkeypatch.setattr(engine, "ABI_VERSION", version + 1)
    recording = sessions.write(tmp_path / "in.mcap", sessions.texts(3))
    _, verdict = judged(recording, tmp_path, "faulty ends", runs=1)
    assert re.fullmatch(
        rf"resim: found _preload\S*\.so of version {version}, expected {version + 1}: install igtl-gateway again, .*",
        verdict.fault,
    )


@pytest.mark.parametrize(("is_computing", "limit_s"), [(True, 10.0), (False, 1.0)])
def test_a_program_that_waits_for_a_processor_does_not_hang(is_computing: bool, limit_s: float) -> None:
    """Beside a load of 50, a program gets 1 % of a processor: it computes, as its states show."""
    clock, program = ManualClock(), Waiting(is_computing)
    nobody = Nobody()
    watch = engine._Watch([program], nobody, clock, ResimOptions(wall_s=1.0), Path(), lambda: None)  # type: ignore[list-item, arg-type]
    how = r"10 s \(10 wall limits, as it computes\)" if is_computing else r"1 s \(the wall limit\)"
    with pytest.raises(ProgramFault, match=f"did not come to rest within {how}"):
        while True:
            clock.advance(100_000_000)
            watch.look()
    assert clock.monotonic_ns() / 1e9 == pytest.approx(limit_s, abs=0.3)
    clock.advance(100_000_000_000)  # this process had no processor itself
    watch.begin()
    watch.look()
    clock.advance(100_000_000_000)
    watch.look()


class Nobody:
    """Where no process connects."""

    def stranger(self) -> int:
        return 0


@dataclass(eq=False)
class Waiting:
    """A process that has not come to rest, and gets no processor."""

    is_busy: bool
    name: str = "program"
    pid: int = 0
    is_running: bool = True
    has_failed: bool = False

    def is_computing(self) -> bool:
        return self.is_busy

    def cpu_s(self) -> float:
        return 0.0


def test_a_process_that_ends_is_no_fault(tmp_path: Path) -> None:
    recording = sessions.write(tmp_path / "in.mcap", sessions.texts(40))
    result, verdict = judged(recording, tmp_path, "faulty asks_git", runs=2)
    assert verdict.exit_code == 0
    assert result.runs[0].remarks == []


def test_a_second_node_of_a_program_is_a_fault(tmp_path: Path) -> None:
    """It would wait without an end, and the verdict be of the first one alone."""
    recording = sessions.write(tmp_path / "in.mcap", sessions.texts(10))
    node = f"{sys.executable} {PROGRAMS}/single.py"
    both = Program(("bash", "-c", f"{node} & {node} & wait"), "both")
    fault = compare(run(recording, [both], ResimOptions(), tmp_path)).fault
    assert fault.startswith(f"both: started another process that takes part: {node}")


PYTHON = sys.executable
#: Launchers, and programs with helpers that wait for work: the outputs are those of the program alone.
HELPED = {
    "shell": ("bash", "-c", f"true && {PYTHON} {PROGRAMS}/helped.py none; true"),
    "launcher": (PYTHON, str(PROGRAMS / "helped.py"), "launch"),
    "helper": (PYTHON, str(PROGRAMS / "helped.py"), "idle"),
    "shared memory": (PYTHON, str(PROGRAMS / "helped.py"), "memory"),
    "pool of processes": (PYTHON, str(PROGRAMS / "helped.py"), "pool"),
    "pool, asked later": (PYTHON, str(PROGRAMS / "helped.py"), "later"),
    "pool of threads": (PYTHON, str(PROGRAMS / "helped.py"), "threads"),
}


@pytest.mark.parametrize("what", HELPED)
def test_a_process_that_waits_for_work_is_no_fault(tmp_path: Path, what: str) -> None:
    recording = sessions.write(tmp_path / "in.mcap", sessions.texts(10))
    result = run(recording, [Program(HELPED[what])], ResimOptions(runs=2), tmp_path)
    assert compare(result).line() == "deterministic: 2 of 2 runs equal"
    assert result.runs[0].remarks == []
    answers = [number * number for number in range(1, 11)]
    if what == "pool, asked later":
        answers = [0, *answers[:-1]]
    assert strings(result.runs[0].outputs, "/out") == [f"m{number} {each}" for number, each in enumerate(answers)]


def test_a_process_that_works_by_itself_is_a_fault(tmp_path: Path) -> None:
    """It would send in real time."""
    recording = sessions.write(tmp_path / "in.mcap", sessions.texts(10))
    fault = compare(run(recording, [program("helped", "pushes")], ResimOptions(), tmp_path)).fault
    assert fault.startswith(f"helped: started another process, which still runs: {PYTHON} {PROGRAMS}/helped.py ")


def test_a_compiler_that_takes_long_is_no_fault(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(engine, "_CHILD_SLEEP_NS", 1_000_000_000)
    recording = sessions.write(tmp_path / "in.mcap", sessions.texts(40))
    result, verdict = judged(recording, tmp_path, "faulty compiles", runs=1, wall_s=1.5)
    assert (verdict.exit_code, verdict.fault) == (0, "")
    times = dict(zip(strings(result.runs[0].outputs, "/out"), published(result.runs[0].outputs, "/out"), strict=True))
    assert times["compiled"][0] == times["m19"][0]
    _, verdict = judged(recording, tmp_path, "faulty compiles", runs=1, cpu_s=1.0)
    assert verdict.fault.startswith("faulty: started another process, which still runs: sh -c ")


@pytest.mark.skipif(platform.machine() != "x86_64", reason="the number of the system call")
@pytest.mark.parametrize("what", ["futex", "mutex"])
def test_a_timeout_of_real_time_weakens_the_guarantee(tmp_path: Path, what: str) -> None:
    recording = sessions.write(tmp_path / "in.mcap", sessions.texts(40))
    result, _ = judged(recording, tmp_path, f"faulty {what}", runs=1, clocks=Clocks.SESSION)
    (remark,) = result.runs[0].remarks
    assert re.fullmatch(r"faulty: thread 'python[\d.]*' waits by futex, whose timeout passes in real time", remark)


def test_timers_of_the_system_weaken_the_guarantee(tmp_path: Path) -> None:
    recording = sessions.write(tmp_path / "in.mcap", sessions.texts(40))
    result, verdict = judged(recording, tmp_path, "faulty sets_timers", runs=1)
    assert verdict.exit_code == 0
    assert result.runs[0].remarks == [
        f"faulty: sets a timer by {call}, which runs in real time"
        for call in ("alarm", "setitimer", "timer_settime", "timerfd_settime")
    ]


def test_the_lock_of_another_process_is_waited_for(tmp_path: Path) -> None:
    recording = sessions.write(tmp_path / "in.mcap", sessions.texts(40))
    lock = tmp_path / "lock"
    with lock.open("w") as file:
        fcntl.flock(file, fcntl.LOCK_EX)

        def release() -> None:
            while not lock.read_text():
                time.sleep(0.05)
            time.sleep(0.5)
            fcntl.flock(file, fcntl.LOCK_UN)

        thread = threading.Thread(target=release)
        thread.start()
        result, verdict = judged(recording, tmp_path, f"faulty locks {lock}", runs=1)
        thread.join()
    assert verdict.exit_code == 0
    times = dict(zip(strings(result.runs[0].outputs, "/out"), published(result.runs[0].outputs, "/out"), strict=True))
    assert times["locked"][0] == times["m19"][0]


def test_a_socket_of_the_programs_own_weakens_the_guarantee(tmp_path: Path) -> None:
    recording = sessions.write(tmp_path / "in.mcap", sessions.texts(40))
    result, _ = judged(recording, tmp_path, "faulty talks", runs=1)
    assert result.runs[0].remarks == ["faulty: has a socket of its own: what it receives there comes in real time"]


def test_nothing_published_is_no_success(tmp_path: Path) -> None:
    recording = sessions.write(tmp_path / "in.mcap", sessions.texts(4, "/other"))
    _, verdict = judged(recording, tmp_path, "faulty asks", runs=1)
    assert (verdict.exit_code, verdict.fault) == (0, "")  # it passes on what it receives
    _, verdict = judged(recording, tmp_path, "faulty ends", runs=1, without=("/in",))
    assert (verdict.exit_code, verdict.fault) == (2, "no program published a message")


def test_a_program_that_fails_at_its_start(tmp_path: Path) -> None:
    recording = sessions.write(tmp_path / "in.mcap", sessions.texts(4))
    for code, line in (
        ("import nothing_of_this_name", "ended with exit code 1: ModuleNotFoundError: No module named"),
        ("import os; os.kill(os.getpid(), 9)", "was ended by signal 9"),
    ):
        (tmp_path / "node.py").write_text(code, "utf-8")
        fault = compare(
            run(recording, [Program((sys.executable, "node.py"), folder=tmp_path)], ResimOptions(), tmp_path)
        ).fault
        assert fault.startswith(f"node.py: {line}")
        assert "linked statically" not in fault


def test_a_program_without_ros(tmp_path: Path) -> None:
    recording = sessions.write(tmp_path / "in.mcap", sessions.texts(4))
    result = run(recording, [Program(("true",))], ResimOptions(), tmp_path)
    assert compare(result).fault == "true: ended with exit code 0; made no ROS 2 node, or is linked statically"
    result = run(recording, [Program(("sleep", "100"))], ResimOptions(wall_s=0.3), tmp_path)
    assert compare(result).fault == "sleep: made no ROS 2 node, or is linked statically within 0.3 s (the wall limit)"


def test_a_program_that_the_library_does_not_reach(tmp_path: Path) -> None:
    """Such as behind sudo, which takes variables away."""
    recording = sessions.write(tmp_path / "in.mcap", sessions.texts(4))
    alone = Program(("env", "-u", "LD_PRELOAD", sys.executable, str(PROGRAMS / "single.py")), "alone")
    begin_s = time.monotonic()
    fault = compare(run(recording, [alone], ResimOptions(wall_s=300.0), tmp_path)).fault
    assert fault.startswith("alone: uses ROS 2 without session time, as LD_PRELOAD did not reach it: ")
    assert time.monotonic() - begin_s < 100


def test_another_middleware_is_refused_by_name(tmp_path: Path) -> None:
    recording = sessions.write(tmp_path / "in.mcap", sessions.texts(4))
    zenoh = Program(("true",), env={"RMW_IMPLEMENTATION": "rmw_zenoh_cpp"})
    with pytest.raises(ConfigError, match="found RMW_IMPLEMENTATION=rmw_zenoh_cpp, expected rmw_fastrtps_cpp"):
        run(recording, [zenoh], ResimOptions(), tmp_path)


def beside_calls(action: Callable[[], None], on_call: Callable[[int], None]) -> None:
    """Do something, and call a function with the number of each call of a function by the main thread."""
    count = 0

    def look(frame: Any, event: str, argument: Any) -> None:
        nonlocal count
        count += event != "return"
        on_call(count)

    sys.setprofile(look)
    try:
        action()
    finally:
        sys.setprofile(None)


def test_ctrl_c_at_any_moment(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    mark = f"mark-{os.getpid()}-interrupts"
    monkeypatch.setenv("MARK_OF_THIS_TEST", mark)
    recording = sessions.write(tmp_path / "in.mcap", sessions.texts(5))
    programs = [Program((str(compiled("echo", tmp_path)),))]

    def once() -> None:
        run(recording, programs, ResimOptions(runs=1), tmp_path)

    once()  # it imports
    calls = [0]
    beside_calls(once, lambda number: calls.__setitem__(0, number))
    chance, interrupted = random.Random(1), 0
    while interrupted < 12:
        moments = sorted(chance.sample(range(100, calls[0] * 9 // 10), 2))
        last = [0]

        def interrupt(number: int, moments: list[int] = moments, last: list[int] = last) -> None:
            last[0] = number
            if number in moments:
                signal.raise_signal(signal.SIGINT)

        try:
            beside_calls(once, interrupt)
        except KeyboardInterrupt:
            interrupted += 1
        else:  # on a busy machine a run looks more often whether something has happened: this one has fewer calls
            assert last[0] < moments[0], moments
            calls[0] = last[0]
        assert processes_with(mark) == [], moments
        assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
        if (path := run_file(tmp_path, 1)).exists():
            SessionFile.open(path).close()
            path.unlink()
    assert not [each.name for each in threading.enumerate() if each.name.startswith("igtl-resim")]


def test_two_signals_as_of_timeout(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    mark = f"mark-{os.getpid()}-two"
    monkeypatch.setenv("MARK_OF_THIS_TEST", mark)
    recording = sessions.write(tmp_path / "in.mcap", sessions.texts(20))
    command = [sys.executable, "-m", "igtl_gateway", "resim", str(recording), "--runs", "1000"]
    command += ["--record", str(tmp_path / "kept.mcap"), "--", sys.executable, str(PROGRAMS / "single.py")]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as gateway:
        assert gateway.stdout
        for line in gateway.stdout:
            if line.startswith("run 1:"):
                break
        for _ in range(2):
            gateway.send_signal(signal.SIGTERM)
        output, errors = gateway.communicate(timeout=60)
    assert (gateway.returncode, errors.strip()) == (2, "igtl-gateway resim: interrupted")
    assert output.endswith(f"{tmp_path / 'kept.mcap'}: the outputs of run 1, complete\n")
    assert processes_with(mark) == []
    with SessionFile.open(tmp_path / "kept.mcap") as file:
        assert any(channel.topic == "/out" and channel.count for channel in file.channels)
