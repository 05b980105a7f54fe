"""Processes that the page starts: for what a person waits they have another priority than the page.

The page stands back behind the bridge.  What it starts would inherit that: a replay, or a verification, would get a
tenth of a processor beside one other program, and the browser that shows it is such a program.  A lowered priority
cannot be raised again, but on Linux each thread has its own, and a process has that of the thread that starts it.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

from igtl_gateway.addon.processes import Child, lower_priority

#: Niceness of a replay, whose messages go out in time; and of work and of the reader of the list, which take a quarter
#: of a processor where one other program needs all of it.
REPLAYS, WORK = 0, 5

#: Starts a process, as the function that it gets does.  Raises as that.
Start = Callable[[Callable[[], Child]], Child]


def directly(make: Callable[[], Child]) -> Child:
    """Start a process with the priority of this thread."""
    return make()


class Starter:
    """Starts processes in a thread of its own, which is to exist before the page stands back.

    A process gets the signal of its end when this thread ends, with the page.

    Args:
        niceness: is added to that of this process.
    """

    def __init__(self, niceness: int) -> None:
        self._thread = ThreadPoolExecutor(1, "igtl-page-start", lower_priority, (niceness,))
        self._thread.submit(int).result()  # its thread is there

    def __call__(self, make: Callable[[], Child]) -> Child:
        return self._thread.submit(make).result()


class Starters:
    """Those of a page."""

    def __init__(self) -> None:
        self.replays, self.work = Starter(REPLAYS), Starter(WORK)
