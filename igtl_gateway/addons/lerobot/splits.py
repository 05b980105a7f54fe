"""Splits of a data set: they follow demonstrations, so that no demonstration is in two of them.

A recipe states ranges of demonstrations: the parts that ``[episodes]`` describes, numbered from 0 on, also those that
have no frame.  A demonstration with a gap becomes several episodes, which are all in its split.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from igtl_gateway.addon import ConfigError

#: Numbers and notes of one kind that are listed.
MOST_LISTED = 10


def splits_of(ranges: Mapping[str, str] | None, demonstrations: int, owners: Sequence[int]) -> dict[str, str]:
    """Return the range of episodes of each split.

    Args:
        ranges: split → range of demonstrations; without one, all episodes are in ``train``.
        demonstrations: their number.
        owners: the demonstration of each episode, in order.

    Raises:
        ConfigError: a range has no demonstration with frames or one of another range, or a demonstration is in none.
    """
    if not ranges:
        return {"train": f"0:{len(owners)}"}
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
            f"splits: found {len(missing)} of {demonstrations} demonstrations in no split, the first is {missing[0]}, "
            "expected each one in a split"
        )
    return found


def divided(owners: Sequence[int]) -> dict[int, list[int]]:
    """Return the demonstrations that are several episodes, each with its episodes."""
    found: dict[int, list[int]] = {}
    for episode, owner in enumerate(owners):
        found.setdefault(owner, []).append(episode)
    return {owner: episodes for owner, episodes in found.items() if len(episodes) > 1}


def listed(numbers: Sequence[int]) -> str:
    """Return numbers as text, the first ``MOST_LISTED`` of them."""
    more = f" and {len(numbers) - MOST_LISTED:,} more" if len(numbers) > MOST_LISTED else ""
    return ", ".join(map(str, numbers[:MOST_LISTED])) + more
