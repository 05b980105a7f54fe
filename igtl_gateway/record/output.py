"""What a worker writes into: one file, parts or a ring in memory, and how the recording goes on in a next file."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from igtl_gateway.base.clock import Clock
from igtl_gateway.base.errors import ConfigError, DamagedRecording, DiskRefused, RecordingError
from igtl_gateway.gateway.log.note import Level, Note
from igtl_gateway.record.new_files import NewFiles
from igtl_gateway.record.options import RecordOptions, path_at
from igtl_gateway.record.parts import PartsWriter
from igtl_gateway.record.prologue import Prologue
from igtl_gateway.record.reports import HELD
from igtl_gateway.record.ring import Ring
from igtl_gateway.record.selection import StateInputRule
from igtl_gateway.record.sessionfile.chunk_rows import RowStream
from igtl_gateway.record.sessionfile.new_file import try_file
from igtl_gateway.record.shared_queue import LARGE_BYTES
from igtl_gateway.record.sole_file import SoleFile

if TYPE_CHECKING:
    from igtl_gateway.gateway.acceptance import Acceptance
    from igtl_gateway.record.black_box import BlackBox


@dataclass(frozen=True, slots=True)
class Hooks:
    """What an output calls.

    Attributes:
        counters: returns those of the recorder so far, for the ledger of a file that is not the last.
        note: takes notes.
        closed: called when a file is complete.
        obstacle: called with what is in the way of the files of a black box, and whether one is missing for that.
    """

    counters: Callable[[], dict[str, Any]]
    note: Callable[[Note], None]
    closed: Callable[[], None]
    obstacle: Callable[[str, bool], None]


class Output:
    """The files of a recording.

    Args:
        path: the file, or the name of parts or snapshots.
        rule: which inputs later outputs depend on.
        options: of the recording.
        files: opens them.
        clock: names files, and paces a black box.
        row_streams: of the queue: the channel of each stream in the present file.
        hooks: what is called.

    Attributes:
        writer: the file, the parts or the ring.
        rows: the file if it takes entries as rows.
        box: the ring if it is a black box.
        refused: what the disk has refused at the start, or ``""``; then no file is open.

    Raises RecordingError when the first file cannot be created.
    """

    def __init__(
        self,
        path: Path,
        rule: StateInputRule,
        options: RecordOptions,
        files: NewFiles,
        clock: Clock,
        row_streams: list[RowStream | None],
        hooks: Hooks,
    ) -> None:
        self.box: BlackBox | None = None
        self.refused = ""
        self._rule = rule
        self._options = options
        self._files = files
        self._clock = clock
        self._row_streams = row_streams
        self._hooks = hooks
        try:
            self.writer = self._open(path)
        except DiskRefused as error:
            if options.stop_on_failure:
                raise
            self.refused = str(error)
            self.writer = self._open(path, later=True)
        self.rows = self._writer_of_rows()

    @property
    def present(self) -> str:
        """The file that is being written; "": there is none, and of a ring."""
        writer = self.writer
        return str(writer.present or "") if isinstance(writer, SoleFile | PartsWriter) else ""

    @property
    def saved(self) -> tuple[int, int]:
        """Number and bytes of the files of a ring."""
        writer = self.writer
        return (len(writer.files), writer.size) if isinstance(writer, Ring) else (0, 0)

    @property
    def window(self) -> str:
        """The file of a black box that is being written, or ``""``."""
        return str(self.box.present or "") if self.box else ""

    @property
    def forgotten(self) -> Mapping[str, int]:
        """Large inputs that a file which begins now lacks, as of SoleFile."""
        return self.writer.forgotten if isinstance(self.writer, SoleFile) else {}

    def in_files(self) -> SoleFile | PartsWriter:
        """Return the writer of a recording that can be started and stopped.  Raises RecordingError for a ring."""
        if isinstance(self.writer, Ring):
            raise RecordingError("found a snapshot buffer, expected a recording")
        return self.writer

    def begin(self) -> Path:
        """Begin the next file, and return its path.  Raises RecordingError, OSError."""
        return self.in_files().begin()

    def go_on(self) -> tuple[Path, int]:
        """Continue in the next file after one was taken away; return its path, and the entries of that.

        Raises RecordingError.
        """
        path, lost = self.in_files().go_on()
        self._forget_channels()
        return path, lost

    def close_present(self) -> Path:
        """Close the present file, and return its path.  Raises RecordingError, OSError."""
        writer = self.in_files()
        path = writer.present
        assert path
        writer.rest({"recorder": self._hooks.counters()})
        return path

    def changed(self) -> None:
        """Another file is written now, or none."""
        self._forget_channels()
        self.rows = self._writer_of_rows()

    def abandon(self) -> tuple[int, bool]:
        """Leave a file that cannot be written further; as SoleFile.abandon."""
        self.rows = None
        return self.in_files().abandon()

    def finish_abandoned(self, ledger: dict[str, Any], *, goes_on: bool) -> None:
        """Give the file that was left its end, as SoleFile.finish_abandoned."""
        if isinstance(self.writer, SoleFile | PartsWriter):
            self.writer.finish_abandoned(ledger, goes_on=goes_on)

    def _forget_channels(self) -> None:
        """The streams of the queue have no channels in the next file yet."""
        self._row_streams[:] = [None] * len(self._row_streams)

    def _writer_of_rows(self) -> SoleFile | None:
        writer = self.writer
        return writer if isinstance(writer, SoleFile) and writer.file and writer.file.takes_rows(LARGE_BYTES) else None

    def _open(self, path: Path, *, later: bool = False) -> SoleFile | PartsWriter | Ring:
        """The writer for these options.

        Args:
            later: create nothing before it is asked for.
        """
        options, prologue = self._options, Prologue(self._rule)
        if options.snapshot_s:
            ring = self._open_ring(path, prologue)
            if not later:
                ring.try_place()
            return ring
        if options.has_parts:
            return PartsWriter(
                path,
                self._files.open,
                prologue,
                max_bytes=options.split_bytes,
                max_s=options.split_s,
                overwrite=options.overwrite,
                waits=options.waits,
                later=later,
                counters=self._hooks.counters,
                on_closed=self._hooks.closed,
                on_held=self._report_held,
            )
        if options.waits and not later:
            try_file(path, path.with_name(f".{path.name}.trial"))
        named = options.named or path
        return SoleFile(
            path,
            self._files.open,
            prologue,
            waits=options.waits or later,
            next_path=lambda: path_at(named, self._clock.utc_ns()),
        )

    def _report_held(self, why: str) -> None:
        text = f"{self.writer.path}: the part goes on, the next one begins later: {why}"
        self._hooks.note(Note(Level.WARN, HELD, text))

    def _open_ring(self, path: Path, prologue: Prologue) -> Ring:
        """The memory for snapshots."""
        options = self._options
        if options.triggers:
            self.box = self._open_box(path, prologue)
            return self.box
        return Ring(path, self._files.open, prologue, seconds=options.snapshot_s, max_bytes=options.snapshot_bytes)

    def _open_box(self, path: Path, prologue: Prologue) -> BlackBox:
        """The writer of a black box."""
        # here: they import most of the gateway, which no other recorder needs
        from igtl_gateway.record.black_box import BlackBox
        from igtl_gateway.record.triggers import TRIGGERED, Triggers

        def on_note(note: Note) -> None:
            """Pass it on; a file may be new to the retention."""
            self._hooks.note(note)
            if note.code != TRIGGERED:
                self._hooks.closed()

        options = self._options
        return BlackBox(
            path,
            self._files.open,
            prologue,
            seconds=options.snapshot_s,
            max_bytes=options.snapshot_bytes,
            rules=options.triggers,
            triggers=Triggers(options.triggers, self._files.types, self._acceptance(), self._hooks.note),
            clock=self._clock,
            counters=self._hooks.counters,
            on_note=on_note,
            on_obstacle=self._hooks.obstacle,
        )

    def _acceptance(self) -> Acceptance:
        """Which bytes the session accepts as messages."""
        # here: only a black box looks into messages
        from igtl_gateway.config.configuration import Config
        from igtl_gateway.gateway.acceptance import Acceptance
        from igtl_gateway.record.sessionfile import facts

        try:
            return Acceptance.of(Config.from_dict(facts.configuration(self._files.session)))
        except (ConfigError, DamagedRecording):  # tests have sessions without one
            return Acceptance()
