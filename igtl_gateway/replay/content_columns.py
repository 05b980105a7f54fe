"""The summary of a recording from its columns: as ``ContentSummary`` of its entries, without an object for each.

Columns are added in stretches between steps of the host's clock.  A file that only ``entries`` can read, and one that
turns out to be damaged, is read entry by entry: the error is that of the first damage.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from igtl_gateway.base.errors import DamagedRecording
from igtl_gateway.gateway.log.clocksteps import ClockStep
from igtl_gateway.gateway.log.entry import Kind
from igtl_gateway.gateway.log.timing import StampTiming
from igtl_gateway.record.sessionfile import layout
from igtl_gateway.record.sessionfile.columns import EntryColumns, Unfit
from igtl_gateway.record.sessionfile.reader import SessionFile
from igtl_gateway.replay.content_summary import ContentSummary, StreamSummary

Numbers = npt.NDArray[np.int64]

#: Times and their differences stay within 64 bits up to here.
_FAR_NS = 1 << 62


def content_of(file: SessionFile, begin_ns: int = 0) -> ContentSummary:
    """The summary of all entries; ``begin_ns`` as of ContentSummary.  Raises as SessionFile.entries."""
    content = ContentSummary(begin_ns)
    try:
        for columns in file.columns():
            _add(content, columns)
    except (Unfit, DamagedRecording):
        return ContentSummary.of(file.entries(), begin_ns)
    return content


def _add(content: ContentSummary, columns: EntryColumns) -> None:
    """Add the next columns.  Raises DamagedRecording, or Unfit for times that are too late for 64 bits."""
    if not len(columns):
        return
    if columns.times.dtype != np.int64 or int(columns.times[-1]) >= _FAR_NS:
        raise Unfit
    rows = _Messages(columns)
    notes = np.flatnonzero(columns.of(lambda stream: stream.kind in layout.NOTE_KINDS))
    done = 0
    for row, entry in zip(notes.tolist(), columns.where(notes).entries(), strict=True):
        if ClockStep.of(entry):
            rows.add(content, done, row)
            done = row
        content.add(entry)
        if abs(content.ahead_ns) >= _FAR_NS:
            raise Unfit
    rows.add(content, done, len(columns))


class _Messages:
    """The messages among entries, in order, with their fields in arrays; ``keys`` has what ``groups`` number."""

    def __init__(self, columns: EntryColumns) -> None:
        wire = columns.wire()
        ros = np.flatnonzero(columns.of(lambda stream: stream.kind in layout.ROS_KINDS))
        at = np.concatenate((wire.rows, ros))
        order = np.argsort(at, kind="stable")
        self._rows: Numbers = at[order]
        self._times: Numbers = columns.times[self._rows].astype(np.int64, copy=False)
        sizes = np.concatenate((wire.ends - wire.begins, columns.ends[ros] - columns.begins[ros]))
        self._sizes: Numbers = sizes[order]
        sources = np.concatenate((wire.source_times, columns.source_times()[ros]))[order]
        if sources.dtype != np.int64 or (len(sources) and int(sources.max()) >= _FAR_NS):
            raise Unfit
        self._sources: Numbers = sources.astype(np.int64, copy=False)
        # a number for each head of OpenIGTLink in each direction, and behind them for each channel of ROS
        first = 2 * len(wire.known)
        numbers = np.concatenate((2 * wire.heads.astype(np.int64) + wire.outgoing, first + columns.channels[ros]))
        found, groups = np.unique(numbers[order], return_inverse=True)
        self._groups: Numbers = groups.reshape(-1)
        self._keys: list[tuple[Kind, str, str, tuple[int, ...]]] = []
        for number in found.tolist():
            if number < first:
                head = wire.known[number // 2]
                kind = Kind.IGTL_OUT if number % 2 else Kind.IGTL_IN
                self._keys.append((kind, head.channel, head.type, head.links))
            else:
                stream = columns.streams[number - first]
                self._keys.append((stream.kind, stream.channel, stream.type, ()))

    def add(self, content: ContentSummary, begin: int, end: int) -> None:
        """Add those of the rows from ``begin`` up to ``end``."""
        here = slice(*np.searchsorted(self._rows, (begin, end)).tolist())
        groups, times = self._groups[here], self._times[here]
        if not len(groups):
            return
        sizes, sources = self._sizes[here], self._sources[here]
        content.entries += len(groups)
        # in the order of their first messages: of equal clocks, the first one counts
        _, firsts = np.unique(groups, return_index=True)
        present = groups[np.sort(firsts)].tolist()
        streams: dict[tuple[Kind, str, str], list[int]] = {}
        clocks: dict[tuple[int, str], list[int]] = {}
        for group in present:
            kind, channel, type_name, links = self._keys[group]
            streams.setdefault((kind, channel, type_name), []).append(group)
            if kind.is_input:
                clocks.setdefault((links[0] if links else 0, channel), []).append(group)
        for key, members in streams.items():
            mask = _of(groups, members)
            stream = content.streams.get(key) or content.streams.setdefault(key, StreamSummary(*key))
            stream.links.update(link for group in members for link in self._keys[group][3])
            stream.add_columns(times[mask], sizes[mask], sources[mask], content.ahead_ns, content.begin_ns)
        for (link, channel), members in clocks.items():
            mask = _of(groups, members)
            timings = content.clocks.setdefault(link, {})
            timing = timings.get(channel) or timings.setdefault(channel, StampTiming())
            timing.add_columns(sources[mask], times[mask] - content.ahead_ns)


def _of(groups: Numbers, members: list[int]) -> npt.NDArray[Any]:
    """Mask of the rows of some groups."""
    mask: npt.NDArray[Any] = groups == members[0] if len(members) == 1 else np.isin(groups, members)
    return mask
