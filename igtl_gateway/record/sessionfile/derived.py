"""Outputs of which a file has the digest: their bytes, computed from the inputs in the file.

Whatever reads messages of a file passes this door, so no reader sees a digest.  The outputs of one input are computed
when the first of them is read.  Bytes are returned only if their digest is that in the file, so nothing depends on how
the state of the gateway was restored: first with links, notes and the first messages of each stream, which most outputs
follow from; where that gives other bytes, with all inputs before, in order.

Memory is bounded by the outputs of one chunk, which are as large as its inputs, some times over.
"""

from __future__ import annotations

from bisect import bisect_right
from collections import OrderedDict
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import IO, TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
from mcap.records import Channel, Schema

from igtl_gateway.base.errors import ConfigError, DamagedRecording, UnsupportedRecording
from igtl_gateway.base.untrusted import limits
from igtl_gateway.base.version import __version__
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.gateway.log.groups import input_groups
from igtl_gateway.record.sessionfile import facts, layout
from igtl_gateway.record.sessionfile.channels import Decode
from igtl_gateway.record.sessionfile.chunk_columns import Columns, Row
from igtl_gateway.record.sessionfile.chunks import batches, packed_chunk
from igtl_gateway.record.sessionfile.columns import mask_of
from igtl_gateway.record.sessionfile.contents import ChunkEntry, Index
from igtl_gateway.record.sessionfile.large_outputs import LARGE_BYTES, NotComputed, OutputDigest

if TYPE_CHECKING:
    from igtl_gateway.gateway.session import Session

#: Key of the version that recorded a session.
VERSION_KEY = "igtl_gateway_version"
#: First messages of each stream that the state may follow from, of large ones the first: in 64, programs such as PLUS
#: are recognised.
_FIRST = 66
#: Chunks that are kept: that of an output, and the one with its input.
_KEPT = 2

_OUTPUTS = frozenset({Kind.IGTL_OUT, Kind.ROS_OUT})
Flags = npt.NDArray[np.bool_]


def is_digested(channel: Channel) -> bool:
    """Whether the messages of a channel are digests of outputs."""
    return layout.DIGEST_KEY in channel.metadata


def who_computes(recorded_by: str) -> str:
    """Which igtl-gateway can compute the outputs of a recording; the version is ``""`` if it is not known."""
    who = f"igtl-gateway {recorded_by}, which" if recorded_by else "the igtl-gateway, of a version that it lacks, that"
    return f"{who} recorded it, can compute them"


def output_channel(channel: Channel, schemas: dict[int, Schema]) -> Channel:
    """The channel of digests as one of the outputs that they stand for, with its schema among ``schemas``."""
    items = dict(channel.metadata)
    topic, ros_type = items.pop(layout.DIGEST_TOPIC_KEY, ""), items.pop(layout.DIGEST_TYPE_KEY, "")
    type_hash = items.pop(layout.DIGEST_HASH_KEY, "")
    items.pop(layout.DIGEST_KEY)
    items.pop(layout.TYPE_HASH_KEY, "")
    if type_hash:
        items[layout.TYPE_HASH_KEY] = type_hash
    number = next((number for number, schema in schemas.items() if schema.name == ros_type), 0)
    if not number:  # a copy of the file without the channels that have no messages
        from igtl_gateway.record.sessionfile.schemas import RosTypes  # here: it reads all definitions of ROS

        definition = RosTypes().find(ros_type)
        encoding, data = (definition.encoding, definition.data) if definition else ("", b"")
        number = max(schemas, default=0) + 1
        schemas[number] = Schema(id=number, data=data, encoding=encoding, name=ros_type)
    return Channel(
        id=channel.id, topic=topic, message_encoding=channel.message_encoding, schema_id=number, metadata=items
    )


@dataclass(slots=True)
class _Run:
    """A session that is computed again, with all inputs or with few.

    Attributes:
        cause_ns: gateway time of the last input that it had.
        outputs: the large outputs of that.
    """

    in_full: bool
    session: Session | None = None
    cause_ns: int = 0
    outputs: list[bytes] = field(default_factory=list)


class DerivedOutputs:
    """The bytes of the outputs of one file that it has the digest of.

    Args:
        path: of the file, for errors.
        stream, index: of it.
        kinds: kind of the outputs of each channel of digests.
        streams, decoders: kind, channel and type, and decoder, of each channel that is read.
        session: the session metadata.
        prologue: returns the inputs before the first entry.
    """

    def __init__(
        self,
        path: str,
        stream: IO[bytes],
        index: Index,
        kinds: Mapping[int, Kind],
        streams: Mapping[int, tuple[Kind, str, str]],
        decoders: Mapping[int, Decode],
        session: Mapping[str, str],
        prologue: Callable[[], Sequence[Entry]],
    ) -> None:
        self.numbers = frozenset(kinds)
        self._path, self._stream, self._index = path, stream, index
        self._kinds, self._streams, self._decoders = kinds, streams, decoders
        self._by, self._facts, self._prologue = session.get(VERSION_KEY, ""), session, prologue
        self._inputs = frozenset(number for number, (kind, _, _) in streams.items() if kind.is_input)
        self._chunks = index.chunks
        if any(one.end_ns > two.start_ns for one, two in pairwise(self._chunks)):
            raise DamagedRecording(f"{path}: found chunks that overlap, expected none in a file with digests")
        self._starts = [chunk.start_ns for chunk in self._chunks]
        self._read: OrderedDict[int, list[Row]] = OrderedDict()  # the messages of chunks by offset, the last ones
        self._few, self._all = _Run(in_full=False), _Run(in_full=True)
        self._known: list[Entry] | None = None
        #: Where it is a set: numbers of the outputs that are not computed, of which the digest stays; else they raise.
        self.missing: set[int] | None = None
        self._with_memory: set[int] = set()  # channels of inputs for which few inputs before did not suffice

    # -- for readers ------------------------------------------------------------------------------------------

    def rows(self, rows: list[Row], wanted: Collection[int]) -> list[Row]:
        """Messages in order, with the outputs in place of the digests of the wanted channels."""
        if self.numbers.isdisjoint(row[0] for row in rows):
            return rows
        found, cause, size = [], None, 0
        for row in rows:
            if row[0] in self._inputs:
                cause = row
            elif row[0] in self.numbers and row[0] in wanted:
                message = self._message(row, cause)
                size += len(message)
                limits.check_limit("memory", size, self._path)
                found.append((*row[:4], 0, len(message), message))
                continue
            found.append(row)
        return found

    def columns(self, data: bytes, columns: Columns, wanted: Flags) -> tuple[bytes, Columns]:
        """Likewise, in columns: the outputs are behind the data.  ``wanted``: mask of the messages."""
        rows = np.flatnonzero(wanted & mask_of(columns.channels, self.numbers))
        if not len(rows):
            return data, columns
        inputs = np.flatnonzero(mask_of(columns.channels, self._inputs))
        begins, ends = columns.begins.copy(), columns.ends.copy()
        parts, size = [data], len(data)
        for number in rows.tolist():
            before = int(np.searchsorted(inputs, number)) - 1
            cause = self._row(data, columns, int(inputs[before])) if before >= 0 else None
            message = self._message(self._row(data, columns, number), cause)
            begins[number], ends[number] = size, size + len(message)
            parts.append(message)
            size += len(message)
            limits.check_limit("memory", size, self._path)
        return b"".join(parts), columns._replace(begins=begins, ends=ends)

    @staticmethod
    def _row(data: bytes, columns: Columns, number: int) -> Row:
        channel, sequence, time_ns, publish_ns, begin, end = (int(column[number]) for column in columns)
        return channel, sequence, time_ns, publish_ns, begin, end, data

    # -- one output -------------------------------------------------------------------------------------------

    def _message(self, row: Row, cause: Row | None) -> bytes:
        try:
            return self._computed(row, cause)
        except (NotComputed, UnsupportedRecording) as error:
            if self.missing is None:
                raise
            if isinstance(error, NotComputed):
                self.missing.add(row[1])
            return bytes(memoryview(row[6])[row[4] : row[5]])

    def _computed(self, row: Row, cause: Row | None) -> bytes:
        channel, sequence, log_ns, publish_ns, begin, end, data = row
        digest = OutputDigest(memoryview(data)[begin:end], sequence, log_ns, publish_ns)
        cause = cause or self._cause_before(log_ns)
        name = self._streams[channel][1] or self._index.channels[channel].topic
        if cause is None:
            raise NotComputed(
                f"{self._path}: entry {sequence}, {name}: found its digest without the input that it follows from"
            )
        payload = None
        if cause[0] not in self._with_memory:
            payload = next((each for each in self._outputs_of(cause, self._few) if digest.is_of(each)), None)
        if payload is None:
            payload = next((each for each in self._outputs_of(cause, self._all) if digest.is_of(each)), None)
            self._with_memory.add(cause[0])
        if payload is None:
            raise self._not_computed(sequence, name, cause[1])
        return digest.message(payload, self._kinds[channel])

    def _not_computed(self, sequence: int, name: str, cause: int) -> Exception:
        what = f"{self._path}: entry {sequence} (caused by entry {cause}), {name}: the file has its digest, and "
        if self._by != __version__:
            return UnsupportedRecording(
                f"{what}igtl-gateway {__version__} computes other bytes; {who_computes(self._by)}"
            )
        return NotComputed(f"{what}what is computed is different: the digest or an input is not as recorded")

    def _cause_before(self, time_ns: int) -> Row | None:
        """The last input before a time."""
        for at in range(bisect_right(self._starts, time_ns) - 1, -1, -1):
            chunk = self._chunks[at]
            if chunk.places and self._inputs.isdisjoint(chunk.channels):
                continue
            found = [row for row in self._rows_of(chunk) if row[0] in self._inputs and row[2] < time_ns]
            if found:
                return found[-1]
        return None

    def _rows_of(self, chunk: ChunkEntry) -> list[Row]:
        if chunk.at not in self._read:
            data = packed_chunk(self._stream, chunk, self._path).unpack()
            self._read[chunk.at] = [row for some in batches(data) for row in some]
            if len(self._read) > _KEPT:
                self._read.popitem(last=False)
        return self._read[chunk.at]

    # -- the session ------------------------------------------------------------------------------------------

    def _outputs_of(self, cause: Row, run: _Run) -> list[bytes]:
        """The large outputs of an input."""
        if run.cause_ns != cause[2]:
            entry = self._decoded(cause)
            if run.session is None or entry.stamp_ns <= run.cause_ns:
                run.session, run.cause_ns = self._begun(), 0
            for before in self._inputs_between(run.cause_ns, entry.stamp_ns, in_full=run.in_full):
                run.session.recorded(before)
            outputs = run.session.recorded(entry)
            run.cause_ns = entry.stamp_ns
            run.outputs = [each.data() for each in outputs if each.kind in _OUTPUTS and each.size >= LARGE_BYTES]
        return run.outputs

    def _begun(self) -> Session:
        # here: most files have no digests, and need no gateway
        from igtl_gateway.config.configuration import Config
        from igtl_gateway.gateway.session import Session, make_core

        try:
            config = Config.from_dict(facts.configuration(self._facts))
        except ConfigError as error:
            raise UnsupportedRecording(
                f"{self._path}: outputs cannot be computed: the recorded configuration cannot be used: {error}"
            ) from None
        session = Session(make_core(config, fast_path=False))
        for group in input_groups(self._prologue()):
            session.restored(group.input, group.outputs)
        return session

    def _inputs_between(self, after_ns: int, before_ns: int, *, in_full: bool) -> Iterator[Entry]:
        if not in_full:
            if self._known is None:
                self._known = list(self._state_inputs())
            yield from (entry for entry in self._known if after_ns < entry.stamp_ns < before_ns)
            return
        first = max(bisect_right(self._starts, after_ns) - 1, 0)
        for chunk in self._chunks[first : bisect_right(self._starts, before_ns)]:
            for row in self._rows_of(chunk):
                if row[0] in self._inputs and after_ns < row[2] < before_ns:
                    yield self._decoded(row)

    def _state_inputs(self) -> Iterator[Entry]:
        """Links, notes of edges, and the first messages of each stream."""
        left = {number: self._index.counts.get(number, 0) for number in self._inputs}
        for number, (kind, _, _) in self._streams.items():
            if number in left and kind in layout.WIRE_TOPICS | dict.fromkeys(layout.ROS_KINDS):
                left[number] = min(left[number], _FIRST)
        had_large: set[int] = set()
        for chunk in self._chunks:
            if chunk.places and not any(left.get(channel) for channel in chunk.channels):
                continue
            for row in self._rows_of(chunk):
                number = row[0]
                if not left.get(number):
                    continue
                left[number] -= 1
                if row[5] - row[4] >= LARGE_BYTES:
                    if number in had_large:
                        continue
                    had_large.add(number)
                yield self._decoded(row, owned=True)

    def _decoded(self, row: Row, *, owned: bool = False) -> Entry:
        if owned:  # not a part of a chunk
            data: Any = bytes(memoryview(row[6])[row[4] : row[5]])
            row = (*row[:4], 0, len(data), data)
        return self._decoders[row[0]](row, row[1])
