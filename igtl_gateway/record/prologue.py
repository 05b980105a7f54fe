"""The prologue: the inputs that the gateway needs before a file that begins in the middle of a session.

The state of the gateway follows from all inputs since the beginning.  Most of them have left nothing behind, so a
few stand for all: links, inputs by which the gateway learned something (a first message of a stream, a version, a
refusal: it shows in their outputs), the last messages of mixed topics, the last accepted command to each topic of a
robot, and the last input of each other stream, which a query may ask for.  They are kept within bounds; where a state
is made of more, only all parts together give it.

Of a disconnected peer only the inputs that taught the gateway something are kept; its link entries are dropped first.
So a long session, in which peers come and go, does not forget the connected ones.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Hashable
from copy import copy

from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.record.selection import StateInputRule
from igtl_gateway.record.shared_queue import owned

MAX_ENTRIES = 5_000
MAX_BYTES = 64 << 20
#: Messages of mixed topics, such as the frames of many nodes on /tf.
MAX_MIXED = 1_000
#: Inputs above the eighth of ``MAX_BYTES``, such as volumes: the last of each stream, within these bounds (one, all).
LARGEST_BYTES, MAX_LARGE_BYTES = 64 << 20, 128 << 20
#: Streams that are named whose last input was not kept.
MAX_FORGOTTEN = 20


class Prologue:
    """Sees all entries in their order; remembers the inputs that matter.

    Attributes:
        forgotten: stream → size of its last input, which was too large to be kept.
    """

    def __init__(self, rule: StateInputRule, max_entries: int = MAX_ENTRIES, max_bytes: int = MAX_BYTES) -> None:
        self._rule = rule
        self._max_entries, self._max_bytes = max_entries, max_bytes
        self._input: Entry | None = None
        self._links: OrderedDict[Hashable, Entry] = OrderedDict()  # by number
        self._gone: OrderedDict[Hashable, Entry] = OrderedDict()  # by number: links of disconnected peers
        self._learned: OrderedDict[Hashable, Entry] = OrderedDict()  # by number
        self._last: OrderedDict[Hashable, Entry] = OrderedDict()  # by stream and link
        self._commands: OrderedDict[Hashable, Entry] = OrderedDict()  # accepted, by topic
        self._refused = False  # nothing shows yet that the input, a command to a robot, was accepted
        self._mixed: OrderedDict[Hashable, Entry] = OrderedDict()  # by number
        self._large: OrderedDict[Hashable, Entry] = OrderedDict()  # by stream and link
        self._bytes = self._large_bytes = 0
        self.forgotten: OrderedDict[str, int] = OrderedDict()

    def observe(self, entry: Entry) -> None:
        """Take notice of the next entry."""
        if entry.kind is Kind.LINK:
            self._input = None
            came = next((seq for seq, link in self._links.items() if link.links == entry.links), None)
            if came is None:
                self._add(self._links, entry.seq, entry)
            else:  # its second entry: the link is down
                self._gone[came] = self._links.pop(came)
                self._add(self._gone, entry.seq, entry)
        elif entry.kind.is_input:
            self._input, self._refused = None, False
            if entry.size > self._max_bytes // 8:  # one picture must not push out everything else
                self._keep_large(entry)
                return
            entry = owned(entry)  # a large one may be lent
            self._input, self._refused = entry, self._rule.commands_robot(entry)
            if self._refused:
                return
            if self._rule.by_input(entry):
                self._add(self._learned, entry.seq, entry)
            elif self._rule.mixes(entry):
                self._add(self._mixed, entry.seq, entry)
                if len(self._mixed) > MAX_MIXED:
                    self._bytes -= self._mixed.popitem(last=False)[1].size
            elif entry.kind is not Kind.EDGE_NOTE:
                self._add(self._last, (entry.kind, entry.channel, entry.links), entry)
        elif self._input is not None and self._rule.guards(entry):
            self._refused = False
            self._add(self._commands, entry.channel, self._input)
        elif self._input is not None and not self._refused and self._rule.refuses(entry):
            self._refuse(self._input)
        elif self._input is not None and not self._refused and self._rule.by_output(entry):
            self._add(self._learned, self._input.seq, self._input)
            self._input = None

    def copy(self) -> Prologue:
        """Return another one that has seen the same, and sees what follows for itself."""
        other = copy(self)
        tables = {name: kept.copy() for name, kept in vars(self).items() if isinstance(kept, OrderedDict)}
        vars(other).update(tables)
        return other

    def skip(self) -> None:
        """Entries follow that this does not see: an output after them need not be of the last input that it saw."""
        self._input = None

    def entries(self) -> list[Entry]:
        """The inputs to be fed to a gateway first, in their order."""
        found = {entry.seq: entry for kept in (*self._tables(), self._large) for entry in kept.values()}
        return [found[seq] for seq in sorted(found)]

    def _refuse(self, entry: Entry) -> None:
        """Forget an input that is a refused command to a robot: of a device with a long name, or in a BIND."""
        self._refused = True
        key = entry.kind, entry.channel, entry.links
        if self._last.get(key) is entry:
            self._bytes -= self._last.pop(key).size

    def _keep_large(self, entry: Entry) -> None:
        """Keep the last of its stream: a first one taught the gateway no more than that."""
        key = entry.kind, entry.channel, entry.links
        before = self._large.pop(key, None)
        self._large_bytes -= before.size if before else 0
        self.forgotten.pop(entry.channel, None)
        if entry.size > LARGEST_BYTES:
            self._forget(entry)
            return
        self._large[key] = owned(entry)
        self._large_bytes += entry.size
        while self._large_bytes > MAX_LARGE_BYTES:
            _, gone = self._large.popitem(last=False)
            self._large_bytes -= gone.size
            self._forget(gone)

    def _forget(self, entry: Entry) -> None:
        self.forgotten[entry.channel] = entry.size
        if len(self.forgotten) > MAX_FORGOTTEN:
            self.forgotten.popitem(last=False)

    def _add(self, kept: OrderedDict[Hashable, Entry], key: Hashable, entry: Entry) -> None:
        before = kept.pop(key, None)
        kept[key] = entry
        self._bytes += entry.size - (before.size if before else 0)
        while self._bytes > self._max_bytes or self._count() > self._max_entries:
            # the last of a stream are the least: pictures, mostly
            least = next(part for part in self._tables() if part)
            _, gone = least.popitem(last=False)
            self._bytes -= gone.size

    def _count(self) -> int:
        return sum(map(len, self._tables()))

    def _tables(self) -> tuple[OrderedDict[Hashable, Entry], ...]:
        """All that is kept, the least first."""
        return self._last, self._mixed, self._gone, self._commands, self._learned, self._links
