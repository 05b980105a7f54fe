"""Limits for reading one file: memory, compression ratio, depth, count and time, each with a name.

The limits in force are a context variable, so that readers need no argument for them.  ``--limit NAME=VALUE`` on the
command line and :func:`limits_in_force` replace them.  A file above a limit raises
:class:`~igtl_gateway.base.errors.LimitExceeded`, which names the place, the value found and the limit.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, fields, replace

from igtl_gateway.base.clock import Clock, SystemClock
from igtl_gateway.base.errors import ConfigError, LimitExceeded
from igtl_gateway.base.near import one_of
from igtl_gateway.base.untrusted.numbers import whole_number

_MIB = 1 << 20
_NS_PER_S = 1_000_000_000


@dataclass(frozen=True, slots=True)
class FileLimits:
    """Limits for reading one file.

    Attributes:
        memory: unpacked bytes of one piece: a chunk, a record, a frame, a header.
        ratio: unpacked bytes per packed byte of a piece; applies above ``free`` bytes.
        free: unpacked bytes of a piece at any ratio: a black image packs to very little.
        depth: levels of nesting of JSON, YAML, message definitions and the like.
        count: items of one kind: fields of a header, connections of a capture, channels, names.
        topics: topics of a bag.
        definition: characters of the definition of one message type with its dependencies.
        fields: fields, constants and types of one such definition; an array of five messages counts as five.
            Also the transforms of one sequence.
        document: characters of a YAML document, or of a line of an image header.
        seconds: time for reading, and CPU time of the whole verb (``cpu_time``), plus ``seconds_per_mb`` for each
            megabyte of the file.
        seconds_per_mb: see ``seconds``.
    """

    memory: int = 1024 * _MIB
    ratio: int = 250
    free: int = 64 * _MIB
    depth: int = 64
    count: int = 200_000
    topics: int = 20_000
    definition: int = 256 * 1024
    fields: int = 3_000
    document: int = 512 * 1024
    seconds: int = 20
    seconds_per_mb: int = 10

    def unpacked(self, packed: int) -> int:
        """Return the allowed unpacked size of a piece of ``packed`` bytes."""
        return min(self.memory, max(self.free, self.ratio * packed))


#: Limit → its meaning, for ``--help`` and the documentation.
MEANINGS = {
    "memory": "decompressed bytes of one chunk, record, frame or header",
    "ratio": "decompressed bytes for each compressed byte, above `free`",
    "free": "decompressed bytes of one piece at any ratio",
    "depth": "levels of nesting (JSON, YAML, message definitions)",
    "count": "items of one kind (header fields, connections, channels, names)",
    "topics": "topics of a bag",
    "definition": "characters of the definition of one message type",
    "fields": "fields, constants and types of one definition; transforms of one sequence",
    "document": "characters of a YAML document or of a line of an image header",
    "seconds": "seconds to read a file, and CPU time of the verb, plus `seconds_per_mb`",
    "seconds_per_mb": "additional seconds for each megabyte of the file",
}

_current: ContextVar[FileLimits] = ContextVar("igtl_gateway_limits", default=FileLimits())  # noqa: B039  # frozen


def current_limits() -> FileLimits:
    """Return the limits in force."""
    return _current.get()


@contextmanager
def limits_in_force(limits: FileLimits) -> Iterator[None]:
    """Read with these limits inside a ``with`` statement."""
    token = _current.set(limits)
    try:
        yield
    finally:
        _current.reset(token)


def parse_limits(words: list[str]) -> FileLimits:
    """Return the limits in force with each ``NAME=VALUE`` replaced.  Raises ConfigError."""
    limits, names = current_limits(), [field.name for field in fields(FileLimits)]
    for word in words:
        name, _, value = word.partition("=")
        number = whole_number(value, (1 << 62) - 1)
        if name not in names or not number:
            raise ConfigError(f"--limit: found {word!r}, expected NAME=NUMBER with {one_of(name, names)}")
        limits = replace(limits, **{name: number})
    return limits


def check_limit(name: str, found: int, place: str, bound: int | None = None) -> None:
    """Raise LimitExceeded if ``found`` is above the limit ``name``, or above ``bound``, which depends on it."""
    allowed = int(getattr(current_limits(), name)) if bound is None else bound
    if found > allowed:
        raise exceeded(name, found, place, allowed)


def check_unpacked(packed: int, unpacked: int, place: str) -> None:
    """Raise LimitExceeded if ``packed`` bytes must not unpack to ``unpacked`` bytes."""
    check_limit("memory", unpacked, place)
    check_limit("ratio", unpacked, place, current_limits().unpacked(packed))


def exceeded(name: str, found: object, place: str, allowed: object) -> LimitExceeded:
    """Return the error for a value above a limit."""
    return LimitExceeded(
        f"{place}: found {found}, expected at most {allowed} (--limit {name}={getattr(current_limits(), name)})"
    )


class Deadline:
    """The deadline for reading a file of ``size`` bytes, from its construction on."""

    def __init__(self, size: int, clock: Clock | None = None) -> None:
        limits = current_limits()
        self._clock = clock or SystemClock()
        self._seconds = limits.seconds + limits.seconds_per_mb * size // 1_000_000
        self._end_ns = self._clock.monotonic_ns() + self._seconds * _NS_PER_S

    def check(self, place: str) -> None:
        """Raise LimitExceeded after the deadline."""
        if self._clock.monotonic_ns() > self._end_ns:
            raise exceeded("seconds", f"more than {self._seconds} s of work", place, f"{self._seconds} s")

    @contextmanager
    def paused(self) -> Iterator[None]:
        """Context manager: its time does not count, as that of a caller who works on what was read."""
        began_ns = self._clock.monotonic_ns()
        try:
            yield
        finally:
            self._end_ns += self._clock.monotonic_ns() - began_ns
