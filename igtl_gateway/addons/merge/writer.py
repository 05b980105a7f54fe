"""Writing a merged session: the messages of several recordings, in the order of the clock of one.

A part of a split recording, and a snapshot, begin midway.  What was latched before stands at the time of their start,
on channels that do not count towards the part: taken out, it is the recording.
"""

from __future__ import annotations

import heapq
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from mcap.records import Channel, Schema

from igtl_gateway.addon import GatewayError, RecordingError, __version__
from igtl_gateway.addon.reading import SessionFile, layout, messages_before
from igtl_gateway.addon.writing import SEQUENCES, McapStream, Row, create_file, merged, os_error_text

_MOST_NS = 1 << 63
#: The file names no program that wrote a part: its messages have one writer.
_LIBRARY = f"igtl-gateway {__version__}"


@dataclass(slots=True)
class MergedPart:
    """A recording that becomes a part.

    Attributes:
        name: the first token of its topics.
        file: the recording.
        to_reference: time of its clock → time of the reference clock, UTC ns.
        facts: what the merged file states of it besides.
    """

    name: str
    file: SessionFile
    to_reference: Callable[[int], int]
    facts: Mapping[str, Any]
    digest: merged.Digest = field(default_factory=merged.Digest)
    channels: dict[int, tuple[Channel, Channel]] = field(default_factory=dict)  # by identity: it, and here
    numbers: list[tuple[int, int, int]] = field(default_factory=list)
    count: int = 0


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
    numbers = merged.ChannelNumbers(merged.ChannelWriter(mcap).register)
    count = 0
    for time_ns, index, schema, channel, row, is_before in heapq.merge(
        *(_timed(part, index) for index, part in enumerate(parts)), key=lambda each: each[:2]
    ):
        part = parts[index]
        _, sequence, log_ns, publish_ns, start, end, data = row
        known = part.channels.get(id(channel))
        if known is None:
            here = (merged.channel_before if is_before else merged.channel_of_part)(part.name, channel)
            known = part.channels[id(channel)] = channel, here
        moved_ns = time_ns
        if is_before:
            moved_ns = part.to_reference(log_ns)
        else:
            part.digest.message(schema, channel, row)
            part.numbers.append((sequence, log_ns, publish_ns))
        count += 1
        mcap.add_message(
            numbers.of(schema, known[1]),
            time_ns,
            b"",
            memoryview(data)[start:end],
            # the age of a message stays: a sender has the clock of its recorder, or one of its own
            time_ns if publish_ns == log_ns else _moved(publish_ns, moved_ns - log_ns),
            count % SEQUENCES,
        )
        if len(part.numbers) == merged.NUMBERS:
            _put_numbers(mcap, part)
    mcap.flush()
    for part in parts:
        if part.numbers:
            _put_numbers(mcap, part)
    return count


def _moved(stamp_ns: int, by_ns: int) -> int:
    """A source stamp on the clock of the reference; one that leaves all calendars stays where it is."""
    moved_ns = stamp_ns + by_ns
    return moved_ns if 0 < moved_ns < _MOST_NS else stamp_ns


def _timed(part: MergedPart, index: int) -> Iterator[tuple[int, int, Schema | None, Channel, Row, bool]]:
    """The messages of a part with their times by the reference clock, which never decrease; first what was before."""
    last = 0
    start_ns = part.to_reference(part.file.start_ns)
    if 0 <= start_ns < _MOST_NS:
        for schema, channel, row in messages_before(part.file):
            yield start_ns, index, schema, channel, row, True
    for schema, channel, row in part.file.messages():
        time_ns = part.to_reference(row[2])
        if not 0 <= time_ns < _MOST_NS:
            raise GatewayError(f"{part.file.path}: found time {row[2]} ns, which the offset moves out of all calendars")
        last = time_ns = max(last, time_ns)
        yield time_ns, index, schema, channel, row, False


def _put_numbers(mcap: McapStream, part: MergedPart) -> None:
    name = merged.NUMBERS_OF.format(part.name) + str(part.count)
    mcap.add_attachment(name, "application/octet-stream", merged.pack_numbers(part.numbers))
    part.count += 1
    part.numbers.clear()


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
