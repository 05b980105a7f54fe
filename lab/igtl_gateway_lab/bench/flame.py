"""A flame graph of the gateway: py-spy looks at its threads while it works, and draws where they were."""

from __future__ import annotations

import os
import shutil
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from igtl_gateway_lab.bench.processes import BenchError, Program

_TOOL = "py-spy"
_RATE_HZ = 250
_AT_MOST_S = 3600
_TITLE = f"igtl-gateway bridge, its threads {_RATE_HZ} times a second"
_END_S = 120.0


def tool() -> str:
    """The program, on the path or beside this Python; "" if it is not installed."""
    path = os.pathsep.join([os.environ.get("PATH", ""), str(Path(sys.executable).parent)])
    return shutil.which(_TOOL, path=path) or ""


@contextmanager
def drawn(gateway: Program, out: Path) -> Iterator[None]:
    """Look at a process during the block, then write the picture (SVG).  Raises BenchError."""
    out.unlink(missing_ok=True)  # it would look like ours
    words = ["record", "--pid", str(gateway.pid), "--output", str(out), "--threads"]
    # nonblocking: it neither stops the gateway at each look, nor takes threads that sleep in the kernel for busy
    command = [tool(), *words, "--nonblocking", "--rate", str(_RATE_HZ), "--duration", str(_AT_MOST_S)]
    with Program(_TOOL, command) as watcher:
        yield
        watcher.interrupt_and_wait(_END_S)
    if not out.is_file():
        raise BenchError(f"{_TOOL}: wrote no {out}")
    # its title is how it was called
    out.write_text(out.read_text("utf-8").replace(" ".join(command), _TITLE), "utf-8")
