"""What is known of a type beside its layout: each class of contents states it, and other tables are made of that."""

from __future__ import annotations

from dataclasses import dataclass

_MIB = 2**20

#: Of fixed size, or with length fields of 16 bits: below 65.6 kB, and at most 1 MiB of metadata accepted beside it.
SHORT = 2 * _MIB
#: Lists: 123,000 points of 136 bytes, 239,000 tools of 70; long strings, and scripts in commands.
LIST = 16 * _MIB
#: One picture, encoded or not: 8K in YUV 4:2:0 is 50 MB.
FRAME = 64 * _MIB


@dataclass(frozen=True, slots=True)
class Traits:
    """What users of a type need to know before they read one.

    Attributes:
        most_bytes: maximum body size that a peer may send, bytes; None: as large as any message may be.
        ns_per_byte: upper bound of the time to read and convert its content, ns for each byte, measured on one core of
            2024 for the most expensive contents; each element of a list is an object in Python.  None: as most types.
        is_bulky: its content is pixels, points or cells, which no table for people shows.
    """

    most_bytes: int | None = None
    ns_per_byte: int | None = None
    is_bulky: bool = False


def traits_of(content: type) -> Traits:
    """Return the traits of a class of contents: its class variable ``TRAITS``; those of most types if it has none."""
    found: Traits = getattr(content, "TRAITS", Traits())
    return found
