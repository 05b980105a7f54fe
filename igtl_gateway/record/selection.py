"""Which inputs are recorded: by stream, and while the recording is not paused.

An input that is left out takes its outputs with it, so what is recorded still follows from what is recorded.  Two
kinds of inputs are recorded in any case, because later outputs depend on them: links and notes, and inputs by which
the gateway learned something, which shows in their outputs (a note, the list of links).  So an input that is to be
left out is held until its outputs have shown it.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

from igtl_gateway.base.globs import matches
from igtl_gateway.gateway.log.changes import is_change
from igtl_gateway.gateway.log.clock_offset import CODES as CLOCK_CODES
from igtl_gateway.gateway.log.clocksteps import ClockStep
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.gateway.log.fates import REFUSED_COMMANDS
from igtl_gateway.gateway.log.marks import is_phase
from igtl_gateway.gateway.log.note import Note
from igtl_gateway.record.sessionfile import layout
from igtl_gateway.record.shared_queue import owned

_IGTL = frozenset({Kind.IGTL_IN, Kind.IGTL_OUT})
_ROS = frozenset({Kind.ROS_IN, Kind.ROS_OUT})
_ALWAYS = frozenset({Kind.LINK, Kind.EDGE_NOTE})
#: The stamp of a message that begins with a header, in CDR, and one that is not set.
_CDR_STAMP, _NO_STAMP = slice(4, 12), bytes(8)
#: Streams counted one by one; the rest together.
MAX_STREAMS = 1_000
OTHERS = "(others)"


@dataclass(frozen=True, slots=True)
class Selection:
    """Globs of streams: ``TYPE/device``, a device name alone, or a topic (``*`` one level, ``**`` any).

    Attributes:
        include: record only these; empty: all.
        exclude: of those, not these.
    """

    include: tuple[str, ...] = ()
    exclude: tuple[str, ...] = ()

    def facts(self) -> dict[str, str]:
        """The items of the session metadata; none where everything is recorded."""
        facts = {layout.INCLUDE_KEY: self.include, layout.EXCLUDE_KEY: self.exclude}
        return {key: json.dumps(globs) for key, globs in facts.items() if globs}

    def __contains__(self, entry: Entry) -> bool:
        names = [entry.channel]
        if entry.kind in _IGTL:
            names.append(entry.channel.partition("/")[2])
        if self.include and not _any_matches(self.include, names):
            return False
        return not _any_matches(self.exclude, names)


@dataclass(frozen=True, slots=True)
class StateInputRule:
    """How to recognise an input that changes later outputs.

    Attributes:
        topics: an output or an input on such a topic shows it.
        types: types of inputs that always change them.
        mixed: topics of which every message adds to what is known: recorded in any case, though too many to be
            repeated in a prologue.
        robots: globs of topics: the states of robots, and the accepted commands to them, by which the guard judges the
            next command.
        stamped: globs of topics whose messages without a stamp are not valid, so that none is the last of its stream.
        aged: whether messages that are too old are withheld, so that the last that was sent counts beside the last one.
    """

    topics: frozenset[str] = frozenset()
    types: frozenset[str] = frozenset()
    mixed: frozenset[str] = frozenset()
    robots: tuple[str, ...] = ()
    stamped: tuple[str, ...] = ()
    aged: bool = False

    def by_input(self, entry: Entry) -> bool:
        """Whether the input itself shows it."""
        facts = entry.kind is Kind.LINK or entry.type in self.types or entry.channel in self.topics
        return facts or is_change(entry) or is_phase(entry) or ClockStep.of(entry) is not None

    def by_output(self, entry: Entry) -> bool:
        """Whether an output shows it of its cause."""
        if entry.kind is Kind.NOTE:
            return Note.of(entry.data()).code not in CLOCK_CODES
        return entry.kind is Kind.ROS_OUT and entry.channel in self.topics

    def mixes(self, entry: Entry) -> bool:
        """Whether it is a message of a mixed topic."""
        return entry.channel in self.mixed

    def is_invalid(self, entry: Entry) -> bool:
        """Whether it is a message of ROS that its sender has marked as not valid, by a header without a stamp."""
        if not self.stamped or entry.kind is not Kind.ROS_IN or entry.data()[_CDR_STAMP] != _NO_STAMP:
            return False
        return any(matches(glob, entry.channel) for glob in self.stamped)

    def judges(self, output: Entry) -> bool:
        """Whether an output shows the result of a command to a robot: that it was refused, or what was published."""
        if not self.robots:
            return False
        if output.kind is Kind.NOTE:
            return Note.of(output.data()).code in REFUSED_COMMANDS
        return output.kind is Kind.ROS_OUT and self.guards(output)

    def guards(self, entry: Entry) -> bool:
        """Whether it is a state of a robot or an accepted command to it."""
        return entry.kind in _ROS and any(matches(glob, entry.channel) for glob in self.robots)


class SelectionFilter:
    """Lets entries pass, in their order; counts what it does not."""

    def __init__(self, selection: Selection, rule: StateInputRule) -> None:
        #: Entries left out so far, by stream.
        self.left_out: Counter[str] = Counter()
        self.paused = False
        self._selection = selection
        self._all = selection == Selection()
        self._rule = rule
        self._chosen: dict[tuple[Kind, str], bool] = {}
        self._open = True  # for the outputs of the last input
        self._held: list[Entry] = []

    @property
    def passes_all(self) -> bool:
        """Whether :meth:`take` returns the entry itself, whatever it is."""
        return self._all and self._open and not self.paused

    def take(self, entry: Entry) -> Sequence[Entry]:
        """The entries that are to be recorded now that this one has come."""
        if self.passes_all:
            return (entry,)
        if entry.kind.is_input:
            self._drop_held()
            self._open = self._is_selected(entry)
        elif not self._open and self._rule_needs(entry):
            self._open = True
            held, self._held = self._held, []
            return (*held, entry)
        if self._open:
            return (entry,)
        self._held.append(owned(entry))
        return ()

    def end(self) -> None:
        """No more entries."""
        self._drop_held()

    def _rule_needs(self, output: Entry) -> bool:
        """Whether an output shows that its cause has to be recorded."""
        rule = self._rule
        return rule.by_output(output) or rule.mixes(output) or rule.guards(output)

    def _drop_held(self) -> None:
        """Count what was held, and is not wanted after all."""
        for entry in self._held:
            self.leave_out(entry)
        self._held.clear()

    def leave_out(self, entry: Entry) -> None:
        """Count an entry that no file has."""
        known = entry.channel in self.left_out or len(self.left_out) < MAX_STREAMS
        self.left_out[entry.channel if known else OTHERS] += 1

    def _is_selected(self, entry: Entry) -> bool:
        rule = self._rule
        if entry.kind in _ALWAYS or rule.by_input(entry) or rule.mixes(entry) or rule.guards(entry):
            return True
        if self.paused:
            return False
        chosen = self._chosen.get((entry.kind, entry.channel))
        if chosen is None:
            chosen = entry in self._selection
            if len(self._chosen) < MAX_STREAMS:
                self._chosen[entry.kind, entry.channel] = chosen
        return chosen


def _any_matches(globs: tuple[str, ...], names: Sequence[str]) -> bool:
    return any(matches(glob, name) for glob in globs for name in names)
