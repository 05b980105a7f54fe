"""The parts of a bridge: what starts in one order, and stops in the reverse."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass
from typing import Protocol


class Part(Protocol):
    """One part.  ``stop`` also ends what a failed ``start`` has begun."""

    def start(self) -> None: ...

    def stop(self) -> None: ...


def _nothing() -> None:
    """This part has nothing to do then."""


@dataclass(frozen=True, slots=True)
class Step:
    """A part of two functions."""

    start: Callable[[], None] = _nothing
    stop: Callable[[], None] = _nothing


class Parts:
    """Parts in the order in which they start.

    Args:
        parts: None stands for a part that this bridge does not have.
    """

    def __init__(self, *parts: Part | None) -> None:
        self._parts = [part for part in parts if part]
        self._started = ExitStack()

    def start(self) -> None:
        """Start all; after an error, those that have started and the failed one are still to be stopped."""
        for part in self._parts:
            self._started.callback(part.stop)
            part.start()

    def stop(self) -> None:
        """Stop all that have started, in the reverse order, even if one fails.  A second call has no effect."""
        self._started.close()
