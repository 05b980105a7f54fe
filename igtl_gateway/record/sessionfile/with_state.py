"""A session file that begins with messages and notes of its prologue, as one session; see ``replay.state_before``."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping
from itertools import chain
from typing import IO

from mcap.records import Attachment, Channel, Metadata, Schema

from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.record.sessionfile.bulk import MessageBlock
from igtl_gateway.record.sessionfile.channels import ChannelSummary, joined
from igtl_gateway.record.sessionfile.chunk_columns import Columns, Row
from igtl_gateway.record.sessionfile.columns import END_NS, EntryColumns, Stream
from igtl_gateway.record.sessionfile.definition import Definition
from igtl_gateway.record.sessionfile.lookup import LatchedStateRule, Numbers
from igtl_gateway.record.sessionfile.merged import Definitions
from igtl_gateway.record.sessionfile.reader import SessionFile

_END_NS = 1 << 63


class SessionWithState(SessionFile):
    """A session file, of which some channels begin with messages and notes from before it.

    Args:
        itself: the file, which the caller closes.
        before: these messages and notes.

    Attributes:
        itself, before: as above.
    """

    def __init__(self, itself: SessionFile, before: SessionFile) -> None:
        for name in (
            "path size session format_version ledger foreign skipped recorded_session recorded_ledger merge parts "
            "missing_parts start_ns end_ns"
        ).split():
            setattr(self, name, getattr(itself, name))
        self.itself, self.before = itself, before
        latched = [each for each in before.channels if each.count]
        self._own = {_key(each) for each in itself.channels}
        self._latched = {_key(each) for each in latched}
        self.channels = joined((*latched, *itself.channels))
        self.definitions = before.definitions | itself.definitions
        self.entry_count = itself.entry_count + sum(each.count for each in latched)

    def definition_of(self, ros_type: str) -> Definition | None:
        """As SessionFile.definition_of."""
        return self.itself.definition_of(ros_type) or self.before.definition_of(ros_type)

    def close(self) -> None:
        """Close the file."""
        self.itself.close()

    def entries(self, *, computed: bool = True) -> Iterator[Entry]:
        """What is from before, then all entries; as SessionFile.entries."""
        return chain(self.before.entries(), self.itself.entries(computed=computed))

    def entries_of_kinds(self, kinds: Collection[Kind]) -> Iterator[Entry]:
        """As SessionFile.entries_of_kinds."""
        return chain(
            (each for each in self.before.entries() if each.kind in kinds), self.itself.entries_of_kinds(kinds)
        )

    def entries_with_state(self, start_ns: int, rule: LatchedStateRule) -> Iterator[Entry]:
        """As SessionFile.entries_with_state."""
        return chain(self.before.entries(), self.itself.entries_with_state(start_ns, rule))

    def entries_starting_at(self, start_ns: int, seq: int = 0) -> Iterator[Entry]:
        """As SessionFile.entries_starting_at."""
        state = (each for each in self.before.entries() if each.stamp_ns >= start_ns)
        return chain(state, self.itself.entries_starting_at(start_ns, seq))

    def blocks(self, channel: ChannelSummary, start_ns: int = 0, end_ns: int = _END_NS) -> Iterator[MessageBlock]:
        """As SessionFile.blocks."""
        if _key(channel) in self._latched:
            yield from self.before.blocks(channel, start_ns, end_ns)
        if _key(channel) in self._own:
            yield from self.itself.blocks(channel, start_ns, end_ns)

    def columns(
        self,
        start_ns: int = 0,
        end_ns: int = END_NS,
        wanted: Callable[[Stream], bool] = lambda _: True,
        *,
        computed: bool = True,
    ) -> Iterator[EntryColumns]:
        """As SessionFile.columns."""
        files = (self.before, self.itself)
        return chain.from_iterable([file.columns(start_ns, end_ns, wanted, computed=computed) for file in files])

    def forget_chunks(self) -> None:
        """As SessionFile.forget_chunks."""
        self.itself.forget_chunks()

    @property
    def is_indexed(self) -> bool:
        """As SessionFile.is_indexed; what is from before is small."""
        return self.itself.is_indexed

    def times(self) -> Iterator[tuple[Mapping[int, Stream], Numbers, Numbers]]:
        """As SessionFile.times."""
        return chain(self.before.times(), self.itself.times())

    def span(self, channel: ChannelSummary) -> tuple[int, int]:
        """As SessionFile.span."""
        spans = [self.before.span(channel)] if _key(channel) in self._latched else []
        spans += [self.itself.span(channel)] if _key(channel) in self._own else []
        found = [each for each in spans if each[0]]
        return (found[0][0], found[-1][1]) if found else (0, 0)

    def messages(
        self, wanted: Callable[[Channel], bool] = lambda _: True
    ) -> Iterator[tuple[Schema | None, Channel, Row]]:
        """Those of the file itself; as SessionFile.messages."""
        return self.itself.messages(wanted)

    def all_columns(self) -> Iterator[tuple[Definitions, bytes, Columns]]:
        """Those of the file itself; as SessionFile.all_columns."""
        return self.itself.all_columns()

    @property
    def has_digests(self) -> bool:
        """As SessionFile.has_digests."""
        return self.itself.has_digests

    def keep_missing(self) -> set[int]:
        """As SessionFile.keep_missing."""
        return self.itself.keep_missing()

    def first_links(self, channel: ChannelSummary) -> tuple[int, ...]:
        """As SessionFile.first_links."""
        return (self.before if _key(channel) in self._latched else self.itself).first_links(channel)

    def attachments(self) -> Iterator[Attachment]:
        """As SessionFile.attachments."""
        return self.itself.attachments()

    def beside(self) -> Iterator[Attachment | Metadata]:
        """As SessionFile.beside."""
        return self.itself.beside()

    def figures(self) -> None:
        """None: nothing was counted of both together."""

    def damaged_indexes(self) -> int:
        """As SessionFile.damaged_indexes."""
        return self.itself.damaged_indexes()

    def extract(self, name: str, out: IO[bytes]) -> None:
        """As SessionFile.extract."""
        self.itself.extract(name, out)

    def prologue(self) -> list[Entry]:
        """As SessionFile.prologue."""
        return self.itself.prologue()

    def prologue_file(self) -> SessionFile | None:
        """None: its state is in it."""
        return None


def _key(channel: ChannelSummary) -> tuple[Kind, str, str]:
    return channel.kind, channel.stream or channel.topic, channel.entry_type
