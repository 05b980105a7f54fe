"""The recordings of a folder: which there are, and what a process of its own reads of them (``listing``)."""

from __future__ import annotations

import json
import os
import stat
import sys
import threading
from collections import deque
from pathlib import Path
from typing import Any

from igtl_gateway.addon import NS_PER_S, SystemClock, python_command
from igtl_gateway.addon.processes import Child
from igtl_gateway.addon.reading import marks_files
from igtl_gateway.addons.page.listing import FACTS, PLACES, PLOT
from igtl_gateway.addons.page.plot_field import usual_field
from igtl_gateway.addons.page.results import keep_newest
from igtl_gateway.addons.page.starting import Start, directly

_COMMAND = python_command("igtl_gateway.addons.page.listing")
#: Most recordings of the list, the newest; longest time for one at its first try, seconds (the next one has twice as
#: much: a busy machine reads slowly), and how often it is tried.
MAX_LISTED, _PATIENCE_S, _TRIES = 500, 30.0, 3
#: A file that changed within this time is being written, ns.
_REST_NS = 3_000_000_000
#: One that could not be read in time is tried again after this time, ns.
_AGAIN_NS = 60_000_000_000
#: Time lines, and numbers of streams, that are kept.
_MAX_PLACES, _MAX_PLOTS = 16, 4

#: Size and time of change (ns) of a recording, and when marks were last added to it (ns).
_Version = tuple[tuple[int, int], int]


def child_environment() -> dict[str, str]:
    """Return the environment of a process of our own: it imports what this one does."""
    return {**os.environ, "PYTHONPATH": os.pathsep.join(str(Path(entry).absolute()) for entry in sys.path)}


class Recordings:
    """The list of a folder; `rows` does not wait for what is still to be read.

    Args:
        folder: where the recordings are.
        start: starts the process that reads them.
    """

    def __init__(self, folder: Path, start: Start = directly) -> None:
        self.folder = folder
        self._start = start
        self._clock = SystemClock()
        self._lock = threading.Lock()
        self._placing = threading.Lock()
        self._places: dict[str, tuple[tuple[int, int], dict[str, Any]]] = {}  # of the last time lines
        self._plots: dict[tuple[str, str], tuple[tuple[int, int], dict[str, Any]]] = {}  # of the last streams
        self._known: dict[str, tuple[_Version, dict[str, Any]]] = {}
        self._to_read: dict[str, _Version] = {}  # the first is being read
        self._reading = False
        self._older = 0  # recordings that are not listed
        self._tries: dict[tuple[str, _Version], int] = {}  # of those that were not read in time
        self._begun_ns = 0  # of the one that is being read, monotonic
        self._reading_name = ""  # of the same

    def path(self, name: str) -> Path | None:
        """Return the path of a recording of the list; None for any other name."""
        return self.folder / name if self.mark(name) else None

    def mark(self, name: str) -> tuple[int, int] | None:
        """Return size and time of change (ns) of a recording of the list; None for any other name."""
        return next((mark for found, mark, _ in self._found() if found == name), None)

    def rows(self) -> list[dict[str, Any]]:
        """Return the recordings, the newest first, with what is known of each."""
        found, now_ns = self._found(), self._clock.utc_ns()
        with self._lock:
            rows = []
            for name, mark, size in found:
                version = mark, _marked_ns(self.folder / name)
                known, facts = self._known.get(name, (None, {}))
                # one that is being written is read again once it has come to rest
                is_late = bool(facts.get("unread")) and now_ns - facts["unread"] > _AGAIN_NS
                is_read = (known == version and not is_late) or (bool(facts) and now_ns - mark[1] < _REST_NS)
                rows.append({"name": name, "bytes": size, "modified_ns": mark[1], **facts, "read": is_read})
                if not is_read:
                    self._to_read.setdefault(name, version)
                    if self._begun_ns and name == self._reading_name:
                        rows[-1]["reading_s"] = (self._clock.monotonic_ns() - self._begun_ns) // NS_PER_S
            if self._to_read and not self._reading:
                self._reading = True
                threading.Thread(target=self._read_all, name="igtl-page-listing", daemon=True).start()
        if rows and self._older:
            rows[-1]["older"] = self._older
        return rows

    def _found(self) -> list[tuple[str, tuple[int, int], int]]:
        """Return name, (size, time of change in ns) and bytes of the newest recordings."""
        found = []
        try:
            with os.scandir(self.folder) as entries:
                for entry in entries:
                    if not entry.name.startswith("."):
                        found += _recording(entry)
        except OSError:
            return []
        found.sort(key=lambda each: -each[1][1])
        self._older = max(len(found) - MAX_LISTED, 0)
        return found[:MAX_LISTED]

    def places(self, name: str) -> dict[str, Any] | None:
        """Return what lies on the time line of a recording, None for another name; one process at a time reads it."""
        mark = self.mark(name)
        if mark is None:
            return None
        with self._placing:
            known, found = self._places.pop(name, (None, {}))
            if known != mark:
                reader = _Reader(self._start)
                try:
                    found = reader.ask(self.folder / name, PLACES)
                finally:
                    reader.close()
            if not found.get("unread"):  # else it is read again
                self._places[name] = mark, found
            keep_newest(self._places, _MAX_PLACES)
            return found

    def plot(self, name: str, key: str, field: str) -> dict[str, Any] | None:
        """Return the numbers of a field of a stream, and the names of all; None for an unknown recording.

        Args:
            key, field: of the stream, and of the numbers; "": the first one.
        """
        mark = self.mark(name)
        if mark is None:
            return None
        with self._placing:
            known, found = self._plots.pop((name, key), (None, {}))
            if known != mark:
                reader = _Reader(self._start)
                try:
                    found = reader.ask(self.folder / name, PLOT, key)
                finally:
                    reader.close()
            if not found.get("unread"):
                self._plots[name, key] = mark, found
            keep_newest(self._plots, _MAX_PLOTS)
        fields = found.get("fields", {})
        chosen = field if field in fields else usual_field(fields)
        return found | {"fields": list(fields), "field": chosen, "values": fields.get(chosen, [])}

    def closed(self, name: str) -> None:
        """A recording was closed just now: what was read of it before is of no use, and it is not still changing."""
        with self._lock:
            self._known.pop(name, None)

    def _next(self) -> tuple[str, _Version, int]:
        """Return which one is read next, and how often it was tried: the newest of those that were tried least."""
        tries = {name: self._tries.get((name, version), 0) for name, version in self._to_read.items()}
        name = min(tries, key=lambda each: (tries[each], -self._to_read[each][0][1]))
        return name, self._to_read[name], tries[name]

    def _read_all(self) -> None:
        reader = _Reader(self._start)
        while True:
            with self._lock:
                self._begun_ns = self._clock.monotonic_ns() if self._to_read else 0
                if not self._to_read:
                    self._reading = False
                    break
                name, version, tries = self._next()
                self._reading_name = name
            facts = reader.ask(self.folder / name, patience_s=_PATIENCE_S * 2**tries)
            if not reader.is_usable:  # it did not survive the file
                reader.close()
                reader = _Reader(self._start)
            with self._lock:
                self._tries.pop((name, version), None)
                del self._to_read[name]
                if facts.get("unread") and tries + 1 < _TRIES:
                    self._tries[name, version] = tries + 1
                    self._to_read[name] = version  # after the others
                else:
                    self._known[name] = version, facts
        reader.close()


class _Reader:
    """The process; of one thread.

    Attributes:
        is_usable: whether it can be asked again.
    """

    def __init__(self, start: Start = directly) -> None:
        self._lines: deque[str] = deque()
        self._changed = threading.Condition()
        self._ended = False
        self.is_usable = True
        self._child = start(
            lambda: Child("page-listing", _COMMAND, on_line=self._take, on_end=self._end, env=child_environment())
        )

    def ask(self, path: Path, what: str = FACTS, *more: str, patience_s: float = 0.0) -> dict[str, Any]:
        """Return what it reads of a recording.

        Args:
            patience_s: the longest time for it; 0: that of a first try.
        """
        patience_s = patience_s or _PATIENCE_S
        self._child.write(json.dumps([str(path), what, *more]) + "\n")
        with self._changed:
            self._changed.wait_for(lambda: self._lines or self._ended, patience_s)
            line = self._lines.popleft() if self._lines else ""
        if line:
            facts: dict[str, Any] = json.loads(line)
            return facts
        self.is_usable = False
        late = f"not read within {patience_s:g} s: this machine is busy, or its disk"
        problem = "it ended the process that reads it" if self._ended else late
        return {"unread": SystemClock().utc_ns(), "problem": problem}

    def close(self) -> None:
        """End the process."""
        self._child.kill()

    def _take(self, line: str) -> None:
        with self._changed:
            self._lines.append(line)
            self._changed.notify()

    def _end(self) -> None:
        with self._changed:
            self._ended = True
            self._changed.notify()


def _marked_ns(path: Path) -> int:
    """Return when marks were last added to a recording, 0 if none are: they are not in it."""
    try:
        return max((each.stat().st_mtime_ns for each in marks_files(path)), default=0)
    except OSError:  # removed meanwhile
        return 0


def _recording(entry: os.DirEntry[str]) -> list[tuple[str, tuple[int, int], int]]:
    """Return a row for a file or the folder of a split recording, also one that cannot be read."""
    try:
        facts = _facts(entry)
        if stat.S_ISDIR(facts.st_mode):
            with os.scandir(entry.path) as inside:
                parts = [_facts(part) for part in inside if part.name.endswith(".mcap")]
            size = sum(part.st_size for part in parts)
            if parts:
                return [(entry.name, (size, max(part.st_mtime_ns for part in parts)), size)]
        elif entry.name.endswith(".mcap"):
            return [(entry.name, (facts.st_size, facts.st_mtime_ns), facts.st_size)]
    except OSError:  # removed meanwhile, or not ours to read
        pass
    return []


def _facts(entry: os.DirEntry[str]) -> os.stat_result:
    """Return the facts of a file, or of a link that leads nowhere.  Raises OSError."""
    try:
        return entry.stat()
    except OSError:
        return entry.stat(follow_symlinks=False)
