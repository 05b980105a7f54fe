"""A merged session: the messages of several recorders in one MCAP file, in the order of one clock.

To every other program it is an ordinary file: each topic has the name of its part in front, and ``log_time`` is that of
the reference clock.  Each part can be taken out again: its messages are in the order that they had, an attachment has
their numbers and times, and a digest states that nothing changed.  ``docs/reference/session-log.md`` specifies it.
"""

from __future__ import annotations

import json
import math
import re
import struct
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from enum import Enum
from typing import IO, TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
from mcap.records import Attachment, Channel, Schema

from igtl_gateway.base.errors import DamagedRecording, UnsupportedRecording
from igtl_gateway.base.near import one_of
from igtl_gateway.base.quantities import counted
from igtl_gateway.base.stamp import NS_PER_S
from igtl_gateway.base.untrusted.shape import fields, list_of, map_of, number, text, wrong
from igtl_gateway.base.untrusted.text import parse_json
from igtl_gateway.base.untrusted.unpack import unpack_zstd_of_any_size
from igtl_gateway.gateway.log.entry import Kind
from igtl_gateway.record.sessionfile import layout
from igtl_gateway.record.sessionfile.chunk_columns import Columns, Row, interleaved
from igtl_gateway.record.sessionfile.compression import compress

if TYPE_CHECKING:
    from igtl_gateway.record.sessionfile.stream import McapStream

#: Metadata record of a merged session: one JSON object, see :data:`_MERGE`.
MERGE_METADATA = "igtl_gateway.merge"
MERGE_KEY = "merge"
#: Keys of the channel metadata: name of the part, and topic and kind there (``layout.KIND_KEY`` would make the file a
#: session of one recorder).
PART_NAME_KEY, PART_TOPIC_KEY, PART_KIND_KEY = (
    "igtl_gateway.part",
    "igtl_gateway.part_topic",
    "igtl_gateway.part_kind",
)
#: Beginning of the names of attachments of a part, and of those with the numbers and times of its messages.
ATTACHMENT_OF, NUMBERS_OF = "parts/{}/", "numbers/{}/"
#: Steps to the time of a part for one of the reference.
_ROUNDS = 3
#: Bounds of a line of an offset, ns and ns per s: beyond are no clocks.
_MOST_NS, _MOST_SLOPE = 1 << 62, 1e9
#: Messages of one attachment of numbers.
NUMBERS = 1 << 16

Times = npt.NDArray[np.int64]
MessageIn = tuple[Schema | None, Channel, Row]
#: Schema and channel by the number of the channel.
Definitions = Mapping[int, tuple[Schema | None, Channel]]

_NAME = re.compile(r"\w+", re.ASCII)
_MESSAGE = struct.Struct("<IIQQQ")
_HEAD = np.dtype([("number", "<u4"), ("sequence", "<u4"), ("time", "<u8"), ("publish_time", "<u8"), ("size", "<u8")])
_CHANNELS = 1 << 16
#: Payloads up to this size together are copied behind their heads, and hashed at once.
_COPIED_BYTES = 16 << 20


class Method(Enum):
    """How the offset of a part's clock is known."""

    BOTH_WAYS = "messages in both directions"
    ONE_WAY = "messages in one direction: a bound"
    GIVEN = "given"
    STREAMS = "the movement in two streams"
    REFERENCE = "the reference"


def _number_or_null(value: Any, place: str) -> None:
    """A number, or null where it is not known."""
    if value is not None and not (type(value) in (int, float) and math.isfinite(value)):
        raise wrong(place, value, "a number or null")


def _name(value: Any, place: str) -> None:
    """The name of a part, which is also a part of a path and of topics."""
    if not isinstance(value, str) or not _NAME.fullmatch(value):
        raise wrong(place, value, "letters, digits and _")


def _method(value: Any, place: str) -> None:
    """How an offset is known."""
    if value not in _METHODS:
        raise wrong(place, value, f"one of {', '.join(sorted(_METHODS))}")


_METHODS = frozenset(method.name.lower() for method in Method)
_CLOCK_NUMBERS = ("offset_s", "low_s", "high_s", "drift_ppm")
_CLOCK = fields(
    {**dict.fromkeys(_CLOCK_NUMBERS, _number_or_null), "method": _method, "via": list_of(text)},
    needed=(*_CLOCK_NUMBERS, "method", "via"),
)
_PART_TEXTS = ("name", "file", "sha256", "digest", "profile", "library")
_PART = fields(
    {
        **dict.fromkeys(_PART_TEXTS, text),
        "name": _name,
        "session": map_of(text),
        "ledger": map_of(text),
        "messages": number,
        "sealed_by": list_of(text),
        "clock": _CLOCK,
    },
    needed=(*_PART_TEXTS, "session", "ledger", "messages", "sealed_by", "clock"),
)
_LATENCY_NUMBERS = ("min_ms", "p50_ms", "p99_ms", "error_ms")
_LATENCY = fields(
    {
        **dict.fromkeys(("from", "to", "stream"), text),
        **dict.fromkeys(_LATENCY_NUMBERS, _number_or_null),
        "messages": number,
    },
    needed=("from", "to", "stream", "messages", *_LATENCY_NUMBERS),
)
_MERGE = fields(
    {
        "parts": list_of(_PART),
        "latencies": list_of(_LATENCY),
        "left_out": list_of(text),
        "reported": list_of(text),
        "shared_topics": map_of(text),
    },
    needed=("parts", "latencies", "left_out"),
)


@dataclass(frozen=True, slots=True)
class Merge:
    """What a merged session states about itself.

    Attributes:
        facts: the JSON object.
    """

    facts: Mapping[str, Any]

    @property
    def names(self) -> list[str]:
        """Names of the parts."""
        return [part["name"] for part in self.facts["parts"]]

    @property
    def reported(self) -> list[str]:
        """What the gateways of the parts warned about, which the messages alone do not show."""
        return list(self.facts.get("reported", ()))

    @property
    def shared_topics(self) -> dict[str, str]:
        """Topic → stream, with their part, of the topics that were made of a stream of several peers."""
        return dict(self.facts.get("shared_topics", {}))


def parse_merge(items: Mapping[str, str], place: str) -> Merge:
    """The content of the metadata record.  Raises DamagedRecording."""
    facts = parse_json(items.get(MERGE_KEY, ""), f"{place}: {MERGE_METADATA}")
    _MERGE(facts, f"{place}: {MERGE_METADATA}")
    return Merge(facts)


def offset_of_part(part: Mapping[str, Any]) -> Callable[[Times], Times] | None:
    """Return how far the clock of a part is ahead, ns, at times (N,) of the reference clock; None: it is the reference.

    ``part``: as the metadata record has it.  Raises DamagedRecording.
    """
    try:
        chain = [
            [(int(at), int(ns), float(slope)) for at, ns, slope in pieces] for pieces in part["clock"].get("chain", ())
        ]
    except (TypeError, ValueError, OverflowError) as error:
        raise DamagedRecording(f"part {part['name']}: clock: chain: {error}") from None
    if not all(abs(at) < _MOST_NS > abs(ns) and abs(slope) < _MOST_SLOPE for each in chain for at, ns, slope in each):
        raise DamagedRecording(f"part {part['name']}: clock: chain: found numbers out of range, expected lines")
    if not any(ns or slope for pieces in chain for _, ns, slope in pieces):
        return None

    def offset(times: Times) -> Times:
        own = times
        for _ in range(_ROUNDS):  # the lines are those of the part's own time, and nearly level
            reference = own
            for pieces in chain:
                reference = reference - _on_lines(pieces, reference)
            own = own + (times - reference)
        return np.asarray(own - times)

    return offset


def _on_lines(pieces: list[tuple[int, int, float]], times: Times) -> Times:
    """Offsets at times (N,) by lines: start, offset there, ns for each second since then."""
    number = np.searchsorted([start for start, _, _ in pieces[1:]], times, side="right")
    found = np.zeros(len(times), np.int64)
    for index, (start, ns, slope) in enumerate(pieces):
        here = number == index
        found[here] = ns + np.rint(slope * ((times[here] - start) / NS_PER_S)).astype(np.int64)
    return found


class ChannelNumbers:
    """Numbers channels by what they contain: the files of a split recording repeat them."""

    def __init__(self, register: Callable[[Schema | None, Channel], int]) -> None:
        self._register = register
        self._numbers: dict[tuple[Any, ...], int] = {}
        self._seen: dict[int, tuple[Channel, int]] = {}  # by identity of the channel, which is kept

    def of(self, schema: Schema | None, channel: Channel) -> int:
        """The number of a channel, which is registered if it is new."""
        seen = self._seen.get(id(channel))
        if seen is not None:
            return seen[1]
        key = channel_key(schema, channel)
        number = self._numbers.get(key)
        if number is None:
            number = self._numbers[key] = self._register(schema, channel)
        self._seen[id(channel)] = channel, number
        return number


def channel_key(schema: Schema | None, channel: Channel) -> tuple[Any, ...]:
    """All that a channel and its schema state."""
    described = (schema.name, schema.encoding, schema.data) if schema else ()
    return channel.topic, channel.message_encoding, *sorted(channel.metadata.items()), *described


class ChannelWriter:
    """Registers channels and their schemas in a file that is written."""

    def __init__(self, mcap: McapStream) -> None:
        self._mcap = mcap
        self._schemas: dict[tuple[str, str, bytes], int] = {}

    def register(self, schema: Schema | None, channel: Channel) -> int:
        """The number of a new channel."""
        number = 0
        if schema:
            key = schema.name, schema.encoding, bytes(schema.data)
            if key not in self._schemas:
                self._schemas[key] = self._mcap.register_schema(*key)
            number = self._schemas[key]
        return self._mcap.register_channel(channel.topic, channel.message_encoding, number, channel.metadata)


class Digest:
    """SHA-256 of what a part contains: its messages, with numbers and times, and what describes them."""

    def __init__(self) -> None:
        import hashlib  # here: most files are not merged

        self._hash = hashlib.sha256()
        self._channels = ChannelNumbers(self._channel)
        self._count = 0
        self._numbers: tuple[Definitions, npt.NDArray[np.uint32]] | None = None  # by channel of a file; 0: not yet

    def message(self, schema: Schema | None, channel: Channel, row: Row) -> None:
        _, sequence, log_ns, publish_ns, start, end, data = row
        number = self._channels.of(schema, channel)
        self._hash.update(_MESSAGE.pack(number, sequence, log_ns, publish_ns, end - start))
        self._hash.update(memoryview(data)[start:end])

    def messages(self, definitions: Definitions, data: bytes, rows: Columns) -> None:
        """As :meth:`message`, of each: definitions by channel, and arguments as of `message_columns`."""
        count, row = len(rows.channels), 0
        if self._numbers is None or self._numbers[0] is not definitions:
            self._numbers = definitions, np.zeros(_CHANNELS, np.uint32)
        numbers = self._numbers[1]
        while row < count:
            unknown = numbers[rows.channels[row:]] == 0
            end = row + int(np.argmax(unknown)) if unknown.any() else count
            self._hash_rows(data, rows.where(slice(row, end)), numbers)
            if end < count:
                channel = int(rows.channels[end])
                numbers[channel] = self._channels.of(*definitions[channel])
            row = end

    def _hash_rows(self, data: bytes, rows: Columns, numbers: npt.NDArray[np.uint32]) -> None:
        heads = np.empty(len(rows.channels), _HEAD)
        heads["number"], heads["size"] = numbers[rows.channels], rows.ends - rows.begins
        heads["sequence"], heads["time"], heads["publish_time"] = rows.sequences, rows.times, rows.publish_times
        if int(heads["size"].sum()) <= _COPIED_BYTES:
            places = map(np.ascontiguousarray, (rows.begins, rows.ends))
            self._hash.update(interleaved(data, heads.tobytes(), *places))
            return
        for head, begin, end in zip(heads, rows.begins.tolist(), rows.ends.tolist(), strict=True):
            self._hash.update(head.tobytes())
            self._hash.update(memoryview(data)[begin:end])

    def attachment(self, attachment: Attachment) -> None:
        self._part(attachment.name.encode())
        self._part(attachment.data)

    def finish(self, session: Mapping[str, str], ledger: Mapping[str, str]) -> str:
        """The digest, in hexadecimal digits."""
        self._part(json.dumps([sorted(session.items()), sorted(ledger.items())]).encode())
        return self._hash.hexdigest()

    def _channel(self, schema: Schema | None, channel: Channel) -> int:
        self._part(repr(channel_key(schema, channel)).encode())
        self._count += 1
        return self._count

    def _part(self, data: bytes) -> None:
        self._hash.update(len(data).to_bytes(8, "little"))
        self._hash.update(data)


def channel_of_part(name: str, channel: Channel) -> Channel:
    """A channel of a part, as it is in the merged file."""
    given = {key: value for key, value in channel.metadata.items() if key != layout.KIND_KEY}
    if layout.KIND_KEY in channel.metadata:
        given[PART_KIND_KEY] = channel.metadata[layout.KIND_KEY]
    given |= {PART_NAME_KEY: name, PART_TOPIC_KEY: channel.topic}
    topic = f"/{name}/{channel.topic.removeprefix('/')}"
    return replace(channel, topic=topic, metadata=given)


def channel_before(name: str, channel: Channel) -> Channel:
    """A channel of what was latched before a part: as one of the part, but the part taken out does not have it."""
    found = channel_of_part(name, channel)
    given = {key: value for key, value in found.metadata.items() if key not in (PART_NAME_KEY, PART_TOPIC_KEY)}
    return replace(found, metadata=given)


def _channel_in_part(channel: Channel) -> Channel:
    """A channel of the merged file, as it was in the part."""
    given = {key: value for key, value in channel.metadata.items() if key not in (PART_NAME_KEY, PART_TOPIC_KEY)}
    if PART_KIND_KEY in given:
        given[layout.KIND_KEY] = given.pop(PART_KIND_KEY)
    return replace(channel, topic=channel.metadata.get(PART_TOPIC_KEY, channel.topic), metadata=given)


def is_noted(channel: Channel) -> bool:
    """Return whether a channel of the merged file has the notes that were inputs of a part."""
    return channel.metadata.get(PART_KIND_KEY) == Kind.EDGE_NOTE.value


def pack_numbers(rows: npt.NDArray[np.uint64]) -> bytes:
    """Sequence, log_time and publish_time of messages (N, 3): differences, column by column, as one frame of zstd."""
    columns = np.array(rows.T)
    columns[2] -= columns[1]
    differences = np.diff(columns, axis=1, prepend=np.zeros((3, 1), np.uint64))
    data = np.ascontiguousarray(differences, "<u8").tobytes()
    return b"".join(map(bytes, compress("zstd", (data,), len(data))))


def _unpack_numbers(packed: bytes, place: str) -> Iterator[tuple[int, int, int]]:
    data = unpack_zstd_of_any_size(packed, place)
    if len(data) % 24:
        raise DamagedRecording(f"{place}: found {counted(len(data), 'byte')}, expected a multiple of 24")
    columns = np.cumsum(np.frombuffer(data, "<u8").reshape(3, -1), axis=1, dtype=np.uint64)
    columns[2] += columns[1]
    return zip(*columns.tolist(), strict=True)


def extract_part(
    merge: Merge, name: str, messages: Iterable[MessageIn], attachments: Iterable[Attachment], out: IO[bytes], path: str
) -> None:
    """Write a part as a file of its own.

    Args:
        merge: what the file states.
        messages, attachments: of the file.
        path: of the file, for errors.

    Raises as ``SessionFile.extract``.
    """
    part = next((each for each in merge.facts["parts"] if each["name"] == name), None)
    if part is None:
        raise UnsupportedRecording(f"{path}/{name}: found no part {name!r}, expected {one_of(name, merge.names)}")
    from igtl_gateway.record.sessionfile.stream import McapStream  # here: most readers write nothing

    digest = Digest()
    mcap = McapStream(out, compression="lz4")
    mcap.start(part["profile"], part["library"])
    for record in layout.SESSION_RECORDS if part["session"] else ():
        mcap.add_metadata(record, layout.seal(part["session"]))
    packed: list[Attachment] = []
    for each in attachments:
        if each.name.startswith(own := ATTACHMENT_OF.format(name)):
            given = each.name.removeprefix(own)
            restored = Attachment(each.create_time, each.log_time, given, each.media_type, each.data)
            digest.attachment(restored)
            mcap.add_attachment(given, each.media_type, each.data, each.log_time, each.create_time)
        elif each.name.startswith(NUMBERS_OF.format(name)):
            packed.append(each)
    numbers = (row for each in packed for row in _unpack_numbers(each.data, f"{path}: {each.name}"))
    channels: dict[int, Channel] = {}
    numbered = ChannelNumbers(ChannelWriter(mcap).register)
    for schema, channel, row in messages:
        if channel.metadata.get(PART_NAME_KEY) != name:
            continue
        found = next(numbers, None)
        if found is None:
            raise DamagedRecording(f"{path}: part {name}: found more messages than numbers, expected as many")
        if row[0] not in channels:
            channels[row[0]] = _channel_in_part(channel)
        _, _, _, _, start, end, data = row
        sequence, log_ns, publish_ns = found
        digest.message(schema, channels[row[0]], (0, sequence, log_ns, publish_ns, start, end, data))
        here = numbered.of(schema, channels[row[0]])
        mcap.add_message(here, log_ns, b"", memoryview(data)[start:end], publish_ns, sequence)
    if next(numbers, None) is not None:
        raise DamagedRecording(f"{path}: part {name}: found fewer messages than numbers, expected as many")
    mcap.flush()
    if part["ledger"]:
        mcap.add_metadata(layout.LEDGER_METADATA, layout.seal(part["ledger"]))
    mcap.finish()
    if (digest_here := digest.finish(part["session"], part["ledger"])) != part["digest"]:
        raise DamagedRecording(f"{path}: part {name}: found digest {digest_here}, expected {part['digest']}")
