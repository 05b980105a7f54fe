"""What an actor has to do, and when: the first thing first, and at one time in the order in which they were noted."""

from __future__ import annotations

import heapq
from collections.abc import Callable, Iterable, Iterator

from igtl_gateway_lab.simulate.actor import Sent

#: Takes the time (UTC ns) at which it is done, and returns the messages to send.
Task = Callable[[int], Iterable[Sent]]


class Agenda:
    """Tasks in order of time."""

    def __init__(self) -> None:
        self._tasks: list[tuple[int, int, Task]] = []
        self._noted = 0

    def add(self, due_ns: int, task: Task) -> None:
        """Note a task for ``due_ns`` (UTC)."""
        self._noted += 1
        heapq.heappush(self._tasks, (due_ns, self._noted, task))

    def clear(self) -> None:
        """Forget everything."""
        self._tasks.clear()

    @property
    def due_ns(self) -> int | None:
        """When the next task is due; None if there is none."""
        return self._tasks[0][0] if self._tasks else None

    def act(self, now_ns: int) -> Iterator[Sent]:
        """Do all that is due by ``now_ns``, what comes up meanwhile included."""
        while self._tasks and self._tasks[0][0] <= now_ns:
            yield from heapq.heappop(self._tasks)[2](now_ns)
