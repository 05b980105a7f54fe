"""Marks of peers: each STRING, and each COMMAND ``Mark``, of the devices that ``mark_from`` names.

The text is a line as the keyboard has it.  The gateway answers such a COMMAND itself.  A mark of a peer is submitted as
an input, as every other mark.
"""

from __future__ import annotations

from collections.abc import Callable

from igtl_gateway.base.errors import ConfigError
from igtl_gateway.base.globs import matches
from igtl_gateway.base.stamp import NS_PER_MS
from igtl_gateway.config.configuration import Config
from igtl_gateway.gateway.log.entry import Entry
from igtl_gateway.gateway.log.marks import MarkNote, OpenPhases
from igtl_gateway.gateway.log.note import Note
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
        on_mark: takes the note of each mark.
    """

    def __init__(self, config: Config, phases: OpenPhases, on_mark: Callable[[Note], None]) -> None:
        self._on_mark = on_mark
        self._globs = config.mark_from
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
        return any(matches(glob, visible(message.device_name)) for glob in self._globs)

    def make(self, entry: Entry, message: Message) -> str:
        """Make the mark of a message that `takes` accepts; return why it cannot be made, or ""."""
        assert isinstance(message.content, String | Command)
        forgotten = max(0, entry.stamp_ns - self._counted_ns) // EVERY_NS
        self._made = max(0, self._made - forgotten)
        self._counted_ns = entry.stamp_ns if not self._made else self._counted_ns + forgotten * EVERY_NS
        if self._made >= BURST:
            return f"mark: found more than {BURST} of peers, expected at most 10 a second after that"
        try:
            mark = MarkNote.parse(message.content.text, visible(message.device_name))
            self._phases.check(mark)
        except ConfigError as error:
            return str(error)
        self._made += 1
        self._on_mark(mark.note())
        return ""
