"""Fault injection, to test the peers: delayed, lost, swapped, truncated and corrupt messages, closed connections.

A `FaultLine` applies faults to the messages of one line.  It receives each message with its time, and returns one
`Fate` per message, in the order in which the messages are sent.  It reads neither a clock nor a random source.  A hash
of the seed, the name of the line, the number of the message and the fault decides whether a fault affects a message.
So the same seed affects the same messages on every machine, and an additional fault does not change which messages the
other faults affect.

Messages keep their order, as over TCP, except for ``reorder``.
"""

from __future__ import annotations

import re
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace
from enum import Enum
from hashlib import blake2b
from typing import Generic, TypeVar

from igtl_gateway.base.errors import ConfigError
from igtl_gateway.base.near import one_of
from igtl_gateway.base.quantities import counted
from igtl_gateway.base.stamp import NS_PER_S
from igtl_gateway.wire.header import CRC_AT


class Unit(Enum):
    """Syntax of the value of a fault."""

    TIME = "TIME"
    SHARE = "SHARE%"
    STEP = "TIME[@TIME]"


@dataclass(frozen=True, slots=True)
class Fault:
    """One kind of fault: name, syntax of the value, and meaning for the documents."""

    name: str
    unit: Unit
    meaning: str


DELAY, JITTER, LOSS, REORDER, TRUNCATE, CORRUPT, DISCONNECT, CLOCK_STEP = (
    "delay",
    "jitter",
    "loss",
    "reorder",
    "truncate",
    "corrupt",
    "disconnect",
    "clock-step",
)

#: All faults.
FAULTS = (
    Fault(DELAY, Unit.TIME, "delay of every message"),
    Fault(JITTER, Unit.TIME, "additional delay of each message, from 0 to TIME; the order is kept"),
    Fault(LOSS, Unit.SHARE, "share of messages that are dropped"),
    Fault(REORDER, Unit.SHARE, "share of messages that are swapped with the next message"),
    Fault(TRUNCATE, Unit.SHARE, "share of messages that are cut in the middle; the connection then closes"),
    Fault(
        CORRUPT,
        Unit.SHARE,
        "share of messages with one flipped bit in the body or the CRC field, so that the CRC is wrong",
    ),
    Fault(DISCONNECT, Unit.SHARE, "share of messages after which the connection closes"),
    Fault(
        CLOCK_STEP,
        Unit.STEP,
        "step of the sender's clock: all stamps are shifted; @TIME: starting at this time after the first message",
    ),
)

#: Fault of a line that would otherwise store too many bytes: a message is sent before its time.
EARLY = "early"

#: Maximum delay and maximum jitter, ns.
MAX_DELAY_NS = 60 * NS_PER_S
#: Maximum step of a clock, and maximum time before it, ns; stamps are limited to 1970 … 2106.
MAX_STEP_NS = 50 * 365 * 86_400 * NS_PER_S
#: Maximum time that a message waits for the next one, with which it is swapped, ns.
OVERTAKEN_WITHIN_NS = NS_PER_S
#: Maximum number of bytes that one line stores (0.5 s of full-HD images at 60 Hz: 187 MB); above it, the oldest leave.
MAX_HELD_BYTES = 256 * 2**20

_NS = {"ns": 1, "us": 1_000, "ms": 1_000_000, "s": NS_PER_S, "min": 60 * NS_PER_S, "h": 3600 * NS_PER_S}
_TIME = re.compile(r"([+-]?)(\d{1,18}(?:\.\d{1,18})?)(ns|us|ms|s|min|h)", re.ASCII)
_SHARE = re.compile(r"(\d{1,18}(?:\.\d{1,18})?)%", re.ASCII)


@dataclass(frozen=True, slots=True)
class Faults:
    """The faults of one line.  Shares are from 0 to 1."""

    delay_ns: int = 0
    jitter_ns: int = 0
    loss: float = 0.0
    reorder: float = 0.0
    truncate: float = 0.0
    corrupt: float = 0.0
    disconnect: float = 0.0
    clock_step_ns: int = 0
    clock_step_at_ns: int = 0

    @classmethod
    def parse(cls, text: str, place: str = "--fault") -> Faults:
        """Return the faults of ``"delay=50ms,loss=1%"``; none for "".  Raises ConfigError with ``place``."""
        rows = {fault.name: fault for fault in FAULTS}
        given: dict[str, float | int] = {}
        seen = set()
        for part in text.split(",") if text.strip() else []:
            name, equals, value = (word.strip() for word in part.partition("="))
            if name not in rows:
                raise ConfigError(f"{place}: found {name!r}, expected NAME=VALUE, {one_of(name, rows)}")
            if name in seen:
                raise ConfigError(f"{place}: found {name} twice, expected it once")
            seen.add(name)
            where = f"{place}: {name}"
            if not equals:
                raise ConfigError(f"{where}: found no value, expected {name}={rows[name].unit.value}")
            match rows[name].unit:
                case Unit.SHARE:
                    given[name] = _share(value, where)
                case Unit.TIME:
                    given[f"{name}_ns"] = _time(value, where, 0, MAX_DELAY_NS)
                case Unit.STEP:
                    step, at, moment = value.partition("@")
                    given["clock_step_ns"] = _time(step, where, -MAX_STEP_NS, MAX_STEP_NS)
                    given["clock_step_at_ns"] = _time(moment, f"{where}: @", 0, MAX_STEP_NS) if at else 0
        return cls(**given)  # type: ignore[arg-type]

    def __bool__(self) -> bool:
        return self != _NONE


_NONE = Faults()


@dataclass(frozen=True, slots=True)
class RelayFaults:
    """The faults of a relay.

    Attributes:
        inward: faults of the messages from clients to the server.
        outward: faults of the messages from the server to clients.
    """

    inward: Faults
    outward: Faults

    @classmethod
    def parse(cls, text: str, place: str = "--fault") -> RelayFaults:
        """Return the faults of both directions; ``in:`` or ``out:`` before a name limits a fault to one direction."""
        ways: dict[str, list[str]] = {"in": [], "out": []}
        for part in text.split(",") if text.strip() else []:
            way, colon, fault = (word.strip() for word in part.partition(":"))
            if colon and fault and way in ways:
                ways[way].append(fault)
            else:
                for both in ways.values():
                    both.append(part)
        return cls(*(Faults.parse(",".join(parts), place) for parts in ways.values()))

    def __bool__(self) -> bool:
        return bool(self.inward) or bool(self.outward)


def _share(text: str, place: str) -> float:
    found = _SHARE.fullmatch(text)
    share = float(found[1]) / 100 if found else -1.0
    if not 0 <= share <= 1:
        raise ConfigError(f"{place}: found {text!r}, expected a share from 0% to 100%, such as 0.5%")
    return share


def _time(text: str, place: str, least_ns: int, most_ns: int) -> int:
    found = _TIME.fullmatch(text)
    if not found or (least_ns == 0 and found[1] == "-"):
        example = "50ms" if least_ns == 0 else "-1h or 250ms"
        raise ConfigError(f"{place}: found {text!r}, expected a time such as {example} ({', '.join(_NS)})")
    time_ns = round(float(found[2]) * _NS[found[3]]) * (-1 if found[1] == "-" else 1)
    if not least_ns <= time_ns <= most_ns:
        raise ConfigError(f"{place}: found {text!r}, expected at most {most_ns // NS_PER_S:,} s")
    return time_ns


T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class Fate(Generic[T]):
    """The result of the fault injection for one message.

    Attributes:
        message: the object that was passed to the line.
        at_ns: time at which the message is sent (or was lost), ns.
        late_ns: delay since its arrival, ns.
        data: the changed bytes; None if they are unchanged.
        lost: whether the message is not sent.
        disconnect: whether the connection is closed after the message.
        done: (name, description) of the faults that affected it, except delay and jitter.  The description is "" for
            a clock step after the first one.
    """

    message: T
    at_ns: int
    late_ns: int = 0
    data: bytes | None = None
    lost: bool = False
    disconnect: bool = False
    done: tuple[tuple[str, str], ...] = ()

    @property
    def reportable(self) -> dict[str, str]:
        """The faults of ``done`` to report: those with a description."""
        return {name: words for name, words in self.done if words}


class FaultLine(Generic[T]):
    """One direction of one connection, or of a replay.

    Time never decreases: an earlier time than the last one is replaced by the last one.

    Args:
        faults: the faults to apply.
        seed: seed of the fault injection.
        name: name of the line; lines with different names have different random numbers.
        moved: returns the bytes of a message with its stamps shifted by a number of ns, for ``clock-step``.
        most_bytes: maximum number of stored bytes.
    """

    def __init__(
        self,
        faults: Faults,
        seed: int,
        name: str,
        moved: Callable[[bytes, int], bytes],
        most_bytes: int = MAX_HELD_BYTES,
    ) -> None:
        self._faults = faults
        self._key = f"{seed}/{name}"
        self._moved = moved
        self._most_bytes = most_bytes
        self._number = 0
        self._first_ns: int | None = None
        self._now_ns = 0
        self._last_ns = 0  # send time of the last message; later messages leave at this time or after it
        self._waiting: deque[tuple[Fate[T], int]] = deque()  # with their sizes in bytes, in the order of sending
        self._overtaken: tuple[Fate[T], int] | None = None  # is sent after the next one
        self._held_bytes = 0
        self._stepped = False

    @property
    def due_ns(self) -> int | None:
        """Send time of the next message if no others arrive, ns; None if none waits."""
        moments = [self._waiting[0][0].at_ns] if self._waiting else []
        if self._overtaken:
            moments.append(self._overtaken[0].at_ns + OVERTAKEN_WITHIN_NS)
        return min(moments, default=None)

    def take(self, now_ns: int, message: T, data: bytes) -> list[Fate[T]]:
        """Add a message; return the messages that are sent or lost up to ``now_ns``."""
        left = self.due(now_ns)
        now_ns = self._now_ns
        self._number += 1
        self._first_ns = now_ns if self._first_ns is None else self._first_ns
        if self._is_hit(LOSS, self._faults.loss):
            return [*left, Fate(message, now_ns, lost=True, done=((LOSS, f"{counted(len(data), 'byte')} not sent"),))]
        fate = self._apply_faults(message, data, now_ns)
        self._last_ns = fate.at_ns
        held = (fate, len(data))
        self._held_bytes += len(data)
        if self._overtaken:
            (behind, size), self._overtaken = self._overtaken, None
            words = (REORDER, "sent after the next message")
            self._waiting += (held, (self._at(behind, fate.at_ns, words), size))
        elif not fate.disconnect and self._is_hit(REORDER, self._faults.reorder):
            self._overtaken = held
        else:
            self._waiting.append(held)
        left += self.due(now_ns)
        while self._waiting and self._held_bytes > self._most_bytes:
            words = (EARLY, f"more than {counted(self._most_bytes, 'byte')} were stored")
            left.append(self._at(self._release(), now_ns, words))
        return left

    def due(self, now_ns: int) -> list[Fate[T]]:
        """Return the messages that are sent up to ``now_ns``."""
        self._now_ns = now_ns = max(now_ns, self._now_ns)
        if self._overtaken and self._overtaken[0].at_ns + OVERTAKEN_WITHIN_NS <= now_ns:
            self._release_held()
        left = []
        while self._waiting and self._waiting[0][0].at_ns <= now_ns:
            left.append(self._release())
        return left

    def drain(self) -> list[Fate[T]]:
        """Return all remaining messages, each with its send time, when no more messages arrive."""
        if self._overtaken:
            self._release_held()
        return [self._release() for _ in range(len(self._waiting))]

    def _release(self) -> Fate[T]:
        fate, size = self._waiting.popleft()
        self._held_bytes -= size
        return fate

    def _release_held(self) -> None:
        assert self._overtaken
        (fate, size), self._overtaken = self._overtaken, None
        self._waiting.append((self._at(fate, fate.at_ns + OVERTAKEN_WITHIN_NS), size))
        self._last_ns = self._waiting[-1][0].at_ns

    @staticmethod
    def _at(fate: Fate[T], at_ns: int, *done: tuple[str, str]) -> Fate[T]:
        return replace(fate, at_ns=at_ns, late_ns=fate.late_ns + at_ns - fate.at_ns, done=(*fate.done, *done))

    def _apply_faults(self, message: T, data: bytes, now_ns: int) -> Fate[T]:
        """Return the fate of a message: changed bytes and send time."""
        faults, done, new = self._faults, [], data
        if faults.clock_step_ns and now_ns - (self._first_ns or 0) >= faults.clock_step_at_ns:
            stepped = self._moved(data, faults.clock_step_ns)
            if stepped != data:
                new = stepped
                step_s = faults.clock_step_ns / NS_PER_S
                done.append((CLOCK_STEP, "" if self._stepped else f"stamps are shifted by {step_s:+g} s from here on"))
                self._stepped = True
        # the size of the body, before the CRC, remains valid: with a wrong size all later messages would be lost
        if self._is_hit(CORRUPT, faults.corrupt) and len(new) > CRC_AT:
            at, bit = divmod(int(self._chance("bit") * 8 * (len(new) - CRC_AT)), 8)
            at += CRC_AT
            new = b"".join((new[:at], bytes((new[at] ^ 1 << bit,)), new[at + 1 :]))
            done.append((CORRUPT, f"bit {bit} of byte {at} flipped"))
        disconnect = self._is_hit(DISCONNECT, faults.disconnect)
        if self._is_hit(TRUNCATE, faults.truncate) and len(new) > 1:
            cut = 1 + int(self._chance("cut") * (len(new) - 1))
            done.append((TRUNCATE, f"truncated after byte {cut} of {len(new)}, connection closed"))
            new, disconnect = new[:cut], True
        elif disconnect:
            done.append((DISCONNECT, "connection closed after it"))
        late_ns = faults.delay_ns
        if faults.jitter_ns:
            late_ns += int(self._chance(JITTER) * faults.jitter_ns)
        at_ns = max(now_ns + late_ns, self._last_ns)
        return Fate(message, at_ns, at_ns - now_ns, None if new is data else new, False, disconnect, tuple(done))

    def _is_hit(self, fault: str, share: float) -> bool:
        return share > 0 and self._chance(fault) < share

    def _chance(self, of: str) -> float:
        """Return a number x, 0 ≤ x < 1, that depends only on seed, line, number of the message and purpose."""
        digest = blake2b(f"{self._key}/{self._number}/{of}".encode(), digest_size=8).digest()
        return (int.from_bytes(digest, "big") >> 11) * 2.0**-53
