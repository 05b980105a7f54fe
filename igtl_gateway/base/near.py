"""Names that are near to a word that means nothing: "did you mean ...?" for verbs, options, settings and streams."""

from __future__ import annotations

from collections.abc import Iterable

from igtl_gateway.base.globs import matches

_MOST = 3


def near_names(word: str, names: Iterable[str], likeness: float = 0.6) -> list[str]:
    """Return at most three of the names, the nearest first; ``likeness``: from 0, anything, to 1, equal."""
    from difflib import get_close_matches  # here: only mistakes need it

    return get_close_matches(word, list(names), _MOST, likeness)


def nearest_name(word: str, names: Iterable[str]) -> str:
    """Return the name that is nearest to ``word``, or "": one that is like it, or has the same last level."""
    listed = sorted(set(names) - {word})
    if found := near_names(word, listed, 0.7):
        return found[0]
    last = word.rpartition("/")[2].lower()
    ends = [name for name in listed if last and name.rpartition("/")[2].lower() == last]
    lower = {name.lower(): name for name in listed}
    return next(iter(ends), "") or next((lower[name] for name in near_names(word.lower(), lower, 0.8)), "")


def near_streams(glob: str, streams: Iterable[str]) -> list[str]:
    """Return at most three streams (``TYPE/device`` or topics) that ``glob``, which matches none, may mean.

    A glob that begins with "/" means a topic, any other one a stream of OpenIGTLink or its device alone.
    """
    word = glob.lower().strip("*")
    if not word.strip("/"):
        return []
    forms: dict[str, str] = {}
    for name in sorted(streams):
        if name.startswith("/") == word.startswith("/"):
            forms[name.lower()] = name
            if not name.startswith("/"):
                forms.setdefault(name.partition("/")[2].lower(), name)
    found = [forms[form] for form in near_names(word, filter(None, forms), 0.7)]
    part = word.rpartition("/")[2] or word
    return list(dict.fromkeys(found or [name for form, name in forms.items() if part in form]))[:_MOST]


def without_match(globs: Iterable[str], streams: Iterable[str]) -> list[str]:
    """Return the globs that match none of the streams (``TYPE/device`` or topics) and none of their devices."""
    names = set(streams)
    names |= {name.partition("/")[2] for name in names if not name.startswith("/")}
    return [glob for glob in globs if not any(matches(glob, name) for name in names)]


def unmatched(glob: str, streams: Iterable[str], what: str = "recorded stream") -> str:
    """Return the sentence about a glob that matches none of the streams."""
    question = did_you_mean(near_streams(glob, streams))
    return f"matches no {what}" + (f"; {question}" if question else "")


def did_you_mean(near: Iterable[str]) -> str:
    """Return the question about names, or "" without any."""
    found = " or ".join(map(repr, near))
    return f"did you mean {found}?" if found else ""
