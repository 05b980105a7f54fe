"""Processes of a measurement: started, listened to, asked, weighed and ended."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import IO, Any, Self

from igtl_gateway.errors import GatewayError

Event = dict[str, Any]

_END_S = 20.0


class BenchError(GatewayError):
    """A program of the measurement did not do its part."""


@dataclass(frozen=True, slots=True)
class Usage:
    """What a process has used.

    Attributes:
        cpu_s: its CPU time, user and system.
        children_cpu_s: that of its children, such as the recorder's process.
        rss_mb: memory in use now.
        peak_mb: at most since its start.
    """

    cpu_s: float
    children_cpu_s: float
    rss_mb: float
    peak_mb: float

    @classmethod
    def of(cls, pid: int) -> Self:
        """Of a process that lives; zeros where the system does not tell (no /proc)."""
        root = Path(f"/proc/{pid}")
        try:
            status = dict(
                line.split(":", 1)
                for line in (root / "status").read_text("ascii", "replace").splitlines()
                if ":" in line
            )
            children = [
                child for task in (root / "task").iterdir() for child in (task / "children").read_text("ascii").split()
            ]
            kib = [float(status.get(name, "0 kB").split()[0]) for name in ("VmRSS", "VmHWM")]
            return cls(
                _cpu_s(root), sum(_cpu_s(Path(f"/proc/{child}")) for child in children), *(k / 1000 for k in kib)
            )
        except OSError:
            return cls(0.0, 0.0, 0.0, 0.0)


def _cpu_s(process: Path) -> float:
    # the name, in brackets, may hold anything; user and system time are the 12th and 13th behind it
    fields = (process / "stat").read_text("ascii", "replace").rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def ours(*words: str) -> list[str]:
    """The command line of a verb of ours."""
    return [sys.executable, "-m", "igtl_gateway", *words]


def _interruptible() -> None:
    """In a program before it begins: an interrupt ends it, although a shell that put us into the background said no."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)


class Program:
    """A program in a process of its own, whose JSON lines are events.

    Args:
        name: for errors.
        command: program and arguments.
    """

    def __init__(self, name: str, command: Sequence[str]) -> None:
        self._name = name
        self._events: SimpleQueue[Event | None] = SimpleQueue()
        self._words: list[str] = []
        # A session of its own: a Ctrl-C is ours, and ends all in order.
        self._process = subprocess.Popen(
            command,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            errors="replace",
            start_new_session=True,
            preexec_fn=_interruptible,  # noqa: PLW1509  # it takes no lock
        )
        self._threads = [
            threading.Thread(target=read, args=(stream,), name=f"igtl-bench-{name}", daemon=True)
            for read, stream in ((self._read_events, self._process.stdout), (self._read_stderr, self._process.stderr))
        ]
        for thread in self._threads:
            thread.start()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        if self._process.poll() is None:
            self._process.kill()
        self._process.wait()
        for thread in self._threads:
            thread.join()
        self._close_input()

    @property
    def pid(self) -> int:
        return self._process.pid

    def wait_for(self, name: str, timeout_s: float, seen: Callable[[Event], None] | None = None) -> Event:
        """The next event of this name; ``seen`` is shown those before it.  Raises BenchError if it does not come."""
        while True:
            try:
                event = self._events.get(timeout=timeout_s)
            except Empty:
                raise BenchError(f"{self._name}: found no {name!r} within {timeout_s:g} s") from None
            if event is None:
                raise BenchError(f"{self._name}: {self._exit_reason(name)}")
            if event.get("event") == name:
                return event
            if seen:
                seen(event)

    def order(self, line: str) -> None:
        """Write a line to its input."""
        pipe: IO[str] = self._process.stdin  # type: ignore[assignment]  # a pipe, see above
        try:
            pipe.write(line + "\n")
            pipe.flush()
        except (BrokenPipeError, ValueError):
            pass  # its end is an event

    def end(self) -> None:
        """End its input and wait until it has gone."""
        self._close_input()
        self.gone()

    def interrupt(self, timeout_s: float = _END_S) -> None:
        """End it as Ctrl-C would, and wait until it has gone."""
        self._process.send_signal(signal.SIGINT)
        self.gone(timeout_s)

    def gone(self, timeout_s: float = _END_S) -> None:
        """Wait until it has ended.  Raises BenchError if it does not, or badly."""
        try:
            code = self._process.wait(timeout_s)
        except subprocess.TimeoutExpired:
            raise BenchError(f"{self._name}: did not end within {timeout_s:g} s") from None
        if code:
            raise BenchError(f"{self._name}: {self._exit_reason('end')}")

    def check(self) -> None:
        """Raises BenchError, with its last words, if it has ended."""
        if self._process.poll() is not None:
            raise BenchError(f"{self._name}: {self._exit_reason('its part')}")

    def _close_input(self) -> None:
        try:
            if self._process.stdin:
                self._process.stdin.close()
        except BrokenPipeError:
            pass  # it has gone before

    def _exit_reason(self, awaited: str) -> str:
        self._threads[1].join()
        code = self._process.wait()
        said = [line for line in self._words if line.strip()]
        return said[-1] if said else f"ended with exit code {code} before {awaited!r}"

    def _read_events(self, stream: IO[str]) -> None:
        with stream:
            for line in stream:
                try:
                    event = json.loads(line)
                except ValueError:
                    continue  # a library that prints
                if isinstance(event, dict):
                    self._events.put(event)
        self._events.put(None)

    def _read_stderr(self, stream: IO[str]) -> None:
        with stream:
            self._words.extend(line.rstrip("\n") for line in stream)
