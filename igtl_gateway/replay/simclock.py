"""The clock of a replay on ``/clock``, for nodes with ``use_sim_time``.

Its ticks come between the entries at fixed steps of recorded time, so they do not depend on the rate.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable, Iterator

from igtl_gateway.base.errors import ConfigError
from igtl_gateway.base.qos import Qos
from igtl_gateway.base.stamp import NS_PER_S, ns_to_ros
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.replay.timeline import SessionTimeline

CLOCK_TOPIC = "/clock"
CLOCK_TYPE = "rosgraph_msgs/msg/Clock"
#: Reliable, which matches every subscriber; those of ROS keep only the latest message.
CLOCK_QOS = Qos(depth=10)

_CLOCK = struct.Struct("<4siI")
_CDR_LE = b"\x00\x01\x00\x00"


def period_ns(hz: float) -> int:
    """Return the recorded time between two ticks.  Raises ConfigError."""
    if not 0 < hz <= NS_PER_S:
        raise ConfigError(f"--clock: found {hz}, expected a positive number of ticks per second")
    return max(1, round(NS_PER_S / hz))


def is_tick(entry: Entry) -> bool:
    """Return whether an entry is a tick: ticks have no entry number."""
    return entry.seq == 0 and entry.channel == CLOCK_TOPIC


def with_ticks(
    entries: Iterable[Entry], start_ns: int | None, step_ns: int, pace: SessionTimeline | None = None
) -> Iterator[Entry]:
    """Yield the entries with ticks between them, the first tick at ``start_ns``; they replace a recorded ``/clock``.

    Args:
        start_ns: time of the first tick; None: that of the first entry.
        step_ns: recorded time between two ticks.
        pace: time line of the session: in a jump of gateway time there are no ticks.
    """
    pace = pace or SessionTimeline()
    next_ns = start_ns
    for entry in entries:
        if entry.channel == CLOCK_TOPIC:
            continue
        if next_ns is None:
            next_ns = entry.stamp_ns
        if (
            next_ns == start_ns and entry.stamp_ns < next_ns
        ):  # latched entries from before the start: the clock comes first
            yield clock_entry(next_ns)
            next_ns += step_ns
        while (next_ns := _behind_jump(next_ns, step_ns, pace)) <= entry.stamp_ns:
            yield clock_entry(next_ns)
            next_ns += step_ns
        yield entry


def _behind_jump(tick_ns: int, step_ns: int, pace: SessionTimeline) -> int:
    """Return the first tick from ``tick_ns`` on that is not in a jump."""
    return tick_ns - (tick_ns - pace.behind_jump_ns(tick_ns)) // step_ns * step_ns


def clock_entry(stamp_ns: int) -> Entry:
    """Return the entry of a tick."""
    data = _CLOCK.pack(_CDR_LE, *ns_to_ros(stamp_ns))
    return Entry(0, stamp_ns, Kind.ROS_OUT, CLOCK_TOPIC, CLOCK_TYPE, (data,))
