"""The frames between the coordinator and the library in a program; ``preload/_preload.c`` has the same table.

A frame is its size (uint32, of what follows), a letter, and its fields without padding in the order of the machine.
Times are session time in UTC ns.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Final

#: Of the interface between both sides; the library states it in its hello.
ABI_VERSION = 3
#: Later than everything.
NEVER: Final = (1 << 63) - 1
#: Classes of events of one time, in their order: recorded inputs, messages of programs, timers and timeouts.  With
#: swapped ties, the first and the last one change places.
INPUT, MESSAGE, DEADLINE, ALL = 0, 1, 2, 9

_HEAD = struct.Struct("=IB")
_ENTITY = struct.Struct("=cBIBBBI")
_IDLE = struct.Struct("=qqBQqq")
_WELCOME = struct.Struct("=qqqIBB")
_MESSAGE = struct.Struct("=QqqIBH")
_OUTPUT = struct.Struct("=Iq")
_REQUEST = struct.Struct("=Iqq")
_RESPONSE = struct.Struct("=IIIqq")
_TO_SERVICE = struct.Struct("=qIIIq")
_TO_CLIENT = struct.Struct("=qIq")
_ROUTED = struct.Struct("=IB")
_RUN = struct.Struct("=qB")
_TIME = struct.Struct("=q")
_HELLO = struct.Struct("=II")
_LOST = struct.Struct("=IqQ")
_SIZE = struct.Struct("=H")


@dataclass(frozen=True, slots=True)
class EntityFrame:
    """A subscription (``s``), publisher (``p``), service (``v``) or client (``c``) that was made, or is gone."""

    kind: str
    is_made: bool
    number: int
    reliable: bool
    latched: bool
    keeps_all: bool
    depth: int
    name: str
    type: str
    node: str
    definition: str

    @property
    def is_ros(self) -> bool:
        """Whether it is of ROS; names of OpenIGTLink streams do not begin with a slash."""
        return self.name.startswith("/")


@dataclass(frozen=True, slots=True)
class Published:
    """A message that a publisher sent."""

    publisher: int
    time_ns: int
    data: bytes


@dataclass(frozen=True, slots=True)
class Request:
    """A request of a client."""

    client: int
    number: int
    time_ns: int
    data: bytes


@dataclass(frozen=True, slots=True)
class Response:
    """A response of a service to the client of a program."""

    service: int
    program: int
    client: int
    number: int
    time_ns: int
    data: bytes


@dataclass(frozen=True, slots=True)
class Remark:
    """Something that the coordinator has to know.

    ``s``: the program has a socket of its own; ``t``: it sets a timer of the system; ``w``: a thread, ``h``: another
    process waits in real time; ``c``: another process computes, ``z``: sleeps, for which the program waits; ``l``: a
    thread sleeps at the end of the session, and for long.
    """

    code: str
    text: str


@dataclass(frozen=True, slots=True)
class Lost:
    """Messages that the full queue of a subscription, service or client has dropped, and the time of the first one."""

    entity: int
    time_ns: int
    count: int


@dataclass(frozen=True, slots=True)
class Progress:
    """The time of a program that computes, or that ends."""

    time_ns: int


@dataclass(frozen=True, slots=True)
class Idle:
    """The program waits.

    Attributes:
        time_ns: its session time.
        next_ns, next_class: its next event of its own; ``NEVER`` without one.
        number: of the last recorded input that was delivered.
        callback_ns: until when a callback sleeps that no thread spins beside, or that messages wait for; 0 for none.
        thread_ns: until when another thread sleeps, of all but the main one; 0 for none.
    """

    time_ns: int
    next_ns: int
    next_class: int
    number: int
    callback_ns: int = 0
    thread_ns: int = 0


@dataclass(frozen=True, slots=True)
class Hello:
    """The first frame of a process."""

    pid: int
    abi: int


@dataclass(frozen=True, slots=True)
class Incoming:
    """A message for a program."""

    number: int
    time_ns: int
    class_: int
    data: bytes


@dataclass(frozen=True, slots=True)
class RunTo:
    """Up to which time and class a program may go on."""

    time_ns: int
    class_: int


@dataclass(frozen=True, slots=True)
class Dropped:
    """The messages that are not delivered are withdrawn."""


@dataclass(frozen=True, slots=True)
class Ended:
    """The session is over."""


FromProgram = EntityFrame | Published | Request | Response | Remark | Lost | Progress | Idle | Hello


def parse(frame: bytes) -> FromProgram:
    """Return a frame of a program, without its size.  Raises ValueError or struct.error for what is not a frame."""
    match frame[:1]:
        case b"O":
            publisher, time_ns = _OUTPUT.unpack_from(frame, 1)
            return Published(publisher, time_ns, frame[13:])
        case b"I":
            return Idle(*_IDLE.unpack_from(frame, 1))
        case b"E":
            kind, made, number, reliable, latched, keeps_all, depth = _ENTITY.unpack_from(frame, 1)
            fields: list[Any] = [kind.decode(), bool(made), number]
            fields += bool(reliable), bool(latched), bool(keeps_all), depth
            at = 1 + _ENTITY.size
            for _ in range(3):
                (size,) = _SIZE.unpack_from(frame, at)
                fields.append(frame[at + 2 : at + 2 + size].decode("utf-8", "replace"))
                at += 2 + size
            fields.append(frame[at:].decode("utf-8", "replace").replace("\0", ""))
            return EntityFrame(*fields)
        case b"Q":
            return Request(*(*_REQUEST.unpack_from(frame, 1), frame[1 + _REQUEST.size :]))
        case b"A":
            return Response(*(*_RESPONSE.unpack_from(frame, 1), frame[1 + _RESPONSE.size :]))
        case b"X":
            return Remark(frame[1:2].decode("ascii", "replace"), frame[4:].decode("utf-8", "replace"))
        case b"V":
            return Lost(*_LOST.unpack_from(frame, 1))
        case b"P":
            return Progress(*_TIME.unpack_from(frame, 1))
        case b"H":
            return Hello(*_HELLO.unpack_from(frame, 1))
        case letter:
            raise ValueError(f"found frame {letter!r}, expected one of E, O, Q, A, X, V, P, I, H")


def split(data: bytes) -> Iterator[Incoming | RunTo | Dropped | Ended]:
    """Yield the frames for a program that a peer without ROS takes; it has no use for the others."""
    at = 0
    while at < len(data):
        size, letter = _HEAD.unpack_from(data, at)
        begin, end_ = at + _HEAD.size, at + 4 + size
        match bytes((letter,)):
            case b"M":
                number, time_ns, _, _, class_, length = _MESSAGE.unpack_from(data, begin)
                yield Incoming(number, time_ns, class_, data[begin + _MESSAGE.size + length : end_])
            case b"R":
                yield RunTo(*_RUN.unpack_from(data, begin))
            case b"D":
                yield Dropped()
            case b"Z":
                yield Ended()
        at = end_


def _frame(letter: bytes, *parts: bytes) -> bytes:
    body = b"".join(parts)
    return _HEAD.pack(1 + len(body), letter[0]) + body


def _text(text: str) -> bytes:
    raw = text.encode()
    return _SIZE.pack(len(raw)) + raw


def welcome(
    start_ns: int, latency_ns: int, wall_offset_ns: int, program: int, *, is_real: bool, deadline_class: int
) -> bytes:
    """The answer to a hello; ``wall_offset_ns``: the wall clock minus session time; or the clocks are the real ones."""
    return _frame(b"W", _WELCOME.pack(start_ns, latency_ns, wall_offset_ns, program, is_real, deadline_class))


def message(number: int, time_ns: int, source_ns: int, target: int, class_: int, topic: bytes, data: bytes) -> bytes:
    """A message; ``target``: a subscription, 0 for all of the topic."""
    size = 1 + _MESSAGE.size + len(topic) + len(data)
    head = _MESSAGE.pack(number, time_ns, source_ns, target, class_, len(topic))
    return b"".join((_HEAD.pack(size, 77), head, topic, data))


def to_service(time_ns: int, service: int, program: int, client: int, number: int, data: bytes) -> bytes:
    return _frame(b"q", _TO_SERVICE.pack(time_ns, service, program, client, number), data)


def to_client(time_ns: int, client: int, number: int, data: bytes) -> bytes:
    return _frame(b"a", _TO_CLIENT.pack(time_ns, client, number), data)


def routed(publisher: int, is_routed: bool) -> bytes:
    """Whether another program receives what a publisher sends: then the program stops behind it."""
    return _frame(b"T", _ROUTED.pack(publisher, 1 if is_routed else 2))


def elsewhere(kind: str, is_made: bool, name: str, type_: str) -> bytes:
    """An entity of the recording, or of another program."""
    return _frame(b"N", kind.encode(), b"\1" if is_made else b"\0", _text(name), _text(type_))


def drop() -> bytes:
    return _frame(b"D")


def run_to(time_ns: int, class_: int) -> bytes:
    """Let the program run, up to the events of this time and class."""
    return _frame(b"R", _RUN.pack(time_ns, class_))


def look(time_ns: int) -> bytes:
    """It is this time; have the program report when all its threads wait."""
    return _frame(b"L", _TIME.pack(time_ns))


def end() -> bytes:
    return _frame(b"Z")
