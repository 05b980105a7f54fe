"""Messages that take long are handled beside the I/O thread, one after the other.

A list of ten thousand elements takes a tenth of a second, in which no other peer would be read.  Its link waits for it
and is not read meanwhile, so each peer has at most one message here, and its messages keep their order.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from functools import partial
from queue import SimpleQueue

from igtl_gateway.base.buffers import Buffer
from igtl_gateway.base.clock import thread_ns
from igtl_gateway.edges.tcp.loop import Loop, Rescue
from igtl_gateway.wire.cost import AT_ONCE_NS, cost_ns

#: The longest time that the end of a link waits for its message: who handles it might wait for the end itself.
_WAIT_S = 5.0


class Job:
    """A message that is handled aside.

    Args:
        work: handles it; does not raise.
        done: called in the I/O thread, once, with what ``work`` returned and the CPU time that it used (ns).
    """

    def __init__(self, work: Callable[[], object], done: Callable[[object, int], None]) -> None:
        self._work = work
        self._done: Callable[[object, int], None] | None = done
        self._result: object = None
        self._used_ns = 0
        self._is_over = threading.Event()

    def run(self) -> None:
        """Handle the message; in the thread of ``Aside``."""
        begun_ns = thread_ns()
        try:
            self._result = self._work()
        finally:
            self._used_ns = thread_ns() - begun_ns
            self._is_over.set()

    def wait(self) -> None:
        """Wait until the message is handled, for a limited time; in the I/O thread."""
        self._is_over.wait(_WAIT_S)
        self.end()

    def end(self) -> None:
        """Report that it is done; in the I/O thread."""
        done, self._done = self._done, None
        if done:
            done(self._result, self._used_ns)


class Aside:
    """The thread that handles them; it begins with the first one."""

    def __init__(self, loop: Loop) -> None:
        self._loop = loop
        self._jobs: SimpleQueue[tuple[Job, Rescue] | None] = SimpleQueue()
        self._thread: threading.Thread | None = None

    @staticmethod
    def takes(message: Buffer) -> bool:
        """Return whether a message takes long."""
        return cost_ns(message) >= AT_ONCE_NS

    def put(self, job: Job, rescue: Rescue) -> None:
        """Have a message handled; in the I/O thread."""
        if self._thread is None:
            self._thread = threading.Thread(target=self._run, name="igtl-aside", daemon=True)
            self._thread.start()
        self._jobs.put((job, rescue))

    def stop(self) -> None:
        """End the thread behind what it has."""
        if self._thread:
            self._jobs.put(None)
            self._thread.join(_WAIT_S)

    def _run(self) -> None:
        while next_one := self._jobs.get():
            job, rescue = next_one
            job.run()
            self._loop.call_soon(partial(job.end), rescue)
