"""Parses moments of a recording: seconds from its start, UTC seconds, or ISO 8601."""

from __future__ import annotations

from datetime import datetime, timedelta, timezone
from decimal import Decimal, InvalidOperation

from igtl_gateway.base.errors import ConfigError
from igtl_gateway.base.quantities import moment_text
from igtl_gateway.base.stamp import NS_PER_S
from igtl_gateway.base.versions import iso_time

#: Numbers from here on are UTC seconds (1973); smaller numbers are seconds from the start (up to three years).
FIRST_UTC_S = 100_000_000

_MAX_NS = 1 << 63
_EPOCH = datetime(1970, 1, 1, tzinfo=timezone.utc)


def moment(text: str, start_ns: int, option: str) -> int:
    """Return UTC ns of ``12.5`` (seconds from the start), ``1795248000.25`` (UTC) or ``2026-11-21T08:00:00Z``.

    ISO times without a zone are UTC.

    Args:
        text: the moment as the user wrote it.
        start_ns: start of the recording, UTC ns.
        option: name of the option, for the error.

    Raises ConfigError.
    """
    try:
        seconds = Decimal(text)
    except InvalidOperation:
        return _iso(text, option)
    if not seconds.is_finite() or seconds < 0:
        raise _unreadable(text, option)
    ns = int(seconds * NS_PER_S) if seconds < _MAX_NS else _MAX_NS
    return _checked(ns if seconds >= FIRST_UTC_S else start_ns + ns, text, option)


def since_text(start_ns: int, recorded_ns: int | None) -> str:
    """Return a recorded time for people, from ``start_ns``."""
    if recorded_ns is None:
        return "the beginning"
    return f"{'+' * (recorded_ns >= start_ns)}{moment_text(recorded_ns - start_ns)}"


def check_part(start_ns: int | None, end_ns: int | None, first_ns: int, last_ns: int, *, is_empty_part: bool) -> None:
    """Raise ConfigError unless a part of a recording, from --start to --end, can hold a message.

    Args:
        start_ns, end_ns: UTC ns; None: of the recording.
        first_ns, last_ns: of the recording, UTC ns.
        is_empty_part: a part whose end is its start has nothing.
    """
    begin_ns = first_ns if start_ns is None else start_ns
    if begin_ns > last_ns:
        found, expected = since_text(first_ns, begin_ns), since_text(first_ns, last_ns)
        raise ConfigError(f"--start: found {found}, expected at most {expected}")
    if end_ns is not None and end_ns < begin_ns + is_empty_part:
        found, expected = since_text(first_ns, end_ns), since_text(first_ns, begin_ns)
        raise ConfigError(f"--end: found {found}, expected {'after' if is_empty_part else 'at least'} {expected}")


def _iso(text: str, option: str) -> int:
    try:
        time = iso_time(text)
    except ValueError:
        raise _unreadable(text, option) from None
    since = (time if time.tzinfo else time.replace(tzinfo=timezone.utc)) - _EPOCH
    return _checked(since // timedelta(microseconds=1) * 1000, text, option)


def _checked(utc_ns: int, text: str, option: str) -> int:
    """Return a moment that a recording can have: it must fit 64 bits and Python's datetime."""
    if not 0 <= utc_ns < _MAX_NS:
        raise ConfigError(f"{option}: found {text!r}, expected a time from 1970 to 2262")
    return utc_ns


def _unreadable(text: str, option: str) -> ConfigError:
    return ConfigError(
        f"{option}: found {text!r}, expected seconds from the beginning, UTC seconds, "
        "or an ISO time such as 2026-11-21T08:00:00Z"
    )
