"""What a test program sends, where the user may choose: type, size, rate and how many."""

from __future__ import annotations

from dataclasses import dataclass

from igtl_gateway.base.errors import ConfigError
from igtl_gateway.base.near import one_of

#: Type → what its size counts, its least, its default and its greatest.
SIZES = {
    "TRANSFORM": ("", 1, 1, 1),
    "STRING": ("bytes", 30, 100, 60_000),
    "POINT": ("points", 1, 100, 100_000),
    "POLYDATA": ("points", 1, 1_000, 1_000_000),
    "IMAGE": ("pixels wide, 3/4 of it high, RGB", 8, 640, 4_000),
}
SENDERS = ("igtl", "ros", "both")

_MAX_RATE_HZ = 2_000.0
_MAX_COUNT = 1_000_000


@dataclass(frozen=True, slots=True)
class Load:
    """Raises ConfigError for what no test program can do.

    Attributes:
        type: of the OpenIGTLink messages.
        size: of one, see ``SIZES``; 0: the default of its type.
        rate_hz: messages a second, each way.
        count: messages, each way.
        sender: which side sends; the other one receives.
    """

    type: str = "TRANSFORM"
    size: int = 0
    rate_hz: float = 30.0
    count: int = 90
    sender: str = "both"

    def __post_init__(self) -> None:
        if self.type not in SIZES:
            raise ConfigError(f"--type: found {self.type!r}, expected {one_of(self.type, SIZES)}")
        unit, least, _, most = SIZES[self.type]
        if self.size and not least <= self.size <= most:
            expected = f"{least:,} to {most:,} {unit}" if unit else "none"
            raise ConfigError(f"--size: found {self.size:,}, expected {expected} for {self.type}")
        if not 0 < self.rate_hz <= _MAX_RATE_HZ:
            raise ConfigError(f"--rate: found {self.rate_hz:g}, expected above 0 and at most {_MAX_RATE_HZ:g} Hz")
        if not 1 <= self.count <= _MAX_COUNT:
            raise ConfigError(f"--count: found {self.count:,}, expected 1 to {_MAX_COUNT:,}")
        if self.sender not in SENDERS:
            raise ConfigError(f"--sender: found {self.sender!r}, expected {one_of(self.sender, SENDERS)}")

    @property
    def length(self) -> int:
        """The size of one message."""
        return self.size or SIZES[self.type][2]

    def lasting(self, duration_s: float | None) -> int:
        """Number of messages in the given number of seconds; the count if None."""
        return self.count if duration_s is None else max(1, round(duration_s * self.rate_hz))
