"""What the recorder's worker reports: codes of its notes, its state, and how the recording ended."""

from __future__ import annotations

from collections import Counter
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

#: Codes of the recorder's notes.
DROPPED, FAILED, REFUSED, UNDEFINED = "record_drop", "record_failed", "record_refused", "record_undefined"
THREAD = "record_thread"
CONTINUED, LOST_PART, HELD = "record_continued", "record_part_lost", "record_split_held"
PAUSED, RESUMED, SNAPSHOT = "record_paused", "record_resumed", "record_snapshot"
STARTED, STOPPED = "record_started", "record_stopped"
#: After a failure, the recording goes on in a new file.
AGAIN = "record_again"
#: A file begins without large inputs that its outputs may depend on.
INCOMPLETE_BEGIN = "prologue_incomplete"

#: Streams by which entries count as dropped that were in a file that was taken away, or were not flushed when the disk
#: failed.
TAKEN, UNFLUSHED = "(in a file that was taken away)", "(not flushed when the disk failed)"


@dataclass(frozen=True, slots=True)
class RecordingSummary:
    """How a recording ended.

    Attributes:
        path: the file; the folder of a split recording; the name that snapshots are called after.
        size: size of all files, in bytes.
        entries: entries in them.
        dropped: entries that are not there though they should be, by stream.
        left_out: entries that were not to be there, by stream.
        files: what was written.
        failure: why it ended before its time, or why a file that was asked for is missing; or ``""``.
    """

    path: Path
    size: int
    entries: int
    dropped: dict[str, int]
    left_out: dict[str, int]
    files: tuple[Path, ...]
    failure: str = ""

    def discard(self) -> None:
        """Remove what was written."""
        for path in self.files:
            path.unlink(missing_ok=True)
        if self.path.is_dir():
            with suppress(OSError):  # something else is in it
                self.path.rmdir()


@dataclass(frozen=True, slots=True)
class WorkerState:
    """The state of the worker.

    Attributes:
        written_entries: entries in the file.
        dropped: entries that the file could not take, by stream.
        left_out: entries that are not to be there, by stream.
        failure: why nothing can be written, or ``""``.
        paused: whether it is.
        file: the file that is being written; "": there is none, before a start, after a stop, and of a snapshot.
        taken_away: the last file that was removed or changed while it was written, and where it goes on; or ``""``.
        before: entries that were written, left out and dropped before the last start.
        saved: snapshots and files of the black box: their number and bytes.
        window: the file of the black box that is being written, or "".
        free_bytes: free bytes of the disk; None: not known.
        left_s: how long it lasts at the present rate, s; None: not known, or it does not fill.
    """

    written_entries: int = 0
    dropped: dict[str, int] = field(default_factory=dict)
    left_out: dict[str, int] = field(default_factory=dict)
    failure: str = ""
    paused: bool = False
    file: str = ""
    taken_away: str = ""
    before: tuple[int, int, int] = (0, 0, 0)
    saved: tuple[int, int] = (0, 0)
    window: str = ""
    free_bytes: int | None = None
    left_s: int | None = None

    def counters(self, not_queued: Counter[str]) -> dict[str, Any]:
        """As they go into the ledger, with what the queue did not take."""
        dropped = not_queued + Counter(self.dropped)
        return {
            "written_entries": self.written_entries,
            "dropped_entries": dropped.total(),
            "dropped": dict(sorted(dropped.items())),
            "left_out_entries": sum(self.left_out.values()),
            "left_out": dict(sorted(self.left_out.items())),
            "failure": self.failure,
            "taken_away": self.taken_away,
        }
