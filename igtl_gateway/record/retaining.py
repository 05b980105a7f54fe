"""Retention in the recorder's process: a thread of its own, so that a large folder or a slow disk delays nothing."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Set
from pathlib import Path

from igtl_gateway.base.clock import Clock
from igtl_gateway.base.quantities import count_text
from igtl_gateway.gateway.log.note import Level, Note
from igtl_gateway.record.options import RecordOptions
from igtl_gateway.record.retention.retention import Choice, Retention, RetentionReport
from igtl_gateway.record.retention.stored import MOST_FILES, StoredRecording
from igtl_gateway.record.retention.upload_state import UploadProtection
from igtl_gateway.record.sessionfile.side_file import parts_folder

#: Codes of its notes.
DELETED, KEPT, FAILED, CLOCK = "retention_deleted", "retention_kept", "retention_failed", "retention_clock"

#: Time between two passes, seconds; the end of a part causes one, too.
_EVERY_S = 60.0
#: Longest wait for the last pass, seconds.
_LAST_S = 10.0
#: Maximum number of files that a note names.
_MOST_NAMES = 20


class RetentionThread:
    """Applies the retention to the folder of a recording.

    Args:
        path: the recording.
        options: rule, and what protects a recording.
        clock: decides about ages.
        files: absolute paths of the files that the recorder has begun; it may grow.
    """

    def __init__(self, path: Path, options: RecordOptions, clock: Clock, files: Set[Path] = frozenset()) -> None:
        assert options.retention
        self._live = parts_folder(path) if options.has_parts else None
        folder = path.absolute().parent
        self._uploads = UploadProtection(folder, all_files=options.uploaded)
        self._seals = options.seal is not None
        self._files = files
        self._retention = Retention(
            folder, options.retention, clock, self._hindrance, is_live=self._is_live, is_running=self._is_running
        )
        self._size = options.retention.size
        #: Bytes that may still come before recordings are deleted; None: none are, or some are kept.
        self.until_deleted: int | None = None
        self._notes: deque[Note] = deque()
        self._last: dict[str, str] = {}  # code → text of the last note
        self._deleted_parts = False
        self._lock = threading.Lock()  # guards the last one
        self._due = threading.Event()
        self._ends = False
        self._thread = threading.Thread(target=self._run, name="retention", daemon=True)

    def wake(self) -> None:
        """Make a pass now."""
        if not self._thread.is_alive() and not self._ends:
            self._thread.start()
        self._due.set()

    def take(self) -> list[Note]:
        """Return the notes since the last call."""
        return [self._notes.popleft() for _ in range(len(self._notes))]

    def has_deleted_parts(self) -> bool:
        """Return whether parts of this recording were deleted since the last call."""
        with self._lock:
            found, self._deleted_parts = self._deleted_parts, False
        return found

    def stop(self) -> None:
        """Make a last pass, and wait for it."""
        self._ends = True
        self._due.set()
        if self._thread.is_alive():
            self._thread.join(_LAST_S)

    def _run(self) -> None:
        while True:
            self._due.wait(_EVERY_S)
            self._due.clear()
            ends = self._ends
            try:
                self._uploads.refresh()
                self._report(self._retention.apply())
            except Exception as error:  # a defect here must not delete anything, nor end the recording
                self._note(Level.ERROR, FAILED, f"no retention: {type(error).__name__}: {error}")
                return
            if ends:
                return

    def _hindrance(self, recording: StoredRecording) -> str:
        if self._seals and not recording.sealed:
            return "it is not sealed"
        return self._uploads.why(recording)

    def _is_live(self, folder: Path) -> bool:
        return self._live is not None and folder == self._live.absolute()

    def _is_running(self, recording: StoredRecording) -> bool:
        return self._is_live(recording.parent) or recording.path in self._files

    def _report(self, report: RetentionReport) -> None:
        is_able = self._size and not (report.kept or report.is_above or report.problem)
        self.until_deleted = max(0, self._size - report.bytes_left) if is_able else None
        if report.deleted:
            if any(self._is_live(each.recording.parent) for each in report.deleted):
                with self._lock:
                    self._deleted_parts = True
            self._notes.append(
                Note(Level.INFO, DELETED, f"retention deleted {_text(report.deleted)}", data=_data(report))
            )
        self._note(Level.WARN, CLOCK, f"ages do not count: {report.clock}" if report.clock else "")
        kept = [each for each in report.kept if each.kept != "an earlier part is kept"]
        text = f"retention keeps {_text(kept)}: {kept[0].kept}" if kept else ""
        if not text and report.is_above:
            text = "the session that runs is larger than half of the size; older recordings do not give way to it"
        self._note(Level.WARN, KEPT, text)
        problem = report.problem or ("" if report.complete else f"found more than {MOST_FILES:,} files in the folder")
        self._note(Level.ERROR, FAILED, f"no retention: {problem}" if problem else "")

    def _note(self, level: Level, code: str, text: str) -> None:
        """Report a state when it begins or changes."""
        if text and text != self._last.get(code):
            self._notes.append(Note(level, code, text))
        self._last[code] = text


def _text(choices: list[Choice]) -> str:
    """``3 recordings (1,234 bytes)``, or the name of one."""
    size = sum(each.recording.size for each in choices)
    what = choices[0].recording.name if len(choices) == 1 else count_text(len(choices), "recording")
    return f"{what} ({count_text(size, 'byte')})"


def _data(report: RetentionReport) -> dict[str, object]:
    names = [each.recording.name for each in report.deleted[:_MOST_NAMES]]
    return {"files": names, "count": len(report.deleted), "bytes_left": report.bytes_left}
