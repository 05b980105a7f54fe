"""A slice of a session: some of its time and streams, as a session of its own that verifies as the whole does.

What the gateway says depends on what it heard before.  So a slice begins with a *prologue*: inputs from before the
cut that rebuild the state, such as the links that are up and the last message of each stream.  How many inputs
that takes is found by trying: with each depth of prologue the gateway is fed, and what it says inside the window is
held against the recording; the first depth at which nothing differs is taken, the last one is everything.

The unit is the *group*: an input with all that lies in the file before the next input.  Inside the window groups are
copied as they are, their outputs from the recording; those of the prologue are computed.  Entry numbers begin at 1
again; gaps inside a group (what the recorder lost) stay gaps.

With globs, inputs are left out inside the window, too, and what depends on those cannot be told from the rest: where
something differs all the same, the outputs of that group are computed, and the report counts it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from enum import Enum

from igtl_gateway.config import Config
from igtl_gateway.convert.common_msgs import TFMessage
from igtl_gateway.convert.igtl_msgs import Command, CommandReply
from igtl_gateway.errors import ConversionError
from igtl_gateway.gateway import LINK_UP, LINKS_TOPIC, TICK, Session, make_core
from igtl_gateway.replay.source import matches_any
from igtl_gateway.replay.verify import compare
from igtl_gateway.session.clocksteps import CLOCK_STEP
from igtl_gateway.session.entry import Entry, Kind
from igtl_gateway.session.note import Note

#: Inputs up to this size are small: poses, texts, queries; no picture, no cloud.
SMALL_BYTES = 4096

_Read = Callable[[], Iterable[Entry]]
_ReadFrom = Callable[[int, int], Iterable[Entry]]
_PREFIXES = ("STT_", "STP_")
_COMMANDS = frozenset({"COMMAND", "RTS_COMMAND", Command.TYPE, CommandReply.TYPE})


class Depth(Enum):
    """Which inputs from before the window are in the slice."""

    STATE = "state"  #: links, subscriptions, commands, first and last message of each stream
    SMALL = "small"  #: those, and all that are small
    ALL = "all"  #: everything


@dataclass(frozen=True, slots=True)
class SliceWindow:
    """What is to be in a slice.

    Attributes:
        start_ns, end_ns: gateway time, UTC ns; the end is outside.
        globs: streams, by topic, ``TYPE/device`` or device: of an input or of what it caused; none = all.
    """

    start_ns: int
    end_ns: int
    globs: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class InputGroup:
    """An input and all that follows it before the next one.

    Attributes:
        input: the input.
        outputs: in their order.
        extent: entry numbers that the group takes, those of lost entries included.
    """

    input: Entry
    outputs: Sequence[Entry]
    extent: int


@dataclass(slots=True)
class SliceReport:
    """What became of a session.

    Attributes:
        depth: of the prologue.
        prologue: inputs in it.
        inputs, outputs: entries inside the window.
        computed: groups inside the window whose outputs are those of today's gateway, not the recorded ones.
        differing: outputs inside the window that today's gateway does not say like this.
        ledger: what the gateway counted.
    """

    depth: Depth
    prologue: int = 0
    inputs: int = 0
    outputs: int = 0
    computed: int = 0
    differing: int = 0
    ledger: dict[str, object] = field(default_factory=dict)


def input_groups(entries: Iterable[Entry]) -> Iterator[InputGroup]:
    """The groups of a session; outputs before the first input belong to none."""
    cause: Entry | None = None
    outputs: list[Entry] = []
    last = 0
    for entry in entries:
        if entry.kind.is_input:
            if cause:
                yield InputGroup(cause, outputs, entry.seq - cause.seq)
            cause, outputs = entry, []
        elif cause:
            outputs.append(entry)
        last = entry.seq
    if cause:
        yield InputGroup(cause, outputs, last + 1 - cause.seq)


class Slice:
    """A window of a session; finds the depth that it needs when it is made.

    The state at the start of the window follows from all inputs before it, so these are read: once.  Only where the
    inputs of :attr:`Depth.STATE` do not suffice they are read again.

    Args:
        read: returns the entries of the session, from the beginning, each time that it is called.
        config: of the session.
        window: the requested part.
        read_from: returns the entries from a time on (UTC ns, entry number of an earlier entry or 0) without reading
            those before it; default: those of ``read``.
    """

    def __init__(self, read: _Read, config: Config, window: SliceWindow, read_from: _ReadFrom | None = None) -> None:
        self._read, self._config, self._window = read, config, window
        self._read_from = read_from
        self._state: dict[int, Entry] | None = None  # the prologue of Depth.STATE, once it is known
        depths = (Depth.STATE, Depth.SMALL) if window.globs else tuple(Depth)
        tried: list[SliceReport] = []
        for depth in depths:
            tried.append(self._tried(depth))
            if not tried[-1].differing:
                break
        self._depth = min(tried, key=lambda report: report.differing).depth
        #: What :meth:`entries` gave, complete when it has ended.
        self.report = SliceReport(self._depth)

    def entries(self) -> Iterator[Entry]:
        """The entries of the slice."""
        self.report = SliceReport(self._depth)
        return self._cut(self.report, rewrite=bool(self._window.globs))

    def _tried(self, depth: Depth) -> SliceReport:
        report = SliceReport(depth)
        for _ in self._cut(report, rewrite=False):
            pass
        return report

    def _cut(self, report: SliceReport, *, rewrite: bool) -> Iterator[Entry]:
        """The entries at the depth of ``report``, counted there; with ``rewrite`` groups that differ are computed."""
        window, depth = self._window, report.depth
        session = Session(make_core(self._config, fast_path=False))
        seq, stamp_ns = 1, 0
        for group in self._groups(depth):
            cause = group.input
            if cause.stamp_ns >= window.end_ns:
                break
            inside = cause.stamp_ns >= window.start_ns
            if inside and not _wanted(group, window):
                continue
            # computed outputs may be more than that day's: later entries make room, as in a live session
            moved = replace(cause, seq=seq, stamp_ns=max(cause.stamp_ns, stamp_ns + 1))
            said = session.recorded(moved)
            outputs = said
            extent = 1 + len(said)
            if inside:
                recorded = [_moved(entry, cause, moved) for entry in group.outputs]
                differing = _differing(recorded, said, moved.seq)
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
        report.ledger = session.gateway.ledger.to_dict()

    def _groups(self, depth: Depth) -> Iterator[InputGroup]:
        """The groups of the prologue, whose outputs may be missing, and all groups from the start of the window on."""
        start_ns = self._window.start_ns
        if depth is not Depth.STATE:
            kept = _prologue(self._read(), self._window, depth).keys()
            for group in input_groups(self._read()):
                if group.input.stamp_ns >= start_ns or group.input.seq in kept:
                    yield group
            return
        if self._state is None:
            self._state = _prologue(self._read(), self._window, depth)
        for seq in sorted(self._state):
            yield InputGroup(self._state[seq], (), 1)
        rest = self._read_from(start_ns, max(self._state, default=0)) if self._read_from else self._read()
        for group in input_groups(rest):
            if group.input.stamp_ns >= start_ns:
                yield group


def _moved(entry: Entry, cause: Entry, moved: Entry) -> Entry:
    """An output behind its cause's new place."""
    return replace(
        entry, seq=moved.seq + entry.seq - cause.seq, stamp_ns=moved.stamp_ns + entry.stamp_ns - cause.stamp_ns
    )


def _differing(recorded: Sequence[Entry], said: Sequence[Entry], cause: int) -> int:
    """How many outputs of a group are not what the gateway says now."""
    now = {entry.seq: entry for entry in said}
    differing = 0
    for entry in recorded:
        other = now.pop(entry.seq, None)
        differing += other is None or compare(entry, other, cause) is not None
    return differing + len(now)


def _wanted(group: InputGroup, window: SliceWindow) -> bool:
    """Whether a group inside the window is in the slice."""
    return not window.globs or _carries_state(group) or _selected(group, window.globs)


def _selected(group: InputGroup, globs: tuple[str, ...]) -> bool:
    return any(
        matches_any(entry.channel, globs)
        or (entry.kind in (Kind.IGTL_IN, Kind.IGTL_OUT) and matches_any(entry.channel.partition("/")[2], globs))
        for entry in (group.input, *group.outputs)
        if entry.channel
    )


def _carries_state(group: InputGroup) -> bool:
    """Whether an input changes what becomes of others, whatever its stream."""
    entry = group.input
    if any(output.channel == LINKS_TOPIC for output in group.outputs):
        return True  # it showed what its peer is
    match entry.kind:
        case Kind.LINK:
            return True
        case Kind.EDGE_NOTE:
            return _code(entry) in (TICK, CLOCK_STEP)
        case _:
            return entry.type.startswith(_PREFIXES) or entry.type in _COMMANDS


def _code(entry: Entry) -> str:
    return Note.of(entry.data()).code


def _prologue(entries: Iterable[Entry], window: SliceWindow, depth: Depth) -> dict[int, Entry]:
    """The inputs before the window that are in the slice, by number; beyond `Depth.STATE` without their content."""
    kept: dict[int, Entry] = {}
    first: dict[object, Entry] = {}
    last: dict[object, Entry] = {}
    links: dict[int, Entry] = {}  # link → the entry with which it came up, while it is up
    for group in input_groups(entries):
        entry = group.input
        if entry.stamp_ns >= window.start_ns:
            break
        if entry.kind is Kind.LINK:
            _follow(links, entry)
        if depth is Depth.ALL or (depth is Depth.SMALL and entry.size <= SMALL_BYTES):
            kept[entry.seq] = replace(entry, payload=())
        elif entry.kind is not Kind.LINK and _carries_state(group):
            kept[entry.seq] = entry
        elif entry.channel and (not window.globs or _selected(group, window.globs)):
            for key in _keys(entry):
                if entry.size <= SMALL_BYTES:
                    first.setdefault(key, entry)
                last[key] = entry
    return kept | {entry.seq: entry for found in (first, last, links) for entry in found.values()}


def _follow(links: dict[int, Entry], entry: Entry) -> None:
    for link in entry.links:
        if _code(entry) == LINK_UP:
            links[link] = entry
        else:
            links.pop(link, None)


def _keys(entry: Entry) -> Iterator[object]:
    """What an input is the latest of: its stream from its link; each of its frames."""
    yield (entry.kind, entry.channel, entry.links)
    if entry.type == TFMessage.TYPE:
        try:
            transforms = TFMessage.unpack(entry.payload[0]).transforms
        except ConversionError:
            return
        for one in transforms:
            yield (entry.channel, one.header.frame_id, one.child_frame_id)
