"""Work that is shared among processes forked from this one: they have all that it has, and start in milliseconds."""

from __future__ import annotations

import gc
import os
import signal
import sys
import threading
import warnings
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from multiprocessing.connection import wait
from pathlib import Path

from igtl_gateway.base.systems.processes import die_with_parent

#: How often a part is tried whose process was killed: another one may have taken the memory.
_TRIES = 3
#: Time between two calls of ``tick``, s.
_TICK_S = 0.2
_READ = 1 << 16


def can_fork() -> bool:
    """Return whether this process may be forked: on Linux, and while no other thread may hold a lock."""
    return sys.platform == "linux" and threading.active_count() == 1


def free_memory() -> int | None:
    """Return the bytes that programs may take without swapping; None where the system does not state it."""
    with suppress(OSError, ValueError, StopIteration):
        lines = Path("/proc/meminfo").read_text(encoding="ascii").splitlines()
        return int(next(line for line in lines if line.startswith("MemAvailable:")).split()[1]) << 10
    return None


@dataclass(slots=True)
class _Process:
    part: int
    pid: int
    reply: bytearray = field(default_factory=bytearray)


def in_processes(
    work: Callable[[int], bytes], parts: int, most: int, tick: Callable[[], None] | None = None
) -> list[bytes | None]:
    """Return what ``work`` makes of each part, in a process of its own; None: a process was killed each time.

    Args:
        work: called with the number of a part; it raises nothing.
        parts: number of them.
        most: processes at a time.
        tick: called now and then while they work.
    """
    replies: list[bytes | None] = [None] * parts
    waiting = [(part, _TRIES) for part in reversed(range(parts))]
    running: dict[int, tuple[_Process, int]] = {}
    try:
        while waiting or running:
            while waiting and len(running) < most:
                part, tries = waiting.pop()
                handle, process = _forked(work, part)
                running[handle] = process, tries
            ended = wait(list(running), _TICK_S if tick else None)
            if tick:
                tick()
            for handle in [each for each in ended if isinstance(each, int)]:
                process, tries = running[handle]
                if block := os.read(handle, _READ):
                    process.reply += block
                    continue
                os.close(handle)
                del running[handle]
                _, status = os.waitpid(process.pid, 0)
                if status == 0:
                    replies[process.part] = bytes(process.reply)
                elif tries > 1:
                    waiting.insert(0, (process.part, tries - 1))  # after the others
    finally:
        for handle, (process, _) in running.items():
            with suppress(OSError):
                os.kill(process.pid, signal.SIGKILL)
                os.waitpid(process.pid, 0)
            os.close(handle)
    return replies


def _forked(work: Callable[[int], bytes], part: int) -> tuple[int, _Process]:
    """Start a process; return where its reply comes from."""
    reader, writer = os.pipe()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # threads of numpy, which are prepared for it
        pid = os.fork()
    if pid:
        os.close(writer)
        return reader, _Process(part, pid)
    status = 1
    try:
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # the first process decides
        die_with_parent()
        gc.freeze()  # what both have stays shared: a collection would write to all of it
        os.close(reader)
        reply = memoryview(work(part))
        while reply:
            reply = reply[os.write(writer, reply) :]
        status = 0
    finally:
        os._exit(status)  # nothing of the first process is tidied up
