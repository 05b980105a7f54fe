"""The order in which people expect names: numbers in them by their value, so that P10 comes after P2."""

from __future__ import annotations

import re

from igtl_gateway.base.untrusted.numbers import whole_number

_NUMBER = re.compile(r"([0-9]{1,18})")


def natural(name: str) -> list[tuple[int, str]]:
    """Return a sort key of a name: ``P2`` is before ``P10``, and ``bag_9`` before ``bag_10``."""
    words = ((word, whole_number(word)) for word in _NUMBER.split(name))
    return [(0, word) if number is None else (number, "") for word, number in words]
