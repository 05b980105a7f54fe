"""Verification of a recording by the compiled conversions, with the full path for the rest and for a sample.

The compiled streams of the fast path, as the native passage has them, compute the outputs of a run of inputs and
compare them with the recorded ones in place, without an object per entry.  The full path, which `verify` is, computes

* inputs that no compiled stream takes: the first messages of each stream, messages of another form, links, notes,
  settings, and everything after which streams are compiled again;
* what the guard has to judge, and whatever is not recorded as expected: it alone states what differs;
* inputs of which a digest stands for an output;
* a sample: the last input of each channel of a file, and one of `EVERY`, chosen by entry number.

If anything differs, the result is that of the full path for the whole recording.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from igtl_gateway.base.errors import DamagedRecording
from igtl_gateway.config.configuration import Config
from igtl_gateway.gateway.core import Gateway
from igtl_gateway.gateway.fastpath.passage_streams import PassageStreams
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.native.passage import Link, Lock, Passage, Publisher, Subscription, is_compiled
from igtl_gateway.record.sessionfile.columns import EntryColumns
from igtl_gateway.record.sessionfile.reader import SessionFile
from igtl_gateway.record.sessionfile.stream_rows import StreamName, StreamNumbers
from igtl_gateway.replay.compare import LeafDecoder
from igtl_gateway.replay.verify import DeclaredLosses, Verifier, VerifyReport

#: The sample has one input of this number.
EVERY = 32

#: As in native/passage/_recheck.h.
_MISFIT, _NO_ROOM = 3, 6
#: A number without common pattern with the numbers of inputs, which often are every second or third.
_SPREAD = np.uint64(0x9E3779B97F4A7C15)
_SHIFT = np.uint64(64 - EVERY.bit_length() + 1)


def can_recheck(config: Config) -> bool:
    """Return whether compiled conversions can compute a session with this configuration here."""
    return is_compiled() and not config.relay


def message_counts(file: SessionFile) -> dict[str, int]:
    """Return topic in a file → its number of messages."""
    counts: Counter[str] = Counter()
    for channel in file.channels:
        counts[channel.topic] += channel.count
    return counts


def recheck(
    columns: Iterable[EntryColumns],
    config: Config,
    losses: DeclaredLosses,
    *,
    counts: Mapping[str, int],
    before: Iterable[Entry] = (),
    decoder: LeafDecoder | None = None,
) -> VerifyReport:
    """Compare recorded outputs with computed ones, as `verify`; where one differs, only that is certain.

    Args:
        columns: entries of the recording in order.
        config, losses, before, decoder: as for `verify`.
        counts: topic in the file → its number of messages.
    """
    checker = Checker(Verifier(config, losses, decoder, compiles=True), counts)
    try:
        checker.verifier.before(before)
        for some in columns:
            checker.take(some)
        return checker.verifier.end()
    finally:
        checker.close()


def is_sampled(numbers: npt.NDArray[np.int64]) -> npt.NDArray[np.bool_]:
    """Mask of the entry numbers whose inputs are of the sample."""
    spread: npt.NDArray[np.bool_] = (numbers.astype(np.uint64) * _SPREAD) >> _SHIFT == 0
    return spread


class _Edges:
    """The links, publishers and subscriptions of a passage without a network: only names of streams."""

    def __init__(self, passage: Passage) -> None:
        self._passage, self._lock = passage, Lock()
        self._links: dict[int, Link] = {}
        self._subscriptions: dict[tuple[str, str], Subscription] = {}
        self._publisher = Publisher(0)

    def link(self, number: int) -> Link:
        if number not in self._links:
            self._links[number] = Link(self._passage, number, -1, self._lock)
        return self._links[number]

    def ignore(self, channel: str, messages: int) -> None:
        """All links take everything."""

    def max_body(self, igtl_type: str) -> int:
        return 0

    def publisher(self, topic: str, ros_type: str) -> Publisher:
        return self._publisher

    def subscription(self, topic: str, ros_type: str) -> Subscription:
        key = topic, ros_type
        if key not in self._subscriptions:
            self._subscriptions[key] = Subscription(self._passage, 0)
        return self._subscriptions[key]


class _Names:
    """Numbers of streams, and where their inputs come from."""

    def __init__(self, edges: _Edges) -> None:
        self._edges = edges
        self._numbers: dict[StreamName, int] = {}
        self._sources: list[Link | Subscription | None] = []
        self._as_tuple: tuple[Link | Subscription | None, ...] = ()

    @property
    def sources(self) -> tuple[Link | Subscription | None, ...]:
        """Where the inputs of each stream come from, by number."""
        if len(self._as_tuple) < len(self._sources):
            self._as_tuple = tuple(self._sources)
        return self._as_tuple

    def number(self, kind: Kind, channel: str, type_name: str, links: tuple[int, ...]) -> int:
        name = kind, channel, type_name, links
        if name not in self._numbers:
            self._numbers[name] = len(self._numbers)
            source: Link | Subscription | None = None
            if kind is Kind.IGTL_IN and len(links) == 1:
                source = self._edges.link(links[0])
            elif kind is Kind.ROS_IN:
                source = self._edges.subscription(channel, type_name)
            self._sources.append(source)
        return self._numbers[name]


class Checker:
    """Has runs of entries compared by the passage, and gives all others to a verifier."""

    def __init__(self, verifier: Verifier, counts: Mapping[str, int]) -> None:
        self.verifier = verifier
        self._left = dict(counts)
        core = verifier.core
        assert isinstance(core, Gateway)
        self._fast_path = core.fast_path
        self._passage = Passage()
        edges = _Edges(self._passage)
        self._names = _Names(edges)
        self._streams = PassageStreams(
            self._passage, edges, self._names.number, lambda _kind, _number: None, lambda _type: False
        )
        self._fast_path.native = self._streams
        self._numbered = StreamNumbers(self._names.number)

    def offer(self, inputs: Iterable[Entry]) -> None:
        """Inputs took the full path before: let the passage copy their compiled streams."""
        for entry in inputs:
            if entry.kind.is_input:
                self._fast_path.offer(entry)

    def collect(self) -> None:
        """Have the core take over what was counted."""
        self._streams.collect_all()

    def close(self) -> None:
        """Break the references of streams and their sources to each other."""
        self._streams.drop_all()
        self._fast_path.native = None

    def take(self, columns: EntryColumns) -> None:
        """Process the next entries."""
        rows = self._rows(columns)
        if rows is None:
            for entry in columns.entries():
                self._in_full(entry)
            return
        row, count, verifier = 0, len(columns), self.verifier
        numbers = columns.numbers
        while row < count:
            why = 0
            if (last := verifier.settled_at) is not None:
                begun = row
                row, why, inputs, last_input = self._passage.recheck(rows, self._names.sources, row, last)
                if why == _NO_ROOM:
                    raise MemoryError
                if inputs:
                    verifier.took(inputs, row - begun - inputs, int(numbers[last_input]), int(numbers[row - 1]))
                if row == count:
                    break
            entry = columns.entry(row)
            if why == _MISFIT:
                self._streams.collect_all()
                self._fast_path.drop_misfit(entry)
            self._in_full(entry)
            row += 1

    def _in_full(self, entry: Entry) -> None:
        if not entry.kind.is_input:
            self.verifier.take(entry)
            return
        self._streams.collect_all()  # the full path depends on it
        self.verifier.take(entry)
        self._fast_path.offer(entry)

    def _rows(self, columns: EntryColumns) -> tuple[Any, ...] | None:
        """The columns that the passage compares; None: only the full path can look at these entries."""
        if columns.times.dtype != np.int64 or columns.publish_times.dtype != np.int64:
            return None
        try:
            idents, sources, begins, ends = self._numbered.of(columns)
        except DamagedRecording:  # raised again where the entry is
            return None
        columns_of = (idents, columns.numbers, columns.times, sources, begins, ends, self._sample(columns))
        return columns.data, *map(np.ascontiguousarray, columns_of)

    def _sample(self, columns: EntryColumns) -> npt.NDArray[np.uint8]:
        """Mask of the inputs that the full path computes, too."""
        chosen = is_sampled(columns.numbers)
        for channel, number in enumerate(np.bincount(columns.channels).tolist()):
            if number and (stream := columns.streams.get(channel)):
                self._left[stream.topic] = left = self._left.get(stream.topic, 0) - number
                if left <= 0:
                    chosen[np.flatnonzero(columns.channels == channel)[-1]] = True
        if (digests := columns.digests()) is not None:  # the passage has nothing to compare with
            inputs = np.flatnonzero(columns.of(lambda stream: stream.kind.is_input))
            causes = np.searchsorted(inputs, np.flatnonzero(digests)) - 1
            chosen[inputs[causes[causes >= 0]]] = True
        return chosen.astype(np.uint8)
