"""Processes that a test ends."""

from __future__ import annotations

import os
import select
import signal
from contextlib import ExitStack

#: Far longer than it takes.
TIMEOUT_S = 30.0


def kill(*processes: int) -> None:
    """Kill processes, each at once, and wait until the last of them has ended.

    ``kill`` returns before a process has ended, and only who started it can wait for it.  Until then it still writes,
    and its locks hold: on a busy machine for a good while.
    """
    with ExitStack() as stack:
        ends = [os.pidfd_open(process) for process in processes]
        for end in ends:
            stack.callback(os.close, end)
        for process in processes:
            os.kill(process, signal.SIGKILL)
        for end in ends:
            assert select.select([end], [], [], TIMEOUT_S)[0], "a killed process does not end"
