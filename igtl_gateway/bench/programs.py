"""The programs on both sides of the gateway: a ROS 2 node or an OpenIGTLink client; each may send, hear, or both.

Orders come as lines on standard input, events go as JSON lines to standard output; times are written into a file.
The orders, in this sequence:

* ``knock``: send message 0 of every stream again and again, until all who are to hear it have told ``heard``;
* ``begin``: send, then tell ``sent``;
* ``count``: tell how many messages were heard;
* the end of the input: write the times and end.
"""

from __future__ import annotations

import json
import os
import socket
import sys
import threading
from array import array
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Protocol, Self

import numpy as np

from igtl_gateway.bench.cases import Direction, Stream, payload
from igtl_gateway.bench.pace import Pace, Schedule
from igtl_gateway.buffers import Buffer
from igtl_gateway.clock import SystemClock
from igtl_gateway.edges.ros import RosEdge
from igtl_gateway.edges.ros_env import prepare_environment
from igtl_gateway.errors import GatewayError
from igtl_gateway.qos import Qos
from igtl_gateway.session.note import Note
from igtl_gateway.stamp import NS_PER_S
from igtl_gateway.wire import HEADER_SIZE, decode

_KNOCK_S = 0.1
#: Knocks of large messages must not become a queue: slower than that no gateway is.
_KNOCK_BYTES_PER_S = 5 << 20
_FOUND_S = 60.0
_BEGIN_NS = 50_000_000
#: Enough for a reader that lags by a second at 1 kHz; large messages, which would cost memory, are not kept as long.
_DEPTH_BYTES, _DEPTH_MOST, _DEPTH_LEAST = 256 << 20, 20_000, 5
_BUFFER_BYTES = 1 << 20
_SOCKET_BYTES = 4 << 20


@dataclass(frozen=True, slots=True)
class Part:
    """A stream that a program sends or hears.

    Attributes:
        stream: which.
        direction: which way it goes through the gateway; without a gateway, whose bytes it is.
        topic: where, in ROS.
        count: messages to send; 0: for ``seconds``.
    """

    stream: Stream
    direction: Direction
    topic: str
    count: int = 0

    @property
    def device(self) -> str:
        return self.stream.device(self.direction)


@dataclass(frozen=True, slots=True)
class Job:
    """What a program is to do.

    Attributes:
        side: ``"ros"`` or ``"igtl"``, or a peer on the side of OpenIGTLink, see ``peers``.
        name: of the node.
        sends, hears: streams.
        seconds: how long to send what has no count.
        times: file to write times into.
        address: of the gateway, for OpenIGTLink.
        listen: be a server there instead.
    """

    side: str
    name: str
    sends: tuple[Part, ...]
    hears: tuple[Part, ...]
    seconds: float
    times: str
    address: tuple[str, int] = ("127.0.0.1", 0)
    listen: bool = False

    def to_json(self) -> str:
        return json.dumps(asdict(self), default=lambda value: value.value)

    @classmethod
    def from_json(cls, text: str) -> Self:
        values = json.loads(text)
        for name in ("sends", "hears"):
            values[name] = tuple(
                Part(Stream(**part.pop("stream")), Direction(part.pop("direction")), **part) for part in values[name]
            )
        values["address"] = tuple(values["address"])
        return cls(**values)


class Heard:
    """Arrivals of one stream: sequence numbers and times."""

    def __init__(self, first: Callable[[Buffer], None]) -> None:
        self.numbers = array("q")
        self.times = array("q")
        self._first: Callable[[Buffer], None] | None = first

    def take(self, number: int, at_ns: int, message: Buffer) -> None:
        if number:
            self.numbers.append(number)
            self.times.append(at_ns)
        elif self._first:
            self._first(message)
            self._first = None


class Side(Protocol):
    """A connection to the world."""

    def open(self) -> None:
        """Connect, and be there for who looks for us."""

    def found(self) -> None:
        """Wait for the others."""

    def sender(self, part: Part) -> Callable[[int], int]:
        """Sends a message by its number; returns the time just before."""

    def close(self) -> None:
        """Leave."""


class RosSide:
    """A node."""

    def __init__(self, job: Job, heard: dict[str, Heard]) -> None:
        self._job = job
        self._now = SystemClock().monotonic_ns
        self._numbers = {part.topic: payload(part.stream.kind).ros_number for part in job.hears}
        self._heard = {part.topic: heard[part.device] for part in job.hears}
        self._edge = RosEdge(node_name=job.name, on_message=self._on_message, wants=lambda *_: None, on_note=_no_note)

    def open(self) -> None:
        self._edge.start()
        for part in self._job.hears:
            kind = payload(part.stream.kind)
            self._edge.subscribe(part.topic, kind.ros_type, Qos(queue_depth(kind.size)))
        for part in self._job.sends:
            kind = payload(part.stream.kind)
            self._edge.advertise(part.topic, kind.ros_type, Qos(queue_depth(kind.size)))

    def found(self) -> None:
        for part in self._job.sends:
            if not self._edge.wait_for_subscribers(part.topic, 1, _FOUND_S):
                raise GatewayError(f"{part.topic}: nobody subscribed within {_FOUND_S:g} s")
        self._edge.wait_ready(_FOUND_S)

    def sender(self, part: Part) -> Callable[[int], int]:
        kind, publish, now, topic = payload(part.stream.kind), self._edge.publish, self._now, part.topic
        make, type_name, qos = kind.ros_maker(), kind.ros_type, Qos(queue_depth(kind.size))

        def send(number: int) -> int:
            message = make(number)
            at_ns = now()
            publish(topic, type_name, message, qos)
            return at_ns

        return send

    def close(self) -> None:
        self._edge.stop()

    def _on_message(self, topic: str, _type: str, cdr: bytes, _source_ns: int) -> None:
        at_ns = self._now()
        self._heard[topic].take(self._numbers[topic](cdr), at_ns, cdr)


class IgtlSide:
    """A blocking socket."""

    def __init__(self, job: Job, heard: dict[str, Heard]) -> None:
        self._job = job
        self._now = SystemClock().monotonic_ns
        self._readers = {
            part.device.encode().ljust(20, b"\0"): (payload(part.stream.kind).igtl_number, heard[part.device])
            for part in job.hears
        }
        self._socket: socket.socket | None = None
        self._reader: threading.Thread | None = None

    def open(self) -> None:
        if self._job.listen:
            with socket.create_server(self._job.address) as server:
                host, port = server.getsockname()
                tell({"event": "listening", "host": host, "port": port})
                self._socket, _ = server.accept()
        else:
            self._socket = socket.create_connection(self._job.address)
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _SOCKET_BYTES)
        self._reader = threading.Thread(target=self._read, args=(self._socket,), name="igtl-bench-reader", daemon=True)
        self._reader.start()

    def found(self) -> None:
        """A connection is all."""

    def sender(self, part: Part) -> Callable[[int], int]:
        assert self._socket
        make, sendall, now = payload(part.stream.kind).igtl_maker(part.device), self._socket.sendall, self._now

        def send(number: int) -> int:
            message = make(number)
            at_ns = now()
            sendall(message)
            return at_ns

        return send

    def wait(self, timeout_s: float) -> None:
        """Until the other end has closed."""
        assert self._reader
        self._reader.join(timeout_s)

    def close(self) -> None:
        assert self._socket and self._reader
        try:
            self._socket.shutdown(socket.SHUT_RDWR)
        except OSError:
            pass  # the gateway has gone before
        self._reader.join()
        self._socket.close()

    def _read(self, source: socket.socket) -> None:
        """Until the end of the connection.  A message has arrived when its last byte has."""
        buffer = bytearray(_BUFFER_BYTES)
        view = memoryview(buffer)
        filled = 0
        while got := _received(source, view[filled:]):
            at_ns = self._now()
            filled += got
            begin = 0
            while filled - begin >= HEADER_SIZE:
                size = HEADER_SIZE + int.from_bytes(view[begin + 42 : begin + 50], "big")
                if size > filled - begin:
                    if size > len(buffer):
                        view = memoryview(bytearray(size))
                        view[: filled - begin] = buffer[begin:filled]
                        buffer, filled, begin = view.obj, filled - begin, 0  # type: ignore[assignment]  # a bytearray
                    break
                reader = self._readers.get(bytes(view[begin + 14 : begin + 34]))
                if reader:
                    number, heard = reader
                    message = view[begin : begin + size]
                    heard.take(number(message), at_ns, message)
                begin += size
            if begin:
                view[: filled - begin] = bytes(view[begin:filled])
                filled -= begin


def run(job: Job) -> None:
    """A program from beginning to end."""
    prepare_environment()
    heard = {part.device: Heard(_first_of(part, job.side)) for part in job.hears}
    side = _side(job, heard)
    side.open()
    orders = _Orders(heard)
    try:
        side.found()
        tell({"event": "ready"})
        sent = _send(job, side, orders)
        orders.ended.wait()
    finally:
        side.close()
    columns = {}
    for part, times in zip(job.sends, sent, strict=True):
        columns[f"sent {part.device}"] = np.array(times, np.int64)
    for device, arrivals in heard.items():
        columns[f"numbers {device}"] = np.frombuffer(arrivals.numbers, np.int64)
        columns[f"received {device}"] = np.frombuffer(arrivals.times, np.int64)
    with Path(job.times).open("wb") as file:
        np.savez(file, allow_pickle=False, **columns)
    tell({"event": "written"})


def _side(job: Job, heard: dict[str, Heard]) -> Side:
    match job.side:
        case "ros":
            return RosSide(job, heard)
        case "pyigtl":
            from igtl_gateway.bench.pyigtl_side import PyigtlSide

            return PyigtlSide(job, heard)
        case _:
            return IgtlSide(job, heard)


class _Orders:
    """What standard input says."""

    def __init__(self, heard: dict[str, Heard]) -> None:
        self.knocking, self.begun, self.ended = threading.Event(), threading.Event(), threading.Event()
        self._heard = heard
        self.pace: Pace | None = None
        threading.Thread(target=self._obey, name="igtl-bench-orders", daemon=True).start()

    def _obey(self) -> None:
        # not sys.stdin: a thread that waits there holds a lock that the end of the program needs
        rest = b""
        while data := os.read(0, 1 << 10):
            *lines, rest = (rest + data).split(b"\n")
            for line in lines:
                match line:
                    case b"knock":
                        self.knocking.set()
                    case b"begin":
                        self.begun.set()
                    case b"count":
                        tell({"event": "count", "messages": sum(len(one.times) for one in self._heard.values())})
        self.ended.set()
        self.begun.set()
        self.knocking.set()
        if self.pace:
            self.pace.stop()


def _send(job: Job, side: Side, orders: _Orders) -> list[list[int]]:
    """Knock, then send; when each message was sent."""
    senders = [side.sender(part) for part in job.sends]
    size = sum(payload(part.stream.kind).size for part in job.sends)
    orders.knocking.wait()
    while not orders.begun.is_set():
        for send in senders:
            send(0)
        orders.begun.wait(max(_KNOCK_S, size / _KNOCK_BYTES_PER_S))
    clock = SystemClock()
    pace = orders.pace = Pace(clock)
    if orders.ended.is_set():
        pace.stop()
    begin_ns = clock.monotonic_ns() + _BEGIN_NS
    schedules = [Schedule(send, part.stream.rate_hz, part.count) for part, send in zip(job.sends, senders, strict=True)]
    sent = pace.run(schedules, begin_ns, begin_ns + round(job.seconds * NS_PER_S))
    if job.sends:
        tell({"event": "sent", "messages": sum(map(len, sent))})
    return sent


def _first_of(part: Part, side: str) -> Callable[[Buffer], None]:
    """What is done at the first message: it has to be a good one, and somebody waits for it."""

    def first(message: Buffer) -> None:
        if side == "igtl":
            content = decode(message).content  # raises if the CRC is wrong
            tell({"event": "heard", "device": part.device, "as": type(content).__name__, "bytes": len(message)})
        else:
            tell({"event": "heard", "device": part.device, "as": part.topic, "bytes": len(message)})

    return first


def _received(source: socket.socket, view: memoryview) -> int:
    try:
        return source.recv_into(view)
    except OSError:
        return 0  # closed under us, by ``close``


def queue_depth(size: int) -> int:
    """Deep enough that a flood of small messages is not cut off by the program that measures it."""
    return max(_DEPTH_LEAST, min(_DEPTH_MOST, _DEPTH_BYTES // size))


def _no_note(_note: Note) -> None:
    """What a node has to say is no part of a measurement."""


def tell(event: dict[str, Any]) -> None:
    """One line to whoever started us."""
    sys.stdout.write(json.dumps(event) + "\n")
    sys.stdout.flush()


def main(arguments: Sequence[str]) -> int:
    """``python -m igtl_gateway.bench JOB``."""
    run(Job.from_json(arguments[0]))
    return 0
