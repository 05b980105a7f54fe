"""Entries of a recording as streams: which of them are messages of which topic, and where their bytes are."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from igtl_gateway.addon import DamagedRecording
from igtl_gateway.addon.reading import EntryColumns, EntryStream, Kind, gathered
from igtl_gateway.addons.view.columns import Rows
from igtl_gateway.addons.view.pen import LAST_NS
from igtl_gateway.addons.view.rows import Form

Array = npt.NDArray[Any]

NOTES = frozenset((Kind.LINK, Kind.EDGE_NOTE, Kind.NOTE))
#: Of an OpenIGTLink message, which states its own channel: more than any number of a channel of MCAP.
_WIRE = 1 << 16


class Unfit(Exception):
    """The entries must be read one by one."""


@dataclass(slots=True, eq=False)
class Stream:
    """The entries of one kind, channel and type among those of a block.

    Attributes:
        kind, channel, type: of the entries.
        rows: (n,) their numbers in the block, ascending.
        begins, ends: (n,) places of the payloads in ``data``.
        data: bytes.
        form: (n,) number of the form of each message; -1 = none of those that were looked for.
    """

    kind: Kind
    channel: str
    type: str
    rows: Array
    begins: Array
    ends: Array
    data: npt.NDArray[np.uint8]
    form: Array = field(default_factory=lambda: np.empty(0, np.int64))
    _gathered: dict[int, tuple[Array, Array]] = field(default_factory=dict)

    def find(self, forms: Sequence[Form]) -> Array:
        """Find which of some forms each message has."""
        self.form = np.full(len(self.rows), -1, np.int64)
        for number, form in enumerate(forms):
            places, messages = self._of_size(len(form.sample))
            if len(places):
                self.form[places[form.fits(messages) & (self.form[places] < 0)]] = number
        return self.form

    def messages(self, places: Array, size: int) -> Array:
        """Messages (k, size) of this size."""
        of_size, messages = self._of_size(size)
        return messages if len(places) == len(of_size) else messages[of_size.searchsorted(places)]

    def between(self, begin: int, end: int) -> slice:
        """The entries in a part of the block."""
        first, last = self.rows.searchsorted((begin, end)).tolist()
        return slice(first, last)

    def _of_size(self, size: int) -> tuple[Array, Array]:
        """The places of the messages of a size among those of the stream, and their bytes (k, size)."""
        found = self._gathered.get(size)
        if found is None:
            places = np.flatnonzero(self.ends - self.begins == size)
            found = self._gathered[size] = places, gathered(self.data, self.begins[places], size)
        return found


@dataclass(frozen=True, slots=True, eq=False)
class Block:
    """Entries in order, with times that are on the time lines.

    Attributes:
        columns: the entries.
        times: of the entries; the source stamps as far as these are on a time line.
        odd: (n,) whether the source stamp is not on the time line.
        inputs: (n,) number of inputs up to each entry.
        streams: all entries.
    """

    columns: EntryColumns
    times: Rows
    odd: npt.NDArray[np.bool_]
    inputs: Array
    streams: Sequence[Stream]
    _stream: Array

    def __len__(self) -> int:
        return len(self.columns)

    @classmethod
    def of(cls, columns: EntryColumns, after_ns: int) -> Block:
        """The streams of entries.

        Args:
            columns: the entries.
            after_ns: gateway time of the entry before them.

        Raises Unfit for no entries, a gateway time that is not on its time line or before another one, and damage.
        """
        stamps = columns.times
        if not len(columns) or stamps.dtype != np.int64 or columns.publish_times.dtype != np.int64:
            raise Unfit
        if stamps[0] <= 0 or stamps[0] < after_ns or stamps[-1] > LAST_NS or (np.diff(stamps) < 0).any():
            raise Unfit
        try:
            wire = columns.wire()
            noted = np.flatnonzero(columns.of(_is_note))
            notes = [*columns.where(noted).entries()]
        except DamagedRecording:
            raise Unfit from None
        sources = columns.source_times()
        sources[wire.rows] = wire.source_times
        odd = (sources != 0) & ((sources < 0) | (sources > LAST_NS))
        begins, ends = columns.begins, columns.ends
        of = columns.channels.astype(np.int64)
        of[wire.rows] = _WIRE + 2 * wire.heads.astype(np.int64) + wire.outgoing
        data = np.frombuffer(columns.data, np.uint8)
        codes, place = np.unique(of, return_inverse=True)
        order = np.argsort(place, kind="stable")
        cuts = np.bincount(place, minlength=len(codes)).cumsum()[:-1]
        streams, is_input = [], np.zeros(len(columns), np.bool_)
        is_input[noted] = [note.kind.is_input for note in notes]
        for code, rows in zip(codes.tolist(), np.split(order, cuts), strict=True):
            if code < _WIRE:
                stated = columns.streams[code]
                kind, channel, name = stated.kind, stated.channel, stated.type
            else:
                head = wire.known[(code - _WIRE) // 2]
                kind, channel, name = Kind.IGTL_OUT if code % 2 else Kind.IGTL_IN, head.channel, head.type
            streams.append(Stream(kind, channel, name, rows, begins[rows], ends[rows], data))
            if kind not in NOTES:
                is_input[rows] = kind.is_input
        times = Rows(columns.numbers, stamps, sources)
        return cls(columns, times, odd, np.cumsum(is_input), streams, place)

    def stream_of(self, row: int) -> Stream:
        """The stream of an entry."""
        return self.streams[int(self._stream[row])]

    def gaps(self, last_number: int) -> npt.NDArray[np.bool_]:
        """Mask of the entries whose stamp is odd, or before which numbers are missing; 0 = there was none."""
        numbers = self.times.numbers
        before = last_number or int(numbers[0])
        return self.odd | (np.diff(numbers, prepend=before) > 1)


def _is_note(stream: EntryStream) -> bool:
    return stream.kind in NOTES
