"""Programs by others on the side of OpenIGTLink: how the gateway does with them, and what they cost by themselves.

``libopenigtlink`` is ``peer.cpp``, compiled against the C++ library when it is first asked for.  ``pyigtl`` is a
program around the Python library (``pyigtl_side``); it polls every 10 ms and keeps the newest message of each
device only, so a message that it does not report is not necessarily lost.
"""

from __future__ import annotations

import shutil
import subprocess
import sys
from dataclasses import dataclass
from functools import cached_property
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from igtl_gateway_lab.bench.cases import Case
from igtl_gateway_lab.bench.jobs import Job
from igtl_gateway_lab.bench.processes import BenchError

LIBRARY, PYIGTL = "libopenigtlink", "pyigtl"
PEERS = (LIBRARY, PYIGTL)

_SOURCE = Path(__file__).with_name("peer.cpp")
_HEADERS = Path("/usr/include/openigtlink")
_COMPILE_S = 120.0
#: Kind → its arguments of ``peer.cpp``.
_CONTENTS = {
    "transform": ("transform", "0", "0"),
    "string-100": ("string", "100", "0"),
    **{f"points-{count}": ("points", str(count), "0") for count in (1, 10, 100, 1000, 10_000)},
    "image-vga": ("image", "640", "480"),
    "image-xga": ("image", "1024", "768"),
    "image-hd": ("image", "1280", "720"),
    "image-fullhd": ("image", "1920", "1080"),
    "image-4k": ("image", "3840", "2160"),
}


def lacks(peer: str, case: Case) -> str:
    """Why a peer does not take part in a case; "" if it does."""
    if case.together or any(stream.kind not in _CONTENTS for stream in case.streams):
        return f"{peer}: nothing sends {case.name}"
    if peer == PYIGTL:
        return "" if find_spec("pyigtl") else "pyigtl: not installed"
    if shutil.which("g++") is None:
        return f"{peer}: no C++ compiler (g++)"
    if not (_HEADERS / "igtlMessageBase.h").is_file():
        return f"{peer}: no headers in {_HEADERS} (Debian: libopenigtlink-dev)"
    return ""


@dataclass(frozen=True)
class Library:
    """The program on the C++ library, compiled into ``folder``."""

    folder: Path

    @cached_property
    def binary(self) -> Path:
        """The program.  Raises BenchError if it cannot be compiled."""
        made = self.folder / "peer"
        words = ["g++", "-std=c++17", "-O2", "-isystem", str(_HEADERS), str(_SOURCE), "-o", str(made)]
        try:
            done = subprocess.run(
                [*words, "-pthread", "-lOpenIGTLink"],
                capture_output=True,
                text=True,
                errors="replace",
                timeout=_COMPILE_S,
                check=False,
            )
        except subprocess.TimeoutExpired:
            raise BenchError(f"{LIBRARY}: g++ did not end within {_COMPILE_S:g} s") from None
        if done.returncode:
            found = [line for line in done.stderr.splitlines() if "error" in line] or ["g++ failed"]
            raise BenchError(f"{LIBRARY}: {found[0]}")
        return made

    def command(self, job: Job) -> list[str]:
        """How to start it for a job of one stream."""
        (part,) = (*job.sends, *job.hears)
        host, port = job.address
        role = "send" if job.sends else "hear"
        where = [host, str(port), str(int(job.listen)), job.times, role, part.device]
        how = [str(part.stream.rate_hz), str(part.count), str(job.seconds)]
        return [str(self.binary), *where, *_CONTENTS[part.stream.kind], *how]


def command(job: Job, library: Library) -> list[str]:
    """How to start the program of a job."""
    if job.side == LIBRARY:
        return library.command(job)
    return [sys.executable, "-m", "igtl_gateway_lab.bench", job.to_json()]


def times_of(job: Job) -> dict[str, Any]:
    """What the program of a job wrote: columns by name.  Raises BenchError."""
    try:
        if job.side != LIBRARY:
            with np.load(job.times, allow_pickle=False) as file:
                return {name: file[name] for name in file.files}
        numbers = np.array([line.split() for line in Path(job.times).read_text("ascii").splitlines()], np.int64)
    except OSError as error:
        raise BenchError(f"{job.name}: wrote no times: {error}") from None
    (part,) = (*job.sends, *job.hears)
    number, at_ns = numbers.reshape(-1, 2).T
    if job.sends:
        return {f"sent {part.device}": at_ns}
    return {f"numbers {part.device}": number, f"received {part.device}": at_ns}
