"""The chosen messages of a session stream by stream, in arrays: the choice of ``selection.chosen_entries``."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from igtl_gateway.addon.igtl import is_dialogue
from igtl_gateway.addon.reading import (
    Entry,
    Head,
    Heads,
    Kind,
    MessageBlock,
    RecordedStamps,
    Rows,
    rows_of,
    rows_of_entries,
)
from igtl_gateway.addons.exchange.account import ExportAccount
from igtl_gateway.addons.exchange.selection import (
    IGTL_KINDS,
    ROS_KINDS,
    Recording,
    VersionFilter,
    matches_stream,
    names_links,
)

Array = npt.NDArray[Any]

_MESSAGES = frozenset({*IGTL_KINDS, *ROS_KINDS})
_MORE = 64


@dataclass(frozen=True, slots=True, eq=False)
class StreamMessages:
    """Some messages of one stream, in order.

    Attributes:
        kind, channel, type: of their entries.
        rows: the messages, one for each element.
        repeated: bool (n,): of those sent in both header versions, the second form.
        order: int64 (n,): places in the order of the messages of all streams that came with them.
        links: int64 (n,): the first link of each; 0: none.
    """

    kind: Kind
    channel: str
    type: str
    rows: Rows
    repeated: npt.NDArray[np.bool_]
    order: npt.NDArray[np.int64]
    links: npt.NDArray[np.int64]
    heads: Heads

    def __len__(self) -> int:
        return len(self.rows)

    def where(self, rows: Array | slice) -> StreamMessages:
        """Those of a mask, of indices or of a slice."""
        arrays = self.rows.where(rows), self.repeated[rows], self.order[rows], self.links[rows]
        return StreamMessages(self.kind, self.channel, self.type, *arrays, self.heads)

    @property
    def all_links(self) -> list[tuple[int, ...]]:
        """The links of the messages, each once."""
        return [self.heads.known[number].links for number in np.unique(self.rows.heads).tolist()]

    def entry(self, row: int) -> Entry:
        """The object of one message."""
        return self.rows.entry(row, self.heads)

    def block(self) -> MessageBlock | None:
        """The messages as a block; None if they are not in one buffer, or a time is after 2262."""
        rows = self.rows
        first = int(rows.which[0])
        if rows.times.dtype != np.int64 or rows.stamps.dtype != np.int64 or (rows.which != first).any():
            return None
        data = np.frombuffer(rows.buffers[first], np.uint8)
        links = self.links if self.kind in IGTL_KINDS else None
        return MessageBlock(data, rows.begins, rows.ends, rows.numbers, rows.times, rows.stamps, links)


class ChosenRows:
    """Chooses the messages of a session.

    Args:
        globs: select streams; empty = all.
        account: gets the senders of the streams.
    """

    def __init__(self, recording: Recording, globs: Sequence[str], account: ExportAccount) -> None:
        self._recording, self._globs, self._account = recording, globs, account
        self._by_link = names_links(globs)
        self._heads = Heads()
        self._facts = _HeadFacts(globs)
        self._forms = VersionFilter()
        self._cause: Head | None = None

    def __iter__(self) -> Iterator[list[StreamMessages]]:
        """Yield the streams of some messages, in the order of their first ones.  Raises as ``SessionFile.entries``."""
        for rows in self._rows():
            self._facts.learn(self._heads)
            if not self._by_link:
                self._see_senders(rows.heads)
            repeated = self._repeated(rows)
            streams = self._facts.streams[rows.heads]
            chosen = np.flatnonzero(streams >= 0)
            if not len(chosen):
                continue
            chosen = chosen[np.argsort(streams[chosen], kind="stable")]
            parts = np.split(chosen, np.flatnonzero(np.diff(streams[chosen])) + 1)
            yield [self._part(rows, part, repeated) for part in sorted(parts, key=lambda part: int(part[0]))]

    def _rows(self) -> Iterator[Rows]:
        stamps = RecordedStamps(self._recording)
        if not stamps:
            return rows_of(self._recording, self._heads)
        fitting: dict[tuple[Kind, str], bool] = {}

        def corrected(entry: Entry) -> Entry:
            key = entry.kind, entry.channel
            if key not in fitting:  # stamps are corrected in messages of ROS only, which have no links
                fitting[key] = entry.kind in ROS_KINDS and matches_stream(entry.channel, entry.kind, self._globs)
            return stamps.entry(entry) if fitting[key] else entry

        return rows_of_entries(map(corrected, self._recording.entries()), self._heads)

    def _part(self, rows: Rows, part: Array, repeated: Array) -> StreamMessages:
        head = self._heads.known[rows.heads[part[0]]]
        links = self._facts.links[rows.heads[part]]
        return StreamMessages(
            head.kind, head.channel, head.type, rows.where(part), repeated[part], part, links, self._heads
        )

    def _see_senders(self, heads: Array) -> None:
        """Take notice of the links of the received streams, and of the topics that were made of them."""
        facts, known, senders = self._facts, self._heads.known, self._account.senders
        received = heads[facts.is_sent[heads]]
        channels, first = np.unique(facts.channels[received], return_index=True)
        for channel in channels[np.argsort(first)].tolist():
            own = received[facts.channels[received] == channel]
            for number in own[np.concatenate(([True], own[1:] != own[:-1]))].tolist():
                head = known[number]
                senders.receive(head.channel, head.links, selected=bool(facts.streams[number] >= 0))
        inputs = facts.is_message_input[heads]
        published = np.flatnonzero(facts.is_published[heads])
        if len(published):
            last = np.maximum.accumulate(np.where(inputs, np.arange(len(heads)), -1))[published]
            pairs = np.where(last < 0, -1, heads[last]) * len(known) + heads[published]
            _, first = np.unique(pairs, return_index=True)
            for at in np.sort(first).tolist():
                cause = self._cause if last[at] < 0 else known[heads[last[at]]]
                if cause is not None and cause.kind is Kind.IGTL_IN and not is_dialogue(cause.type):
                    senders.cause(cause.channel, known[heads[published[at]]].channel)
        if inputs.any():
            self._cause = known[heads[len(heads) - 1 - int(np.argmax(inputs[::-1]))]]

    def _repeated(self, rows: Rows) -> npt.NDArray[np.bool_]:
        """Which messages were sent before in the other header version, by the same input."""
        facts, heads = self._facts, rows.heads
        found = np.zeros(len(heads), np.bool_)
        inputs = facts.is_input[heads]
        sent = np.flatnonzero(facts.is_sent_out[heads])
        groups = np.cumsum(inputs)[sent]
        last = int(np.count_nonzero(inputs))
        # most inputs cause one message of a stream, which needs no comparison; more may follow the last input
        _, places, counts = np.unique(
            groups * np.int64(len(self._heads.known)) + facts.channels[heads[sent]],
            return_inverse=True,
            return_counts=True,
        )
        compared = (counts[places.reshape(-1)] > 1) | (groups == 0) | (groups == last)
        group = 0
        for row, its in zip(sent[compared].tolist(), groups[compared].tolist(), strict=True):
            if its != group:
                group, self._forms = its, VersionFilter()
            found[row] = self._forms.repeat(rows.entry(row, self._heads))
        if group != last:
            self._forms = VersionFilter()
        return found


class _HeadFacts:
    """What is known of each head, as arrays by its number.

    Attributes:
        streams: number of the stream of chosen messages; -1: not chosen.
        channels: number of the channel.
        links: the first link; 0: none.
        is_input: of the gateway.
        is_message_input: an input that is a message.
        is_sent: received from a peer, without those of dialogues.
        is_sent_out, is_published: chosen, and sent to a peer or published by the gateway.
    """

    def __init__(self, globs: Sequence[str]) -> None:
        self._globs = globs
        self._streams: dict[tuple[Kind, str, str], int] = {}
        self._channels: dict[str, int] = {}
        self._count = 0
        self.streams, self.channels, self.links = (np.zeros(0, np.int64) for _ in range(3))
        self.is_input, self.is_message_input, self.is_sent, self.is_sent_out, self.is_published = (
            np.zeros(0, np.bool_) for _ in range(5)
        )

    def learn(self, heads: Heads) -> None:
        """Add the heads that are new."""
        known = heads.known
        if len(known) > len(self.streams):
            for name, array in vars(self).items():
                if isinstance(array, np.ndarray):
                    setattr(self, name, np.append(array, np.zeros(len(known) + _MORE - len(array), array.dtype)))
        for number in range(self._count, len(known)):
            head = known[number]
            chosen = head.kind in _MESSAGES and matches_stream(head.channel, head.kind, self._globs, head.links)
            key = head.kind, head.channel, head.type
            self.streams[number] = self._streams.setdefault(key, len(self._streams)) if chosen else -1
            self.channels[number] = self._channels.setdefault(head.channel, len(self._channels))
            self.links[number] = head.links[0] if head.links else 0
            self.is_input[number] = head.kind.is_input
            self.is_message_input[number] = head.kind.is_input and head.kind in _MESSAGES
            self.is_sent[number] = head.kind is Kind.IGTL_IN and not is_dialogue(head.type)
            self.is_sent_out[number] = chosen and head.kind is Kind.IGTL_OUT
            self.is_published[number] = chosen and head.kind is Kind.ROS_OUT
        self._count = len(known)
