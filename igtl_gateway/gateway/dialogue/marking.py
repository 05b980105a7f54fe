"""Marks of peers: each STRING, and each COMMAND ``Mark``, of the devices that ``mark_from`` names.

The text is a line as the keyboard has it.  The gateway answers such a COMMAND itself.  A mark of a peer is submitted as
an input, as every other mark.

A message that was stamped earlier is a mark of that moment, if the clock of its sender is known: from the other streams
of its link, or because it is that of this machine.
"""

from __future__ import annotations

from collections.abc import Callable
from ipaddress import ip_address

from igtl_gateway.base.errors import ConfigError
from igtl_gateway.base.globs import matches
from igtl_gateway.base.stamp import NS_PER_MS, NS_PER_S
from igtl_gateway.config.configuration import Config
from igtl_gateway.config.settings import SOURCE
from igtl_gateway.gateway.guard import Guard
from igtl_gateway.gateway.log.entry import Entry
from igtl_gateway.gateway.log.marks import MAX_AGO_S, MarkNote, OpenPhases
from igtl_gateway.gateway.log.timing import best
from igtl_gateway.gateway.peers import Peer
from igtl_gateway.wire import Message
from igtl_gateway.wire.command import Command
from igtl_gateway.wire.fields import visible
from igtl_gateway.wire.text import String

#: Name of the command.
COMMAND_NAME = "Mark"
#: Marks that all peers together may make at once, and the time after which they may make one more.
BURST, EVERY_NS = 100, 100 * NS_PER_MS


class Marking:
    """Decides on the marks of peers.

    Args:
        config: has the devices.
        phases: those that are open.
        guard: knows the clocks of peers.
        on_mark: takes each mark.
    """

    def __init__(self, config: Config, phases: OpenPhases, guard: Guard, on_mark: Callable[[MarkNote], None]) -> None:
        self._on_mark = on_mark
        self._guard = guard
        self._globs = config.mark_from
        self._uses_stamps = config.stamp == SOURCE
        self._phases = phases
        self._made = 0  # and not yet forgotten
        self._counted_ns = 0

    def takes(self, message: Message) -> bool:
        """Return whether a message is to make a mark."""
        content = message.content
        if not self._globs or not isinstance(content, String | Command):
            return False
        if isinstance(content, Command) and (content.name != COMMAND_NAME or visible(message.type) != "COMMAND"):
            return False
        return self._is_of_device(visible(message.device_name))

    def make(self, entry: Entry, message: Message, peer: Peer | None) -> str:
        """Make the mark of a message that `takes` accepts; return why it cannot be made, or ""."""
        assert isinstance(message.content, String | Command)
        forgotten = max(0, entry.stamp_ns - self._counted_ns) // EVERY_NS
        self._made = max(0, self._made - forgotten)
        self._counted_ns = entry.stamp_ns if not self._made else self._counted_ns + forgotten * EVERY_NS
        if self._made >= BURST:
            return f"mark: found more than {BURST} of peers, expected at most 10 a second after that"
        try:
            since_ns = self._since_ns(entry, peer) if peer and self._uses_stamps else 0
            mark = MarkNote.parse(message.content.text, visible(message.device_name), since_ns)
            self._phases.check(mark)
        except ConfigError as error:
            return str(error)
        self._made += 1
        self._on_mark(mark)
        return ""

    def _is_of_device(self, name: str) -> bool:
        return any(matches(glob, name) for glob in self._globs)

    def _since_ns(self, entry: Entry, peer: Peer) -> int:
        """Return the time since the stamp of a message; 0 without a stamp, and by a clock that is not known.

        The least age of the peer's other messages is the offset of its clock.
        """
        others = best(
            watched.timing
            for (link, stream), watched in self._guard.items()
            if link == peer.link and not self._is_of_device(stream.partition("/")[2])
        )
        is_known = others and others.stamped
        age_ns = entry.stamp_ns - self._guard.ahead_ns - entry.source_ns
        offset_ns = others.least_ns if others and is_known else 0
        is_known = is_known or _is_here(peer.address)
        since_ns = max(0, age_ns - offset_ns)
        return since_ns if entry.source_ns > 0 and is_known and since_ns < MAX_AGO_S * NS_PER_S else 0


def _is_here(address: str) -> bool:
    """Return whether an address ``HOST:PORT`` is of this machine."""
    try:
        return ip_address(address.rpartition(":")[0].strip("[]")).is_loopback
    except ValueError:
        return False
