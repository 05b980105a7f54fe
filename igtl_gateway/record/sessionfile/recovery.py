"""Recovering a damaged recording: all that is readable, as a file that every reader opens, and the name of the rest.

The new file is read again before anything is reported of it: by our reader, by the ``mcap`` library and by rosbags.
A chunk of which every message is right is copied as it is; of a long whole recording, whose chunks all are, the two
libraries read both ends, and our reader reads all of it and compares all indexes.
What would make a reader refuse it is not copied but named as a loss: an entry whose time is out of order, metadata and
attachments of another shape, a ledger of an earlier recovery that is too deep.
"""

from __future__ import annotations

import json
from array import array
from bisect import bisect_right
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import asdict, dataclass
from itertools import islice
from pathlib import Path
from tempfile import TemporaryFile
from types import MappingProxyType
from typing import Any

import numpy as np
from mcap.reader import make_reader
from mcap.records import Attachment, Channel, Message, Metadata, Schema
from rosbags.highlevel import AnyReader

from igtl_gateway.base.errors import DamagedRecording, GatewayError, LimitExceeded
from igtl_gateway.base.quantities import count_text, counted
from igtl_gateway.base.version import __version__
from igtl_gateway.record.sessionfile import facts, layout
from igtl_gateway.record.sessionfile.chunks import batches
from igtl_gateway.record.sessionfile.columns import Unfit
from igtl_gateway.record.sessionfile.compression import Compression
from igtl_gateway.record.sessionfile.copying import CopyWriter
from igtl_gateway.record.sessionfile.merged import MERGE_METADATA, parse_merge
from igtl_gateway.record.sessionfile.reader import SessionFile, prologue_of
from igtl_gateway.record.sessionfile.salvage import HAS_SESSION, Salvage, Salvaged, SalvagedChunk
from igtl_gateway.record.sessionfile.salvage_report import (
    ATTACHMENT,
    HEADER,
    LEDGER,
    METADATA,
    NUMBER,
    Loss,
    SalvageReport,
)
from igtl_gateway.record.sessionfile.side_file import RecordingPart

#: Messages that every reader reads again.  Of a whole recording with more, the chunks are copied as they are, so the
#: libraries read all around them, and messages at the beginning and at the end; this program reads all.
_READ_BY_ALL = 20_000
#: Characters of a reason; a reader of the ledger must not meet the damage in it.
_MAX_REASON = 300


@dataclass(frozen=True, slots=True)
class Recovery:
    """A recovered file.

    Attributes:
        facts: what its ledger states of its origin.
        report: what was read, and what is lost.
        part: its row in the side file of a split recording.
        notes: programs that do not read the new file, and why; they do not read the damaged one either.
        goes_on: it is a part of a split recording that another part follows.
    """

    facts: dict[str, Any]
    report: SalvageReport
    part: RecordingPart
    notes: tuple[str, ...]
    goes_on: bool


class _Missing(Exception):
    """Digests of outputs that cannot be computed from what is left; ``numbers`` of the outputs, modulo 2³²."""

    def __init__(self, numbers: set[int]) -> None:
        self.numbers = numbers


class _Disorder(Exception):
    """A message of a session is older than the one before it."""


def recover(
    source: Path,
    place: Path,
    progress: Callable[[Salvage], None] = lambda _: None,
    session: Mapping[str, str] = MappingProxyType({}),
) -> Recovery:
    """Write the readable rest of a recording, and read it again with every reader.

    Args:
        source: the damaged file, or a sound one.
        place: the file to write, which is incomplete after an error.
        progress: called after each message.
        session: session metadata of a recording that has lost its own.

    Raises UnsupportedRecording (nothing of MCAP in it, a newer version), DamagedRecording if no file with all that is
    readable can be read again, RecordingError if the file cannot be written.
    """
    return _recovered(source, place, progress, _check, session)


def copy_readable(source: Path, place: Path) -> SalvageReport:
    """As :func:`recover`, but only our reader will read the new file: what it refuses is found when it does."""
    return _recovered(source, place, lambda _: None, _check_digests, {}).report


#: Reads the new file; yields which programs do not.
_Reads = Callable[[Path, Salvage], Iterator[str]]


def _recovered(
    source: Path, place: Path, progress: Callable[[Salvage], None], check: _Reads, session: Mapping[str, str]
) -> Recovery:
    in_turn, without = True, frozenset[int]()
    while True:
        try:
            return _attempt(source, place, progress, check, session, in_turn=in_turn, without=without)
        except (_Disorder, LimitExceeded):
            if not in_turn:
                raise
            in_turn = False
        except _Missing as missing:
            without |= missing.numbers
        place.unlink(missing_ok=True)


def _attempt(
    source: Path,
    place: Path,
    progress: Callable[[Salvage], None],
    check: _Reads,
    session: Mapping[str, str],
    *,
    in_turn: bool,
    without: Collection[int],
) -> Recovery:
    """Copy messages in turn, or in order of time and not compressed, which takes more room but no limit refuses it.

    ``without``: numbers of outputs whose digests are left out.
    """
    with Salvage.open(source) as file:
        compression: Compression = file.compression if in_turn else "none"
        items = file.recorded_session or ({} if file.foreign else dict(session))
        with CopyWriter(place, file.profile, file.library, items, compression=compression) as writer:
            losses = list(_copy_beside(file, writer))
            if not file.has_header:
                losses.append(_loss(HEADER, "not readable: which program wrote the file"))
            for found in _in_turn(file) if in_turn else _in_order(file, place.parent):
                if isinstance(found, SalvagedChunk) and not without:
                    writer.write_chunk(found.definitions, found.chunk, found.data)
                    progress(file)
                    continue
                for schema, channel, message in _messages_of(found):
                    if message.sequence in without and layout.DIGEST_KEY in channel.metadata:
                        items = channel.metadata
                        name = items.get(layout.STREAM_KEY) or items.get(layout.DIGEST_TOPIC_KEY, channel.topic)
                        why = f"entry {message.sequence}, {name}: what is left of its input does not give its digest"
                        file.report.add(_loss(NUMBER, why, file.position))
                        file.report.messages -= 1
                    else:
                        writer.write(schema, channel, message)
                progress(file)
            for loss in losses:
                file.report.add(loss)
            origin, ledger = _ledger(file)
            part = writer.close(ledger)
        return Recovery(origin, file.report, part, tuple(check(place, file)), layout.GOES_ON_KEY in ledger)


def _copy_beside(file: Salvage, writer: CopyWriter) -> Iterator[Loss]:
    """Copy metadata records and attachments; yield those that no reader would take."""
    for metadata in file.metadata():
        if why := _refusal(_check_metadata, metadata):
            yield _loss(METADATA, f"{metadata.name[:80]}: {why}")
        else:
            writer.add_metadata(metadata)
    for attachment in file.attachments():
        if why := _refusal(_check_attachment, attachment):
            yield _loss(ATTACHMENT, f"{attachment.name[:80]}: {why}")
        else:
            writer.add_attachment(attachment)


def _refusal(check: Callable[[Any], None], record: Metadata | Attachment) -> str:
    """Return why a record cannot be read; ``""`` if it can."""
    try:
        check(record)
    except (GatewayError, layout.LayoutError) as error:
        return str(error)
    return ""


def _check_metadata(metadata: Metadata) -> None:
    if metadata.name == MERGE_METADATA:
        parse_merge(layout.unseal(metadata.metadata), "merge")


def _check_attachment(attachment: Attachment) -> None:
    if attachment.name == layout.PROLOGUE_ATTACHMENT:
        prologue_of(attachment, Path(layout.PROLOGUE_ATTACHMENT))


def _loss(what: str, text: str, at: int = 0) -> Loss:
    return Loss(what, at, 0, 0, 0, text[:_MAX_REASON])


_Found = tuple[Schema | None, Channel, Message]


def _messages_of(found: _Found | SalvagedChunk) -> Iterator[_Found]:
    if not isinstance(found, SalvagedChunk):
        yield found
        return
    definitions = {channel.id: (schema, channel) for schema, channel in found.definitions}
    for rows in batches(found.data):
        for number, sequence, time_ns, publish_ns, begin, end, data in rows:
            yield *definitions[number], Message(number, time_ns, data[begin:end], publish_ns, sequence)


def _in_turn(file: Salvage) -> Iterator[_Found | SalvagedChunk]:
    """The messages as they lie in the file, and whole chunks.  Raises _Disorder for a session whose times decrease."""
    last_ns = 0
    for each in file.read_chunks():
        if isinstance(each, SalvagedChunk):
            if each.first_ns < last_ns and not file.foreign:
                raise _Disorder
            last_ns = each.last_ns
            yield each
            continue
        if each.message.log_time < last_ns and not file.foreign:
            raise _Disorder
        last_ns = each.message.log_time
        yield each.schema, each.channel, each.message


def _in_order(file: Salvage, folder: Path) -> Iterator[_Found]:
    """The messages in order of time; in between they are in a file.

    Of a session, whose entries are numbered, those are left out and named whose times do not fit between the others.
    """
    columns = tuple(array("Q") for _ in range(6))
    times, publishes, sequences, channels, ends, places = columns
    definitions: dict[int, Salvaged] = {}
    with TemporaryFile(dir=folder) as spool:
        end = 0
        for each in file.read():
            message = each.message
            definitions.setdefault(message.channel_id, each)
            end += spool.write(message.data)
            row = (message.log_time, message.publish_time, message.sequence, message.channel_id, end, file.position)
            for column, value in zip(columns, row, strict=True):
                column.append(value)
        if file.foreign:
            rows = sorted(range(len(times)), key=times.__getitem__)
        else:
            rows = _longest_rising(times)
            _name_the_others(file, rows, times, sequences, places)
        for number in rows:
            start = ends[number - 1] if number else 0
            spool.seek(start)
            data = spool.read(ends[number] - start)
            known = definitions[channels[number]]
            message = Message(channels[number], times[number], data, publishes[number], sequences[number])
            yield known.schema, known.channel, message


def _longest_rising(times: array[int]) -> list[int]:
    """Return the rows of the longest part of the times that never decreases."""
    ends: list[int] = []  # by length: the smallest last time of such a part
    rows: list[int] = []  # and its row
    before = array("q")
    for row, time_ns in enumerate(times):
        at = bisect_right(ends, time_ns)
        before.append(rows[at - 1] if at else -1)
        ends[at : at + 1] = [time_ns]
        rows[at : at + 1] = [row]
    found = []
    row = rows[-1] if rows else -1
    while row >= 0:
        found.append(row)
        row = before[row]
    return found[::-1]


def _name_the_others(
    file: Salvage, kept: list[int], times: array[int], sequences: array[int], places: array[int]
) -> None:
    following = iter([*kept, len(times)])
    next_kept, last = next(following), -1
    for row, time_ns in enumerate(times):
        if row == next_kept:
            last, next_kept = row, next(following)
            continue
        near = f"{times[last]} before" if last >= 0 else f"{times[next_kept]} after"
        text = f"entry {sequences[row]}: its time, {time_ns} ns, is out of order: found {near} it"
        file.report.add(_loss(NUMBER, text, places[row]))
        file.report.messages -= 1
    file.report.start_ns, file.report.end_ns = times[kept[0]], times[kept[-1]]


def _ledger(file: Salvage) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return what the ledger states of the origin, and the ledger, which a reader takes."""
    ledger = file.ledger or {}
    origin = _origin(file)
    found = {**ledger, "recovered": origin}
    if "recovered" in ledger:
        found["recovered"] = origin = {**origin, "earlier": ledger["recovered"]}
    try:
        facts.ledger(json.dumps(found), "")
    except (DamagedRecording, RecursionError) as error:
        file.report.add(_loss(LEDGER, f"what it states of an earlier recovery: {error}"))
        origin = _origin(file)
        found = {**ledger, "recovered": origin}
    return origin, found


def _origin(file: Salvage) -> dict[str, Any]:
    report = file.report
    return {
        "by": f"igtl-gateway {__version__}",
        "from": file.path.name,
        "from_bytes": report.size,
        "whole": report.whole,
        "closed": report.closed,
        HAS_SESSION: bool(file.recorded_session),
        "messages": report.messages,
        "missing": report.missing,
        "missing_numbers": report.missing_numbers,
        "lost": [asdict(loss) for loss in report.lost],
        "more_lost": report.more_lost,
    }


# -- reading it again ------------------------------------------------------------------------------------------------


def _read_through(file: SessionFile) -> None:
    """Read and decode all entries.  Raises as `SessionFile.entries`."""
    try:
        found = file.columns()
    except Unfit:
        for _ in file.entries():
            pass
        return
    for columns in found:
        columns.wire()
        for row in np.flatnonzero(columns.of(lambda stream: stream.kind in layout.NOTE_KINDS)).tolist():
            columns.entry(row)


def _check_digests(place: Path, _file: Salvage) -> Iterator[str]:
    """Raise _Missing where outputs cannot be computed."""
    with SessionFile.open(place) as again:
        missing = again.keep_missing()
        if again.has_digests:
            _read_through(again)
        if missing:
            raise _Missing(missing)
    return iter(())


def _check(place: Path, file: Salvage) -> Iterator[str]:
    """Read the new file with every reader; yield why rosbags does not, which needs CDR and definitions of its own.

    Raises DamagedRecording if ours or the mcap library does not, or if messages are missing.
    """
    with SessionFile.open(place) as again:
        again.prologue()
        for _ in again.attachments():
            pass
        missing = again.keep_missing()
        _read_through(again)
        if missing:
            raise _Missing(missing)
        damaged = again.damaged_indexes()
    reads_all = not file.report.whole or file.report.messages <= _READ_BY_ALL
    windows: list[tuple[int | None, int | None]] = [(None, None)]
    if damaged:
        raise DamagedRecording(f"{file.path}: found damaged indexes of {counted(damaged, 'chunk')} in the new file")
    try:
        with place.open("rb") as stream:
            reader = make_reader(stream)
            if reads_all:
                count = sum(1 for _ in reader.iter_messages())
            else:
                for is_last in (False, True):
                    for _ in islice(reader.iter_messages(reverse=is_last), _READ_BY_ALL // 2):
                        pass
                summary = reader.get_summary()
                count = summary.statistics.message_count if summary and summary.statistics else 0
                chunks = summary.chunk_indexes if summary else []
                spans = sorted((chunk.message_start_time, chunk.message_end_time + 1) for chunk in chunks)
                windows = [*spans[:1], *spans[1:][-1:]]
            for _ in (*reader.iter_metadata(), *reader.iter_attachments()):
                pass
    except Exception as error:  # the library has no common class of errors
        raise DamagedRecording(
            f"{file.path}: what is readable is no file for the mcap library: {type(error).__name__}: {error}"
        ) from None
    if count != file.report.messages:
        raise DamagedRecording(
            f"{file.path}: read {count_text(file.report.messages, 'message')}, found {count} in the new file"
        )
    if place.suffix == ".mcap":
        try:
            with AnyReader([place]) as bag:
                for start_ns, end_ns in windows:
                    for _ in bag.messages(start=start_ns, stop=end_ns):
                        pass
        except Exception as error:  # nor has this one
            yield f"rosbags does not read it: {str(error)[:_MAX_REASON] or type(error).__name__}"
