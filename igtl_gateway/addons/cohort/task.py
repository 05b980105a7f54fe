"""One file as a task: done by a program of its own, with bounds of time and memory.

A job that takes too long, or kills its program, is a result.  The program is kept for the next task of the thread,
of the caller or of a worker of Dask.
"""

from __future__ import annotations

import json
import os
import queue
import sys
import threading
from collections.abc import Mapping
from typing import Any

from igtl_gateway.addon import NS_PER_S, Self, SystemClock
from igtl_gateway.addon.processes import KILL, Child
from igtl_gateway.addons.cohort.ends import FAILED, KILLED, MEMORY, TIMEOUT
from igtl_gateway.addons.cohort.run import KnownFile, RunSettings

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
            [sys.executable, "-m", "igtl_gateway.addons.cohort.worker", str(memory)],
            on_line=self._replies.put,
            on_end=lambda: self._replies.put(_ENDED),
            env=dict(os.environ) | _ONE_THREAD,
            death_signal=KILL,
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
        """Return the last line that it wrote to its standard error, after it has ended."""
        return next((line for line in reversed(self._child.error_lines()) if line.strip()), "")


class Programs:
    """The programs of the threads of a process: one for each, kept for its next task.

    A context manager, which ends them; tasks that run meanwhile have the status ``killed``.
    """

    def __init__(self) -> None:
        self._of_thread = threading.local()
        self._lock = threading.Lock()
        self._running: set[JobProgram] = set()
        self._ended = False

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        with self._lock:
            self._ended = True
            running = list(self._running)
        for program in running:
            program.end()

    def run_task(self, job: Mapping[str, Any], memory: int, timeout_s: float) -> dict[str, Any]:
        """Do a job; see the function `run_task`."""
        clock = SystemClock()
        start_ns = clock.monotonic_ns()
        reply = self._reply(job, memory, timeout_s)
        return reply | {"seconds": (clock.monotonic_ns() - start_ns) / NS_PER_S}

    def _reply(self, job: Mapping[str, Any], memory: int, timeout_s: float) -> dict[str, Any]:
        words = ""
        for _ in range(TRIES):
            program = self._program(memory)
            if program is None:
                return {"status": KILLED, "error": "the run was ended"}
            try:
                reply = program.ask(job, timeout_s)
            except TimeoutError:
                self._forget(program)
                return {"status": TIMEOUT, "error": f"took more than {timeout_s:g} s (--timeout)"}
            if reply is not None:
                if reply["status"] == MEMORY:  # the next file begins with all of it
                    program.end()
                    self._forget(program)
                return reply
            words = program.last_words()
            self._forget(program)
        return {"status": KILLED, "error": f"the worker ended {TRIES} times in this file{': ' * bool(words)}{words}"}

    def _program(self, memory: int) -> JobProgram | None:
        """The program of this thread, with this bound; None after the end."""
        program: JobProgram | None = getattr(self._of_thread, "program", None)
        if program is not None and program.memory != memory:
            program.end()
            self._forget(program)
            program = None
        with self._lock:
            if self._ended:
                return None
            if program is None:
                program = self._of_thread.program = JobProgram(memory)
                self._running.add(program)
        return program

    def _forget(self, program: JobProgram) -> None:
        self._of_thread.program = None
        with self._lock:
            self._running.discard(program)


_of_this_process = Programs()


def run_task(job: Mapping[str, Any], memory: int, timeout_s: float) -> dict[str, Any]:
    """Return the reply of ``jobs.run_job`` with ``seconds``; ``status`` may be ``timeout`` or ``killed``, too."""
    return _of_this_process.run_task(job, memory, timeout_s)


def job_of(work: RunSettings, item: KnownFile) -> dict[str, Any]:
    """Return the job of a file."""
    file, content, part = item
    return {
        "name": file.name,
        "size": file.size,
        "e_tag": file.e_tag,
        "verb": work.verb,
        "settings": {**work.settings, **part},
        "limits": list(work.limits),
        "content": content,
    }


def failed(error: BaseException) -> dict[str, Any]:
    """Return the reply for a task that raised."""
    if type(error).__name__ == "KilledWorker":
        return {"status": KILLED, "error": "the worker of Dask died with this file"}
    return {"status": FAILED, "error": f"{type(error).__name__}: {error}"}
