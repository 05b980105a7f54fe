"""Splitting a recording: a folder of session files, each readable alone.

A part ends only before an input, so outputs lie in the part of their cause.  After a crash the side file lacks the last
part, and everything else opens as it is.

Each part begins with a prologue, which may be much larger than what is recorded.  It does not count towards the size
of a part, and it must not fill the disk: a part with a large one goes on until it has as many bytes of its own, for a
minute at most if parts end by time, and no more than `MAX_PER_MINUTE` parts begin in a minute.
"""

from __future__ import annotations

import contextlib
import os
import sys
from collections import deque
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from igtl_gateway.base.errors import GatewayError, RecordingError
from igtl_gateway.base.quantities import size_text
from igtl_gateway.base.stamp import NS_PER_S
from igtl_gateway.gateway.log.entry import Entry
from igtl_gateway.record.prologue import Prologue
from igtl_gateway.record.retention.retention_log import RetentionLog
from igtl_gateway.record.sessionfile import layout
from igtl_gateway.record.sessionfile.figures import SO_FAR, Figures
from igtl_gateway.record.sessionfile.new_file import cannot_begin, make_folder
from igtl_gateway.record.sessionfile.side_file import (
    SIDE_FILE,
    RecordingPart,
    files_of,
    part_path,
    parts_folder,
    write_side_file,
)
from igtl_gateway.record.sessionfile.whole_files import check_target
from igtl_gateway.record.sessionfile.writer import SessionWriter

#: Parts that begin in a minute, at most: what would begin one more goes on in the part that is there.
MAX_PER_MINUTE = 60
_MINUTE_NS = 60 * NS_PER_S
#: Prologues up to this size, bytes, hold no split back.
_SMALL_PROLOGUE = 1 << 20

_DELETED = "deleted"
#: What another program does to a closed part: it takes it to another place, or damages it.
REMOVED, TRUNCATED = "was removed", "was truncated"

#: (path, further session facts, prologue) → the writer of a part.
Open = Callable[[Path, dict[str, str], Sequence[Entry]], SessionWriter]


class PartsWriter:
    """Writes a split recording; as SessionWriter.

    Args:
        path: ``name.mcap``, which names the folder.
        open_part: makes the writer of a part.
        prologue: has to be fresh.
        max_bytes, max_s: a part ends when it has this size without its prologue, or this duration; 0: never.
        overwrite: replace an existing split recording.
        waits: rest at first; the first part has number 1 then: it begins midway, as those after it.
        later: create the folder with the first part, not now.
        counters: of the recorder so far, for the ledger of a part that is not the last.
        on_closed: called when a part is closed.
        on_held: called with the reason when a split is held back, once until parts end on time again.

    Raises RecordingError when the folder or the first part cannot be created.
    """

    def __init__(
        self,
        path: Path,
        open_part: Open,
        prologue: Prologue,
        *,
        max_bytes: int,
        max_s: float,
        overwrite: bool,
        waits: bool = False,
        later: bool = False,
        counters: Callable[[], dict[str, Any]],
        on_closed: Callable[[], None] = lambda: None,
        on_held: Callable[[str], None] = lambda _why: None,
    ) -> None:
        self._on_closed, self._on_held = on_closed, on_held
        self.path = parts_folder(path)
        self._open_part = open_part
        self._prologue = prologue
        self._max_bytes, self._max_ns = max_bytes, int(max_s * NS_PER_S)
        self._counters = counters
        self._parts: list[RecordingPart] = []
        self._looked = 0  # the next of them to look at
        self._gone: set[Path] = set()  # those of them that were removed
        self._left: list[Path] = []  # parts that could not be written to their end
        self._left_entries = 0
        self._without_end: SessionWriter | None = None  # the last of them
        self._number = self._name = 0  # of the part, and the one in its name, which may be larger
        self._asked = False  # the next part
        self._begun_ns: deque[int] = deque(maxlen=MAX_PER_MINUTE)  # stamps of the inputs before which parts began
        self._is_held = self._was_held = False  # the end of this part, and that of the part before
        self._begin_bytes = self._prologue_bytes = 0  # of this part
        self._previous = ""  # name of the part before
        self._so_far = Figures()  # of all parts
        self._rests = self._ended = waits  # ended: the part is one of the complete ones
        self._overwrite = overwrite
        self._old: list[Path] = []
        self._has_folder = False
        if later:
            self._rests = self._ended = True
            return
        self._prepare()
        if waits:
            return
        try:
            self._part = self._open(0, 0)
        except RecordingError:
            with contextlib.suppress(OSError):  # it holds something
                self.path.rmdir()
            raise
        self._remove_old()

    def _prepare(self) -> None:
        """Make the folder.  Raises RecordingError."""
        self._old = _make_folder(self.path, self._overwrite)
        self._has_folder = True

    def _remove_old(self) -> None:
        """Remove the files of an earlier recording, which stays until the new one has begun."""
        for each in self._old:
            if each != self._part.path:
                each.unlink(missing_ok=True)
        self._old = []

    @property
    def entries(self) -> int:
        closed = sum(part.entries for part in self._parts) + self._left_entries
        return closed + (0 if self._ended else self._part.entries)

    @property
    def size(self) -> int:
        """Bytes of the part that is being written; 0 in a rest."""
        return 0 if self._rests or self._ended else self._part.size

    @property
    def undefined(self) -> list[str]:
        return [] if self._rests else self._part.undefined

    @property
    def files(self) -> list[Path]:
        """All that was written."""
        known = [*(part.path for part in self._parts), *self._left]
        return [*known, *([] if self._ended else [self._part.path]), self.path / SIDE_FILE]

    def write(self, entry: Entry) -> None:
        """Add an entry, in the next part if this one is full.  Raises as SessionWriter.write."""
        if not self._rests:
            if entry.kind.is_input and self._part.entries and self._full(entry):
                self._end({"recorder": self._counters(), layout.GOES_ON_KEY: True}, last_part=False)
                self._next()
                self._begun_ns.append(entry.stamp_ns)
                self._was_held, self._is_held = self._is_held, False
            self._part.write(entry)
        self._prologue.observe(entry)

    def split(self) -> None:
        """End the part before the next input, whatever its size; a part without entries goes on."""
        self._asked = not self._rests and self._part.entries > 0

    def flush(self) -> None:
        """As SessionWriter.flush."""
        if not self._rests:
            self._part.flush()

    def close(self, ledger: dict[str, Any]) -> None:
        """End the last part.  Raises RecordingError; what was flushed stays readable."""
        if not self._rests:
            self._end(ledger)

    @property
    def present(self) -> Path | None:
        """The part that is being written; None in a rest."""
        return None if self._rests else self._part.path

    def rest(self, ledger: dict[str, Any]) -> None:
        """End the part, and write nothing until `begin`.  Raises RecordingError."""
        if not self._rests:
            self._rests = True
            self._end(ledger, last_part=False)

    def abandon(self) -> tuple[int, bool]:
        """Leave a part that cannot be written further, and rest; as SoleFile.abandon."""
        if self._rests or self._ended:
            self._rests = True
            return 0, False
        part = self._part
        if not part.has_failed:
            return 0, False
        self._rests = self._ended = True
        if not part.was_taken:
            self._left.append(part.path)
            self._without_end = part
        self._left_entries += part.flushed_entries
        return part.entries - part.flushed_entries, part.was_taken

    def finish_abandoned(self, ledger: dict[str, Any], *, goes_on: bool) -> None:
        """As SoleFile.finish_abandoned; the part is among the complete ones then."""
        part = self._without_end
        if part is None or not part.finish_after_failure(ledger, last_part=not goes_on):
            return
        self._without_end = None
        self._left.remove(part.path)
        self._left_entries -= part.flushed_entries
        self._keep(part)
        with contextlib.suppress(OSError):  # the next part writes it again
            self.update_side_file()

    def _keep(self, part: SessionWriter) -> None:
        """It is one of the complete parts now.  Raises OSError."""
        size = part.path.stat().st_size
        topics = tuple(part.topics())
        self._parts.append(RecordingPart(part.path, part.start_ns, part.end_ns, part.entries, topics, size))

    def begin(self) -> Path:
        """Begin the next part after a rest, and return its path.  Raises RecordingError."""
        if not self._has_folder or not self.path.is_dir():  # a disk that was repaired may have lost it
            self._prepare()
        self._next()
        self._rests = False
        self._remove_old()
        return self._part.path

    def go_on(self) -> tuple[Path, int]:
        """Begin the next part where the file of this one was taken away; return its path, and the entries of this one.

        The side file does not name a part that was taken away; a folder is made again.  Raises RecordingError.
        """
        lost = self._part.entries
        if not os.path.lexists(self.path):
            self._prepare()
        self._next()
        return self._part.path, lost

    def take_missing(self, at_most: int = sys.maxsize) -> list[tuple[RecordingPart, str]]:
        """Look at some closed parts; return those that another program has removed or truncated, and what it did.

        A truncated one is not a part any more.  What the retention has deleted is not among them.
        """
        found = []
        for _ in range(min(at_most, len(self._parts))):
            self._looked %= len(self._parts)
            part = self._parts[self._looked]
            why = "" if part.path in self._gone else _why_missing(part)
            if why and why != _DELETED:
                found.append((part, why))
            if why == TRUNCATED:
                del self._parts[self._looked]
                continue
            if why:
                self._gone.add(part.path)
            self._looked += 1
        return found

    def _next(self) -> None:
        self._asked = False
        number, name = self._number + 1, self._name + 1
        # something has that name: a folder, a link, or the beginning of a part that the disk refused
        while (path := part_path(self.path, name)) not in self._old and os.path.lexists(path):
            name += 1
        self._part = self._open(number, name)
        self._number, self._name = number, name
        self._ended = False

    def _full(self, entry: Entry) -> bool:
        """Whether the part ends before this input."""
        lasted_ns, own = entry.stamp_ns - self._part.start_ns, self._part.size - self._begin_bytes
        is_late = bool(self._max_ns and lasted_ns >= self._max_ns)
        if not (self._asked or is_late or (self._max_bytes and own >= self._max_bytes)):
            return False
        why = self._hindrance(entry.stamp_ns, own, is_old=is_late and lasted_ns >= _MINUTE_NS)
        if why and not self._is_held:
            self._is_held = True
            if not self._was_held:
                self._on_held(why)
        return not why

    def _hindrance(self, now_ns: int, own: int, *, is_old: bool) -> str:
        """Why a part that is due to end goes on; ``""``: it ends.

        Args:
            own: its bytes without the prologue.
            is_old: its time is over, and a minute, too.
        """
        begun = self._begun_ns
        if len(begun) == MAX_PER_MINUTE and now_ns - begun[0] < _MINUTE_NS:
            return f"{MAX_PER_MINUTE} parts began within a minute, which is the limit"
        if max(own, _SMALL_PROLOGUE) < self._prologue_bytes and not (self._asked or is_old):
            until = " and a minute has not passed" if self._max_ns else ""
            return (
                f"each part begins with the last messages of the streams ({size_text(self._prologue_bytes)}), "
                f"and this one has less than that of its own{until}"
            )
        return ""

    def _open(self, number: int, name: int) -> SessionWriter:
        facts = {layout.PART_KEY: str(number)}
        if self._previous:
            facts[layout.PREVIOUS_KEY] = self._previous
        path, prologue = part_path(self.path, name), self._prologue.entries()
        part = self._open_part(path, facts, prologue)
        if part.is_counted:
            part.count(SO_FAR, self._so_far)
        self._begin_bytes, self._prologue_bytes = part.size, sum(entry.size for entry in prologue)
        self._previous = path.name
        return part

    def _end(self, ledger: dict[str, Any], *, last_part: bool = True) -> None:
        part = self._part
        part.close(ledger, last_part=last_part)
        try:
            if not self._ended:
                self._keep(part)
                self._ended = True
            self.update_side_file()
        except OSError as error:
            raise RecordingError(f"recording to {self.path} failed: {error.strerror or error}") from error
        self._on_closed()

    def update_side_file(self) -> None:
        """Write the side file: it names the closed parts that are still there.  Raises OSError."""
        write_side_file(self.path, [part for part in self._parts if part.path.exists()])


def _why_missing(part: RecordingPart) -> str:
    """Return what has happened to a closed part; "" if it is there, _DELETED if the retention has deleted it."""
    try:
        return TRUNCATED if part.path.stat().st_size < part.size else ""
    except FileNotFoundError:
        name = f"{part.path.parent.name}/{part.path.name}"
        return _DELETED if RetentionLog(part.path.absolute().parent.parent).has_deleted(name) else REMOVED
    except OSError:
        return ""


def _make_folder(folder: Path, overwrite: bool) -> list[Path]:
    """Make the folder; return the files of an earlier recording.  Raises RecordingError with the obstacle."""
    try:
        make_folder(folder)
        return []
    except FileExistsError:
        if not folder.is_dir():
            raise RecordingError(f"cannot record to {folder}: it is not a folder") from None
        ours = files_of(folder)
        if ours and not overwrite:
            raise RecordingError(
                f"cannot record to {folder}: it holds a recording already, which is not replaced without --overwrite"
            ) from None
        try:
            for path in ours:
                check_target(path, overwrite=True)
        except GatewayError as error:
            raise RecordingError(str(error)) from None
        return ours
    except (OSError, ValueError) as error:
        raise cannot_begin(folder, error) from None
