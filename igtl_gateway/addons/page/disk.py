"""What the page asks of a disk: in a thread of its own, because one that does not answer must not stop the page."""

from __future__ import annotations

import shutil
import threading
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from igtl_gateway.addon import NS_PER_S, SystemClock

#: Longest wait for an answer, s; a disk without one for the second time, ns, is shown, and not waited for.
_WAIT_S, _SILENT_NS = 0.3, 2 * NS_PER_S


@dataclass(frozen=True, slots=True)
class DiskFacts:
    """Bytes and number of the files of a recording, the bytes that its disk has left (None: its folder is gone), and
    the time for which the disk has not answered (0: it answers)."""

    size: int = 0
    files: int = 0
    free: int | None = 0
    silent_s: float = 0.0


class DiskLook:
    """Looks at the files of a recording.

    Args:
        ask: returns size, files and free bytes.
    """

    def __init__(self, ask: Callable[[Path, Path], tuple[int, int, int | None]] | None = None) -> None:
        self._ask = ask or ask_disk
        self._clock = SystemClock()
        self._changed = threading.Condition()
        self._asked_ns = 0  # monotonic; 0: nothing is asked
        self._known = DiskFacts()

    def look(self, path: Path, parts: Path) -> DiskFacts:
        """Return what is known of a file, or of the parts of a split recording; waits a moment for the disk."""
        with self._changed:
            if not self._asked_ns:
                self._asked_ns = self._clock.monotonic_ns()
                threading.Thread(target=self._run, args=(path, parts), name="igtl-page-disk", daemon=True).start()
            silent_ns = self._clock.monotonic_ns() - self._asked_ns
            if silent_ns < _SILENT_NS:
                self._changed.wait_for(lambda: not self._asked_ns, _WAIT_S)
            known = self._known
            return known if not self._asked_ns or silent_ns < _SILENT_NS else _silent(known, silent_ns)

    def _run(self, path: Path, parts: Path) -> None:
        found = DiskFacts(*self._ask(path, parts))
        with self._changed:
            self._known, self._asked_ns = found, 0
            self._changed.notify_all()


def _silent(known: DiskFacts, silent_ns: int) -> DiskFacts:
    return DiskFacts(known.size, known.files, known.free, silent_ns / NS_PER_S)


def ask_disk(path: Path, parts: Path) -> tuple[int, int, int | None]:
    """Return bytes and number of the files of a recording, and the free bytes of its disk; None: its folder is gone."""
    return *_size(path, parts), _free(path.parent)


def _free(folder: Path) -> int | None:
    try:
        return shutil.disk_usage(folder).free
    except OSError:
        return None


def _size(path: Path, parts: Path) -> tuple[int, int]:
    try:
        if path.is_file():
            return path.stat().st_size, 1
        sizes = [each.stat().st_size for each in parts.glob("*.mcap")] if parts.is_dir() else []
        return sum(sizes), len(sizes)
    except OSError:  # a part that was just removed
        return 0, 0
