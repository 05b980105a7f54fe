"""A slice of a session: a part of its time and streams as a separate session that verifies.

The outputs of the gateway depend on earlier inputs.  So a slice begins with a *prologue*: inputs from before the window
that restore the state, such as open links and the latest message of each stream.  The size of the prologue is found by
trial: for each depth the gateway processes prologue and window, and its outputs in the window are compared with the
recording.  The first depth without a difference is used; the last depth contains all inputs.

The unit is the *group*: an input and all entries before the next input.  In the window, groups are copied with their
recorded outputs; in the prologue, outputs are computed.  Entry numbers start at 1; gaps in a group (entries that the
recorder lost) stay gaps.

A recording that begins midway has a prologue of its own, which becomes that of the slice: only there are the results of
the commands to robots before it.

Globs also leave out inputs in the window, and other outputs can depend on them.  If the outputs of a group differ
therefore, they are computed, and the report counts the group.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from types import MappingProxyType

from igtl_gateway.base.errors import GatewayError
from igtl_gateway.config.configuration import Config
from igtl_gateway.gateway import Session, make_core
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.gateway.log.groups import InputGroup, input_groups
from igtl_gateway.gateway.log.marks import MARK
from igtl_gateway.gateway.orders import is_unwritten
from igtl_gateway.record.sessionfile.columns import Unfit
from igtl_gateway.record.sessionfile.stream_rows import ColumnsWriter
from igtl_gateway.record.sessionfile.writer import SessionWriter
from igtl_gateway.replay.slice_columns import ColumnsOf, compare_window, restored, state_in_columns, window_columns
from igtl_gateway.replay.slice_state import (
    SMALL_BYTES,
    Depth,
    SliceWindow,
    carries_state,
    find_prologue,
    is_selected,
    keys_of,
    note_code,
)
from igtl_gateway.replay.verify import compare

_Read = Callable[[], Iterable[Entry]]
_ReadFrom = Callable[[int, int], Iterable[Entry]]


@dataclass(slots=True)
class SliceReport:
    """The result of slicing a session.

    Attributes:
        depth: depth of the prologue.
        prologue: number of inputs in the prologue.
        inputs, outputs: number of entries in the window.
        computed: number of groups in the window whose outputs are computed, not recorded.
        differing: number of outputs in the window that differ from the computed ones.
        compiled: number of inputs in the window whose outputs compiled conversions compared, instead of the full path.
        ledger: the ledger of the slice.
    """

    depth: Depth
    prologue: int = 0
    inputs: int = 0
    outputs: int = 0
    computed: int = 0
    differing: int = 0
    compiled: int = 0
    ledger: dict[str, object] = field(default_factory=dict)


class Slice:
    """A slice of a session; the constructor finds the necessary depth of the prologue.

    The state at the start of the window follows from all inputs before it, so these are read: once.  Only where the
    inputs of :attr:`Depth.STATE` do not suffice they are read again.

    Args:
        read: returns the entries of the session from the start, each time that it is called.
        config: configuration of the session.
        window: the requested part.
        read_from: returns the entries from a time on (UTC ns, entry number of an earlier entry or 0) without reading
            those before it; default: those of ``read``.
        before: the prologue of the session, if it begins midway.
        columns: returns the entries from a time on (UTC ns) in columns, for a trial by compiled conversions and for
            :meth:`write`; None: there are none.
        counts: topic in the file → its number of messages.
    """

    def __init__(
        self,
        read: _Read,
        config: Config,
        window: SliceWindow,
        read_from: _ReadFrom | None = None,
        before: Iterable[Entry] = (),
        columns: ColumnsOf | None = None,
        counts: Mapping[str, int] = MappingProxyType({}),
    ) -> None:
        self._read, self._config, self._window = read, config, window
        self._read_from = read_from
        self._before = [group for group in input_groups(before) if _is_needed(group, window)]
        self._state: dict[int, Entry] | None = None  # the prologue of Depth.STATE, once it is known
        self._columns: ColumnsOf | None = None  # as given, if the trial in columns found no difference
        self._found = self._tried_in_columns(columns, counts) or self._tried_with_care()
        self._depth = self._found.depth
        #: The report, complete at the end of :meth:`entries` and of :meth:`write`.
        self.report = SliceReport(self._depth)

    @property
    def follows(self) -> bool:
        """Whether all outputs of the slice are those that are computed from it."""
        return not self._found.differing or bool(self._window.globs)

    def entries(self) -> Iterator[Entry]:
        """Yield the entries of the slice."""
        self.report = SliceReport(self._depth)
        rewrite = bool(self._window.globs) and self._found.differing > 0
        # what the window computes is known from the trial, and only its outputs that differ are needed
        return self._cut(self.report, rewrite=rewrite, known=None if rewrite else self._found)

    def before(self) -> list[Entry]:
        """Return the prologue of the slice: what the state needs of that of the session."""
        return [entry for group in self._groups_before(self._depth) for entry in (group.input, *group.outputs)]

    def write(self, writer: SessionWriter) -> None:
        """Write the entries of the slice.  Raises as the writer, and as the functions that read the session."""
        if self._columns is None or writer.has_digests:
            for entry in self.entries():
                writer.write(entry)
            return
        last = None
        for last in restored(self._prologue_of_state(), self._behind(Depth.STATE).recorded):
            writer.write(last)
        in_bulk = ColumnsWriter(writer)
        for columns in window_columns(self._columns, self._window, self._prologue_of_state(), last):
            in_bulk.write(columns)
        self.report = self._found

    def _tried_in_columns(self, columns: ColumnsOf | None, counts: Mapping[str, int]) -> SliceReport | None:
        """Try the least depth in columns; None: only the careful way can decide."""
        if columns is None or self._window.globs:
            return None
        try:
            self._state = state_in_columns(columns, self._window)
            before = self._groups_before(Depth.STATE)
            entries = [entry for group in before for entry in (group.input, *group.outputs)]
            found = compare_window(columns, self._config, self._window, self._state, before=entries, counts=counts)
        except (GatewayError, Unfit):
            self._state = None
            return None
        self._columns = columns
        window = found.window
        return SliceReport(
            Depth.STATE, len(before) + found.prologue, window.inputs, window.outputs,
            compiled=window.compiled, ledger=found.ledger,
        )  # fmt: skip

    def _tried_with_care(self) -> SliceReport:
        """Try one depth after the other."""
        tried: list[SliceReport] = []
        for depth in (Depth.STATE, Depth.SMALL) if self._window.globs else Depth:
            tried.append(self._tried(depth))
            if not tried[-1].differing:
                break
        return min(tried, key=lambda report: report.differing)

    def _behind(self, depth: Depth) -> Session:
        """Return a session behind what the state needs of the prologue of the recording."""
        session = Session(make_core(self._config, fast_path=False))
        for group in self._groups_before(depth):
            session.restored(group.input, group.outputs)
        return session

    def _tried(self, depth: Depth) -> SliceReport:
        report = SliceReport(depth)
        for _ in self._cut(report, rewrite=False):
            pass
        return report

    def _cut(self, report: SliceReport, *, rewrite: bool, known: SliceReport | None = None) -> Iterator[Entry]:
        """Yield the entries at the depth of ``report`` and count them.

        Args:
            rewrite: compute the outputs of groups that differ.
            known: the report of an earlier pass at this depth, so that nothing is computed in the window.
        """
        window, depth = self._window, report.depth
        session = self._behind(depth)
        report.prologue = len(self._groups_before(depth))
        seq, stamp_ns = 1, 0
        for group in self._groups(depth):
            cause = group.input
            if cause.stamp_ns >= window.end_ns:
                break
            inside = cause.stamp_ns >= window.start_ns
            if inside and not _wanted(group, window):
                continue
            # more outputs can be computed than recorded: later entries move, as in a live session
            moved = replace(cause, seq=seq, stamp_ns=max(cause.stamp_ns, stamp_ns + 1))
            computed = [] if inside and known else session.recorded(moved)
            outputs = computed
            extent = 1 + len(computed)
            if inside:
                recorded = [_moved(entry, cause, moved) for entry in group.outputs]
                differing = 0 if known else _differing(recorded, computed, moved.seq)
                report.differing += differing
                if differing and rewrite:
                    report.computed += 1
                else:
                    outputs, extent = recorded, group.extent
                report.inputs += 1
                report.outputs += len(outputs)
            else:
                report.prologue += 1
            yield moved
            yield from outputs
            seq += extent
            stamp_ns = (outputs[-1] if outputs else moved).stamp_ns
        report.ledger = known.ledger if known else session.gateway.ledger.to_dict()
        report.differing = known.differing if known else report.differing

    def _groups_before(self, depth: Depth) -> list[InputGroup]:
        """Return the groups of the prologue; at the least depth without pictures that others follow in the session."""
        if depth is not Depth.STATE:
            return self._before
        followed = {key for entry in self._prologue_of_state().values() for key in keys_of(entry)}
        return [
            group
            for group in self._before
            if group.input.size <= SMALL_BYTES or not followed.issuperset(keys_of(group.input))
        ]

    def _groups(self, depth: Depth) -> Iterator[InputGroup]:
        """Yield the groups of the prologue, possibly without outputs, and all groups from the window on."""
        start_ns = self._window.start_ns
        if depth is not Depth.STATE:
            kept = find_prologue(self._read(), self._window, depth).keys()
            for group in input_groups(self._read()):
                if group.input.stamp_ns >= start_ns or group.input.seq in kept:
                    yield group
            return
        state = self._prologue_of_state()
        for seq in sorted(state):
            yield InputGroup(state[seq], (), 1)
        rest = self._read_from(start_ns, max(state, default=0)) if self._read_from else self._read()
        for group in input_groups(rest):
            if group.input.stamp_ns >= start_ns:
                yield group

    def _prologue_of_state(self) -> dict[int, Entry]:
        if self._state is None:
            self._state = find_prologue(self._read(), self._window, Depth.STATE)
        return self._state


def _moved(entry: Entry, cause: Entry, moved: Entry) -> Entry:
    """Return an output with the number and time relative to its moved cause."""
    return replace(
        entry, seq=moved.seq + entry.seq - cause.seq, stamp_ns=moved.stamp_ns + entry.stamp_ns - cause.stamp_ns
    )


def _differing(recorded: Sequence[Entry], computed: Sequence[Entry], cause: int) -> int:
    """Return the number of outputs of a group that differ from the computed ones."""
    now = {entry.seq: entry for entry in computed}
    differing = 0
    for entry in recorded:
        other = now.pop(entry.seq, None)
        differing += other is None or compare(entry, other, cause) is not None
    return differing + len(now)


def _wanted(group: InputGroup, window: SliceWindow) -> bool:
    """Return whether a group in the window is in the slice."""
    entry = group.input
    is_mark = entry.kind is Kind.EDGE_NOTE and note_code(entry) == MARK
    return (
        not window.globs or is_mark or is_unwritten(entry) or carries_state(group) or is_selected(group, window.globs)
    )


def _is_needed(group: InputGroup, window: SliceWindow) -> bool:
    """Return whether a group of the prologue of the session may influence the window."""
    in_time = group.input.stamp_ns < window.start_ns
    return in_time and (not window.globs or carries_state(group) or is_selected(group, window.globs))
