"""Shapes of untrusted JSON: checked once when it is read, so that later code need not check it.

A :data:`Shape` is called with a value and its place.  It raises DamagedRecording with the place, the value found and
the expected value.  The functions here are shapes, or build shapes from shapes.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Collection, Mapping
from typing import Any

from igtl_gateway.base.errors import DamagedRecording
from igtl_gateway.base.untrusted.numbers import whole_number

Shape = Callable[[Any, str], None]

_SHOWN = 40


def wrong(place: str, found: Any, expected: str) -> DamagedRecording:
    """Return the error for a wrong value, which is shortened."""
    try:
        text = json.dumps(found, default=repr)
    except (ValueError, RecursionError):
        text = type(found).__name__
    text = text if len(text) <= _SHOWN else f"{text[:_SHOWN]}…"
    return DamagedRecording(f"{place}: found {text}, expected {expected}")


def anything(_value: Any, _place: str) -> None:
    """Any JSON value."""


def unexpected(_value: Any, place: str) -> None:
    """No value: a field that is not known."""
    raise DamagedRecording(f"{place}: found an unknown field, expected none of this name")


def text(value: Any, place: str) -> None:
    """A string."""
    if not isinstance(value, str):
        raise wrong(place, value, "a string")


def truth(value: Any, place: str) -> None:
    """True or false."""
    if not isinstance(value, bool):
        raise wrong(place, value, "true or false")


def number(value: Any, place: str) -> None:
    """An integer from 0 to 2^63 − 1."""
    if type(value) is not int or not 0 <= value < 1 << 63:
        raise wrong(place, value, "an integer of 0 or more")


def digits(value: Any, place: str) -> None:
    """A string of decimal digits for an integer of at most 64 bits."""
    if whole_number(value) is None:
        raise wrong(place, value, "a number of at most 64 bits")


def map_of(inner: Shape) -> Shape:
    """Return the shape of an object with any keys."""

    def check(value: Any, place: str) -> None:
        if not isinstance(value, dict):
            raise wrong(place, value, "an object")
        for key, item in value.items():
            inner(item, f"{place}.{key[:_SHOWN]}")

    return check


def list_of(inner: Shape) -> Shape:
    """Return the shape of an array."""

    def check(value: Any, place: str) -> None:
        if not isinstance(value, list):
            raise wrong(place, value, "an array")
        for at, item in enumerate(value):
            inner(item, f"{place}[{at}]")

    return check


def fields(known: Mapping[str, Shape], needed: Collection[str] = (), other: Shape = anything) -> Shape:
    """Return the shape of an object with known fields and a shape for all other fields."""

    def check(value: Any, place: str) -> None:
        if not isinstance(value, dict):
            raise wrong(place, value, "an object")
        for name in needed:
            if name not in value:
                raise DamagedRecording(f"{place}: found no field {name!r}, expected one")
        for key, item in value.items():
            known.get(key, other)(item, f"{place}.{key[:_SHOWN]}")

    return check
