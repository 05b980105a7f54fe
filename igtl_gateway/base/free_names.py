"""Names that are still free, each found in a few steps: also for the last of thousands that want the same one."""

from __future__ import annotations

from collections.abc import Container

#: Underscores that are appended to a name at most: with one more for each that wants it, a few kilobytes of names would
#: become megabytes.
_MAX_UNDERSCORES = 8


class FreeNames:
    """Assigns names that differ: underscores are appended to one that is taken, and a number where many want it.

    Args:
        reserved: names that are not assigned.
    """

    def __init__(self, reserved: Container[str] = ()) -> None:
        self._reserved = reserved
        self._taken: set[str] = set()
        self._next: dict[str, int] = {}  # name → the number of the form that was not tried yet

    def take(self, name: str) -> str:
        """Return the name, or the first form of it that is free; it is taken then."""
        number = self._next.get(name, 0)
        while (made := _form(name, number)) in self._taken or made in self._reserved:
            number += 1
        self._next[name] = number + 1
        self._taken.add(made)
        return made


def _form(name: str, number: int) -> str:
    return name + "_" * number if number <= _MAX_UNDERSCORES else f"{name}_{number}"
