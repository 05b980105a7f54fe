"""A part of a session with the state before it, for readers of messages.

A part of a split recording, and a snapshot, begin midway: static transforms, the description of a robot, plans and
surfaces may have been sent long before.  The prologue has them, so that the gateway can go on from there.  Here they
are the first messages of the part, at their recorded times, as in a slice.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator
from itertools import chain
from typing import IO

from mcap.records import Attachment, Channel, Schema

from igtl_gateway.config.configuration import Config
from igtl_gateway.gateway.log.entry import MESSAGES, Entry, Kind
from igtl_gateway.record.sessionfile.bulk import MessageBlock
from igtl_gateway.record.sessionfile.channels import ChannelSummary, joined
from igtl_gateway.record.sessionfile.chunks import Row
from igtl_gateway.record.sessionfile.definition import Definition
from igtl_gateway.record.sessionfile.lookup import LatchedStateRule
from igtl_gateway.record.sessionfile.reader import SessionFile
from igtl_gateway.replay.latched import STATE_TYPES, part_of_session
from igtl_gateway.replay.source import through_gateway

#: Latched topics of ROS, for recordings whose prologue has no quality of service: the ends of their names.
_LATCHED_TOPICS = ("/tf_static", "/robot_description")
_END_NS = 1 << 63


def with_state(file: SessionFile) -> SessionFile:
    """Return the file with the latched messages from before it; the same file if there are none.

    Latched are ROS topics with transient-local durability, and the OpenIGTLink types that are a state and not a sample.
    The caller closes only the file that it has opened.

    Raises DamagedRecording.
    """
    before = file.prologue_file()
    if before is None:
        return file
    known = {(each.topic, each.type) for each in file.channels if each.qos and each.qos.latched}
    latched = [
        each
        for each in before.channels
        if each.count and each.kind in MESSAGES and each.kind.is_input and _is_latched(each, known)
    ]
    return _SessionWithState(file, before, latched) if latched else file


def latched_before(file: SessionFile, config: Config) -> Iterator[Entry]:
    """Yield the latched messages from before a file, and what the gateway made of them, in their order.

    Raises DamagedRecording.
    """
    before = file.prologue_file()
    if before is None:
        return
    latched = {(each.topic, each.type) for each in (*before.channels, *file.channels) if each.qos and each.qos.latched}

    def is_latched(topic: str, ros_type: str) -> bool:
        return (topic, ros_type) in latched or topic.endswith(_LATCHED_TOPICS)

    has_links = any(each.kind is Kind.LINK for each in before.channels)
    entries = through_gateway((), config, has_links=has_links, before=file.prologue())
    yield from part_of_session(entries, file.start_ns, None, is_latched)


def without_state(file: SessionFile) -> SessionFile:
    """Return the file itself, without what :func:`with_state` has added."""
    return file.itself if isinstance(file, _SessionWithState) else file


def _is_latched(channel: ChannelSummary, known: Collection[tuple[str, str]]) -> bool:
    if channel.kind is not Kind.ROS_IN:
        return channel.entry_type in STATE_TYPES
    is_known = (channel.qos is not None and channel.qos.latched) or (channel.topic, channel.type) in known
    return is_known or channel.topic.endswith(_LATCHED_TOPICS)


class _SessionWithState(SessionFile):
    """A session file and channels of its prologue; see :func:`with_state`."""

    def __init__(self, file: SessionFile, before: SessionFile, latched: list[ChannelSummary]) -> None:
        for name in (
            "path size session format_version ledger foreign skipped recorded_session recorded_ledger merge parts "
            "missing_parts start_ns end_ns"
        ).split():
            setattr(self, name, getattr(file, name))
        self.itself, self._before = file, before
        self._own = {_key(each) for each in file.channels}
        self._latched = {_key(each) for each in latched}
        self.channels = joined((*latched, *file.channels))
        self.definitions = before.definitions | file.definitions
        self.entry_count = file.entry_count + sum(each.count for each in latched)

    def definition_of(self, ros_type: str) -> Definition | None:
        """As SessionFile.definition_of."""
        return self.itself.definition_of(ros_type) or self._before.definition_of(ros_type)

    def close(self) -> None:
        """Close the file."""
        self.itself.close()

    def _state(self) -> Iterator[Entry]:
        for entry in self._before.entries():
            kind = entry.kind
            if kind in MESSAGES and (kind, entry.channel, entry.type) in self._latched:
                yield entry

    def entries(self) -> Iterator[Entry]:
        """The latched messages, then all entries; as SessionFile.entries."""
        return chain(self._state(), self.itself.entries())

    def entries_of_kinds(self, kinds: Collection[Kind]) -> Iterator[Entry]:
        """As SessionFile.entries_of_kinds."""
        return chain((each for each in self._state() if each.kind in kinds), self.itself.entries_of_kinds(kinds))

    def entries_with_state(self, start_ns: int, rule: LatchedStateRule) -> Iterator[Entry]:
        """As SessionFile.entries_with_state."""
        return chain(self._state(), self.itself.entries_with_state(start_ns, rule))

    def entries_starting_at(self, start_ns: int, seq: int = 0) -> Iterator[Entry]:
        """As SessionFile.entries_starting_at."""
        state = (each for each in self._state() if each.stamp_ns >= start_ns)
        return chain(state, self.itself.entries_starting_at(start_ns, seq))

    def blocks(self, channel: ChannelSummary, start_ns: int = 0, end_ns: int = _END_NS) -> Iterator[MessageBlock]:
        """As SessionFile.blocks."""
        if _key(channel) in self._latched:
            yield from self._before.blocks(channel, start_ns, end_ns)
        if _key(channel) in self._own:
            yield from self.itself.blocks(channel, start_ns, end_ns)

    def span(self, channel: ChannelSummary) -> tuple[int, int]:
        """As SessionFile.span."""
        spans = [self._before.span(channel)] if _key(channel) in self._latched else []
        spans += [self.itself.span(channel)] if _key(channel) in self._own else []
        found = [each for each in spans if each[0]]
        return (found[0][0], found[-1][1]) if found else (0, 0)

    def messages(
        self, wanted: Callable[[Channel], bool] = lambda _: True
    ) -> Iterator[tuple[Schema | None, Channel, Row]]:
        """Those of the file itself; as SessionFile.messages."""
        return self.itself.messages(wanted)

    def attachments(self) -> Iterator[Attachment]:
        """As SessionFile.attachments."""
        return self.itself.attachments()

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
