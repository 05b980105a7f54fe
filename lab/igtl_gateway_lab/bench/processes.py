"""Processes of a measurement, and what they use."""

from __future__ import annotations

import ctypes
import sys
from dataclasses import dataclass
from pathlib import Path

from igtl_gateway.base.errors import GatewayError
from igtl_gateway.base.stamp import NS_PER_S
from igtl_gateway.base.versions import Self
from igtl_gateway_lab.programs import EventProgram


class BenchError(GatewayError):
    """A program of the measurement did not do its part."""


class Program(EventProgram):
    """A program of the measurement."""

    error = BenchError


@dataclass(frozen=True, slots=True)
class Usage:
    """Resources that a process has used.

    Attributes:
        cpu_s: its CPU time, user and system.
        children_cpu_s: that of its children, such as the recorder's process.
        rss_mb: memory in use now.
        peak_mb: largest amount of memory since its start.
    """

    cpu_s: float
    children_cpu_s: float
    rss_mb: float
    peak_mb: float

    @classmethod
    def of(cls, pid: int) -> Self:
        """Return the usage of a running process; zeros without /proc, or if it has ended."""
        root = Path(f"/proc/{pid}")
        try:
            status = _status(root)
            kib = [float(status.get(name, "0 kB").split()[0]) for name in ("VmRSS", "VmHWM")]
            return cls(_cpu_s(pid), sum(map(_cpu_s, _descendants(pid))), *(k / 1000 for k in kib))
        except OSError:
            return cls(0.0, 0.0, 0.0, 0.0)


def wakeups(pid: int) -> dict[int, int]:
    """How often each thread of a process has waited so far, by its id; nothing without /proc."""
    found = {}
    try:
        for task in Path(f"/proc/{pid}/task").iterdir():
            found[int(task.name)] = int(_status(task).get("voluntary_ctxt_switches", "0"))
    except OSError:  # a thread has just ended, or the process
        pass
    return found


def _status(folder: Path) -> dict[str, str]:
    lines = (folder / "status").read_text("ascii", "replace").splitlines()
    return dict(line.split(":", 1) for line in lines if ":" in line)


def _descendants(pid: int) -> list[int]:
    """The children of a process, such as the recorder's or the programs of a launcher, and theirs."""
    found = [
        int(child)
        for task in Path(f"/proc/{pid}/task").iterdir()
        for child in (task / "children").read_text("ascii").split()
    ]
    return found + [grandchild for child in found for grandchild in _descendants(child)]


class _Timespec(ctypes.Structure):
    _fields_ = (("seconds", ctypes.c_long), ("ns", ctypes.c_long))


def _cpu_s(pid: int) -> float:
    """CPU time of a process, to the nanosecond where there is a clock of it (Linux); raises OSError if it has ended."""
    clock, spent = ctypes.c_int(), _Timespec()
    if _LIBC and not _LIBC.clock_getcpuclockid(ctypes.c_int(pid), ctypes.byref(clock)):
        if not _LIBC.clock_gettime(clock, ctypes.byref(spent)):
            return float(spent.seconds + spent.ns / NS_PER_S)
    raise ProcessLookupError(pid)


_LIBC = ctypes.CDLL(None) if sys.platform == "linux" else None
