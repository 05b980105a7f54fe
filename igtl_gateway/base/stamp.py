"""Time stamps: OpenIGTLink's 32.32 fixed point ⇄ integer nanoseconds ⇄ ROS time.

A *tick word* is the raw 64-bit field of the OpenIGTLink header: upper 32 bits: whole seconds since
1970-01-01T00:00:00Z, lower 32 bits: the fraction in units of 2⁻³² s.  0 means "not set", never 1970.

The conversion is that of the reference library (``igtl_util.c``), not the mathematically exact one.  It processes the
fraction from its top bit, with a step that begins at half a second and is halved, rounding *up*.  So ns → fraction →
ns is the identity for every ns, and the results are bit-equal to those of C++ peers.  Fractions of 0xFFFFFFD9 and above
are 1,000,000,000 ns or more; this module carries them into the seconds.
"""

from __future__ import annotations

from datetime import datetime, timezone

NS_PER_S = 1_000_000_000
NS_PER_MS = 1_000_000


def _steps() -> tuple[int, ...]:
    """Return the nanoseconds of each of the 32 fraction bits, top bit first."""
    steps, step = [], NS_PER_S
    for _ in range(32):
        step = (step + 1) >> 1
        steps.append(step)
    return tuple(steps)


_STEPS = _steps()

# The value of a fraction is a sum over its bits, so four table look-ups replace 32 steps.
_BYTE_NS = tuple(
    tuple(sum(_STEPS[8 * byte + bit] for bit in range(8) if value & (0x80 >> bit)) for value in range(256))
    for byte in range(4)
)

# The first nine steps are exact halvings (500000000 … 1953125): one division replaces nine of the steps.
_EXACT_BITS = 9
_EXACT_STEP_NS = NS_PER_S >> _EXACT_BITS
_TAIL = tuple((step, 1 << (31 - bit)) for bit, step in enumerate(_STEPS) if bit >= _EXACT_BITS)


def fraction_to_ns(fraction: int) -> int:
    """Return the nanoseconds of a 32-bit fraction as the reference library computes them (0 … 1,000,000,010)."""
    return (
        _BYTE_NS[0][fraction >> 24]
        + _BYTE_NS[1][fraction >> 16 & 0xFF]
        + _BYTE_NS[2][fraction >> 8 & 0xFF]
        + _BYTE_NS[3][fraction & 0xFF]
    )


def ns_to_fraction(ns: int) -> int:
    """Return the 32-bit fraction of ``ns`` (0 … 999,999,999) as the reference library computes it."""
    quotient, rest = divmod(ns, _EXACT_STEP_NS)
    fraction = quotient << (32 - _EXACT_BITS)
    for step, bit in _TAIL:
        if rest >= step:
            fraction |= bit
            rest -= step
            if not rest:
                break
    return fraction


def ticks_to_ns(ticks: int) -> int:
    """Return the UTC nanoseconds of a tick word; 0 (unset) remains 0."""
    return (ticks >> 32) * NS_PER_S + fraction_to_ns(ticks & 0xFFFFFFFF)


def of_milliseconds(ticks: int) -> int:
    """Return the tick word for one whose fraction counts milliseconds; unchanged if the fraction is larger."""
    milliseconds = ticks & 0xFFFFFFFF
    return (ticks >> 32 << 32) | ns_to_fraction(milliseconds * NS_PER_MS) if milliseconds < 1_000 else ticks


def ticks_as_read(ticks: int, source_ns: int) -> int:
    """Return the tick word that a session has read in place of ``ticks`` if its entry has the stamp ``source_ns``."""
    read = of_milliseconds(ticks)
    return read if ticks_to_ns(read) == source_ns else ticks


def ns_to_ticks(ns: int) -> int:
    """Return the tick word of UTC nanoseconds; 0 for 0 (unset) and times before 1970.  From 2106 on the field wraps."""
    seconds, rest = divmod(max(ns, 0), NS_PER_S)
    return (seconds & 0xFFFFFFFF) << 32 | ns_to_fraction(rest)


def ns_to_ros(ns: int) -> tuple[int, int]:
    """Return ``(sec, nanosec)`` of builtin_interfaces/Time (int32, uint32) for UTC nanoseconds."""
    seconds, rest = divmod(ns, NS_PER_S)
    # Time.sec has 32 bits with sign: after 2038 it wraps, as in every ROS 2 message
    return (seconds + 0x80000000) % 0x100000000 - 0x80000000, rest


def ros_to_ns(sec: int, nanosec: int) -> int:
    """Return the UTC nanoseconds of a builtin_interfaces/Time; 0 for ``(0, 0)`` (unset)."""
    return sec * NS_PER_S + nanosec


def utc_text(ns: int) -> str:
    """Return UTC nanoseconds as ISO 8601 text: ``2026-11-21T08:00:00.123456789Z``."""
    seconds, rest = divmod(ns, NS_PER_S)
    return f"{datetime.fromtimestamp(seconds, timezone.utc):%Y-%m-%dT%H:%M:%S}.{rest:09d}Z"
