"""Which number of a stream a plot shows first.  Pure."""

from __future__ import annotations

from collections.abc import Mapping


def usual_field(fields: Mapping[str, list[float | None]]) -> str:
    """Return the name of the first number that changes and is no time; "" without numbers."""
    moves = (name for name, values in fields.items() if not name.endswith("_ns") and len(set(values)) > 1)
    return next(moves, next(iter(fields), ""))
