"""Programs in processes of their own: started, read line by line, and ended; and what they report themselves."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import threading
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from typing import IO, Any

from igtl_gateway.base.systems.processes import INTERRUPT, apart
from igtl_gateway.base.versions import Self

#: Seconds that output may come after the end of a program.
_READ_S = 5.0
#: Lines of the standard error that are kept.
_KEPT_LINES = 100
#: Seconds that its last line may come after the end of a program.
_LAST_LINE_S = 0.5

OnLine = Callable[[str], None]

_OUTPUT = threading.Lock()


class Child:
    """A program that runs beside this one, in a session of its own: Ctrl-C at the terminal does not reach it.

    Threads read its output, so that it never waits for a reader.  On Linux it gets ``death_signal`` when the thread
    that started it ends, in whatever way.  A with block kills it at its end, if it still runs.

    Args:
        name: of the threads.
        command: program and arguments.
        on_line: called with each line of the standard output; None: the output is discarded.
        on_end: called when the standard output has ended; only with ``on_line``.
        on_error_line: called with each line of the standard error.
        on_error_end: called when the standard error has ended.
        env: its environment; None: our own.
        death_signal: described above.

    Raises OSError if the program cannot be started.
    """

    def __init__(
        self,
        name: str,
        command: Sequence[str],
        *,
        on_line: OnLine | None = None,
        on_end: Callable[[], None] = lambda: None,
        on_error_line: OnLine = lambda line: None,
        on_error_end: Callable[[], None] = lambda: None,
        env: Mapping[str, str] | None = None,
        death_signal: signal.Signals = signal.SIGINT,
    ) -> None:
        self._error_lines: deque[str] = deque(maxlen=_KEPT_LINES)
        self._process = subprocess.Popen(
            command,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE if on_line else subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
            errors="replace",
            env=env,
            **apart(death_signal),
        )

        def keep(line: str) -> None:
            self._error_lines.append(line)
            on_error_line(line)

        readers: list[tuple[IO[str] | None, OnLine, Callable[[], None]]] = [(self._process.stderr, keep, on_error_end)]
        if on_line:
            readers.append((self._process.stdout, on_line, on_end))
        self._threads = [
            threading.Thread(target=_read, args=reader, name=f"igtl-{name}", daemon=True) for reader in readers
        ]
        for thread in self._threads:
            thread.start()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.kill()

    @property
    def pid(self) -> int:
        return self._process.pid

    @property
    def is_running(self) -> bool:
        return self._process.poll() is None

    def write(self, text: str) -> None:
        """Write to its standard input; nothing if it has ended."""
        if self._process.stdin:
            with suppress(BrokenPipeError, ValueError):
                self._process.stdin.write(text)
                self._process.stdin.flush()

    def close_input(self) -> None:
        """End its standard input."""
        if self._process.stdin:
            with suppress(BrokenPipeError):
                self._process.stdin.close()

    def interrupt(self) -> None:
        """Send what Ctrl-C would."""
        self._process.send_signal(INTERRUPT)

    def wait(self, timeout_s: float | None = None) -> int | None:
        """Wait for its end; the exit code, None if that took too long."""
        try:
            return self._process.wait(timeout_s)
        except subprocess.TimeoutExpired:
            return None

    def terminate(self, timeout_s: float) -> None:
        """Have it end, and kill it if that takes too long."""
        self._process.terminate()
        self.wait(timeout_s)
        self.kill()

    def kill(self) -> None:
        """Kill it if it runs, and wait until its output is read, but not long for what it has left running."""
        if self.is_running:
            self._process.kill()
        self._process.wait()
        for thread in self._threads:
            thread.join(_READ_S)
        self.close_input()

    def error_lines(self) -> list[str]:
        """The last lines of its standard error, after it has ended; waits a little for them."""
        self._threads[0].join(_LAST_LINE_S)
        return list(self._error_lines)

    def exit_reason(self) -> str:
        """The last line of its standard error that is not empty, ``""`` for none; waits until it has ended."""
        self._threads[0].join()
        self._process.wait()
        return next((line for line in reversed(self._error_lines) if line.strip()), "")


def _read(stream: IO[str], on_line: OnLine, on_end: Callable[[], None]) -> None:
    with stream:
        for line in stream:
            on_line(line.rstrip("\n"))
    on_end()


def report_facts(facts: Mapping[str, Any]) -> None:
    """Write facts as a line of the standard output of this process, which who started it reads; from any thread."""
    data = json.dumps(facts).encode() + b"\n"
    with _OUTPUT:
        while data:
            data = data[os.write(1, data) :]
