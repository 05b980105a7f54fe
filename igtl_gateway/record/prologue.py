"""The prologue: the inputs that the gateway needs before a file that begins in the middle of a session.

The state of the gateway follows from all inputs since the beginning.  Most of them have left nothing behind, so a
few stand for all: links, inputs by which the gateway learned something (a first message of a stream, a version: it
shows in their outputs), the first state that names the joints of a robot, the last messages of mixed topics, the last
accepted command to each topic of a robot, and the last input of each other stream, which a query may ask for.  They are
kept within bounds; where a state is made of more, only all parts together give it.

Whether a command to a robot was accepted may follow from more than these.  So the outputs that show it follow their
input: refusals, and what reached the robot.  The last refusal after which a stream begins again is kept, too, and so is
a note about commands that were not written whose message has not come yet.

Of a disconnected peer only the inputs that taught the gateway something are kept; its link entries are dropped first.
So a long session, in which peers come and go, does not forget the connected ones.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Hashable
from copy import copy

from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.gateway.log.fates import REFUSED_DEVICE
from igtl_gateway.gateway.log.note import Note
from igtl_gateway.gateway.orders import BEGIN_AGAIN, is_unwritten
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


#: An input, and the outputs that show the results of the commands to robots in it.
_Group = tuple[Entry, ...]
_Table = OrderedDict[Hashable, _Group]


class Prologue:
    """Sees all entries in their order; remembers the inputs that matter."""

    def __init__(self, rule: StateInputRule, max_entries: int = MAX_ENTRIES, max_bytes: int = MAX_BYTES) -> None:
        self._rule = rule
        self._max_entries, self._max_bytes = max_entries, max_bytes
        self._group: _Group = ()  # of the last input, which its outputs complete
        self._taught = False  # whether the gateway learned something by it
        self._sent = False  # whether it was sent to peers
        self._links: _Table = OrderedDict()  # by number
        self._gone: _Table = OrderedDict()  # by number: links of disconnected peers
        self._learned: _Table = OrderedDict()  # by number
        self._last: _Table = OrderedDict()  # by stream and link; the last that was sent, by topic
        self._commands: _Table = OrderedDict()  # accepted, by topic; refused, so that a stream begins again, by device
        self._unwritten: _Group = ()  # the last input, if it is about the next one
        self._mixed: _Table = OrderedDict()  # by number
        self._named: OrderedDict[str, None] = OrderedDict()  # topics of robots whose order of joints is known
        self._large: _Table = OrderedDict()  # by stream and link
        self._count = self._bytes = self._large_bytes = 0
        self._forgotten: OrderedDict[str, int] = OrderedDict()  # stream → size of its last input

    def observe(self, entry: Entry) -> None:
        """Take notice of the next entry."""
        if entry.kind is Kind.LINK:
            self.skip()
            came = next((seq for seq, (link, *_) in self._links.items() if link.links == entry.links), None)
            if came is None:
                self._add(self._links, entry.seq, (entry,))
            else:  # its second entry: the link is down
                self._gone[came] = self._links.pop(came)
                self._add(self._gone, entry.seq, (entry,))
        elif entry.kind.is_input:
            self.skip()
            if entry.size > LARGEST_BYTES:
                self._drop_large(entry)
                self._forget(entry)
                return
            self._group = (owned(entry),)  # a large one may be lent
            self._taught, self._sent = self._rule.by_input(entry), False
        elif self._group and self._rule.judges(entry):
            self._group += (owned(entry),)
        elif self._group:
            self._taught = self._taught or self._rule.by_output(entry)
            self._sent = self._sent or entry.kind is Kind.IGTL_OUT

    @property
    def forgotten(self) -> OrderedDict[str, int]:
        """Stream → size of its last input, which was too large to be kept."""
        self._settle()
        return self._forgotten

    def copy(self) -> Prologue:
        """Return another one that has seen the same, and sees what follows for itself."""
        other = copy(self)
        tables = {name: kept.copy() for name, kept in vars(self).items() if isinstance(kept, OrderedDict)}
        vars(other).update(tables)
        return other

    def skip(self) -> None:
        """Entries follow that this does not see: an output after them need not be of the last input that it saw."""
        self._settle()
        self._group = self._unwritten = ()

    def entries(self) -> list[Entry]:
        """The inputs to be fed to a gateway first, in their order, each with what it needs of its outputs."""
        self._settle()
        found = {group[0].seq: group for kept in (*self._tables(), self._large) for group in kept.values()}
        found |= {one.seq: (one,) for one in self._unwritten}
        return [entry for seq in sorted(found) for entry in found[seq]]

    def _settle(self) -> None:
        """Keep the last input, as far as its outputs are known: more of them may follow."""
        if not self._group:
            return
        entry, *results = self._group
        if is_unwritten(entry):
            self._unwritten = self._group
        if self._size(self._group) > self._max_bytes // 8 or len(results) > self._max_entries // 8:
            self._keep_large(self._group)  # one picture must not push out everything else
            return
        for output in results:
            if output.kind is Kind.ROS_OUT:
                self._add(self._commands, output.channel, self._group)
            elif (note := Note.of(output.data())).code in BEGIN_AGAIN:
                self._add(self._commands, note.data.get(REFUSED_DEVICE, ""), self._group)
        if self._fixes_joints(entry):
            self._named[entry.channel] = None
            self._taught = True
        if self._sent and self._rule.aged and entry.kind is Kind.ROS_IN:
            self._add(self._last, entry.channel, self._group)
        if self._taught:
            self._add(self._learned, entry.seq, self._group)
        elif self._rule.mixes(entry):
            self._add(self._mixed, entry.seq, self._group)
            if len(self._mixed) > MAX_MIXED:
                self._pop_oldest(self._mixed)
        elif entry.kind is not Kind.EDGE_NOTE and not self._rule.is_invalid(entry):
            self._add(self._last, (entry.kind, entry.channel, entry.links), self._group)

    def _fixes_joints(self, entry: Entry) -> bool:
        """Return whether an input is the first that names the joints of a robot: their order is that of commands."""
        if not self._rule.robots or entry.channel in self._named or not self._rule.guards(entry):
            return False
        # here: it imports numpy, which the recorder of no other session needs
        from igtl_gateway.gateway.joint_order import names_of_state

        return bool(names_of_state(entry))

    def _keep_large(self, group: _Group) -> None:
        """Keep the last of its stream: a first one taught the gateway no more than that."""
        entry = group[0]
        self._drop_large(entry)
        self._large[entry.kind, entry.channel, entry.links] = group
        self._large_bytes += self._size(group)
        while self._large_bytes > MAX_LARGE_BYTES:
            _, gone = self._large.popitem(last=False)
            self._large_bytes -= self._size(gone)
            self._forget(gone[0])

    def _drop_large(self, entry: Entry) -> None:
        """Another large input of a stream has come."""
        before = self._large.pop((entry.kind, entry.channel, entry.links), ())
        self._large_bytes -= self._size(before)
        self._forgotten.pop(entry.channel, None)

    def _forget(self, entry: Entry) -> None:
        self._forgotten[entry.channel] = entry.size
        if len(self._forgotten) > MAX_FORGOTTEN:
            self._forgotten.popitem(last=False)

    def _add(self, kept: _Table, key: Hashable, group: _Group) -> None:
        before = kept.pop(key, ())
        kept[key] = group
        self._count += len(group) - len(before)
        self._bytes += self._size(group) - self._size(before)
        while self._bytes > self._max_bytes or self._count > self._max_entries:
            # the last of a stream are the least: pictures, mostly
            self._pop_oldest(next(part for part in self._tables() if part))

    def _pop_oldest(self, kept: _Table) -> None:
        _, gone = kept.popitem(last=False)
        self._count -= len(gone)
        self._bytes -= self._size(gone)

    @staticmethod
    def _size(group: _Group) -> int:
        return sum(entry.size for entry in group)

    def _tables(self) -> tuple[_Table, ...]:
        """All that is kept, the least first."""
        return self._last, self._mixed, self._gone, self._commands, self._learned, self._links
