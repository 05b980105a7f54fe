"""Numbers that belong to names in the same message, such as those of joints: a column for each name, in any order.

A message of a topic need not have all names, nor the same order as the last one: two arms can publish on one topic.
What a message does not have is not a number, until ``completed`` takes it from the other messages.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[Any]
Mask = npt.NDArray[np.bool_]

#: Fields with the names of the other lists of a message.
NAME_FIELDS = ("name", "names", "joint_names")


@dataclass(frozen=True, slots=True, eq=False)
class NamedNumbers:
    """Numbers by name.

    Attributes:
        names: K names, in the order of their first appearance.
        values: (N, K) float64; NaN where a message does not have the name.
        known: (N, K) bool, whether the message has it.
        orders: number of different lists of names.
        unclear: messages with names that are not unique, or not as many as numbers; they have no values.
    """

    names: tuple[str, ...]
    values: Array
    known: Mask
    orders: int
    unclear: int


def by_name(names: Sequence[Sequence[str] | None], values: Sequence[Sequence[float] | None]) -> NamedNumbers | None:
    """Return the numbers of N messages by the names in them; None if no message with numbers has names.

    Args:
        names: the names in each message.
        values: the numbers in each message, in the order of its names.
    """
    columns: dict[str, int] = {}
    places: dict[tuple[str, ...], list[int]] = {}
    rows_of: dict[tuple[str, ...], list[int]] = {}
    unclear = 0
    for row, (own, numbers) in enumerate(zip(names, values, strict=True)):
        if numbers is None or not len(numbers):
            continue
        key = tuple(own or ())
        if len(key) != len(numbers) or len(set(key)) != len(key):
            unclear += 1
            continue
        if key not in places:
            places[key] = [columns.setdefault(name, len(columns)) for name in key]
            rows_of[key] = []
        rows_of[key].append(row)
    if not columns:
        return None
    found = np.full((len(names), len(columns)), np.nan)
    known = np.zeros(found.shape, np.bool_)
    for key, rows in rows_of.items():
        at = np.ix_(rows, places[key])
        found[at] = np.array([_listed(values[row]) for row in rows], float)
        known[at] = True
    return NamedNumbers(tuple(columns), found, known, len(places), unclear)


def _listed(numbers: Sequence[float | None] | None) -> list[float]:
    return [np.nan if each is None else each for each in (() if numbers is None else numbers)]


def completed(found: NamedNumbers, times: Array, rule: str, most_ns: int, most_step: float = np.inf) -> Array:
    """Return the values (N, K) with those that a message does not have taken from the others, NaN where none is near.

    Args:
        found: the values by name.
        times: (N,) int64, times of the messages, ns.
        rule: ``hold``: the last value before; ``nearest``; ``interpolate``: between the values before and after.
        most_ns: largest age, distance, or distance of two values.
        most_step: between two values that differ by more there is no other one: ``interpolate`` takes the nearer one.
    """
    if found.known.all():
        return found.values
    order = np.argsort(times, kind="stable")
    at = times[order]
    result = found.values.copy()
    for column in range(len(found.names)):
        known = found.known[order, column]
        missing = np.flatnonzero(~known)
        have = np.flatnonzero(known)
        if not len(missing) or not len(have):
            continue
        values = found.values[order[have], column]
        after = np.searchsorted(have, missing)  # of those that are known
        before, later = np.maximum(after - 1, 0), np.minimum(after, len(have) - 1)
        back = np.where(after > 0, at[missing] - at[have[before]], _NEVER)
        ahead = np.where(after < len(have), at[have[later]] - at[missing], _NEVER)
        if rule == "interpolate":
            good = (after > 0) & (after < len(have)) & (back <= most_ns - np.minimum(ahead, most_ns))
            share = back / np.maximum(back + np.where(good, ahead, 1), 1)
            steps = values[later] - values[before]
            share = np.where(np.abs(steps) > most_step, share > 0.5, share)
            filled = values[before] + np.where(good, share, 0) * steps
        elif rule == "nearest":
            good = np.minimum(back, ahead) <= most_ns
            filled = np.where(back <= ahead, values[before], values[later])
        else:
            good = (after > 0) & (back <= most_ns)
            filled = values[before]
        result[order[missing[good]], column] = filled[good]
    return result


#: Distance of what is not there, ns; a sum of two of them is an int64.
_NEVER = (1 << 62) - 1
