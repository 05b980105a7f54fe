"""Names that are near to a word that means nothing: "did you mean ...?" for verbs, options, settings and streams."""

from __future__ import annotations

from collections.abc import Iterable

_MOST = 3


def near_names(word: str, names: Iterable[str], likeness: float = 0.6) -> list[str]:
    """Return at most three of the names, the nearest first; ``likeness``: from 0, anything, to 1, equal."""
    from difflib import get_close_matches  # here: only mistakes need it

    return get_close_matches(word, list(names), _MOST, likeness)


def did_you_mean(near: Iterable[str]) -> str:
    """Return the question about names, or "" without any."""
    found = " or ".join(map(repr, near))
    return f"did you mean {found}?" if found else ""
