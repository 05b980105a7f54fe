"""Quantities for people: counts, durations, offsets, sizes and rates, each in the unit of its magnitude.

Files and JSON have numbers in one unit; what a person reads has at most four digits, except the
offset of a clock: its error is stated beside it.
"""

from __future__ import annotations

from collections.abc import Iterable

from igtl_gateway.base.stamp import NS_PER_MS, NS_PER_S

_MINUTE, _HOUR, _DAY, _YEAR = 60, 3_600, 86_400, 365.25 * 86_400
#: An age of a message above this is no latency: the stamp is of another session, or of another kind of clock.
ANOTHER_SESSION_NS = _DAY * NS_PER_S
#: Durations from here on have the next unit.
_MOST_HOURS, _MOST_DAYS = 48 * _HOUR, 730 * _DAY
#: Below a second: unit, and its nanoseconds.
_SMALL = (("ns", 1), ("µs", 1_000), ("ms", 1_000_000))
_KILO = 1_000
#: Offsets of clocks from here on are in seconds.
_LONG_NS = 10 * NS_PER_S


def count_text(number: int, thing: str, things: str = "") -> str:
    """``1 message``, ``1,234 messages``."""
    return f"{number:,} {thing if number == 1 else things or thing + 's'}"


def counted(number: int, thing: str, things: str = "") -> str:
    """``1 byte``, ``1234 bytes``: of what a message or a file has, as its format counts it."""
    return f"{number} {thing if number == 1 else things or thing + 's'}"


def few_text(values: Iterable[object], most: int) -> str:
    """``a, b and 3 more``: the first values of a list, and the number of the others."""
    listed = list(values)
    more = f" and {len(listed) - most:,} more" if len(listed) > most else ""
    return ", ".join(map(str, listed[:most])) + more


def by_count(number: int, one: str, several: str) -> str:
    """Return the word that goes with one of a thing, or with none or several: ``is`` and ``are``."""
    return one if number == 1 else several


def duration_text(ns: float) -> str:
    """``812 ns``, ``12.3 µs``, ``1.25 ms``, ``12.3 s``, ``4 min 5 s``, ``3 h 25 min``, ``331 days``, ``56 years``."""
    ns = abs(ns)
    if not ns:
        return "0 s"
    for unit, size in _SMALL:
        text = _digits(ns / size) if size > 1 else f"{ns:.0f}"
        if float(text) < _KILO:
            return f"{text} {unit}"
    seconds = ns / NS_PER_S
    if float(_digits(seconds)) < _MINUTE:
        return f"{_digits(seconds)} s"
    if round(seconds) < _HOUR:
        return _two(round(seconds), _MINUTE, "min", "s")
    if seconds < _MOST_HOURS:
        return _two(round(seconds / _MINUTE), _MINUTE, "h", "min")
    if seconds < _MOST_DAYS:
        days = seconds / _DAY
        return f"{days:,.0f} days" if days >= 10 else f"{f'{days:.1f}'.removesuffix('.0')} days"
    years = seconds / _YEAR
    return f"{years:,.0f} years"


def seconds_text(seconds: float) -> str:
    """A duration of a clock that runs, in whole seconds: ``42 s``, ``3 min 20 s``."""
    return duration_text(round(seconds) * NS_PER_S)


def rough_text(seconds: float) -> str:
    """A duration that is estimated, in one unit: ``17 min``, ``28 h``, ``9 days``."""
    size = next((size for size in (_HOUR, _MINUTE) if seconds >= 2 * size), 1)
    return seconds_text(round(seconds / size) * size)


def moment_text(ns: float) -> str:
    """The time since the start of a session, as ``--at`` and ``--start`` take it: ``12.345 s``."""
    return f"{ns / NS_PER_S:.3f} s"


def offset_text(ns: float) -> str:
    """A duration with its sign: ``+12.3 ms``, ``-331 days``."""
    return f"{'-' if ns < 0 else '+' if ns else ''}{duration_text(ns)}"


def clock_text(ns: float) -> str:
    """The offset of a clock, to the microsecond however large it is: ``+12.300 ms``, ``-3,600.000124 s``."""
    return f"{ns / NS_PER_MS:+,.3f} ms" if abs(ns) < _LONG_NS else f"{ns / NS_PER_S:+,.6f} s"


def size_text(number: float) -> str:
    """Bytes: ``812 B``, ``9.6 MB``."""
    for unit in ("B", "kB", "MB", "GB"):
        if number < _KILO:
            return f"{number:.0f} {unit}" if unit == "B" else f"{number:.1f} {unit}"
        number /= _KILO
    return f"{number:,.1f} TB"


def rate_text(hertz: float) -> str:
    """``0.02 Hz``, ``29.9 Hz``, ``1.2 kHz``."""
    if hertz >= _KILO:
        return f"{hertz / _KILO:,.1f} kHz"
    return f"{hertz:.1f} Hz" if hertz >= 1 else f"{hertz:.2g} Hz"


def _digits(value: float) -> str:
    text = f"{value:.1f}" if value >= 10 else f"{value:.2f}"
    return text.removesuffix(".00" if value < 10 else ".0")


def _two(number: int, size: int, large: str, small: str) -> str:
    """A number of small units as large and small ones: ``4 min 5 s``, ``2 h``."""
    whole, rest = divmod(number, size)
    return f"{whole:,} {large}" + (f" {rest} {small}" if rest else "")
