"""Fractions of stamps in another unit: ns, µs or ms where the protocol counts 2^-32 s.

A fraction of the protocol is any number below 2^32, one in nanoseconds is below 10^9: of 50 stamps at any times, all
are below 10^9 with a probability of 10^-32.  A sender can have a rhythm, so the times of arrival decide: read in the
other unit, the ages of the messages are nearly equal.  Imported messages have no time of arrival but their stamp: of
these the fractions decide alone, if they fill a second of the other unit, over several seconds.
"""

from __future__ import annotations

from igtl_gateway.base.stamp import NS_PER_MS, NS_PER_S, fraction_to_ns

#: Unit → its nanoseconds, coarsest first; a fraction is less than a second of it.
_UNITS = (("ms", NS_PER_MS), ("us", 1_000), ("ns", 1))
#: Least number of stamps for a result.
_ENOUGH = 20
#: The spread of the ages is at least this, and this number of times the one in the other unit.
_LEAST_SPREAD_NS, _TIMES = 50 * NS_PER_MS, 3
#: Below this, the ages are those of imported messages.  Of these, least number of stamps, of seconds between the first
#: and the last one, and the part of a second of the other unit that they fill at least, from below to above.
_IMPORTED_NS, _ENOUGH_IMPORTED, _LEAST_S, _FROM_NS, _TO_NS = 100_000, 50, 2, NS_PER_S // 5, 4 * NS_PER_S // 5
_FRACTION = 0xFFFFFFFF
#: A fraction that counts seconds since 1970 is not further from the present than this.
_DAY_S = 24 * 3600


class _Spread:
    """The smallest and the largest of some ages, in nanoseconds."""

    __slots__ = ("least", "most")

    def __init__(self) -> None:
        self.least, self.most = 0, -1

    def add(self, age_ns: int) -> None:
        if self.most < self.least:
            self.least = self.most = age_ns
        self.least, self.most = min(self.least, age_ns), max(self.most, age_ns)

    @property
    def ns(self) -> int:
        return self.most - self.least


class FractionUnits:
    """The unit in which the stamps of one stream count the fraction of a second; constant memory.

    Attributes:
        stamped: number of stamps that are not 0.
        least, largest: the smallest and the largest fraction.
        low_words: number of stamps with 0 seconds, whose fraction counts seconds since 1970.
    """

    __slots__ = ("_first_s", "_last_s", "_protocol", "_units", "largest", "least", "low_words", "stamped")

    def __init__(self) -> None:
        self.stamped = self.largest = self.low_words = self._first_s = self._last_s = 0
        self.least = _FRACTION
        self.reset()

    def add(self, ticks: int, arrival_ns: int) -> None:
        """Look at a stamp; 0 is unset."""
        if not ticks:
            return
        seconds, fraction = ticks >> 32, ticks & _FRACTION
        self.stamped += 1
        self.least, self.largest = min(self.least, fraction), max(self.largest, fraction)
        self._first_s, self._last_s = self._first_s or seconds, seconds
        self.low_words += not seconds and abs(arrival_ns // NS_PER_S - fraction) < _DAY_S
        age_ns = arrival_ns - seconds * NS_PER_S
        self._protocol.add(age_ns - fraction_to_ns(fraction))
        for (_, unit_ns), spread in zip(_UNITS, self._units, strict=True):
            spread.add(age_ns - fraction * unit_ns)

    def reset(self) -> None:
        """The own clock was set: the ages before it do not compare; counts remain."""
        self._protocol, self._units = _Spread(), tuple(_Spread() for _ in _UNITS)

    @property
    def unit(self) -> str:
        """The unit of the fractions: ``"ms"``, ``"us"`` or ``"ns"``; ``""`` for that of the protocol."""
        if self._protocol.ns < _IMPORTED_NS:
            return self._unit_of_imported
        if self.stamped < _ENOUGH or self._protocol.ns < _LEAST_SPREAD_NS:
            return ""
        for (name, unit_ns), spread in zip(_UNITS, self._units, strict=True):
            if self.largest * unit_ns < NS_PER_S:
                return name if spread.ns * _TIMES <= self._protocol.ns else ""
        return ""

    @property
    def _unit_of_imported(self) -> str:
        if self.stamped < _ENOUGH_IMPORTED or self._last_s - self._first_s < _LEAST_S:
            return ""
        for name, unit_ns in _UNITS:
            if self.least * unit_ns <= _FROM_NS and _TO_NS <= self.largest * unit_ns < NS_PER_S:
                return name
        return ""

    @property
    def spread_ns(self) -> int:
        """Difference of the ages, read as the protocol has it."""
        return max(self._protocol.ns, 0)

    @property
    def is_low_word(self) -> bool:
        """Whether all stamps have the seconds in the word of the fraction."""
        return bool(self.stamped) and self.low_words == self.stamped
