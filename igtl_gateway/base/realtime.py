"""Priority, memory and CPUs of the threads that pass messages, where the system permits it (Linux).

The threads are those that receive and send: of Fast DDS, of the TCP edge and of the ROS edge.  The recorder, the
status output, the discovery of the graph and the watchdog of Fast DDS keep their priority: no message waits for them.
A thread that one of these threads starts inherits its settings.

Each setting has its own permission.  ``RealtimeOptions.check`` finds out before the bridge opens anything, so a
missing permission costs no recording and no link.
"""

from __future__ import annotations

import ctypes
import errno
import os
import sys
import threading
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from igtl_gateway.base.errors import ConfigError, Unavailable

#: Range of priorities of SCHED_FIFO in Linux.
PRIORITIES = range(1, 100)

#: Beginnings of the names of threads that pass messages.  Fast DDS names its own; ours have the names of Python.
MESSAGE_THREADS = (
    *("dds.shm.", "dds.udp.", "dds.tcp.", "dds.asyn.", "dds.ev."),
    *("igtl-tcp", "igtl-ros-receiver", "igtl-passage"),
)
#: Threads with such a name that pass none: it removes segments of killed processes.
_OTHER_THREADS = ("dds.shm.wdog",)

_TASKS = Path("/proc/self/task")
_STATUS = Path("/proc/self/status")

#: Bits of CapEff (linux/capability.h).
CAP_IPC_LOCK, CAP_SYS_NICE = 14, 23
# of mlockall (bits/mman.h): memory of today, memory of later, but only pages that are used (Linux 4.4)
_MCL_CURRENT, _MCL_FUTURE, _MCL_ONFAULT = 1, 2, 4


def cpus_text(cpus: frozenset[int] | set[int]) -> str:
    """Return CPUs as ``notations.cpus`` reads them: ``2,4-6``."""
    parts: list[list[int]] = []
    for cpu in sorted(cpus):
        if parts and parts[-1][-1] == cpu - 1:
            parts[-1][1:] = [cpu]
        else:
            parts.append([cpu])
    return ",".join("-".join(map(str, part)) for part in parts)


@dataclass(frozen=True, slots=True)
class RealtimeOptions:
    """How the threads that pass messages are scheduled.

    Attributes:
        priority: of SCHED_FIFO, 1 (lowest) to 99; 0: keep the policy.
        lock_memory: keep all used pages of the process in memory.
        cpus: run these threads on these CPUs only; empty: on all.
    """

    priority: int = 0
    lock_memory: bool = False
    cpus: frozenset[int] = frozenset()

    def __post_init__(self) -> None:
        if self.priority and self.priority not in PRIORITIES:
            raise ConfigError(
                f"--realtime-priority: found {self.priority}, expected {PRIORITIES[0]} (lowest) to {PRIORITIES[-1]}"
            )

    def __bool__(self) -> bool:
        return bool(self.priority or self.lock_memory or self.cpus)

    def check(self) -> None:
        """Return if this process has all permissions.  Raises Unavailable with the missing one."""
        if sys.platform == "linux":
            if self.cpus and not self.cpus <= (usable := os.sched_getaffinity(0)):
                raise Unavailable(
                    f"--cpu-affinity: found CPU {cpus_text(self.cpus - usable)}, expected CPUs of {cpus_text(usable)}, "
                    "which this process may use (taskset, cpuset of the container)"
                )
            if self.lock_memory:
                _check_memory()
            if self.priority:
                _check_priority(self.priority)
        elif self:
            raise Unavailable("--realtime-priority, --lock-memory and --cpu-affinity: available on Linux only")

    def apply(self) -> str:
        """Set everything for the threads that exist; return one line of text, empty if there is nothing to set.

        Raises Unavailable.
        """
        if not self:
            return ""
        done: list[str] = []
        names: list[str] = []
        if self.priority or self.cpus:
            for thread, name in sorted(message_threads().items()):
                try:
                    self._apply_to(thread)
                except ProcessLookupError:  # it has just ended
                    continue
                except OSError as error:
                    raise Unavailable(f"thread {name}: {error.strerror}") from None
                names.append(name)
        if self.priority:
            done.append(f"SCHED_FIFO {self.priority}")
        if self.cpus:
            done.append(f"CPUs {cpus_text(self.cpus)}")
        text = f"{', '.join(done)} for {len(names)} thread{'' if len(names) == 1 else 's'}" if done else ""
        if self.lock_memory:
            _lock_memory()
            text += f"{', ' if text else ''}memory locked"
        return f"real-time: {text}" + (f" ({', '.join(names)})" if names else "")

    def _apply_to(self, thread: int) -> None:
        """Set CPUs and priority of a thread.  Raises OSError."""
        if sys.platform == "linux":
            if self.cpus:
                os.sched_setaffinity(thread, self.cpus)
            if self.priority:
                os.sched_setscheduler(thread, os.SCHED_FIFO, os.sched_param(self.priority))


def message_threads(tasks: Path = _TASKS) -> dict[int, str]:
    """Return number and name of the threads of this process that pass messages.

    Python gives its threads a name in the system from version 3.14 on; before, only Python itself has the names.
    """
    ours = {thread.native_id: thread.name for thread in threading.enumerate()}
    found = {}
    for task in tasks.iterdir():
        number = int(task.name)
        try:
            name = ours.get(number) or (task / "comm").read_text("utf-8", "replace").strip()
        except OSError:  # the thread has just ended
            continue
        if name.startswith(MESSAGE_THREADS) and name not in _OTHER_THREADS:
            found[number] = name
    return found


def has_capability(number: int, status: Path = _STATUS) -> bool:
    """Return whether this process has a capability of the system; False if that is unknown."""
    try:
        lines = status.read_text("ascii", "replace").splitlines()
    except OSError:
        return False
    words = next((line.split() for line in lines if line.startswith("CapEff:")), [])
    return len(words) > 1 and bool(int(words[1], 16) >> number & 1)


if sys.platform == "linux":
    import resource

    def _check_priority(priority: int) -> None:
        """Try the priority in a thread that ends.  Raises Unavailable."""
        problem: list[OSError] = []

        def attempt() -> None:
            try:
                os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
            except OSError as error:
                problem.append(error)

        thread = threading.Thread(target=attempt, name="igtl-attempt")
        thread.start()
        thread.join()
        if not problem:
            return
        limit = resource.getrlimit(resource.RLIMIT_RTPRIO)[0]
        permitted = limit in (resource.RLIM_INFINITY, -1) or limit >= priority
        if has_capability(CAP_SYS_NICE) or permitted:  # so the reason is the control group, or a sandbox
            raise Unavailable(
                f"--realtime-priority {priority}: {problem[0].strerror}, although the limits permit it; "
                "give the control group a real-time budget (cpu.rt_runtime_us)"
            )
        raise Unavailable(
            f"--realtime-priority {priority}: found RLIMIT_RTPRIO {limit} without CAP_SYS_NICE, "
            f"expected {priority} or more; "
            f"add 'USER - rtprio {priority}' to /etc/security/limits.conf and log in again "
            "(systemd: LimitRTPRIO=, Docker: --cap-add SYS_NICE)"
        )

    def _check_memory() -> None:
        """Return if all memory may be locked, also what is allocated later.  Raises Unavailable.

        A finite limit is no permission, even if it is large: later memory counts with its whole address range, and
        where it exceeds the limit, threads cannot start and messages cannot be allocated.
        """
        limit = resource.getrlimit(resource.RLIMIT_MEMLOCK)[0]
        if limit not in (resource.RLIM_INFINITY, -1) and not has_capability(CAP_IPC_LOCK):
            raise Unavailable(
                f"--lock-memory: found RLIMIT_MEMLOCK {limit >> 10} KiB without CAP_IPC_LOCK, expected unlimited; "
                "add 'USER - memlock unlimited' to /etc/security/limits.conf and log in again "
                "(systemd: LimitMEMLOCK=infinity, Docker: --cap-add IPC_LOCK)"
            )


def _lock_memory(mlockall: Callable[[int], int] | None = None) -> None:
    """Lock used pages, and others as soon as they are used, so no empty range takes memory.  Raises Unavailable.

    Processes that this one starts, such as the recorder's, do not inherit the lock.
    """
    call = mlockall or ctypes.CDLL(None, use_errno=True).mlockall
    if call(_MCL_CURRENT | _MCL_FUTURE | _MCL_ONFAULT):
        number = ctypes.get_errno()
        why = "needs Linux 4.4 or later" if number == errno.EINVAL else os.strerror(number)
        raise Unavailable(f"--lock-memory: {why}")
