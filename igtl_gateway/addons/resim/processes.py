"""The processes of programs: started, watched, ended with all that they have started."""

from __future__ import annotations

import shutil
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from igtl_gateway.addon import ConfigError
from igtl_gateway.base.child import Child
from igtl_gateway.base.systems.processes import KILL, end_session, ticks_per_second

#: Seconds that a program has to end after the session, as after Ctrl-C.
_END_S = 2.0
#: The thread of the library that looks whether all others wait (`_resim_time.h`).
_WATCHER = "igtl-resim"
#: States of a thread that computes, or waits for a processor or a disk.
_COMPUTING = "RD"


@dataclass(frozen=True, slots=True)
class ThreadUse:
    """A thread or process: its name, its state (a letter of the kernel) and the CPU seconds that it has used.

    ``children_s``: those of processes that it started, and that have ended.
    """

    name: str
    state: str
    cpu_s: float
    children_s: float = 0.0


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
        self.name = name
        self._ros_pid = 0
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
            raise ConfigError(f"{name}: cannot be started: {error.strerror}: {command[0]}") from error

    def joined(self, pid: int) -> None:
        """Remember the process that takes part in the session: a child, if the program is a launcher."""
        self._ros_pid = pid

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
        lines = self._child.last_error_lines()
        return f"{how}: {lines[0].strip()}" if lines else how

    def cpu_s(self) -> float:
        """CPU time of all its threads so far, s; 0 where the system has no /proc, or it has ended."""
        return _use(Path(f"/proc/{self.pid}/stat")).cpu_s

    def busiest(self) -> ThreadUse:
        """The thread that runs, or else the one with the most CPU time."""
        uses = _threads(self.pid)
        return max(uses, key=lambda use: (use.state == "R", use.cpu_s), default=ThreadUse("", "", 0.0))

    def is_computing(self) -> bool:
        """Whether a thread of the program computes, or would if this machine had a processor for it."""
        return is_computing(self.pid)

    def libraries(self) -> set[str]:
        """Names of the libraries that it has loaded."""
        try:
            text = Path(f"/proc/{self.pid}/maps").read_text("utf-8", "replace")
        except OSError:
            return set()
        return {Path(line.split(None, 5)[5]).name for line in text.splitlines() if ".so" in line}

    def end(self) -> None:
        """Have it end as by Ctrl-C, and kill what is left of its session; idempotent."""
        if self._child.is_running:
            self._child.interrupt()
            self._child.wait(_END_S)
        end_session(self._child.pid)
        self._child.kill()


def command_of(pid: int) -> str:
    """The command of a process that runs; ``""`` if it has ended."""
    with suppress(OSError):
        words = Path(f"/proc/{pid}/cmdline").read_bytes().split(b"\0")
        state = _use(Path(f"/proc/{pid}/stat")).state
        return b" ".join(words).decode("utf-8", "replace").strip() if state not in ("Z", "X", "") else ""
    return ""


def is_computing(pid: int) -> bool:
    """Whether a thread of a process, or of those that it has started, computes, or waits for a processor or a disk."""
    return any(use.state in _COMPUTING for each in _family(pid) for use in _threads(each) if use.name != _WATCHER)


def cpu_with_children_s(pid: int) -> float:
    """CPU seconds that a process, and those that it has started, have used; 0 if it has ended."""
    uses = [_use(Path(f"/proc/{each}/stat")) for each in _family(pid)]
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


def _use(stat: Path) -> ThreadUse:
    try:
        text = stat.read_text("utf-8", "replace")
    except OSError:
        return ThreadUse("", "", 0.0)
    name, _, rest = text.partition("(")[2].rpartition(")")
    fields = rest.split()
    user, system, user_of_children, system_of_children = map(int, fields[11:15])
    ticks = ticks_per_second()
    return ThreadUse(name, fields[0], (user + system) / ticks, (user_of_children + system_of_children) / ticks)
