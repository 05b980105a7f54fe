"""Channels: what their records state of their entries, and how their messages become entries.

The reader and the salvage of damaged files share this module, so that both read a channel alike.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace

from mcap.records import Channel, Schema

from igtl_gateway.base.qos import Qos
from igtl_gateway.base.untrusted.derived_types import DerivedType
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.record.sessionfile import layout
from igtl_gateway.record.sessionfile.chunk_columns import Row
from igtl_gateway.record.sessionfile.messages import RawUnpacker, unpack_note

#: MCAP's sequence has 32 bits; entry numbers have no bound.
SEQUENCES = 1 << 32
#: A message is large that has at least this part of its chunk: it is not copied.
_LARGE_PART = 4
_ROS_TYPE = re.compile(r"\w+/msg/\w+", re.ASCII)
_KINDS = {kind.value: kind for kind in Kind}

#: Makes an entry of a row and an entry number; raises LayoutError.
Decode = Callable[[Row, int], Entry]


@dataclass(frozen=True, slots=True)
class ChannelSummary:
    """A channel of the file.

    Attributes:
        topic: its topic in the file.
        type: ROS message type in the file; our own for OpenIGTLink and notes.
        kind: kind of its entries.
        stream: the channel of its entries: the topic of ROS messages, ``TYPE/device name`` of OpenIGTLink; ``""``
            where streams share the channel, and for notes.
        count: messages.
        qos: as recorded; None where the file has none.
    """

    topic: str
    type: str
    kind: Kind
    stream: str
    count: int
    qos: Qos | None

    @classmethod
    def of(cls, channel: Channel, schema: Schema, kind: Kind, count: int) -> ChannelSummary:
        """Of a channel whose entries have a kind."""
        is_ros = kind in layout.ROS_KINDS
        stream = channel.topic if is_ros else layout.unescape(channel.metadata.get(layout.STREAM_KEY, ""))
        qos = layout.parse_qos_yaml(channel.metadata.get(layout.QOS_KEY, ""))
        return cls(channel.topic, schema.name, kind, stream, count, qos)

    @property
    def entry_type(self) -> str:
        """Type of its entries."""
        return self.type if self.kind in layout.ROS_KINDS else self.stream.partition("/")[0]


def joined(channels: Iterable[ChannelSummary]) -> tuple[ChannelSummary, ...]:
    """One for each stream, with all of its messages: rosbag2 writes several of a topic, and each part has its own."""
    found: dict[tuple[str, str, Kind, str], ChannelSummary] = {}
    for channel in channels:
        key = (channel.topic, channel.type, channel.kind, channel.stream)
        found[key] = replace(channel, count=channel.count + (found[key].count if key in found else 0))
    return tuple(found.values())


@dataclass(frozen=True, slots=True)
class SkippedChannel:
    """A channel that is not read, and why."""

    topic: str
    type: str
    count: int
    why: str


def kind_of(channel: Channel, schema: Schema | None, foreign: bool) -> tuple[Kind | None, str]:
    """Kind of a channel's entries; or None and the reason why it cannot be read."""
    if channel.message_encoding != layout.MESSAGE_ENCODING:
        return None, f"found encoding {channel.message_encoding!r}, expected {layout.MESSAGE_ENCODING!r}"
    is_derived = schema is not None and DerivedType.of(schema.name) is not None
    if schema is None or not (is_derived or _ROS_TYPE.fullmatch(schema.name)):
        return None, f"found type {schema.name if schema else ''!r}, expected package/msg/Name"
    if b"\n---" in schema.data and not is_derived:
        return None, "a service, not a topic"
    if foreign:
        return Kind.ROS_IN, ""
    name = channel.metadata.get(layout.KIND_KEY, "")
    if name not in _KINDS:
        return None, f"found kind {name!r}: not written by the gateway"
    kind = _KINDS[name]
    expected = layout.type_of(kind)
    if expected and schema.name != expected:
        return None, f"found type {schema.name!r}, expected {expected!r}"
    return kind, ""


def is_marked(channel: Channel) -> bool:
    """Whether the gateway has written the channel."""
    return layout.KIND_KEY in channel.metadata


def next_seq(seq: int, sequence: int) -> int:
    """The entry number behind ``seq`` that MCAP's ``sequence`` stands for; ``seq`` itself if it repeats."""
    return seq + (sequence - seq) % SEQUENCES


def decoder(kind: Kind, topic: str, ros_type: str) -> Decode:
    """What decodes the messages of one channel."""
    if kind in layout.WIRE_TOPICS:
        return _raw_decoder()
    if kind in layout.NOTE_KINDS:
        return lambda row, seq: unpack_note(row[6][row[4] : row[5]], seq, row[2])

    def ros(row: Row, seq: int) -> Entry:
        _, _, log_ns, publish_ns, start, end, data = row
        # in MCAP, publish_time = log_time means "not set"
        source_ns = publish_ns if publish_ns != log_ns else 0
        return Entry(seq, log_ns, kind, topic, ros_type, (data[start:end],), (), source_ns)

    return ros


def _raw_decoder() -> Decode:
    unpack = RawUnpacker()

    def raw(row: Row, seq: int) -> Entry:
        _, _, log_ns, publish_ns, start, end, data = row
        # a small part of a chunk must not keep all of it
        large = (end - start) * _LARGE_PART >= len(data)
        return unpack(memoryview(data) if large else data, seq, log_ns, publish_ns, start, end)

    return raw
