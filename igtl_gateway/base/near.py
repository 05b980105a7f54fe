"""Names that are near to a word that means nothing: "did you mean ...?" for verbs, options, settings and streams."""

from __future__ import annotations

from collections.abc import Iterable
from shlex import quote

from igtl_gateway.base.globs import matches

_MOST = 3
#: Names that a message lists of a recording, which may have any number.
LISTED = 12
#: How much less like a word a further name may be than the nearest one.
_MARGIN = 0.12
#: Characters of the shortest word that is looked for inside of names.
_LEAST_PART = 3


def near_names(word: str, names: Iterable[str], likeness: float = 0.6) -> list[str]:
    """Return at most three of the names, the nearest first; ``likeness``: from 0, anything, to 1, equal.

    Of names that are not like the word, those that are with other capitals, and then those that contain it.
    """
    listed = list(names)
    if found := _alike(word, listed, likeness):
        return found
    part, lower = word.lower(), {name.lower(): name for name in reversed(listed)}
    found = [lower[name] for name in _alike(part, list(lower), likeness)]
    if not found and len(part) >= _LEAST_PART:
        found = [name for form, name in lower.items() if part in form][::-1][:_MOST]
    return found


def _alike(word: str, names: list[str], likeness: float) -> list[str]:
    """Return the names that are like a word, without those that are much less like it than the first one."""
    from difflib import SequenceMatcher, get_close_matches  # here: only mistakes need it

    found = get_close_matches(word, names, _MOST, likeness)
    shares = [SequenceMatcher(None, name, word).ratio() for name in found]
    return [name for name, share in zip(found, shares, strict=True) if share > shares[0] - _MARGIN]


def one_of(word: str, names: Iterable[str], most: int = 0) -> str:
    """Return what is expected in place of a word that is not one of the names: ``one of a, b; did you mean 'b'?``.

    Args:
        most: names that are listed; 0: all.
    """
    listed = list(names)
    more = len(listed) - most if most else 0
    shown = ", ".join(listed[:most] if more > 0 else listed) or "none"
    question = did_you_mean(near_names(word, listed))
    return f"one of {shown}" + (f" and {more:,} more" if more > 0 else "") + (f"; {question}" if question else "")


def nearest_name(word: str, names: Iterable[str]) -> str:
    """Return the name that is nearest to ``word``, or "": one that is like it, or has the same last level."""
    listed = sorted(set(names) - {word})
    if found := _alike(word, listed, 0.7):
        return found[0]
    last = word.rpartition("/")[2].lower()
    ends = [name for name in listed if last and name.rpartition("/")[2].lower() == last]
    lower = {name.lower(): name for name in listed}
    return next(iter(ends), "") or next((lower[name] for name in _alike(word.lower(), list(lower), 0.8)), "")


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


def streams_expected(globs: Iterable[str], streams: Iterable[str], file: object = "FILE") -> str:
    """Return what is expected in place of names or globs that match no recorded stream, and what lists these."""
    names = sorted(streams)
    question = did_you_mean(dict.fromkeys(near for glob in globs for near in near_streams(glob, names)))
    listed = f"expected a recorded stream: igtl-gateway info {quote(str(file))} lists them"
    return f"{listed}; {question}" if question else listed


def did_you_mean(near: Iterable[str]) -> str:
    """Return the question about names, or "" without any."""
    found = " or ".join(map(repr, near))
    return f"did you mean {found}?" if found else ""
