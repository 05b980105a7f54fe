"""Moments of a recording as people write them: seconds from its beginning, UTC seconds, or ISO 8601."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta
from decimal import Decimal, InvalidOperation

from igtl_gateway.errors import ConfigError
from igtl_gateway.stamp import NS_PER_S

#: From here on a number of seconds is UTC (1973), below it counts from the beginning (three years).
FIRST_UTC_S = 100_000_000

_MAX_NS = 1 << 63
_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)


def moment(text: str, start_ns: int, option: str) -> int:
    """UTC nanoseconds of ``12.5`` (seconds from the beginning), ``1795248000.25`` (UTC) or ``2026-11-21T08:00:00Z``.

    ISO times without a zone are UTC.

    Args:
        text: as written.
        start_ns: the beginning of the recording, in UTC ns.
        option: where it was written, for the error.

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


def _iso(text: str, option: str) -> int:
    try:
        time = datetime.fromisoformat(text)
    except ValueError:
        raise _unreadable(text, option) from None
    since = (time if time.tzinfo else time.replace(tzinfo=UTC)) - _EPOCH
    return _checked(since // timedelta(microseconds=1) * 1000, text, option)


def _checked(utc_ns: int, text: str, option: str) -> int:
    """A moment that a recording can have: unsigned 64 bits, of which Python's times take fewer."""
    if not 0 <= utc_ns < _MAX_NS:
        raise ConfigError(f"{option}: found {text!r}, expected a time from 1970 to 2262")
    return utc_ns


def _unreadable(text: str, option: str) -> ConfigError:
    return ConfigError(
        f"{option}: found {text!r}, expected seconds from the beginning, UTC seconds, or a time as 2026-11-21T08:00:00Z"
    )
