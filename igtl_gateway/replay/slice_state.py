"""The inputs before a window that restore the state of the gateway at its start: the prologue of a slice."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from enum import Enum
from itertools import chain

from igtl_gateway.base.errors import ConversionError
from igtl_gateway.convert.common_msgs import TFMessage
from igtl_gateway.convert.igtl_msgs import Command, CommandReply
from igtl_gateway.gateway import LINK_UP, LINKS_TOPIC, TICK
from igtl_gateway.gateway.log.changes import SETTING
from igtl_gateway.gateway.log.clocksteps import CLOCK_STEP
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.gateway.log.groups import InputGroup, input_groups
from igtl_gateway.gateway.log.marks import is_phase
from igtl_gateway.gateway.log.note import Note
from igtl_gateway.gateway.orders import UNWRITTEN, is_unwritten
from igtl_gateway.replay.source import matches_any

#: Maximum size of a small input: poses, strings and queries are small, images and clouds are not.
SMALL_BYTES = 4096

_PREFIXES = ("STT_", "STP_")
_COMMANDS = frozenset({"COMMAND", "RTS_COMMAND", Command.TYPE, CommandReply.TYPE})


class Depth(Enum):
    """Which inputs from before the window are in the slice."""

    STATE = "state"  #: links, stream requests, commands, first and last message of each stream
    SMALL = "small"  #: also all small inputs
    ALL = "all"  #: all inputs


@dataclass(frozen=True, slots=True)
class SliceWindow:
    """The window of a slice.

    Attributes:
        start_ns, end_ns: gateway time, UTC ns; the end is not included.
        globs: topic, ``TYPE/device`` or device of an input or of its outputs; empty = all.
    """

    start_ns: int
    end_ns: int
    globs: tuple[str, ...] = ()


class StateFinder:
    """Finds the inputs of a prologue among the groups before the window, which it takes in their order."""

    def __init__(self, window: SliceWindow, depth: Depth) -> None:
        self._window, self._depth = window, depth
        self._kept: dict[int, Entry] = {}
        self._first: dict[object, Entry] = {}
        self._last: dict[object, Entry] = {}
        self._links: dict[int, Entry] = {}  # open link → the entry of its opening
        # stream → its last command that was not written, with the note
        self._begins_again: dict[str, tuple[Entry, Entry]] = {}

    @property
    def has_unwritten(self) -> bool:
        """Whether the last group is a note about the message after it."""
        return UNWRITTEN in self._last

    def take(self, group: InputGroup) -> None:
        """Take the next group."""
        entry, depth, globs = group.input, self._depth, self._window.globs
        if entry.kind is Kind.LINK:
            _follow(self._links, entry)
        if depth is Depth.ALL or (depth is Depth.SMALL and entry.size <= SMALL_BYTES):
            self._kept[entry.seq] = replace(entry, payload=())
        elif entry.kind is not Kind.LINK and carries_state(group):
            self._kept[entry.seq] = entry
        elif is_unwritten(entry):  # about the message after it
            self._last[UNWRITTEN] = entry
        elif entry.channel and (not globs or is_selected(group, globs)):
            if UNWRITTEN in self._last:
                self._begins_again[entry.channel] = self._last.pop(UNWRITTEN), entry
            for key in keys_of(entry):
                if entry.size <= SMALL_BYTES:
                    self._first.setdefault(key, entry)
                self._last[key] = entry

    def found(self) -> dict[int, Entry]:
        """Return entry number → input of the prologue; beyond `Depth.STATE` without the payload."""
        before = (entry for pair in self._begins_again.values() for entry in pair)
        found = chain(before, self._first.values(), self._last.values(), self._links.values())
        return self._kept | {entry.seq: entry for entry in found}


def find_prologue(entries: Iterable[Entry], window: SliceWindow, depth: Depth) -> dict[int, Entry]:
    """Return what a `StateFinder` finds in a session."""
    finder = StateFinder(window, depth)
    for group in input_groups(entries):
        if group.input.stamp_ns >= window.start_ns:
            break
        finder.take(group)
    return finder.found()


def changes_state(kind: Kind, type_name: str) -> bool:
    """Whether a message of a type influences the outputs of other streams."""
    return kind not in (Kind.LINK, Kind.EDGE_NOTE) and (type_name.startswith(_PREFIXES) or type_name in _COMMANDS)


def is_selected(group: InputGroup, globs: tuple[str, ...]) -> bool:
    """Return whether an input or one of its outputs matches one of the globs."""
    return any(
        matches_any(entry.channel, globs)
        or (entry.kind in (Kind.IGTL_IN, Kind.IGTL_OUT) and matches_any(entry.channel.partition("/")[2], globs))
        for entry in (group.input, *group.outputs)
        if entry.channel
    )


def carries_state(group: InputGroup) -> bool:
    """Return whether an input influences the outputs of other streams."""
    entry = group.input
    if any(output.channel == LINKS_TOPIC for output in group.outputs):
        return True  # it changed the profile of its peer
    match entry.kind:
        case Kind.LINK:
            return True
        case Kind.EDGE_NOTE:
            return note_code(entry) in (TICK, CLOCK_STEP, SETTING) or is_phase(entry)
        case _:
            return changes_state(entry.kind, entry.type)


def note_code(entry: Entry) -> str:
    """Return the code of the note in an entry."""
    return Note.of(entry.data()).code


def _follow(links: dict[int, Entry], entry: Entry) -> None:
    for link in entry.links:
        if note_code(entry) == LINK_UP:
            links[link] = entry
        else:
            links.pop(link, None)


def keys_of(entry: Entry) -> Iterator[object]:
    """Yield the keys of which an input is the latest: its link and stream, or each of its frames."""
    yield (entry.kind, entry.channel, entry.links)
    if entry.type == TFMessage.TYPE:
        try:
            transforms = TFMessage.unpack(entry.payload[0]).transforms
        except ConversionError:
            return
        for one in transforms:
            yield (entry.channel, one.header.frame_id, one.child_frame_id)
