"""Moments as a caller writes them, and as int64 UTC nanoseconds."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from datetime import datetime, timedelta, timezone
from typing import Any

import numpy as np

from igtl_gateway.base.errors import ConfigError
from igtl_gateway.base.stamp import NS_PER_S
from igtl_gateway.gateway.log.marks import Mark
from igtl_gateway.replay.moment import FIRST_UTC_S
from igtl_gateway.replay.recorded_marks import marked_moment

#: A moment: seconds from the start of the recording (a number below 100,000,000; negative: from its end), an integer in
#: UTC nanoseconds, a ``datetime`` (without a zone: UTC), a ``numpy.datetime64``, or a string such as
#: ``"2026-11-21T08:00:00Z"`` or ``"mark:suture-3"``.
Moment = int | float | np.integer[Any] | str | datetime | np.datetime64

#: The first integer that is UTC nanoseconds: 1970-01-12.
_FIRST_UTC_NS = 10**15
_EPOCH = datetime(1970, 1, 1, tzinfo=timezone.utc)


def to_ns(value: Moment, start_ns: int, end_ns: int, name: str, marks: Callable[[], Sequence[Mark]]) -> int:
    """Return a moment in UTC ns.  Raises ConfigError, which begins with ``name``.

    Args:
        value: the moment.
        start_ns: start of the recording, UTC ns.
        end_ns: its last message, UTC ns.
        name: of the argument.
        marks: returns those of the recording.
    """
    if isinstance(value, str):
        return marked_moment(value, start_ns, name, marks)
    if isinstance(value, np.datetime64):
        return int(value.astype("datetime64[ns]").astype(np.int64))
    if isinstance(value, datetime):
        since = (value if value.tzinfo else value.replace(tzinfo=timezone.utc)) - _EPOCH
        return since // timedelta(microseconds=1) * 1000
    number = int(value) if isinstance(value, np.integer) else value
    if isinstance(number, int | float) and not isinstance(number, bool):
        if abs(number) < FIRST_UTC_S:
            return round(number * NS_PER_S) + (start_ns if number >= 0 else end_ns)
        if isinstance(number, int) and number >= _FIRST_UTC_NS:
            return number
    raise ConfigError(
        f"{name}: found {value!r}, expected seconds from the start, integer UTC nanoseconds, a datetime, or a string "
        "such as '2026-11-21T08:00:00Z'"
    )


def tolerance_ns(value: float | timedelta | None, name: str = "tolerance") -> int | None:
    """Return a length of time in ns; None: no limit.  Raises ConfigError unless it is 0 or more seconds."""
    if value is None:
        return None
    seconds = value.total_seconds() if isinstance(value, timedelta) else value
    if isinstance(seconds, int | float) and 0 <= seconds < FIRST_UTC_S:
        return round(seconds * NS_PER_S)
    raise ConfigError(f"{name}: found {value!r}, expected 0 or more seconds, or None")
