"""Globs of topics and streams, matched without backtracking.

Patterns and names may come from a file, so the time of a match is bounded by the product of their lengths, whatever
they are.  All states of the pattern are followed at once, as the bits of one number: bit ``i`` is set if the name so
far matches the first ``i`` characters of the pattern, wildcards of any length not counted.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

#: Characters of the longest glob, and of the longest name that is compared with one: a topic of ROS has at most 255.
MAX_LENGTH = 1024

_ACROSS, _WITHIN, _ONE, _LEVEL = "**", "*", "?", "/"


@dataclass(frozen=True, slots=True)
class _Pattern:
    """A glob as bits of states.

    Attributes:
        accepted: character → states that it leads out of.
        others: states that any character except those of ``accepted`` and the level separator leads out of.
        across, within: states with a wildcard of any length, across levels and within one.
        end: the state after the last character.
        start: what each name that matches begins with.
        rest: the glob behind it.
    """

    accepted: dict[str, int]
    others: int
    across: int
    within: int
    end: int
    start: str
    rest: str


def matches(glob: str, name: str) -> bool:
    """Return whether ``name`` matches ``glob``: ``*`` and ``?`` within one level, ``**`` across levels.

    A glob of more than MAX_LENGTH characters matches only itself; so does a longer name, which ``**`` matches, too.
    """
    if glob in (name, _ACROSS):
        return True
    if max(len(glob), len(name)) > MAX_LENGTH:
        return False
    pattern = _pattern(glob)
    if len(name) < pattern.end or not name.startswith(pattern.start):
        return False
    if pattern.rest == _ACROSS:
        return True
    if pattern.rest == _WITHIN:
        return _LEVEL not in name[len(pattern.start) :]
    accepted, others, across, within = pattern.accepted, pattern.others, pattern.across, pattern.within
    both = across | within
    states = 1
    for character in name:
        led = (states & accepted.get(character, others)) << 1
        states = led | states & (across if character == _LEVEL else both)
        if not states:
            return False
    return bool(states >> pattern.end & 1)


@lru_cache(maxsize=1024)
def _pattern(glob: str) -> _Pattern:
    places: dict[str, list[int]] = {_LEVEL: []}  # of the characters, by state
    across = within = state = at = 0
    while at < len(glob):
        if glob.startswith(_ACROSS, at):
            across |= 1 << state
            at += len(_ACROSS)
            continue
        if glob[at] == _WITHIN:
            within |= 1 << state
        else:
            places.setdefault(glob[at], []).append(state)
            state += 1
        at += 1
    others = _bits(places.pop(_ONE, []))
    accepted = {each: _bits(states) | (0 if each == _LEVEL else others) for each, states in places.items()}
    wild = min((found for found in map(glob.find, (_WITHIN, _ONE)) if found >= 0), default=len(glob))
    return _Pattern(accepted, others, across, within, state, glob[:wild], glob[wild:])


def _bits(states: list[int]) -> int:
    return sum(1 << state for state in states)
