"""Processes: how one is started apart from this one, its priority, its CPUs, and a bound of its memory."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

#: Tries to lower the priority of a session, and the time between two, seconds.
_TRIES, _AGAIN_S = 20, 0.1

if sys.platform == "win32":
    import ctypes

    _IDLE_PRIORITY_CLASS = 0x40
    _KERNEL = ctypes.WinDLL("kernel32", use_last_error=True)
    _KERNEL.GetCurrentProcess.restype = ctypes.c_void_p

    #: What Ctrl-C at a terminal would send.  Windows sends Ctrl-C to whole consoles only.
    INTERRUPT = signal.CTRL_BREAK_EVENT
    #: What ends a process at once.
    KILL: signal.Signals = signal.SIGTERM

    def apart(death_signal: signal.Signals) -> dict[str, Any]:
        """Return arguments of ``Popen``: Ctrl-C at the terminal does not reach the process.

        Nothing ends it with its parent: it has to end with its input.

        Args:
            death_signal: not used.
        """
        return {"creationflags": subprocess.CREATE_NEW_PROCESS_GROUP}

    def die_with_parent(death_signal: int = KILL) -> None:
        """Do nothing: Windows has no such signal.

        Args:
            death_signal: not used.
        """

    def lower_priority(niceness: int) -> None:
        """Run this process only when no other one needs the processor.

        Args:
            niceness: not used; Windows has classes instead.
        """
        _KERNEL.SetPriorityClass(ctypes.c_void_p(_KERNEL.GetCurrentProcess()), _IDLE_PRIORITY_CLASS)

    def set_session_niceness(niceness: int, pid: int = 0) -> bool:
        """Do nothing: Windows has no sessions.

        Args:
            niceness: not used.
            pid: not used.
        """
        return True

    def end_session(pid: int) -> None:
        """Kill the processes of a session; Windows has none.

        Args:
            pid: of its first process.
        """

    def ticks_per_second() -> int:
        """Return the unit of CPU times in /proc, which Windows does not have."""
        return 1

else:
    import ctypes
    import resource

    _PR_SET_PDEATHSIG = 1
    _SESSION_NICENESS = "/proc/{}/autogroup"
    #: Loaded before any fork.
    _LIBC = ctypes.CDLL(None) if sys.platform == "linux" else None

    #: What Ctrl-C at a terminal would send.
    INTERRUPT = signal.SIGINT
    #: What ends a process at once.
    KILL = signal.SIGKILL

    def apart(death_signal: signal.Signals) -> dict[str, Any]:
        """Return arguments of ``Popen``: a session of its own, so that Ctrl-C at the terminal does not reach it.

        Args:
            death_signal: on Linux the process gets it when the thread that started it ends, in whatever way.
        """
        return {"start_new_session": True, "preexec_fn": partial(_prepare, death_signal)}

    def die_with_parent(death_signal: int = signal.SIGKILL) -> None:
        """On Linux, get a signal when the thread that started this process ends, in whatever way."""
        if _LIBC:
            _LIBC.prctl(_PR_SET_PDEATHSIG, death_signal)

    def _prepare(death_signal: int) -> None:
        """In the new process, before the program: accept interrupts, and end with the thread that started it.

        It takes no lock, so it may run between fork and exec.
        """
        # ignored where a shell without job control started us in the background; the program would ignore it, too
        signal.signal(signal.SIGINT, signal.SIG_DFL)
        die_with_parent(death_signal)
        if niceness := os.nice(0):  # else it would not count: the share of a new session is that of others
            set_session_niceness(niceness)

    def lower_priority(niceness: int) -> None:
        """Add to the niceness of this process, where that is permitted; it counts without real-time priority only."""
        with suppress(OSError):
            if sys.platform == "linux" and os.sched_getscheduler(0) in (os.SCHED_FIFO, os.SCHED_RR):
                os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
            os.nice(niceness)

    def set_session_niceness(niceness: int, pid: int = 0) -> bool:
        """Set the niceness of the session of a process; False if that is to be tried again.

        Linux may give each session the same share, whatever the niceness of its processes (autogroup).  All sessions
        together may change theirs ten times a second.

        Args:
            niceness: from 0 on, it may be lowered again.
            pid: of the process; 0: this one.
        """
        try:
            handle = os.open(
                _SESSION_NICENESS.format(pid or "self"), os.O_WRONLY
            )  # no file object: it may be between fork and exec
        except OSError:  # the system has no sessions
            return True
        try:
            os.write(handle, str(niceness).encode())
        except BlockingIOError:  # one was changed just now
            return False
        except OSError:
            pass
        finally:
            os.close(handle)
        return True

    def end_session(pid: int) -> None:
        """Kill all processes that are left in the session, and its process group, that `apart` made.

        Args:
            pid: of its first process.
        """
        with suppress(OSError):
            os.killpg(pid, signal.SIGKILL)

    def ticks_per_second() -> int:
        """Return the unit of CPU times in /proc."""
        return os.sysconf("SC_CLK_TCK")


def stand_back(niceness: int) -> None:
    """Lower the priority of this process, which another one started `apart`, for good; it counts from soon on."""
    lower_priority(niceness)
    for _ in range(_TRIES):
        if set_session_niceness(niceness):
            return
        threading.Event().wait(_AGAIN_S)


def processor_times(pid: int) -> tuple[int, int] | None:
    """Return how long (ns) the first thread of a process ran, and was ready and had no processor; None: unknown."""
    try:
        ran, ready, _ = Path(f"/proc/{pid}/schedstat").read_text(encoding="ascii").split()
        return int(ran), int(ready)
    except (OSError, ValueError):  # not Linux, or a kernel that does not count, or the process is gone
        return None


def is_program() -> bool:
    """Return whether this process is the command ``igtl-gateway``, and not a program that uses the package."""
    return "igtl_gateway.start" in sys.modules  # nothing else imports it


def usable_cpus() -> int:
    """Return the number of CPUs that this process may use."""
    if sys.platform == "linux":
        return len(os.sched_getaffinity(0))
    else:  # a type checker for Linux takes what follows the return for unreachable
        return os.cpu_count() or 1


def limit_data(most: int) -> None:
    """Bound the data of this process, where the system has such a bound: Linux has, Windows and macOS do not.

    Args:
        most: bytes; where a lower bound holds already, that stays.
    """
    if sys.platform != "win32":
        with suppress(ValueError, OSError):
            resource.setrlimit(resource.RLIMIT_DATA, (most, most))
