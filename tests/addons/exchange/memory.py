"""A recording in memory, for exporters: inputs from a peer."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

from mcap.records import Attachment, Metadata

from igtl_gateway.addons.exchange.source import ImportedItem, note_item, numbered, peer_item
from igtl_gateway.base.buffers import join
from igtl_gateway.base.stamp import ns_to_ticks
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.record.sessionfile.columns import EntryColumns, Unfit
from igtl_gateway.record.sessionfile.definition import Definition
from igtl_gateway.wire import Message, encode
from igtl_gateway.wire.body import Body
from igtl_gateway.wire.message import Item

#: When recordings begin, UTC ns.
START = 1_700_000_000 * 10**9
MS = 1_000_000


@dataclass
class InMemory:
    """What an exporter needs of a session file."""

    items: Sequence[ImportedItem]
    session: dict[str, str] = field(default_factory=dict)
    channels: Sequence[Any] = ()
    definitions: dict[str, str] = field(default_factory=dict)
    skipped: Sequence[Any] = ()

    def entries(self) -> Iterator[Entry]:
        return numbered(self.items)

    def columns(self) -> Iterator[EntryColumns]:
        raise Unfit

    def entries_of_kinds(self, kinds: Collection[Kind]) -> Iterator[Entry]:
        return (entry for entry in self.entries() if entry.kind in kinds)

    def prologue(self) -> list[Entry]:
        return []

    def beside(self) -> Iterator[Attachment | Metadata]:
        return iter(())

    def definition_of(self, ros_type: str) -> Definition | None:
        text = self.definitions.get(ros_type, "")
        return Definition(text.encode()) if text else None


def sent(at_ms: float, device: str, kind: str, content: Body, **metadata: str) -> ImportedItem:
    """A message of a peer, stamped with its time."""
    time_ns = START + int(at_ms * MS)
    items = tuple(Item.of(key, text) for key, text in metadata.items())
    version = 2 if items else 1
    message = Message(kind, device, content, ns_to_ticks(time_ns), header_version=version, metadata=items)
    return peer_item(time_ns, 1, join(encode(message)))


def said(at_ms: float, code: str, stream: str) -> ImportedItem:
    """A note on a stream."""
    return note_item(START + int(at_ms * MS), code, "note of a test", stream=stream)
