"""rerun's viewer as a child process, and what its log reports."""

from __future__ import annotations

import os
import re
import signal
from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path
from threading import Event

from igtl_gateway.addon import ViewerError
from igtl_gateway.addon.processes import Child, missing

_KEPT = 20_000  #: number of characters of the viewer's last log lines that are kept
_STOP_S = 5.0


def viewer_binary() -> Path:
    """Return the binary of the viewer: ``rerun`` on the path is a Python wrapper that leaves it running at its exit.

    Raises ViewerError if it is not installed.
    """
    spec = find_spec("rerun_cli")
    if spec is not None and spec.origin is not None:
        path = Path(spec.origin).with_name("rerun")
        if path.is_file():
            return path
    raise ViewerError(missing("rerun"))


class ViewerProcess:
    """A viewer that ends with this process.

    Args:
        arguments: of the viewer.
        log: the value of RUST_LOG.
        expected: patterns of log lines that show that it is ready.

    Attributes:
        ready: set when all expected lines were logged, or the viewer has exited.
        ended: set when it has exited.
        found: the first group of each expected line, ``""`` until it is logged.
        text: the last lines of the log.
        pid: process id.

    Raises ViewerError if rerun is missing.
    """

    def __init__(self, arguments: Sequence[str], log: str, expected: Sequence[re.Pattern[str]]) -> None:
        self.ready = Event()
        self.ended = Event()
        self.found = [""] * len(expected)
        self.text = ""
        self._expected = tuple(expected)
        self._child = Child(
            "viewer",
            [str(viewer_binary()), *arguments],
            on_error_line=self._on_line,
            on_error_end=self._on_end,
            env={**os.environ, "RERUN_ANALYTICS": "0", "NO_COLOR": "1", "RUST_LOG": log},
            death_signal=signal.SIGTERM,
        )
        self._child.close_input()
        self.pid = self._child.pid

    def last_lines(self) -> str:
        """The last three lines of the log."""
        lines = [line.strip() for line in self.text.splitlines() if line.strip()]
        return " | ".join(lines[-3:]) or "none"

    def close(self) -> None:
        """Stop the viewer and wait until it has exited.  A second call does nothing."""
        self._child.terminate(_STOP_S)

    def _on_line(self, line: str) -> None:
        self.text = f"{self.text}{line}\n"[-_KEPT:]
        for at, pattern in enumerate(self._expected):
            if match := pattern.search(line):
                self.found[at] = match[1]
        if all(self.found):
            self.ready.set()

    def _on_end(self) -> None:
        self.ended.set()
        self.ready.set()
