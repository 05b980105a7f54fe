"""The processes of programs: started, watched, ended with all that they have started."""

from __future__ import annotations

import os
import re
import shutil
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from igtl_gateway.addon import ConfigError
from igtl_gateway.addon.processes import KILL, Child, end_session, ticks_per_second

#: What Python writes before an exception that nothing catches, and its exit code then.
_TRACEBACK, _UNCAUGHT = "Traceback (most recent call last):", 1
#: How a program ends that has nothing to do.
ENDED_WELL = "ended with exit code 0"
#: A line of a traceback with a place, and places in it that no user wrote.
_FRAME = re.compile(r'  File "(?P<file>.+)", line (?P<line>[0-9]{1,9})')
_OF_OTHERS = ("/site-packages/", "/dist-packages/", f"/python3.{sys.version_info.minor}/", "<frozen ")
#: Seconds that a program has to end after the session, as after Ctrl-C.
_END_S = 2.0
#: Share of the CPU time of a program, and seconds, from which on a thread computes.
_SHARE, _LEAST_S = 0.1, 0.05
#: The thread of the library that looks whether all others wait (`preload/_time.h`).
_WATCHER = "igtl-resim"
#: A library that each program of ROS 2 loads, and no launcher without it.
_MIDDLEWARE = re.compile(r"librmw_\w+\.so")
#: The variable with the place of the session's socket.
_PLACE = "IGTL_GATEWAY_RESIM"
#: Letters of a command in a message.
_COMMAND_LENGTH = 100
#: States of a thread that computes, or waits for a processor or a disk.
_COMPUTING = "RD"


@dataclass(frozen=True, slots=True)
class ThreadUse:
    """A thread or process: its name, its state (a letter of the kernel) and the CPU seconds that it has used.

    ``children_s``: those of processes that it started, and that have ended.  ``began``: when it did, in ticks.
    """

    name: str
    state: str
    cpu_s: float
    children_s: float = 0.0
    began: int = 0


class Process:
    """A running program.

    Args:
        name: for messages.
        command: program and arguments.
        env: its environment.
        folder: where it runs.

    Raises ConfigError if it cannot be started.
    """

    def __init__(self, name: str, command: Sequence[str], env: Mapping[str, str], folder: Path | None) -> None:
        self.name, self.env = name, env
        self._ros_pid = 0
        self._image = b""
        program = str(folder / command[0]) if folder and "/" in command[0] else command[0]
        if folder and not shutil.which(
            program, path=env.get("PATH")
        ):  # else env(1) reports it, as the program's own end
            raise ConfigError(f"{name}: cannot be started: found no such program: {program}")
        if folder:
            command = ("env", "-C", str(folder), *command)
        try:
            self._child = Child(f"resim-{name}", command, on_line=lambda line: None, env=env, death_signal=KILL)
        except OSError as error:
            is_there = isinstance(error, FileNotFoundError) and "/" in command[0] and Path(command[0]).exists()
            script = f"; python {command[0]} runs a script" * command[0].endswith(".py")
            why = f"found no interpreter of its first line{script}" if is_there else error.strerror
            why = "found no such program; it comes with a sourced ROS 2" if command[0] == "ros2" else why
            raise ConfigError(f"{name}: cannot be started: {why}: {command[0]}") from error

    def joined(self, pid: int) -> None:
        """Remember the process that takes part in the session: a child, if the program is a launcher."""
        self._ros_pid = pid
        self._image = _image_of(pid)

    @property
    def is_replaced(self) -> bool:
        """Whether the process runs another program than when it joined, by exec."""
        now = _image_of(self.pid)
        return bool(self._image and now) and now != self._image

    @property
    def _root(self) -> int:
        return self._child.pid

    @property
    def pid(self) -> int:
        return self._ros_pid or self._child.pid

    @property
    def is_running(self) -> bool:
        return self._child.is_running

    @property
    def has_failed(self) -> bool:
        """Whether it ended by an exit code other than 0, or by a signal."""
        return not self._child.is_running and self._child.wait() != 0

    def wait(self, seconds: float) -> None:
        """Wait for its end, at most this long."""
        self._child.wait(seconds)

    def exit_text(self) -> str:
        """How it ended, with its last line; waits for the end."""
        code = self._child.wait(_END_S)
        if code is None:
            return "closed its connection"
        how = f"ended with exit code {code}" if code >= 0 else f"was ended by signal {-code}"
        line = _reason(self._child.error_lines(), code)
        return f"{how}: {line}" if line else how

    def cpu_s(self) -> float:
        """CPU time of all its threads so far, s; 0 where the system has no /proc, or it has ended.

        As long as no process has joined the session: with all that it has started.
        """
        return _use_of(self.pid).cpu_s if self._ros_pid else cpu_with_children_s(self._root)

    def busiest(self) -> ThreadUse:
        """The thread that runs, or else the one with the most CPU time."""
        uses = _threads(self.pid)
        return max(uses, key=lambda use: (use.state == "R", use.cpu_s), default=ThreadUse("", "", 0.0))

    def computing_threads(self) -> int:
        """How many threads have used a tenth of its CPU time each, of half a second at least; 0 if it has ended."""
        uses = [use.cpu_s for use in _threads(self.pid) if use.name != _WATCHER]
        return sum(each >= max(_SHARE * sum(uses), _LEAST_S) for each in uses) if sum(uses) >= 10 * _LEAST_S else 0

    def is_computing(self) -> bool:
        """Whether a thread of the program computes, or would if this machine had a processor for it."""
        return is_computing(self.pid)

    def libraries(self) -> set[str]:
        """Names of the libraries that it has loaded."""
        return _libraries(self.pid)

    def without(self, library: str) -> int:
        """The process of it or its launcher that has loaded a middleware of ROS, but not this library; 0 for none."""
        loaded = {pid: _libraries(pid) for pid in self.family()}
        found = (pid for pid, names in loaded.items() if library not in names and any(map(_MIDDLEWARE.match, names)))
        return next(found, 0)

    def family(self) -> set[int]:
        """It, the launcher that may have started it, and the processes that these have started."""
        return set(_family(self._root))

    def end(self) -> None:
        """Have it end as by Ctrl-C, and kill what is left of its session."""
        if self._child.is_running:
            self._child.interrupt()
            self._child.wait(_END_S)
        end_session(self._child.pid)

    def close(self) -> None:
        """Wait for its last line."""
        self._child.kill()


def _image_of(pid: int) -> bytes:
    """What a process got from the kernel when its program started: another one at each exec; nothing if it ended."""
    with suppress(OSError):
        return Path(f"/proc/{pid}/auxv").read_bytes()
    return b""


def _libraries(pid: int) -> set[str]:
    """Names of the libraries that a process has loaded."""
    try:
        text = Path(f"/proc/{pid}/maps").read_text("utf-8", "replace")
    except OSError:
        return set()
    return {Path(line.split(None, 5)[5]).name for line in text.splitlines() if ".so" in line}


def end_all(processes: Sequence[Process], place: Path) -> None:
    """End programs, and the processes that run apart from them; ``place``: of the session's socket."""
    others = apart_from(processes, place)
    for each in reversed(processes):
        each.end()
    for pid in {*others, *apart_from(processes, place)}:
        with suppress(OSError):
            os.kill(pid, KILL)
    for each in processes:
        each.close()


def apart_from(processes: Sequence[Process], place: Path) -> list[int]:
    """Numbers of processes that programs have started and left alone, such as a daemon, which has a session of its own.

    They have the session in their environment, or the library has noted their number beside its socket.
    """
    mark = f"{_PLACE}={place}".encode()
    known = {pid for each in processes for pid in each.family()}
    marked = {int(each.name) for each in Path("/proc").glob("[0-9]*") if mark in _environment(each)}
    marked |= {each.pid for each in notes(place) if each.what == "f" and _use_of(each.pid).began == each.began}
    return sorted(marked - known)


@dataclass(frozen=True, slots=True)
class Note:
    """What the library has noted of a process beside the socket of the session.

    Attributes:
        what: ``f`` it was started, ``s`` it has a socket of the network, ``u`` it is a copy of a program, and uses ROS.
        pid, began: the process, and when it began, in ticks.
        text: the function that a copy has called.
    """

    what: str
    pid: int
    began: int
    text: str


def notes(place: Path) -> list[Note]:
    """Return what the library has noted; ``place``: of the session's socket."""
    file = Path(f"{place}.notes")
    lines = [line.split(" ", 3) for line in file.read_text("ascii").splitlines()] if file.exists() else []
    return [Note(what, int(pid), int(began), text) for what, pid, began, text in lines]


def _environment(process: Path) -> list[bytes]:
    """What a process was started with; nothing of one that has ended, or is of another user."""
    with suppress(OSError):
        return (process / "environ").read_bytes().split(b"\0")
    return []


def _reason(lines: Sequence[str], code: int) -> str:
    """The line that states why a program has ended: the last one, or the first of a Python exception and its place."""
    at = max((index for index, line in enumerate(lines) if line.startswith(_TRACEBACK)), default=None)
    rest = lines if at is None or code != _UNCAUGHT else [line for line in lines[at + 1 :] if line[:1] != " "][:1]
    frames = [frame for line in lines[at or 0 :] if rest is not lines and (frame := _FRAME.match(line))]
    own = [frame for frame in frames if not any(part in frame["file"] for part in _OF_OTHERS)]
    place = "".join(f" ({Path(frame['file']).name}, line {frame['line']})" for frame in (own or frames)[-1:])
    return next((line.strip() + place for line in reversed(rest) if line.strip()), "")


def command_of(pid: int) -> str:
    """The command of a process that runs, in a short line; ``""`` if it has ended."""
    with suppress(OSError):
        words = Path(f"/proc/{pid}/cmdline").read_bytes().split(b"\0")
        state = _use_of(pid).state
        text = " ".join(b" ".join(words).decode("utf-8", "replace").split())
        text = text if len(text) <= _COMMAND_LENGTH else f"{text[:_COMMAND_LENGTH]}…"
        return text if state not in ("Z", "X", "") else ""
    return ""


def is_computing(pid: int) -> bool:
    """Whether a thread of a process, or of those that it has started, computes, or waits for a processor or a disk."""
    return any(use.state in _COMPUTING for each in _family(pid) for use in _threads(each) if use.name != _WATCHER)


def cpu_with_children_s(pid: int) -> float:
    """CPU seconds that a process, and those that it has started, have used; 0 if it has ended."""
    uses = [_use_of(each) for each in _family(pid)]
    return sum(use.cpu_s + use.children_s for use in uses)


def _family(pid: int) -> Iterator[int]:
    """The numbers of a process and of those that it has started, and so on."""
    coming = [pid]
    while coming:
        yield (parent := coming.pop())
        with suppress(OSError):
            for task in Path(f"/proc/{parent}/task").iterdir():
                coming += map(int, (task / "children").read_text("ascii").split())


def _threads(pid: int) -> list[ThreadUse]:
    """The threads of a process; none if it has ended."""
    with suppress(OSError):
        uses = [_use(task / "stat") for task in Path(f"/proc/{pid}/task").iterdir()]
        return [use for use in uses if use.state]
    return []


def _use_of(pid: int) -> ThreadUse:
    """What a process uses."""
    return _use(Path(f"/proc/{pid}/stat"))


def _use(stat: Path) -> ThreadUse:
    try:
        text = stat.read_text("utf-8", "replace")
    except OSError:
        return ThreadUse("", "", 0.0)
    name, _, rest = text.partition("(")[2].rpartition(")")
    fields = rest.split()
    user, system, user_of_children, system_of_children = map(int, fields[11:15])
    ticks = ticks_per_second()
    children_s = (user_of_children + system_of_children) / ticks
    return ThreadUse(name, fields[0], (user + system) / ticks, children_s, int(fields[19]))
