"""The account of an export: for each stream, declared = written + left out, with reasons."""

from __future__ import annotations

from dataclasses import dataclass, field

from igtl_gateway.addon.reading import Entry, Kind
from igtl_gateway.addons.exchange.senders import Senders
from igtl_gateway.addons.exchange.source import ImportedStream

#: Different reasons that a row lists: an untrusted file could cause a different one for each message.
_MAX_REASONS = 5


@dataclass(slots=True)
class ExportedStream(ImportedStream):
    """The account of one stream, or of one kind of parts of its messages: declared = taken + left out.

    Attributes:
        failed: number of those left out that should have been written, but could not be.
        reasons: reason → number left out; ``why`` has the same as text.
    """

    failed: int = 0
    reasons: dict[str, int] = field(default_factory=dict)

    @property
    def good(self) -> bool:
        """Return whether the sums close and nothing failed."""
        return not self.failed and self.declared == self.taken + self.left_out

    def leave_out(self, why: str, count: int = 1) -> None:
        """Count messages or parts that the format cannot represent."""
        self.left_out += count
        if why not in self.reasons and len(self.reasons) >= _MAX_REASONS:
            why = "other reasons"
        self.reasons[why] = self.reasons.get(why, 0) + count
        self.why = why if len(self.reasons) == 1 else "; ".join(f"{n:,}: {why}" for why, n in self.reasons.items())

    def fail(self, why: str, count: int = 1) -> None:
        """Count messages that should be written but cannot be."""
        self.failed += count
        self.leave_out(why, count)


@dataclass(slots=True)
class ExportAccount:
    """The account of the selected streams.

    Attributes:
        rows: for each stream the number of messages in the session, written, and left out with a reason.
        parts: the same for parts of messages that the format represents only in part: attributes, points, cells.
        others: messages of the selected streams whose type does not fit the format: type → number.
        files: number of files written.
        notes: further facts for people.
        senders: streams of OpenIGTLink that were received, written or not; see ``Senders``.
    """

    rows: list[ExportedStream] = field(default_factory=list)
    parts: list[ExportedStream] = field(default_factory=list)
    others: dict[str, int] = field(default_factory=dict)
    files: int = 0
    notes: list[str] = field(default_factory=list)
    senders: Senders = field(default_factory=Senders)
    _by_stream: dict[tuple[Kind, str, str], ExportedStream] = field(default_factory=dict)
    _by_part: dict[tuple[Kind, str, str, str], ExportedStream] = field(default_factory=dict)

    def row(self, entry: Entry) -> ExportedStream:
        """Return the row of an entry's stream; counts the entry as declared."""
        return self.stream(entry.kind, entry.channel, entry.type)

    def stream(self, kind: Kind, channel: str, type_name: str, count: int = 1) -> ExportedStream:
        """Return the row of a stream; counts some of its messages as declared."""
        key = (kind, channel, type_name)
        row = self._by_stream.get(key)
        if row is None:
            row = self._by_stream[key] = ExportedStream(channel, 0, type_name)
            self.rows.append(row)
        row.declared += count
        return row

    def part(self, entry: Entry, unit: str) -> ExportedStream:
        """Return the row of one kind of parts of a stream's messages; ``unit`` names the kind: ``attributes``."""
        key = (entry.kind, entry.channel, entry.type, unit)
        row = self._by_part.get(key)
        if row is None:
            row = self._by_part[key] = ExportedStream(entry.channel, 0, entry.type, unit=unit)
            self.parts.append(row)
        return row


def first_few(texts: list[str], most: int, separator: str = ", ") -> str:
    """Return the first few strings, and the number of the others."""
    more = [f"{len(texts) - most:,} more"] if len(texts) > most else []
    return separator.join([*texts[:most], *more])
