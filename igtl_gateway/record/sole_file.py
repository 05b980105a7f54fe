"""A recording that is not split: one file, and a next one where that was taken away, was closed on request, or failed.

A file that another program removes, replaces or changes while it is written cannot be continued.  What comes then goes
into ``name_1.mcap`` beside it, a later part of the recording: it begins with what is known of the inputs before it.
These are the ones that were not written as rows (``chunk_rows``): links, settings and the first of each stream are
among them.  So does what comes after a rest, in which nothing is written.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from igtl_gateway.gateway.log.entry import Entry
from igtl_gateway.record.prologue import Prologue
from igtl_gateway.record.sessionfile import layout
from igtl_gateway.record.sessionfile.chunk_rows import RowStream
from igtl_gateway.record.sessionfile.writer import SessionWriter

#: (path, further session facts, prologue) → the writer of a file.
Open = Callable[[Path, dict[str, str], Sequence[Entry]], SessionWriter]


class SoleFile:
    """Writes a recording that is not split; as SessionWriter.

    Args:
        path: the file to create.
        open_file: makes its writer.
        prologue: has to be fresh.
        waits: rest at first.
        next_path: returns the path of a file that is begun after a rest; one that is taken gets a number.

    Raises RecordingError when the file cannot be created.
    """

    def __init__(
        self, path: Path, open_file: Open, prologue: Prologue, *, waits: bool, next_path: Callable[[], Path]
    ) -> None:
        self.path = path
        self._open_file = open_file
        self._prologue = prologue
        self._next_path = next_path
        self._number = 0
        self._previous = ""
        self._closed: list[Path] = []  # on request
        self._without_end: SessionWriter | None = None  # the last file that the disk refused
        self._closed_entries = 0
        #: The writer of the present file; None in a rest.
        self.file: SessionWriter | None = None
        if not waits:
            self.file = open_file(path, {}, ())

    @property
    def entries(self) -> int:
        return self._closed_entries + (self.file.entries if self.file else 0)

    @property
    def size(self) -> int:
        """Bytes of the present file; 0 in a rest."""
        return self.file.size if self.file else 0

    @property
    def forgotten(self) -> Mapping[str, int]:
        """Stream → size of its last input, which a file that begins now lacks."""
        return self._prologue.forgotten

    @property
    def undefined(self) -> list[str]:
        return self.file.undefined if self.file else []

    @property
    def files(self) -> list[Path]:
        """The files that are there."""
        return [*self._closed, *([self.file.path] if self.file else [])]

    @property
    def present(self) -> Path | None:
        """The file that is being written; None in a rest."""
        return self.file.path if self.file else None

    def write(self, entry: Entry) -> None:
        """As SessionWriter.write; in a rest only what a later file begins with is kept."""
        if self.file:
            self.file.write(entry)
        self._prologue.observe(entry)

    def add_rows(self, room: memoryview, begin: int, end: int, streams: list[RowStream | None]) -> tuple[int, int, int]:
        """As SessionWriter.add_rows."""
        assert self.file
        self._prologue.skip()
        return self.file.add_rows(room, begin, end, streams)

    def end_full_chunk(self) -> None:
        """As SessionWriter.end_full_chunk."""
        assert self.file
        self.file.end_full_chunk()

    def row_stream(self, entry: Entry) -> RowStream | None:
        """As SessionWriter.row_stream."""
        return self.file.row_stream(entry) if self.file else None

    def flush(self) -> None:
        """As SessionWriter.flush."""
        if self.file:
            self.file.flush()

    def close(self, ledger: dict[str, Any]) -> None:
        """As SessionWriter.close."""
        if self.file:
            self.file.close(ledger)

    def rest(self, ledger: dict[str, Any]) -> None:
        """Close the file, and write nothing until `begin`.  Raises RecordingError."""
        if self.file:
            self.file.close(ledger)
            self._closed.append(self.file.path)
            self._closed_entries += self.file.entries
            self._previous, self.file = self.file.path.name, None

    def abandon(self) -> tuple[int, bool]:
        """Leave a file that cannot be written further, and rest.

        Returns how many entries it may not have, and whether it was taken away: then it is not a file of the recording.
        """
        file = self.file
        if file is None or not file.has_failed:
            return 0, False
        self.file = None
        if not file.was_taken:
            self._closed.append(file.path)
            self._without_end = file
        self._closed_entries += file.flushed_entries
        self._previous = file.path.name
        return file.entries - file.flushed_entries, file.was_taken

    def finish_abandoned(self, ledger: dict[str, Any], *, goes_on: bool) -> None:
        """Give the file that was left last its end, if the disk has room for it; this may be called again.

        ``goes_on``: the recording does, for the seals of parts.
        """
        if self._without_end and self._without_end.finish_after_failure(ledger):
            self._without_end = None

    def begin(self) -> Path:
        """Open the next file after a rest, and return its path.  Raises RecordingError."""
        path = self._next_path()
        return self._next(path, is_taken=path in self._closed or os.path.lexists(path))

    def go_on(self) -> tuple[Path, int]:
        """Open the next file; return its path, and the entries of the one before.  Raises RecordingError."""
        before = self.file
        assert before
        self._previous = before.path.name
        return self._next(self.path, is_taken=True), before.entries

    def _next(self, path: Path, *, is_taken: bool) -> Path:
        """Open a later file of the recording: at this path, or beside it with a number."""
        stem = path.stem if path.suffix == ".mcap" else path.name
        number = self._number + 1
        if is_taken:
            while os.path.lexists(path.with_name(f"{stem}_{number}.mcap")):
                number += 1
            path = path.with_name(f"{stem}_{number}.mcap")
        facts = {layout.PART_KEY: str(number)} | ({layout.PREVIOUS_KEY: self._previous} if self._previous else {})
        self.file = self._open_file(path, facts, self._prologue.entries())
        self._number = number
        return path
