"""Processes of a measurement, and what they use."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Self

from igtl_gateway.errors import GatewayError
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
            status = dict(
                line.split(":", 1)
                for line in (root / "status").read_text("ascii", "replace").splitlines()
                if ":" in line
            )
            children = [
                child for task in (root / "task").iterdir() for child in (task / "children").read_text("ascii").split()
            ]
            kib = [float(status.get(name, "0 kB").split()[0]) for name in ("VmRSS", "VmHWM")]
            return cls(
                _cpu_s(root), sum(_cpu_s(Path(f"/proc/{child}")) for child in children), *(k / 1000 for k in kib)
            )
        except OSError:
            return cls(0.0, 0.0, 0.0, 0.0)


def _cpu_s(process: Path) -> float:
    # the name, in brackets, can contain anything; user and system time are the 12th and 13th field after it
    fields = (process / "stat").read_text("ascii", "replace").rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
