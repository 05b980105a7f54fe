"""Splits of a data set: they follow demonstrations, sessions or patients, so that none of these is in two splits.

For one session a recipe may state ranges of demonstrations: the parts that ``[episodes]`` describes, numbered from 0
on, also those that have no frame.  A demonstration with a gap becomes several episodes, which are all in its split.
For any number of sessions it states shares, or the names of the sessions or patients of each split.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import PurePath

from igtl_gateway.addon import ConfigError, matches
from igtl_gateway.addon.terminal import counted, few_text

#: Numbers and notes of one kind that are listed.
MOST_LISTED = 10
#: In ``splits.patient``: where the path of a session has the patient.
PATIENT = "{patient}"
TRAIN = "train"
#: Range of episodes of a split, and ranges of a split that are read.
RANGE = re.compile(r"([0-9]{1,9}):([0-9]{1,9})")
MOST_RANGES = 10_000
Value = str | float | tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Group:
    """What is never divided: a session, or the sessions of a patient.

    Attributes:
        name: of the session or the patient.
        frames: of all its sessions.
        split: where it is already, or "".
    """

    name: str
    frames: int
    split: str = ""


def has_ranges(splits: Mapping[str, Value] | None) -> bool:
    """Return whether splits are ranges of demonstrations."""
    return any(isinstance(value, str) for value in (splits or {}).values())


def group_of(path: str, patient: str) -> str:
    """Return the name of the session at a path, or that of its patient; bytes that are not UTF-8 are escaped.

    Args:
        path: of the recording.
        patient: as ``"{patient}_*"`` or ``"{patient}/*"``, compared with the end of the path; "": the session.

    Raises ConfigError for a path that is not like the pattern.
    """
    where = PurePath(path.encode("utf-8", "backslashreplace").decode())
    name = where.name.removesuffix(where.suffix)
    if not patient:
        return name
    parts = [*where.parts[:-1], name][-(patient.count("/") + 1) :]
    signs = {PATIENT: "([^/]+?)", "*": "[^/]*"}
    pieces = (signs.get(each, re.escape(each)) for each in re.split(r"(\{patient\}|\*)", patient))
    found = re.fullmatch("".join(pieces), "/".join(parts))
    if found is None:
        raise ConfigError(f"splits.patient: found the session {'/'.join(parts)!r}, expected a name like {patient!r}")
    return found[1]


def assigned(splits: Mapping[str, Value] | None, groups: Sequence[Group]) -> dict[str, str]:
    """Return the split of each group.

    By shares, each next group goes to the split that lacks the most frames, and each split has one or more.

    Args:
        splits: of the recipe: shares or names; None: all groups are in ``train``.
        groups: in the order in which they are assigned; those that have a split keep it.

    Raises ConfigError for a group in no split or in two, and for fewer groups than shares.
    """
    if not splits:
        return {each.name: each.split or TRAIN for each in groups}
    found = {each.name: each.split for each in groups if each.split}
    shares = {name: value for name, value in splits.items() if isinstance(value, float)}
    if not shares:
        named = {name: value for name, value in splits.items() if isinstance(value, tuple)}
        return {each.name: found.get(each.name) or _named(named, each.name) for each in groups}
    if len(groups) < len(shares):
        raise ConfigError(
            f"splits: found {counted(len(groups), 'session or patient', 'sessions or patients')} for "
            f"{len(shares)} splits, expected one or more for each"
        )
    frames = dict.fromkeys(shares, 0)
    for each in groups:
        if each.split in frames:
            frames[each.split] += each.frames
    todo = [each for each in groups if not each.split]
    for number, each in enumerate(todo):
        total = sum(frames.values()) + each.frames
        empty = [name for name in shares if name not in found.values()]
        names = empty if len(todo) - number <= len(empty) else list(shares)
        split = max(names, key=lambda name: shares[name] * total - frames[name])
        found[each.name] = split
        frames[split] += each.frames
    return found


def _named(splits: Mapping[str, tuple[str, ...]], group: str) -> str:
    found = [name for name, globs in splits.items() if any(matches(glob, group) for glob in globs)]
    if len(found) != 1:
        places = f"in {' and '.join(found)}" if found else f"in none of {', '.join(splits)}"
        raise ConfigError(f"splits: found {group!r} {places}, expected it in one split")
    return found[0]


def unused_names(splits: Mapping[str, Value] | None, groups: Sequence[str]) -> list[str]:
    """Return the names in splits that no session or patient has."""
    globs = [(name, glob) for name, value in (splits or {}).items() if isinstance(value, tuple) for glob in value]
    return [f"splits.{name}: {glob!r}" for name, glob in globs if not any(matches(glob, each) for each in groups)]


def check_kept(splits: Mapping[str, Value] | None, groups: Sequence[Group]) -> None:
    """Raise ConfigError for a group whose name is in another split than the group is already."""
    named = {name: value for name, value in (splits or {}).items() if isinstance(value, tuple)}
    for each in groups:
        others = [name for name, globs in named.items() if any(matches(glob, each.name) for glob in globs)]
        if others not in ([], [each.split]):
            raise ConfigError(
                f"splits: found {each.name!r} in {' and '.join(others)}, expected it in {each.split} as in the data set"
            )


def ranges_of(splits: Sequence[str]) -> dict[str, str]:
    """Return the episodes of each split: half-open ranges, which have commas between them if there are several.

    Args:
        splits: of each episode, in order.
    """
    found: dict[str, list[list[int]]] = {}
    for number, name in enumerate(splits):
        ranges = found.setdefault(name, [])
        if ranges and ranges[-1][1] == number:
            ranges[-1][1] = number + 1
        else:
            ranges.append([number, number + 1])
    return {name: ",".join(f"{start}:{end}" for start, end in ranges) for name, ranges in found.items()}


def owners_of(splits: Mapping[str, str], count: int) -> list[str]:
    """Return the split of each of ``count`` episodes, as info.json has them; "": none.  Wrong ranges are left out."""
    found = [""] * count
    for name, text in splits.items():
        for part in text.split(",", MOST_RANGES):
            if numbers := RANGE.fullmatch(part):
                first, last = min(int(numbers[1]), count), min(int(numbers[2]), count)
                found[first:last] = [name] * max(last - first, 0)
    return found


def splits_of(ranges: Mapping[str, str] | None, demonstrations: int, owners: Sequence[int]) -> dict[str, str]:
    """Return the range of episodes of each split of one session.

    Args:
        ranges: split → range of demonstrations; without one, all episodes are in ``train``.
        demonstrations: their number.
        owners: the demonstration of each episode, in order.

    Raises:
        ConfigError: a range has no demonstration with frames or one of another range, or a demonstration is in none.
    """
    if not ranges:
        return {TRAIN: f"0:{len(owners)}"}
    names: dict[int, str] = {}
    found: dict[str, str] = {}
    for name, text in ranges.items():
        start, end = map(int, text.split(":"))
        if not start < end <= demonstrations:
            raise ConfigError(
                f"splits.{name}: found {text!r}, expected a range within 0:{demonstrations}, the demonstrations found"
            )
        own = [episode for episode, owner in enumerate(owners) if start <= owner < end]
        if not own:
            raise ConfigError(f"splits.{name}: found no frame in demonstrations {text}, expected one or more")
        for number in range(start, end):
            if number in names:
                raise ConfigError(
                    f"splits.{name}: found demonstration {number}, which is in {names[number]}, expected one split"
                )
            names[number] = name
        found[name] = f"{own[0]}:{own[-1] + 1}"
    missing = sorted(set(owners) - names.keys())
    if missing:
        raise ConfigError(
            f"splits: found {len(missing)} of {counted(demonstrations, 'demonstration')} in no split, the first is "
            f"{missing[0]}, "
            "expected each one in a split"
        )
    return found


def divided(owners: Sequence[int]) -> dict[int, list[int]]:
    """Return the demonstrations that are several episodes, each with its episodes."""
    found: dict[int, list[int]] = {}
    for episode, owner in enumerate(owners):
        found.setdefault(owner, []).append(episode)
    return {owner: episodes for owner, episodes in found.items() if len(episodes) > 1}


def runs(numbers: Sequence[int]) -> str:
    """Return rising numbers as text, those in a row by the first and the last one."""
    found: list[list[int]] = []
    for number in numbers:
        if found and found[-1][1] == number - 1:
            found[-1][1] = number
        else:
            found.append([number, number])
    return few_text((first if first == last else f"{first} to {last}" for first, last in found), MOST_LISTED)


def listed(numbers: Sequence[int]) -> str:
    """Return numbers as text, the first ``MOST_LISTED`` of them."""
    return few_text(numbers, MOST_LISTED)
