"""Names under which several things are written: each has one of its own, also where upper and lower case are equal."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterable, Mapping
from typing import TypeVar

Key = TypeVar("Key", bound=Hashable)


def numbered(name: str, number: int) -> str:
    """Return a name with a number behind it."""
    return f"{name}{number}"


def distinct_names(
    names: Mapping[Key, str],
    wanted: Callable[[str], str],
    taken: Iterable[str] = (),
    other: Callable[[str, int], str] = numbered,
) -> dict[Key, str]:
    """Return a written name for each key, all different.

    Who has the name that it is written with keeps it: ``ToolA`` is never the number two of ``Tool A``.

    Args:
        names: key → its own name, in the order of precedence; several keys may have one.
        wanted: own name → the name to write it with, if that is free.
        taken: names that are not free.
        other: wanted name and number, from 2 → another name; each number gives a new one.
    """
    used = {name.casefold() for name in taken}
    found: dict[Key, str] = {}
    for key, name in names.items():
        if wanted(name) == name and name.casefold() not in used:
            used.add(name.casefold())
            found[key] = name
    numbers: dict[str, int] = {}
    for key, name in names.items():
        if key in found:
            continue
        first = written = wanted(name)
        number = numbers.get(first, 1)
        while written.casefold() in used:
            number += 1
            written = other(first, number)
        numbers[first] = number
        used.add(written.casefold())
        found[key] = written
    return {key: found[key] for key in names}
