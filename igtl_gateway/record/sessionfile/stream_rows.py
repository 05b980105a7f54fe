"""Streams of entries in columns by number, and entries that are written from columns."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.record.sessionfile import layout
from igtl_gateway.record.sessionfile.chunk_rows import MessageRows, RowStream
from igtl_gateway.record.sessionfile.columns import EntryColumns, Numbers, Stream, Times, WireHead
from igtl_gateway.record.sessionfile.writer import SessionWriter

_CHANNELS = 1 << 16
_NO_STREAM = -1
#: Streams that a writer knows at a time: more than a session has, unless a peer invents names.
_MOST_STREAMS = 10_000
_WIRE_KINDS = (Kind.IGTL_IN, Kind.IGTL_OUT)

#: Kind, channel, type and links of the entries of a stream.
StreamName = tuple[Kind, str, str, tuple[int, ...]]


class StreamRows(NamedTuple):
    """Entries with the numbers of their streams; each array has one element per entry.

    Attributes:
        idents: int32, numbers of the streams; -1 for notes.
        sources: the sender's stamp, UTC ns; 0 = unset; notes have their time or 0.
        begins, ends: int64, places of the payloads of the entries.
    """

    idents: npt.NDArray[np.int32]
    sources: Times
    begins: Numbers
    ends: Numbers

    def first(self, count: int) -> StreamRows:
        """The first entries."""
        return StreamRows(self.idents[:count], self.sources[:count], self.begins[:count], self.ends[:count])


class StreamNumbers:
    """Numbers the streams of entries in columns.

    Args:
        number: returns the number of a stream, for each that is new in a file.
    """

    def __init__(self, number: Callable[[Kind, str, str, tuple[int, ...]], int]) -> None:
        self._number = number
        self._of_channel: tuple[Mapping[int, Stream], npt.NDArray[np.int32]] | None = None
        self._heads: Sequence[WireHead] = ()
        self._of_head = np.zeros((0, 2), np.int32)

    def of(self, columns: EntryColumns) -> StreamRows:
        """The streams of some entries.  Raises DamagedRecording as :meth:`EntryColumns.wire`."""
        wire = columns.wire()
        idents = self._of_channels(columns.streams)[columns.channels]
        sources, begins, ends = columns.source_times(), columns.begins.copy(), columns.ends.copy()
        if len(wire):
            self._learn_heads(wire.known)
            idents[wire.rows] = self._of_head[wire.heads, wire.outgoing.astype(np.intp)]
            sources[wire.rows], begins[wire.rows], ends[wire.rows] = wire.source_times, wire.begins, wire.ends
        return StreamRows(idents, sources, begins, ends)

    def _of_channels(self, streams: Mapping[int, Stream]) -> npt.NDArray[np.int32]:
        """MCAP channel → number of the stream of ROS."""
        if self._of_channel is None or self._of_channel[0] is not streams:
            found = np.full(_CHANNELS, _NO_STREAM, np.int32)
            for number, stream in streams.items():
                if stream.kind in layout.ROS_KINDS:
                    found[number] = self._number(stream.kind, stream.channel, stream.type, ())
            self._of_channel = streams, found
        return self._of_channel[1]

    def _learn_heads(self, heads: Sequence[WireHead]) -> None:
        if heads is not self._heads:  # another file, or one with so many that its numbers begin again
            self._heads, self._of_head = heads, np.zeros((0, 2), np.int32)
        new = [
            [self._number(kind, head.channel, head.type, head.links) for kind in _WIRE_KINDS]
            for head in heads[len(self._of_head) :]
        ]
        if new:
            self._of_head = np.concatenate((self._of_head, np.array(new, np.int32)))


class ColumnsWriter:
    """Writes entries in columns with a session writer, as it would write each of them.

    Args:
        writer: of the file; it may be used in between.
    """

    def __init__(self, writer: SessionWriter) -> None:
        self._writer = writer
        self._forget()

    def _forget(self) -> None:
        self._numbers: dict[StreamName, int] = {}
        self._streams: list[RowStream | None] = []
        self._numbered = StreamNumbers(self._number)

    def write(self, columns: EntryColumns) -> None:
        """Add entries.  Raises as :meth:`SessionWriter.write`, and DamagedRecording of their file."""
        if len(self._streams) > _MOST_STREAMS:
            self._forget()
        found = self._numbered.of(columns)
        times, sources = columns.times, found.sources
        publish = np.where(sources == 0, times, sources)
        which = np.zeros(len(columns), np.uint16)
        arrays = (which, found.idents, columns.numbers, times, publish, sources, found.begins, found.ends)
        rows = MessageRows((columns.data,), *map(np.ascontiguousarray, arrays))
        row = self._writer.add_columns(rows, 0, self._streams)
        while row < len(columns):
            entry = columns.entry(row)
            self._writer.write(entry)
            self._learn(int(found.idents[row]), entry)
            row = self._writer.add_columns(rows, row + 1, self._streams)

    def _number(self, kind: Kind, channel: str, type_name: str, links: tuple[int, ...]) -> int:
        name = kind, channel, type_name, links
        if name not in self._numbers:
            self._numbers[name] = len(self._streams)
            self._streams.append(None)
        return self._numbers[name]

    def _learn(self, ident: int, entry: Entry) -> None:
        if ident != _NO_STREAM and self._streams[ident] is None:
            self._streams[ident] = self._writer.row_stream(entry)
