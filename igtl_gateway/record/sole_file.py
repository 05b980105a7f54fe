"""A recording that is not split: one file, and a next one where that was taken away.

A file that another program removes, replaces or changes while it is written cannot be continued.  What comes then goes
into ``name_1.mcap`` beside it, a later part of the recording: it begins with what is known of the inputs before it.
These are the ones that were not written as rows (``chunk_rows``): links, settings and the first of each stream are
among them.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from igtl_gateway.gateway.log.entry import Entry
from igtl_gateway.record.prologue import Prologue
from igtl_gateway.record.sessionfile import layout
from igtl_gateway.record.sessionfile.chunk_rows import RowStream
from igtl_gateway.record.sessionfile.writer import SessionWriter
from igtl_gateway.record.shared_queue import LARGE_BYTES

#: (path, further session facts, prologue) → the writer of a file.
Open = Callable[[Path, dict[str, str], Sequence[Entry]], SessionWriter]


class SoleFile:
    """Writes a recording that is not split; as SessionWriter.

    Args:
        path: the file to create.
        open_file: makes its writer.
        prologue: has to be fresh.

    Raises RecordingError when the file cannot be created.
    """

    def __init__(self, path: Path, open_file: Open, prologue: Prologue) -> None:
        self.path = path
        self._open_file = open_file
        self._prologue = prologue
        #: The writer of the present file.
        self.file = open_file(path, {}, ())
        self._number = 0

    @property
    def entries(self) -> int:
        return self.file.entries

    @property
    def undefined(self) -> list[str]:
        return self.file.undefined

    @property
    def files(self) -> list[Path]:
        """The file that is there."""
        return [self.file.path]

    def write(self, entry: Entry) -> None:
        """As SessionWriter.write."""
        self.file.write(entry)
        if entry.size < LARGE_BYTES:  # a larger one may be lent
            self._prologue.observe(entry)

    def add_rows(self, room: memoryview, begin: int, end: int, streams: list[RowStream | None]) -> tuple[int, int, int]:
        """As SessionWriter.add_rows."""
        self._prologue.skip()
        return self.file.add_rows(room, begin, end, streams)

    def flush(self) -> None:
        """As SessionWriter.flush."""
        self.file.flush()

    def close(self, ledger: dict[str, Any]) -> None:
        """As SessionWriter.close."""
        self.file.close(ledger)

    def go_on(self) -> tuple[Path, int]:
        """Open the next file; return its path, and the entries of the one before.  Raises RecordingError."""
        before = self.file
        stem = self.path.stem if self.path.suffix == ".mcap" else self.path.name
        path = self.path
        while path == self.path or os.path.lexists(path):
            self._number += 1
            path = self.path.with_name(f"{stem}_{self._number}.mcap")
        facts = {layout.PART_KEY: str(self._number), layout.PREVIOUS_KEY: before.path.name}
        self.file = self._open_file(path, facts, self._prologue.entries())
        return path, before.entries
