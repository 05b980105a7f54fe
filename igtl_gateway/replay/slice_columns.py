"""A slice in columns: its prologue, the trial of its window by compiled conversions, and the entries to be copied.

All of it has the results of ``replay/slice``, which has the careful way, group by group; what only that can decide
raises.  Of the inputs before a window only those become objects that may belong to the prologue: notes, messages that
change the state of other streams, and of each stream in each block the last one and the first small one.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from igtl_gateway.base.errors import GatewayError
from igtl_gateway.config.configuration import Config
from igtl_gateway.convert.common_msgs import TFMessage
from igtl_gateway.gateway import LINKS_TOPIC
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.gateway.log.groups import InputGroup
from igtl_gateway.gateway.orders import is_unwritten
from igtl_gateway.record.sessionfile.channels import SEQUENCES
from igtl_gateway.record.sessionfile.columns import EntryColumns
from igtl_gateway.record.sessionfile.stream_rows import StreamName, StreamNumbers, StreamRows
from igtl_gateway.replay.recheck import Checker, can_recheck
from igtl_gateway.replay.slice_state import SMALL_BYTES, Depth, SliceWindow, StateFinder, changes_state
from igtl_gateway.replay.verify import DeclaredLosses, Verifier, VerifyReport

#: Returns the entries from a time on (UTC ns), as :meth:`SessionFile.columns`.
ColumnsOf = Callable[[int], Iterator[EntryColumns]]
Mask = npt.NDArray[np.bool_]


class Distrust(GatewayError):
    """Only the careful way can decide."""


@dataclass(frozen=True, slots=True)
class Compared:
    """The trial of a window without a difference: what it counted, and the ledger of the slice.

    Attributes:
        prologue: number of inputs in the prologue.
        window: of the entries behind it.
        ledger: of the slice.
    """

    prologue: int
    window: VerifyReport
    ledger: dict[str, object]


def state_in_columns(columns_of: ColumnsOf, window: SliceWindow) -> dict[int, Entry]:
    """Return what ``find_prologue`` finds for a window without globs at `Depth.STATE`.

    Raises `Distrust`, `Unfit`; as `SessionFile.entries`, also where that meets another fault first.
    """
    state = _State(window)
    for columns in columns_of(0):
        if state.take(columns):
            break
    return state.found()


def compare_window(
    columns_of: ColumnsOf,
    config: Config,
    window: SliceWindow,
    state: Mapping[int, Entry],
    *,
    before: Iterable[Entry],
    counts: Mapping[str, int],
) -> Compared:
    """Compute a window without globs behind a prologue, and compare its outputs with the recorded ones.

    Args:
        columns_of: returns the entries of the session from a time on.
        config: configuration of the session.
        state: entry number → input of the prologue.
        before: what the state needs of the prologue of the session.
        counts: topic in the file → its number of messages.

    Raises as `state_in_columns`; `Distrust` if an output differs.
    """
    if not can_recheck(config):
        raise Distrust("the conversions are not compiled")
    checker = Checker(Verifier(config, DeclaredLosses(), None, compiles=True), counts)
    try:
        verifier = checker.verifier
        verifier.before(before)
        (last,) = deque(restored(state, verifier.compute), 1) or (None,)
        for columns in window_columns(columns_of, window, state, last):
            checker.take(columns)
            if not verifier.is_good:
                break
        report = verifier.end()
        checker.collect()
        if not report.good:
            raise Distrust("an output differs")
        return Compared(len(state), report, verifier.core.ledger.to_dict())
    finally:
        checker.close()


def restored(state: Mapping[int, Entry], compute: Callable[[Entry], list[Entry]]) -> Iterator[Entry]:
    """Yield the inputs of a prologue, numbered from 1, each with the outputs that are computed from it."""
    seq, stamp_ns = 0, 0
    for number in sorted(state):
        given = state[number]
        cause = replace(given, seq=seq + 1, stamp_ns=max(given.stamp_ns, stamp_ns + 1))
        outputs = compute(cause)
        yield cause
        yield from outputs
        last = outputs[-1] if outputs else cause
        seq, stamp_ns = last.seq, last.stamp_ns


def window_columns(
    columns_of: ColumnsOf, window: SliceWindow, state: Mapping[int, Entry], last: Entry | None
) -> Iterator[EntryColumns]:
    """Yield the entries of a window with their numbers in the slice.

    Args:
        columns_of: returns the entries of the session from a time on.
        state: entry number → input of the prologue.
        last: the last entry of the prologue in the slice.

    Raises as `state_in_columns`; `Distrust` where times do not increase.
    """
    inputs = _Inputs()
    earlier = max(state, default=0) % SEQUENCES
    last_ns = last.stamp_ns if last else 0
    shift: int | None = None
    is_first = True
    for columns in columns_of(window.start_ns):
        if columns.times.dtype != np.int64:
            raise Distrust("times after 2262")
        if is_first and int(columns.numbers[0]) % SEQUENCES == earlier:
            raise Distrust("an entry number twice")
        is_first = False
        mask, _, _ = inputs.of(columns)
        rows = np.flatnonzero(mask)
        begin = 0
        if shift is None:
            if not len(rows):
                continue
            begin = int(rows[0])
            shift = (last.seq if last else 0) + 1 - int(columns.numbers[begin])
        late = rows[columns.times[rows] >= window.end_ns]
        end = int(late[0]) if len(late) else len(columns)
        if end > begin:
            some = columns.where(slice(begin, end))
            before = np.concatenate((np.array([last_ns]), some.times[:-1]))
            if (mask[begin:end] & (some.times <= before)).any():
                raise Distrust("times that do not increase")
            last_ns = int(some.times[-1])
            yield replace(some, numbers=some.numbers + shift)
        if len(late):
            return


class _Inputs:
    """Finds the inputs among entries in columns."""

    def __init__(self) -> None:
        self.names: list[StreamName] = []
        self._numbers: dict[StreamName, int] = {}
        self._numbered = StreamNumbers(self._number)
        self._are_inputs = np.zeros(0, np.bool_)

    def of(self, columns: EntryColumns) -> tuple[Mask, StreamRows, list[Entry]]:
        """Return the mask of the inputs, the streams, and the notes of all kinds.  Raises DamagedRecording."""
        rows = self._numbered.of(columns)
        is_note = rows.idents < 0
        notes = list(columns.where(is_note).entries())
        if len(self._are_inputs) < len(self.names):
            self._are_inputs = np.array([kind.is_input for kind, *_ in self.names])
        mask = np.zeros(len(columns), np.bool_)
        mask[is_note] = [note.kind.is_input for note in notes]
        mask[~is_note] = self._are_inputs[rows.idents[~is_note]]
        return mask, rows, notes

    def _number(self, kind: Kind, channel: str, type_name: str, links: tuple[int, ...]) -> int:
        name = kind, channel, type_name, links
        if name not in self._numbers:
            self._numbers[name] = len(self.names)
            self.names.append(name)
        return self._numbers[name]


class _State:
    """Finds the inputs of the prologue, block by block."""

    def __init__(self, window: SliceWindow) -> None:
        self._start_ns = window.start_ns
        self._finder = StateFinder(window, Depth.STATE)
        self._inputs = _Inputs()
        self._group: list[Entry] = []  # the last input with its outputs so far
        self._has_small: set[int] = set()  # streams of which there was a small input

    def take(self, columns: EntryColumns) -> bool:
        """Take the next entries; return whether the window begins in them."""
        mask, rows, notes = self._inputs.of(columns)
        inside = np.flatnonzero(mask & (columns.times >= self._start_ns))
        if len(inside):
            end = int(inside[0])
            notes = [note for note in notes if note.seq < columns.numbers[end]]
            columns, mask, rows = columns.where(slice(end)), mask[:end], rows.first(end)
        cause = np.cumsum(mask) - 1
        chosen = self._chosen(mask, rows, cause, notes)
        for entry in columns.where(np.append(chosen, True)[cause]).entries():
            if entry.kind.is_input:
                self._end_group()
                self._group = [entry]
            elif self._group:
                self._group.append(entry)
        return bool(len(inside))

    def found(self) -> dict[int, Entry]:
        """Return what was found."""
        self._end_group()
        return self._finder.found()

    def _end_group(self) -> None:
        if self._group:
            cause, *outputs = self._group
            self._finder.take(InputGroup(cause, outputs, len(self._group)))
            self._group = []

    def _chosen(self, mask: Mask, rows: StreamRows, cause: npt.NDArray[np.intp], notes: list[Entry]) -> Mask:
        """Mask of the inputs in a block that the finder has to look at, in their groups."""
        inputs = np.flatnonzero(mask)
        if self._finder.has_unwritten or any(note.kind.is_input and is_unwritten(note) for note in notes):
            return np.ones(len(inputs), np.bool_)
        idents = rows.idents[inputs]
        of_state, of_links = self._kinds_of_streams()
        chosen = (idents < 0) | of_state[idents]
        answers = cause[~mask & of_links[rows.idents] & (rows.idents >= 0)]
        chosen[answers[answers >= 0]] = True
        chosen[-1:] = True  # its outputs may go on in the next block
        ordinary = np.flatnonzero(~chosen)
        sizes = (rows.ends - rows.begins)[inputs]
        for ident in np.unique(idents[ordinary]).tolist():
            own = ordinary[idents[ordinary] == ident]
            chosen[own[-1]] = True
            if ident not in self._has_small:
                small = own[sizes[own] <= SMALL_BYTES]
                if len(small):
                    chosen[small[0]] = True
                    self._has_small.add(ident)
        return chosen

    def _kinds_of_streams(self) -> tuple[Mask, Mask]:
        """By number of the stream: each of its inputs may be of the prologue; it is of the states of links."""
        names = self._inputs.names
        of_state = [type_name == TFMessage.TYPE or changes_state(kind, type_name) for kind, _, type_name, _ in names]
        # the last element is that of notes, which have no stream
        return np.array([*of_state, False]), np.array([*(channel == LINKS_TOPIC for _, channel, *_ in names), False])
