"""Commands that wait for their reply, in both directions: who asked whom, and until when.

A command without a reply would leave a program waiting that stands beside a robot; so each has a deadline, and at
the deadline whoever asked is told.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

#: Commands that wait at once, in each direction.
MAX_PENDING = 1_000


@dataclass(frozen=True, slots=True)
class PendingCommand:
    """A command that waits.

    Attributes:
        link: number of the peer that asked (from a peer) or is asked (to a peer).
        command_id: of the command.
        device: device name in its header.
        name: of the command.
        deadline_ns: gateway time, UTC ns.
    """

    link: int
    command_id: int
    device: str
    name: str
    deadline_ns: int


class PendingCommands:
    """Commands of one direction, by peer and id."""

    def __init__(self) -> None:
        self._pending: dict[tuple[int, int], PendingCommand] = {}
        self._last_id = 0

    def __len__(self) -> int:
        return len(self._pending)

    @property
    def due_ns(self) -> int | None:
        """The first deadline, None where nothing waits."""
        return min((one.deadline_ns for one in self._pending.values()), default=None)

    def new_id(self) -> int:
        """An id that no waiting command has."""
        taken = {command_id for _, command_id in self._pending}
        while True:
            self._last_id = self._last_id % 0xFFFFFFFF + 1
            if self._last_id not in taken:
                return self._last_id

    def add(self, command: PendingCommand) -> bool:
        """False where too many wait already, or the peer has one of this id."""
        key = (command.link, command.command_id)
        if key in self._pending or len(self._pending) >= MAX_PENDING:
            return False
        self._pending[key] = command
        return True

    def take(self, command_id: int, link: int = 0) -> PendingCommand | None:
        """The waiting command that a reply answers: of this peer, or with link 0 the first of this id."""
        keys = [key for key in self._pending if key[1] == command_id and link in (0, key[0])]
        return self._pending.pop(keys[0]) if keys else None

    def overdue(self, now_ns: int) -> list[PendingCommand]:
        """Take those whose time is up."""
        return self._take(key for key, one in self._pending.items() if one.deadline_ns <= now_ns)

    def on_link_down(self, link: int) -> list[PendingCommand]:
        """Take those of a peer that is no more."""
        return self._take(key for key in self._pending if key[0] == link)

    def _take(self, keys: Iterable[tuple[int, int]]) -> list[PendingCommand]:
        return [self._pending.pop(key) for key in list(keys)]
