"""What is forgotten of that which is kept for later messages, where all of it exceeds a number of bytes."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import TypeVar

Item = TypeVar("Item")

#: Code of the notes about latched messages that were forgotten, and the word of the ledger that counts them.
FORGOTTEN = "latched_forgotten"


def forgotten_text(topic: str, size: int, room: int) -> str:
    """Return the text of the note: ``size`` bytes of a topic were forgotten, because all have more than ``room``."""
    return (
        f"{topic}: {size / (1 << 20):,.1f} MiB of latched messages are forgotten, who joins gets none before the next: "
        f"those of all topics exceed {room >> 20} MiB (latched_mib)"
    )


def largest_first(items: Iterable[Item], size: Callable[[Item], int]) -> list[Item]:
    """Return the order in which latched messages are forgotten: a plan stays beside volumes without number."""
    return sorted(items, key=size, reverse=True)


def beyond(room: int | None, items: Iterable[Item], size: Callable[[Item], int]) -> list[Item]:
    """Return the items without which the others are within the room: those that alone exceed it, then the first ones.

    Args:
        room: bytes; None: any number.
        items: in the order in which they are forgotten; the caller has left out the newest, which may be large.
        size: bytes of an item.
    """
    if room is None:
        return []
    ordered = sorted(items, key=lambda item: size(item) <= room)
    excess, found = sum(map(size, ordered)) - room, []
    for item in ordered:
        if excess <= 0:
            break
        found.append(item)
        excess -= size(item)
    return found
