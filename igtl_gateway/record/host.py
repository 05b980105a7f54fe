"""Where the recorder's worker runs: in a process of its own, or in a thread.

A thread is for tests on manual time, and for systems that refuse another process, or memory which processes can share
(a limit of the size of files counts for that, too).

``python -m igtl_gateway.record.host PIPE MEMORY BRIDGE`` is that process: file descriptors it inherits, and the number
of the process that has started it.
"""

from __future__ import annotations

import mmap
import os
import subprocess
import sys
import threading
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from multiprocessing import Pipe
from pathlib import Path

from igtl_gateway.base.clock import Clock, SystemClock
from igtl_gateway.base.systems.processes import lower_priority, processor_times, set_session_niceness
from igtl_gateway.base.systems.signals import ignore_endings
from igtl_gateway.base.versions import python_command
from igtl_gateway.record.bridge_end import WorkerPipe
from igtl_gateway.record.options import LARGEST_BYTES, RecordOptions
from igtl_gateway.record.pace import Times
from igtl_gateway.record.shared_queue import QueueReader, QueueWriter, memory, shared_memory
from igtl_gateway.record.worker import WorkerSettings, run_worker

#: Of the process: that of the bridge.  A lower priority cannot be raised again without privileges, and a recorder that
#: gets no processor breaks the promise of the flush interval.
_NICENESS = 0

#: Niceness of the session, where the system has sessions: as long as the recorder keeps up it goes behind all others.
_BEHIND, _LEVEL = 10, 0


@dataclass(frozen=True, slots=True)
class WorkerHost:
    """A worker at work.

    Attributes:
        pipe: the recorder's end.
        queue: the end that puts.
        times: of the worker's thread.
        raise_priority: of a worker that gets no processor, and cannot see that; False: to be tried again.
        wait: waits for the worker's end, and returns how it ended, in a few words.
        warning: what is not as it should be, or ``""``.
    """

    pipe: WorkerPipe
    queue: QueueWriter
    wait: Callable[[], str]
    times: Times = lambda: None
    warning: str = ""
    raise_priority: Callable[[], bool] = lambda: True


Host = Callable[[WorkerSettings, Clock], WorkerHost]


def in_process(settings: WorkerSettings, clock: Clock) -> WorkerHost:
    """A process of its own, which outlives this one until all is written; a thread where the system refuses that.

    On Windows it is always a thread: memory without a name cannot be passed to another process there.
    """
    if sys.platform == "win32":
        return in_thread(settings, clock)
    try:
        child, ours, queue = _start(settings.options)
    except OSError as error:
        warning = f"no process of the recorder's own ({error.strerror}): it is a thread of the bridge"
        return replace(in_thread(settings, clock), warning=warning)

    def wait() -> str:
        code = child.wait()
        return f"killed by signal {-code}" if code < 0 else f"exit code {code}"

    queue.warm_up()  # while it starts
    # of a process that did not start there is no first answer
    try:
        ours.send(settings)
    except BrokenPipeError:
        pass
    return WorkerHost(
        ours,
        queue,
        wait,
        partial(processor_times, child.pid),
        raise_priority=partial(set_session_niceness, _LEVEL, child.pid),
    )


def _start(options: RecordOptions) -> tuple[subprocess.Popen[bytes], WorkerPipe, QueueWriter]:
    """The process, our end of the pipe, and the queue to it.  Raises OSError."""
    handle = shared_memory(options.queue_bytes, LARGEST_BYTES)
    try:
        queue = _queue_writer(mmap.mmap(handle, 0), options)
        ours, theirs = Pipe()
        with theirs:
            child = subprocess.Popen(
                [*python_command(__name__), str(theirs.fileno()), str(handle), str(os.getpid())],
                pass_fds=(theirs.fileno(), handle),
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,  # readers of the bridge's output wait for the bridge only
                # Ctrl-C in the bridge's terminal must not end this process: the bridge decides when it ends
                start_new_session=True,
                env={**os.environ, "PYTHONPATH": os.pathsep.join(_python_path())},
            )
    finally:
        os.close(handle)
    return child, ours, queue


def _python_path() -> list[str]:
    """Where this process finds its modules; the empty entry is the folder that it works in."""
    return [str(Path(entry).absolute()) for entry in sys.path]


def in_thread(settings: WorkerSettings, clock: Clock) -> WorkerHost:
    """A thread of this process, with its clock."""
    ours, theirs = Pipe()
    place = memory(settings.options.queue_bytes, LARGEST_BYTES)
    getter, queue = QueueReader(place), _queue_writer(place, settings.options)

    def run() -> None:
        with theirs:
            run_worker(settings, getter, theirs, clock)

    thread = threading.Thread(target=run, name="recorder-worker", daemon=True)
    thread.start()

    def wait() -> str:
        thread.join()
        return "its thread has ended"

    return WorkerHost(ours, queue, wait)


def _queue_writer(place: mmap.mmap, options: RecordOptions) -> QueueWriter:
    return QueueWriter(place, options.queue_entries, options.queue_bytes)


def main() -> None:
    """The process."""
    from multiprocessing.connection import Connection  # of file descriptors: not on Windows

    # a service manager signals all processes of a service at once: the bridge decides when this one ends
    ignore_endings()
    pipe, handle, bridge = (int(word) for word in sys.argv[1:])
    lower_priority(_NICENESS)
    with Connection(pipe) as connection, suppress(EOFError):  # the bridge ended before it sent the settings
        settings = connection.recv()
        try:
            queue = QueueReader(mmap.mmap(handle, 0))
        except OSError as error:
            connection.send(f"cannot record to {settings.path}: no memory for its queue: {error.strerror}")
            return
        orphaned, times = (lambda: os.getppid() != bridge), partial(processor_times, os.getpid())
        run_worker(settings, queue, connection, SystemClock(), orphaned, _set_priority, times)


def _set_priority(hurried: bool) -> bool:
    """Lower the priority below that of all other processes, or restore it; False if that is to be tried again.

    Where the system has no sessions, only the niceness of the process counts.
    """
    return set_session_niceness(_LEVEL if hurried else _BEHIND)


if __name__ == "__main__":
    main()
