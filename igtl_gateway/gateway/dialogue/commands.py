"""Pending commands of both directions: sender, addressee and deadline.

A command without a reply would keep a program beside a robot waiting.  So each command has a deadline, and at the
deadline its sender gets a reply about the failure.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

#: Maximum number of pending commands in each direction.
MAX_PENDING = 1_000


@dataclass(frozen=True, slots=True)
class PendingCommand:
    """A command that waits for its reply.

    Attributes:
        link: number of the peer that sent it (from a peer) or gets it (to a peer).
        command_id: id of the command.
        device: device name in its header.
        name: name of the command.
        deadline_ns: gateway time, UTC ns.
    """

    link: int
    command_id: int
    device: str
    name: str
    deadline_ns: int


class PendingCommands:
    """Pending commands of one direction, by peer and id."""

    def __init__(self) -> None:
        self._pending: dict[tuple[int, int], PendingCommand] = {}
        self._last_id = 0

    def __len__(self) -> int:
        return len(self._pending)

    @property
    def due_ns(self) -> int | None:
        """The earliest deadline; None if no command waits."""
        return min((one.deadline_ns for one in self._pending.values()), default=None)

    def new_id(self) -> int:
        """Return an id that no pending command has."""
        taken = {command_id for _, command_id in self._pending}
        while True:
            self._last_id = self._last_id % 0xFFFFFFFF + 1
            if self._last_id not in taken:
                return self._last_id

    def add(self, command: PendingCommand) -> bool:
        """Add a command; return False if too many wait, or if the peer has a pending command with this id."""
        key = (command.link, command.command_id)
        if key in self._pending or len(self._pending) >= MAX_PENDING:
            return False
        self._pending[key] = command
        return True

    def take(self, command_id: int, link: int = 0) -> PendingCommand | None:
        """Remove and return the command of a reply: that of the peer ``link``, or with 0 the first with this id."""
        keys = [key for key in self._pending if key[1] == command_id and link in (0, key[0])]
        return self._pending.pop(keys[0]) if keys else None

    def overdue(self, now_ns: int) -> list[PendingCommand]:
        """Remove and return the commands whose deadline has passed."""
        return self._take(key for key, one in self._pending.items() if one.deadline_ns <= now_ns)

    def on_link_down(self, link: int) -> list[PendingCommand]:
        """Remove and return the commands of a disconnected peer."""
        return self._take(key for key in self._pending if key[0] == link)

    def _take(self, keys: Iterable[tuple[int, int]]) -> list[PendingCommand]:
        return [self._pending.pop(key) for key in list(keys)]
