"""Writing a merged session: the messages of several recordings, in the order of the clock of one.

A part of a split recording, and a snapshot, begin midway.  What was latched before stands at the time of their start,
on channels that do not count towards the part: taken out, it is the recording.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from mcap.records import Channel, Schema

from igtl_gateway.addon import GatewayError, RecordingError, __version__
from igtl_gateway.addon.reading import SessionFile, layout, messages_before
from igtl_gateway.addon.writing import (
    SEQUENCES,
    Definitions,
    McapStream,
    MessageRows,
    RowStream,
    channels_of,
    create_file,
    merged,
    os_error_text,
)

Array = npt.NDArray[Any]

_MOST_NS = 1 << 63
#: Two numbers below have a sum of 63 bits.
_SUM_NS = 1 << 62
_CHANNELS = 1 << 16
#: The file names no program that wrote a part: its messages have one writer.
_LIBRARY = f"igtl-gateway {__version__}"


@dataclass(slots=True)
class MergedPart:
    """A recording that becomes a part.

    Attributes:
        name: the first token of its topics.
        file: the recording.
        to_reference: time of its clock → time of the reference clock, UTC ns.
        times_to_reference: the same for times (N,) uint64; int64, or Python numbers where they do not fit.
        facts: what the merged file states of it besides.
    """

    name: str
    file: SessionFile
    to_reference: Callable[[int], int]
    times_to_reference: Callable[[Array], Array]
    facts: Mapping[str, Any]
    digest: merged.Digest = field(default_factory=merged.Digest)
    count: int = 0  # of its attachments with numbers
    numbers: list[Array] = field(default_factory=list)  # (N, 3), of the next ones

    @property
    def count_of_numbers(self) -> int:
        """Messages whose numbers are in no attachment yet."""
        return sum(map(len, self.numbers))

    def take_numbers(self) -> Array:
        """The numbers of the next attachment."""
        found = np.concatenate(self.numbers)
        self.numbers = [found[merged.NUMBERS :]]
        return found[: merged.NUMBERS]


def write_merged(path: Path, parts: Sequence[MergedPart], facts: Mapping[str, Any]) -> int:
    """Write the merged session, and return the number of its messages.

    Messages with equal times are in the order of the parts; those of one part stay in their order.

    Args:
        path: the file to create.
        parts: the recordings.
        facts: what the file states besides its parts.

    Raises DamagedRecording of a part, RecordingError if the file cannot be written.
    """
    file = create_file(path)
    try:
        mcap = McapStream(file, compression="zstd")
        mcap.start(layout.MCAP_PROFILE, _LIBRARY)
        count = _write(mcap, parts)
        rows = [_facts(part) for part in parts]
        text = json.dumps({**facts, "parts": rows}, sort_keys=True)
        mcap.add_metadata(merged.MERGE_METADATA, layout.seal({merged.MERGE_KEY: text}))
        mcap.finish()
        file.close()
    except OSError as error:
        raise RecordingError(f"cannot write {path}: {os_error_text(error)}") from error
    finally:
        with suppress(OSError):
            file.raw.close()  # closed already, or without what a full disk did not take
    return count


def _write(mcap: McapStream, parts: Sequence[MergedPart]) -> int:
    for part in parts:
        for each in part.file.attachments():
            part.digest.attachment(each)
            name = merged.ATTACHMENT_OF.format(part.name) + each.name
            mcap.add_attachment(name, each.media_type, each.data, each.log_time, each.create_time)
    writer = _Writer(mcap, parts)
    for blocks in _in_order([_Reader(part, writer.ident) for part in parts]):
        writer.write(blocks)
    mcap.flush()
    for part in parts:
        if part.count_of_numbers:
            _put_numbers(mcap, part)
    return writer.count


@dataclass(slots=True)
class _Block:
    """Messages of a part with their times by the reference clock, which do not decrease; an element for each message.

    Attributes:
        data: bytes with the payloads.
        idents: int32, of their channels in the merged file.
        times, publish_times: there, int64 and uint64 ns.
        begins, ends: int64, places of the payloads.
        numbers: uint64 (N, 3), sequence, log_time and publish_time in the part; empty for what was before it.
    """

    data: bytes
    idents: Array
    times: Array
    publish_times: Array
    begins: Array
    ends: Array
    numbers: Array

    def first(self, count: int) -> _Block:
        """The first messages, which are then no longer in this block."""
        names = ("idents", "times", "publish_times", "begins", "ends", "numbers")
        found = _Block(self.data, *(getattr(self, name)[:count] for name in names))
        for name in names:
            setattr(self, name, getattr(self, name)[count:])
        return found


class _Reader:
    """The messages of a part in blocks; first what was before it.

    Args:
        part: the part.
        ident: returns the ident of a channel of a part, and whether it is one of what was before.
    """

    def __init__(self, part: MergedPart, ident: Callable[[MergedPart, Schema | None, Channel, bool], int]) -> None:
        self._part, self._ident = part, ident
        self._last_ns = 0
        self._blocks = chain(self._before(), self._messages())
        self.block: _Block | None = next(self._blocks, None)

    def take(self, until_ns: int, *, included: bool) -> _Block:
        """Return the messages of this block up to a time, which are not taken again."""
        assert self.block
        count = int(np.searchsorted(self.block.times, until_ns, "right" if included else "left"))
        found = self.block.first(count)
        if not len(self.block.times):
            self.block = next(self._blocks, None)
        return found

    def _before(self) -> Iterator[_Block]:
        part = self._part
        start_ns = part.to_reference(part.file.start_ns)
        if not 0 <= start_ns < _MOST_NS:
            return
        for schema, channel, row in messages_before(part.file):
            _, _, log_ns, publish_ns, start, end, data = row
            moved_ns = part.to_reference(log_ns)
            stamp_ns = start_ns if publish_ns == log_ns else _moved(publish_ns, moved_ns - log_ns)
            self._last_ns = start_ns
            yield _Block(
                data,
                np.array([self._ident(part, schema, channel, True)], np.int32),
                np.array([start_ns]),
                np.array([stamp_ns], np.uint64),
                np.array([start]),
                np.array([end]),
                np.empty((0, 3), np.uint64),
            )

    def _messages(self) -> Iterator[_Block]:
        part = self._part
        idents = np.full(_CHANNELS, -1, np.int32)
        known: Definitions | None = None
        for definitions, data, columns in part.file.all_columns():
            if not len(columns.times):
                continue
            if definitions is not known:
                known = definitions
                idents[:] = -1
            for channel in channels_of(columns):
                if idents[channel] < 0:
                    idents[channel] = self._ident(part, *definitions[channel], False)
            part.digest.messages(definitions, data, columns)
            times = part.times_to_reference(columns.times)
            wrong = (times < 0) | (times >= _MOST_NS)
            if wrong.any():
                found = f"time {int(columns.times[np.argmax(wrong)])} ns"
                raise GatewayError(f"{part.file.path}: found {found}, which the offset moves out of all calendars")
            times = np.maximum.accumulate(np.maximum(times.astype(np.int64), self._last_ns))
            self._last_ns = int(times[-1])
            numbers = np.stack((columns.sequences.astype(np.uint64), columns.times, columns.publish_times), 1)
            publish = _all_moved(columns.publish_times, columns.times, times)
            yield _Block(data, idents[columns.channels], times, publish, columns.begins, columns.ends, numbers)


def _in_order(readers: Sequence[_Reader]) -> Iterator[list[tuple[int, _Block]]]:
    """Yield blocks whose messages come before all that follow, with the numbers of their parts.

    Messages with equal times are in the order of the parts.
    """
    while waiting := [(index, reader.block) for index, reader in enumerate(readers) if reader.block]:
        # the messages that a part has behind its block are not earlier than the last one in it
        until_ns, last = min((int(block.times[-1]), index) for index, block in waiting)
        yield [(index, readers[index].take(until_ns, included=index <= last)) for index, _ in waiting]


class _Writer:
    """Writes the messages of blocks in their order, and registers channels where their first message is."""

    def __init__(self, mcap: McapStream, parts: Sequence[MergedPart]) -> None:
        self.count = 0
        self._mcap, self._parts = mcap, parts
        self._numbers = merged.ChannelNumbers(merged.ChannelWriter(mcap).register)
        self._streams: list[RowStream | None] = []
        self._channels: list[tuple[Schema | None, Channel]] = []

    def ident(self, part: MergedPart, schema: Schema | None, channel: Channel, is_before: bool) -> int:
        """A new ident of a channel of a part."""
        here = (merged.channel_before if is_before else merged.channel_of_part)(part.name, channel)
        self._channels.append((schema, here))
        self._streams.append(None)
        return len(self._channels) - 1

    def write(self, blocks: Sequence[tuple[int, _Block]]) -> None:
        """Write messages, and the numbers of parts that have enough for an attachment."""
        some = [block for _, block in blocks]
        sizes = [len(block.times) for block in some]
        which = np.repeat(np.arange(len(some), dtype=np.uint16), sizes)
        times = np.concatenate([block.times for block in some])
        order = np.argsort(times, kind="stable")
        which, times = which[order], times[order]
        idents, publish, begins, ends = (
            np.concatenate([getattr(block, name) for block in some])[order]
            for name in ("idents", "publish_times", "begins", "ends")
        )
        numbers = np.arange(self.count + 1, self.count + 1 + len(times), dtype=np.int64)
        rows = MessageRows(
            tuple(block.data for block in some), which, idents, numbers, times, publish, publish, begins, ends
        )
        ends_at = [self._filled(self._parts[index], which == at, block) for at, (index, block) in enumerate(blocks)]
        row = 0
        for stop in sorted({*(place for places in ends_at for place in places), len(times)}):
            self._add(rows, row, stop)
            row = stop
            for at, (index, _) in enumerate(blocks):
                if stop in ends_at[at]:
                    _put_numbers(self._mcap, self._parts[index])
        self.count += len(times)

    @staticmethod
    def _filled(part: MergedPart, own: Array, block: _Block) -> list[int]:
        """Add the numbers of a block; return the rows behind which an attachment of the part is full."""
        before = part.count_of_numbers % merged.NUMBERS
        part.numbers.append(block.numbers)
        if before + len(block.numbers) < merged.NUMBERS:
            return []
        places = np.flatnonzero(own)
        found: list[int] = (places[merged.NUMBERS - before - 1 :: merged.NUMBERS] + 1).tolist()
        return found

    def _add(self, rows: MessageRows, row: int, stop: int) -> None:
        rows = MessageRows(rows.data, *(np.ascontiguousarray(column[:stop]) for column in rows[1:]))
        row = self._mcap.add_columns(rows, row, self._streams)
        while row < stop:
            ident = int(rows.idents[row])
            channel = self._numbers.of(*self._channels[ident])
            self._streams[ident] = channel, -1, b""
            data = memoryview(rows.data[rows.which[row]])[rows.begins[row] : rows.ends[row]]
            self._mcap.add_message(
                channel,
                int(rows.times[row]),
                b"",
                data,
                int(rows.publish_times[row]),
                int(rows.numbers[row]) % SEQUENCES,
            )
            row = self._mcap.add_columns(rows, row + 1, self._streams)


def _moved(stamp_ns: int, by_ns: int) -> int:
    """A source stamp on the clock of the reference; one that leaves all calendars stays where it is."""
    moved_ns = stamp_ns + by_ns
    return moved_ns if 0 < moved_ns < _MOST_NS else stamp_ns


def _all_moved(stamps: Array, times: Array, moved_times: Array) -> Array:
    """Source stamps (N,) uint64 on the clock of the reference; where they equal the time they stay equal to it.

    The age of a message stays: a sender has the clock of its recorder, or one of its own.
    """
    if max(int(each.max()) for each in (stamps, times, moved_times)) >= _SUM_NS:
        found = [
            moved if stamp == time else _moved(stamp, moved - time)
            for stamp, time, moved in zip(stamps.tolist(), times.tolist(), moved_times.tolist(), strict=True)
        ]
        return np.array(found, np.uint64)
    signed = stamps.astype(np.int64)
    moved = signed + (moved_times - times.astype(np.int64))
    moved = np.where(moved > 0, moved, signed)
    return np.where(stamps == times, moved_times, moved).astype(np.uint64)


def _put_numbers(mcap: McapStream, part: MergedPart) -> None:
    name = merged.NUMBERS_OF.format(part.name) + str(part.count)
    mcap.add_attachment(name, "application/octet-stream", merged.pack_numbers(part.take_numbers()))
    part.count += 1


def _facts(part: MergedPart) -> dict[str, Any]:
    session, ledger = part.file.recorded_session, part.file.recorded_ledger
    return {
        **part.facts,
        "name": part.name,
        "digest": part.digest.finish(session, ledger),
        "profile": layout.MCAP_PROFILE,
        "library": session.get("igtl_gateway_version", ""),
        "session": session,
        "ledger": ledger,
    }
