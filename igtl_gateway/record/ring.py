"""Snapshots: the last seconds of a session in memory, written into a file of their own on request."""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import suppress
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

from igtl_gateway.base.stamp import NS_PER_S
from igtl_gateway.gateway.log.entry import Entry
from igtl_gateway.record.prologue import Prologue
from igtl_gateway.record.sessionfile import layout
from igtl_gateway.record.sessionfile.layout import LayoutError
from igtl_gateway.record.sessionfile.new_file import try_file
from igtl_gateway.record.sessionfile.writer import SessionWriter

#: (path, further session facts, prologue) → the writer of a snapshot.
Open = Callable[[Path, dict[str, str], Sequence[Entry]], SessionWriter]

_ENTRY_BYTES = 500  # what an entry costs beside its payload


class Ring:
    """Keeps entries; as SessionWriter, but files come from :meth:`take` only.

    Args:
        path: ``name.mcap``: snapshots are ``name_<UTC time>.mcap`` beside it.
        open_file: makes the writer of a snapshot.
        prologue: has to be fresh.
        seconds, max_bytes: older entries, and those above the size, are dropped, an input with its outputs.
    """

    def __init__(self, path: Path, open_file: Open, prologue: Prologue, *, seconds: float, max_bytes: int) -> None:
        self.path = path
        #: Entries that were written, and the size of the files.
        self.entries = self.size = 0
        self.undefined: list[str] = []
        self.files: list[Path] = []
        self._open_file = open_file
        self._prologue = prologue
        self._seconds = seconds
        self._max_ns, self._max_bytes = int(seconds * NS_PER_S), max_bytes
        self._entries: deque[Entry] = deque()
        self._bytes = 0
        #: Stamp of the newest input that was forgotten, UTC ns; 0: none was.
        self.forgotten_ns = 0

    def try_place(self) -> None:
        """Report an obstacle now, not at the first snapshot.  Raises RecordingError."""
        try_file(self.path, self._path(0))

    def write(self, entry: Entry) -> None:
        """Keep an entry, and drop those that are too old."""
        self._entries.append(entry)
        self._bytes += entry.size + _ENTRY_BYTES
        while self._bytes > self._max_bytes or entry.stamp_ns - self._entries[0].stamp_ns > self._max_ns:
            if not self._forget_oldest():
                break

    def _forget_oldest(self) -> bool:
        """Forget the oldest input with its outputs; False if there is nothing else."""
        following = next((at for at, entry in enumerate(self._entries) if at and entry.kind.is_input), 0)
        if following:
            self.forgotten_ns = self._entries[0].stamp_ns
        for _ in range(following):
            gone = self._entries.popleft()
            self._bytes -= gone.size + _ENTRY_BYTES
            self._prologue.observe(gone)
        return following > 0

    def take(self, ledger: dict[str, Any], utc_ns: int) -> Path:
        """Write all entries into a file named by the time.  Raises RecordingError; the ring goes on in any case."""
        entries = list(self._entries)
        path = self._path(utc_ns)
        writer = self._open_file(path, {layout.SNAPSHOT_KEY: f"{self._seconds:g}"}, self._prologue.entries())
        for entry in entries:
            with suppress(LayoutError):  # what the format cannot hold costs only itself
                writer.write(entry)
        writer.close({**ledger, "recorder": ledger["recorder"] | {"written_entries": writer.entries}})
        self.files.append(path)
        self.entries += writer.entries
        self.undefined += [name for name in writer.undefined if name not in self.undefined]
        self.size += path.stat().st_size
        return path

    def flush(self) -> None:
        """Nothing to flush: entries are in memory."""

    def close(self, ledger: dict[str, Any]) -> None:
        """Drop the entries: only requested snapshots are written."""
        self._entries.clear()

    def _path(self, utc_ns: int) -> Path:
        time = datetime.fromtimestamp(utc_ns // NS_PER_S, timezone.utc)
        name = f"{self.path.stem if self.path.suffix == '.mcap' else self.path.name}_{time:%Y%m%dT%H%M%SZ}"
        path, number = self.path.with_name(f"{name}.mcap"), 1
        while os.path.exists(path):  # False for a name that is too long: creating the file reports that
            number += 1
            path = self.path.with_name(f"{name}_{number}.mcap")
        return path
