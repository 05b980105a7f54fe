"""Where the recorder's worker works: in a process of its own, or in a thread.

A thread is for tests on manual time, and for systems that refuse memory which processes can share (a limit of the size
of files counts for that, too).

``python -m igtl_gateway.record.host PIPE MEMORY`` is that process; the numbers are file descriptors it inherits.
"""

from __future__ import annotations

import mmap
import os
import subprocess
import sys
import threading
from collections.abc import Callable
from dataclasses import dataclass, replace
from multiprocessing import Pipe
from multiprocessing.connection import Connection

from igtl_gateway.clock import Clock, SystemClock
from igtl_gateway.record.options import LARGEST_BYTES, RecordOptions
from igtl_gateway.record.shared_queue import Getter, Putter, memory, shared_memory
from igtl_gateway.record.worker import Settings, work

#: The bridge goes first where there is not processor time enough for both; the queue bridges that.
_NICENESS = 5


@dataclass(frozen=True, slots=True)
class Place:
    """A worker at work.

    Attributes:
        pipe: the recorder's end.
        queue: the end that puts.
        wait: waits for the worker's end, and says in a few words how it was.
        warning: what is not as it should be, or ``""``.
    """

    pipe: Connection
    queue: Putter
    wait: Callable[[], str]
    warning: str = ""


Host = Callable[[Settings, Clock], Place]


def in_process(settings: Settings, clock: Clock) -> Place:
    """A process of its own, which outlives this one until all is written; a thread where memory is refused."""
    try:
        handle = shared_memory(settings.options.queue_bytes, LARGEST_BYTES)
    except OSError as error:
        warning = f"no memory for a process of the recorder's own ({error.strerror}): it is a thread of the bridge"
        return replace(in_thread(settings, clock), warning=warning)
    ours, theirs = Pipe()
    try:
        child = subprocess.Popen(
            [sys.executable, "-P", "-m", __name__, str(theirs.fileno()), str(handle)],
            pass_fds=(theirs.fileno(), handle),
            stdin=subprocess.DEVNULL,
            # what ends the bridge from a terminal must not end this: the bridge says when
            start_new_session=True,
            env={**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
        )
        theirs.close()
        queue = _putter(mmap.mmap(handle, 0), settings.options)
    finally:
        os.close(handle)

    def wait() -> str:
        code = child.wait()
        return f"killed by signal {-code}" if code < 0 else f"exit code {code}"

    # a process that did not start is told of by the first answer, which does not come
    try:
        ours.send(settings)
    except BrokenPipeError:
        pass
    return Place(ours, queue, wait)


def in_thread(settings: Settings, clock: Clock) -> Place:
    """A thread of this process, with its clock."""
    ours, theirs = Pipe()
    place = memory(settings.options.queue_bytes, LARGEST_BYTES)
    getter, queue = Getter(place), _putter(place, settings.options)

    def run() -> None:
        with theirs:
            work(settings, getter, theirs, clock)

    thread = threading.Thread(target=run, name="recorder-worker", daemon=True)
    thread.start()

    def wait() -> str:
        thread.join()
        return "its thread has ended"

    return Place(ours, queue, wait)


def _putter(place: mmap.mmap, options: RecordOptions) -> Putter:
    return Putter(place, options.queue_entries, options.queue_bytes)


def main() -> None:
    """The process."""
    pipe, handle = (int(word) for word in sys.argv[1:])
    os.nice(_NICENESS)
    with Connection(pipe) as connection:
        work(connection.recv(), Getter(mmap.mmap(handle, 0)), connection, SystemClock())


if __name__ == "__main__":
    main()
