"""The account of an export: for every stream, declared = written + left out, and why."""

from __future__ import annotations

from dataclasses import dataclass, field

from igtl_gateway.exchange.source import ImportedStream
from igtl_gateway.session.entry import Entry, Kind

#: Reasons that a row tells apart: those of hostile files can all be different.
_MAX_REASONS = 5


@dataclass(slots=True)
class ExportedStream(ImportedStream):
    """The account of one stream, or of one sort of parts of its messages: declared = taken + left out.

    Attributes:
        failed: how many of those left out should have been written, but could not be.
        reasons: how many were left out for each reason; ``why`` is the same as text.
    """

    failed: int = 0
    reasons: dict[str, int] = field(default_factory=dict)

    @property
    def good(self) -> bool:
        """Whether everything is accounted for and nothing failed."""
        return not self.failed and self.declared == self.taken + self.left_out

    def leave_out(self, why: str, count: int = 1) -> None:
        """Count what the format has no place for."""
        self.left_out += count
        if why not in self.reasons and len(self.reasons) >= _MAX_REASONS:
            why = "other reasons"
        self.reasons[why] = self.reasons.get(why, 0) + count
        self.why = why if len(self.reasons) == 1 else "; ".join(f"{n:,}: {why}" for why, n in self.reasons.items())

    def fail(self, why: str) -> None:
        """Count what should be written but cannot be."""
        self.failed += 1
        self.leave_out(why)


@dataclass(slots=True)
class ExportAccount:
    """What became of the streams that were asked for.

    Attributes:
        rows: by stream: what the session has, what was written, what was left out and why.
        parts: the same for parts of messages that the format cannot hold all of: attributes, points, cells.
        others: messages of the chosen streams that are not for this format, counted by type.
        files: number of files written.
        notes: what else people should know.
    """

    rows: list[ExportedStream] = field(default_factory=list)
    parts: list[ExportedStream] = field(default_factory=list)
    others: dict[str, int] = field(default_factory=dict)
    files: int = 0
    notes: list[str] = field(default_factory=list)
    _by_stream: dict[tuple[Kind, str, str], ExportedStream] = field(default_factory=dict)
    _by_part: dict[tuple[Kind, str, str, str], ExportedStream] = field(default_factory=dict)

    def row(self, entry: Entry) -> ExportedStream:
        """The row of an entry's stream, with the entry counted as one that the session has."""
        key = (entry.kind, entry.channel, entry.type)
        row = self._by_stream.get(key)
        if row is None:
            row = self._by_stream[key] = ExportedStream(entry.channel, 0, entry.type)
            self.rows.append(row)
        row.declared += 1
        return row

    def part(self, entry: Entry, unit: str) -> ExportedStream:
        """The row of one sort of parts of a stream's messages; ``unit`` names it: ``attributes``."""
        key = (entry.kind, entry.channel, entry.type, unit)
        row = self._by_part.get(key)
        if row is None:
            row = self._by_part[key] = ExportedStream(entry.channel, 0, entry.type, unit=unit)
            self.parts.append(row)
        return row
