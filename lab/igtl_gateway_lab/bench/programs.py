"""The programs on both sides of the gateway: a ROS 2 node or an OpenIGTLink client; each can send, receive, or both.

Commands are lines on standard input, events are JSON lines on standard output; times are written into a file.
The commands, in this sequence:

* ``knock``: send message 0 of every stream again and again, until each receiver has sent the event ``heard``;
* ``begin``: send, then report ``sent``;
* ``count``: report the number of received messages;
* ``stall``, ``resume``: of OpenIGTLink clients, read nothing meanwhile;
* the end of the input: write the times and end.
"""

from __future__ import annotations

import json
import os
import socket
import sys
import threading
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from igtl_gateway.buffers import Buffer
from igtl_gateway.clock import SystemClock
from igtl_gateway.edges.ros.env import prepare_environment
from igtl_gateway.stamp import NS_PER_S
from igtl_gateway.wire import decode
from igtl_gateway_lab.bench.cases import payload
from igtl_gateway_lab.bench.cutter import Arrivals, Cutter
from igtl_gateway_lab.bench.jobs import Job, JobStream
from igtl_gateway_lab.bench.pace import Schedule, Send, SendPacer
from igtl_gateway_lab.bench.payloads import Form
from igtl_gateway_lab.bench.ros_side import RosTransport
from igtl_gateway_lab.bench.window import SendWindow, progress

_KNOCK_S = 0.1
#: Knocks of large messages must not become a queue: slower than that no gateway is.
_KNOCK_BYTES_PER_S = 5 << 20
_FOUND_S = 60.0
_BEGIN_NS = 50_000_000
_SOCKET_BYTES = 4 << 20


class BenchTransport(Protocol):
    """A connection to the world."""

    def open(self) -> None:
        """Connect, and be there for who looks for us."""

    def wait_for_peers(self) -> None:
        """Wait for the others."""

    def sender(self, part: JobStream) -> Send:
        """Sends messages by their numbers; returns the time just before each."""

    def close(self) -> None:
        """Leave."""


class IgtlTransport:
    """Blocking sockets: one for each client that we are."""

    def __init__(self, job: Job, heard: dict[str, Arrivals]) -> None:
        self._job = job
        self._now = SystemClock().monotonic_ns
        clients: dict[int, dict[bytes, tuple[Form, Arrivals]]] = {}
        for part in job.hears:
            readers = clients.setdefault(part.client, {})
            readers[part.device.encode().ljust(20, b"\0")] = (payload(part.stream.kind).forms[1], heard[part.key])
        self._clients = list(clients.values()) or [{}]
        self._sockets: list[socket.socket] = []
        self._threads: list[threading.Thread] = []
        #: Cleared, nothing is read.
        self.reading = threading.Event()
        self.reading.set()

    def open(self) -> None:
        for readers in self._clients:
            link = self._connection()
            link.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            link.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _SOCKET_BYTES)
            thread = threading.Thread(
                target=self._read, args=(link, Cutter(readers)), name="igtl-bench-reader", daemon=True
            )
            self._sockets.append(link)
            self._threads.append(thread)
            thread.start()

    def _connection(self) -> socket.socket:
        if not self._job.listen:
            return socket.create_connection(self._job.address)
        with socket.create_server(self._job.address) as server:
            host, port = server.getsockname()
            print_event({"event": "listening", "host": host, "port": port})
            return server.accept()[0]

    def wait_for_peers(self) -> None:
        """A connection is all."""

    def sender(self, part: JobStream) -> Send:
        kind, sendall, now = payload(part.stream.kind), self._sockets[0].sendall, self._now
        make, (most, batch) = kind.igtl_maker(part.device), kind.igtl_batch(part.device)

        def send(first: int, count: int) -> list[int]:
            times = []
            while count:
                many = min(count, most)
                messages = make(first) if many == 1 else batch(first, many)
                times += [now()] * many
                sendall(messages)
                first, count = first + many, count - many
            return times

        return send

    def wait(self, timeout_s: float) -> None:
        """Until the other end has closed."""
        for thread in self._threads:
            thread.join(timeout_s)

    def close(self) -> None:
        self.reading.set()
        for link in self._sockets:
            try:
                link.shutdown(socket.SHUT_RDWR)
            except OSError:
                pass  # the gateway has closed the connection before
        self.wait(_FOUND_S)
        for link in self._sockets:
            link.close()

    def _read(self, source: socket.socket, cutter: Cutter) -> None:
        """Until the end of the connection."""
        now, reading = self._now, self.reading
        while got := _received(source, cutter.room()):
            cutter.take(got, now())
            reading.wait()


def run(job: Job) -> None:
    """A program from beginning to end."""
    prepare_environment()
    heard = {part.key: Arrivals(_first_of(part, job.side), progress(part.progress)) for part in job.hears}
    side = _side(job, heard)
    side.open()
    orders = _StdinCommands(heard, side)
    try:
        side.wait_for_peers()
        print_event({"event": "ready"})
        sent = _send(job, side, orders)
        orders.ended.wait()
    finally:
        side.close()
    columns = {}
    for part, times in zip(job.sends, sent, strict=True):
        columns[f"sent {part.device}"] = np.array(times, np.int64)
    for key, arrivals in heard.items():
        columns[f"numbers {key}"] = np.frombuffer(arrivals.numbers, np.int64)
        columns[f"received {key}"] = np.frombuffer(arrivals.times, np.int64)
    with Path(job.times).open("wb") as file:
        np.savez(file, allow_pickle=False, **columns)
    print_event({"event": "written"})


def _side(job: Job, heard: dict[str, Arrivals]) -> BenchTransport:
    match job.side:
        case "ros":
            return RosTransport(job, heard)
        case "pyigtl":
            from igtl_gateway_lab.bench.pyigtl_side import PyigtlTransport

            return PyigtlTransport(job, heard)
        case _:
            return IgtlTransport(job, heard)


class _StdinCommands:
    """The commands on standard input."""

    def __init__(self, heard: dict[str, Arrivals], side: BenchTransport) -> None:
        self.knocking, self.begun, self.ended = threading.Event(), threading.Event(), threading.Event()
        self._heard = heard
        self._side = side
        self.pace: SendPacer | None = None
        threading.Thread(target=self._read_commands, name="igtl-bench-orders", daemon=True).start()

    def _read_commands(self) -> None:
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
                    case b"stall" | b"resume" if isinstance(self._side, IgtlTransport):
                        (self._side.reading.clear if line == b"stall" else self._side.reading.set)()
                    case b"count":
                        print_event({"event": "count", "messages": sum(len(one.times) for one in self._heard.values())})
        self.ended.set()
        self.begun.set()
        self.knocking.set()
        if self.pace:
            self.pace.stop()


def _send(job: Job, side: BenchTransport, orders: _StdinCommands) -> list[list[int]]:
    """Knock, then send; when each message was sent."""
    senders = [side.sender(part) for part in job.sends]
    size = sum(payload(part.stream.kind).size for part in job.sends)
    orders.knocking.wait()
    while not orders.begun.is_set():
        for send in senders:
            send(0, 1)
        orders.begun.wait(max(_KNOCK_S, size / _KNOCK_BYTES_PER_S))
    clock = SystemClock()
    pace = orders.pace = SendPacer(clock)
    if orders.ended.is_set():
        pace.stop()
    begin_ns = clock.monotonic_ns() + _BEGIN_NS
    schedules = [
        Schedule(
            send,
            part.stream.rate_hz,
            part.count,
            SendWindow(progress(part.progress), part.window, clock) if part.window else None,
        )
        for part, send in zip(job.sends, senders, strict=True)
    ]
    sent = pace.run(schedules, begin_ns, begin_ns + round(job.seconds * NS_PER_S))
    if job.sends:
        print_event({"event": "sent", "messages": sum(map(len, sent))})
    return sent


def _first_of(part: JobStream, side: str) -> Callable[[Buffer], None]:
    """Return what is done at the first message: check it, and report it to the runner, which waits for it."""

    def first(message: Buffer) -> None:
        if side == "igtl":
            content = decode(message).content  # raises if the CRC is wrong
            print_event({"event": "heard", "key": part.key, "as": type(content).__name__, "bytes": len(message)})
        else:
            print_event({"event": "heard", "key": part.key, "as": part.topic, "bytes": len(message)})

    return first


def _received(source: socket.socket, view: memoryview) -> int:
    try:
        return source.recv_into(view)
    except OSError:
        return 0  # closed under us, by ``close``


def print_event(event: dict[str, Any]) -> None:
    """Write an event for the program that started this one."""
    sys.stdout.write(json.dumps(event) + "\n")
    sys.stdout.flush()


def main(arguments: Sequence[str]) -> int:
    """``python -m igtl_gateway_lab.bench JOB``."""
    run(Job.from_json(arguments[0]))
    return 0
