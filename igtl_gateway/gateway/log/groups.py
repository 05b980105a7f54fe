"""The groups of a session: each input with what follows from it."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

from igtl_gateway.gateway.log.entry import Entry


@dataclass(frozen=True, slots=True)
class InputGroup:
    """An input and all entries before the next input.

    Attributes:
        input: the input.
        outputs: its outputs in order.
        extent: number of entry numbers in the group, including lost entries.
    """

    input: Entry
    outputs: Sequence[Entry]
    extent: int


def input_groups(entries: Iterable[Entry]) -> Iterator[InputGroup]:
    """Yield the groups of a session; outputs before the first input are left out."""
    cause: Entry | None = None
    outputs: list[Entry] = []
    last = 0
    for entry in entries:
        if entry.kind.is_input:
            if cause:
                yield InputGroup(cause, outputs, entry.seq - cause.seq)
            cause, outputs = entry, []
        elif cause:
            outputs.append(entry)
        last = entry.seq
    if cause:
        yield InputGroup(cause, outputs, last + 1 - cause.seq)
