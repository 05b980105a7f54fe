"""One file as a task of Dask: done by a program beside the worker of Dask, with bounds of time and memory.

A job that takes too long, or kills its program, is a result.  The program is kept for the next task of the thread.
"""

from __future__ import annotations

import json
import os
import queue
import signal
import sys
import threading
from collections.abc import Mapping
from typing import Any

from igtl_gateway.child import Child
from igtl_gateway.clock import SystemClock
from igtl_gateway.cohort.ends import KILLED, TIMEOUT
from igtl_gateway.stamp import NS_PER_S

#: How often a job is tried again whose program was killed: another process may have been the cause.
TRIES = 3
_ENDED = ""
#: Libraries that would start a thread for each core, in each program.
_ONE_THREAD = dict.fromkeys(("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"), "1")


class JobProgram:
    """A running program of ``worker``.

    Args:
        memory: bytes that its data may take, 0 for any number.
    """

    def __init__(self, memory: int) -> None:
        self.memory = memory
        self._replies: queue.Queue[str] = queue.Queue()
        self._child = Child(
            "cohort",
            [sys.executable, "-m", "igtl_gateway.cohort.worker", str(memory)],
            on_line=self._replies.put,
            on_end=lambda: self._replies.put(_ENDED),
            env=dict(os.environ) | _ONE_THREAD,
            death_signal=signal.SIGKILL,
        )

    @property
    def pid(self) -> int:
        return self._child.pid

    def ask(self, job: Mapping[str, Any], timeout_s: float) -> dict[str, Any] | None:
        """Return the reply; None if the program ended without one.  Raises TimeoutError.

        After None and TimeoutError, the program has ended.
        """
        self._child.write(f"{json.dumps(job)}\n")
        try:
            line = self._replies.get(timeout=timeout_s)
        except queue.Empty:
            self._child.kill()
            raise TimeoutError from None
        if line == _ENDED:
            self._child.kill()
            return None
        return dict(json.loads(line))

    def end(self) -> None:
        """End the program."""
        self._child.kill()

    def last_words(self) -> str:
        """Return the last line that it wrote to its standard error."""
        return "".join(self._child.last_error_lines())


_of_this_thread = threading.local()


def run_task(job: Mapping[str, Any], memory: int, timeout_s: float) -> dict[str, Any]:
    """Return the reply of ``jobs.run_job`` with ``seconds``; ``status`` may be ``timeout`` or ``killed``, too."""
    clock = SystemClock()
    start_ns = clock.monotonic_ns()
    reply = _reply(job, memory, timeout_s)
    return reply | {"seconds": (clock.monotonic_ns() - start_ns) / NS_PER_S}


def _reply(job: Mapping[str, Any], memory: int, timeout_s: float) -> dict[str, Any]:
    words = ""
    for _ in range(TRIES):
        program: JobProgram | None = getattr(_of_this_thread, "program", None)
        if program is None or program.memory != memory:
            end_program()
            program = _of_this_thread.program = JobProgram(memory)
        try:
            reply = program.ask(job, timeout_s)
        except TimeoutError:
            _of_this_thread.program = None
            return {"status": TIMEOUT, "error": f"took more than {timeout_s:g} s (--timeout)"}
        if reply is not None:
            return reply
        words = program.last_words()
        _of_this_thread.program = None
    return {"status": KILLED, "error": f"the worker ended {TRIES} times in this file{': ' * bool(words)}{words}"}


def end_program() -> None:
    """End the program of this thread."""
    program: JobProgram | None = getattr(_of_this_thread, "program", None)
    if program is not None:
        program.end()
        _of_this_thread.program = None
