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

from igtl_gateway.base.buffers import Buffer
from igtl_gateway.base.clock import SystemClock
from igtl_gateway.base.stamp import NS_PER_S
from igtl_gateway.edges.ros.env import prepare_environment
from igtl_gateway.wire import decode
from igtl_gateway_lab.bench.cases import payload
from igtl_gateway_lab.bench.cutter import Arrivals, Cutter
from igtl_gateway_lab.bench.figures import Times
from igtl_gateway_lab.bench.jobs import Job, JobStream
from igtl_gateway_lab.bench.native import SOCKET_BYTES, NativeIgtlSide, NativeRosSide, connect
from igtl_gateway_lab.bench.pace import Schedule, Send, SendPacer
from igtl_gateway_lab.bench.payloads import Form
from igtl_gateway_lab.bench.ros_side import RosTransport
from igtl_gateway_lab.bench.window import SendWindow, progress

_KNOCK_S = 0.1
_FIRST_LOOK_S = 0.01
#: Knocks of large messages must not become a queue: slower than that no gateway is.
_KNOCK_BYTES_PER_S = 5 << 20
_FOUND_S = 60.0
_BEGIN_NS = 50_000_000


class BenchTransport(Protocol):
    """A connection to the world, used from Python."""

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
            link.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, SOCKET_BYTES)
            thread = threading.Thread(
                target=self._read, args=(link, Cutter(readers)), name="igtl-bench-reader", daemon=True
            )
            self._sockets.append(link)
            self._threads.append(thread)
            thread.start()

    def _connection(self) -> socket.socket:
        if not self._job.listen:
            return connect(self._job.address)
        with socket.create_server(self._job.address) as server:
            host, port = server.getsockname()
            _print_listening(host, port)
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


class BenchSide(Protocol):
    """What a program does; its loops are native or in Python."""

    def open(self) -> None:
        """Connect, and be there for who looks for us."""

    def wait_for_peers(self) -> None:
        """Wait for the others."""

    def knock(self) -> None:
        """Send message 0 of every stream."""

    def send(self, begin_ns: int, until_ns: int) -> Sequence[Sequence[int] | Times]:
        """Send everything; for each stream when its messages were sent."""

    def stop_sending(self) -> None:
        """End ``send``, from another thread."""

    def stall(self, stopped: bool) -> None:
        """Read nothing, or read again."""

    def count(self) -> int:
        """How many messages have arrived."""

    def close(self) -> None:
        """Leave."""

    def columns(self) -> dict[str, Times]:
        """Numbers and times of what has arrived, after ``close``."""


class PythonSide:
    """The loops in Python, around a transport."""

    def __init__(self, job: Job) -> None:
        self._job = job
        self._heard = {part.key: Arrivals(_first_of(part, job.side), progress(part.progress)) for part in job.hears}
        self._transport = _transport(job, self._heard)
        self._clock = SystemClock()
        self._pace = SendPacer(self._clock)
        self._senders: list[Send] = []

    def open(self) -> None:
        self._transport.open()

    def wait_for_peers(self) -> None:
        self._transport.wait_for_peers()
        self._senders = [self._transport.sender(part) for part in self._job.sends]

    def knock(self) -> None:
        for send in self._senders:
            send(0, 1)

    def send(self, begin_ns: int, until_ns: int) -> list[list[int]]:
        schedules = [
            Schedule(
                send,
                part.stream.rate_hz,
                part.count,
                SendWindow(progress(part.progress), part.window, self._clock) if part.window else None,
            )
            for part, send in zip(self._job.sends, self._senders, strict=True)
        ]
        return self._pace.run(schedules, begin_ns, until_ns)

    def stop_sending(self) -> None:
        self._pace.stop()

    def stall(self, stopped: bool) -> None:
        if isinstance(self._transport, IgtlTransport):
            (self._transport.reading.clear if stopped else self._transport.reading.set)()

    def count(self) -> int:
        return sum(len(one.times) for one in self._heard.values())

    def close(self) -> None:
        self._transport.close()

    def columns(self) -> dict[str, Times]:
        arrays = {}
        for key, arrivals in self._heard.items():
            arrays[f"numbers {key}"] = np.frombuffer(arrivals.numbers, np.int64)
            arrays[f"received {key}"] = np.frombuffer(arrivals.times, np.int64)
        return arrays


def run(job: Job) -> None:
    """A program from beginning to end."""
    prepare_environment()
    side = _side(job)
    side.open()
    orders = _StdinCommands(side)
    try:
        side.wait_for_peers()
        print_event({"event": "ready"})
        if isinstance(side, NativeRosSide | NativeIgtlSide):
            threading.Thread(target=_report_firsts, args=(job, side, orders), name="igtl-bench-firsts").start()
        sent = _send(job, side, orders)
        orders.ended.wait()
    finally:
        orders.ended.set()
        side.close()
    columns = side.columns()
    for part, times in zip(job.sends, sent, strict=True):
        columns[f"sent {part.device}"] = np.array(times, np.int64)
    with Path(job.times).open("wb") as file:
        np.savez(file, allow_pickle=False, **columns)
    print_event({"event": "written"})


def _side(job: Job) -> BenchSide:
    if job.native and job.side == "ros" and not job.zenoh:
        return NativeRosSide(job)
    if job.native and job.side == "igtl":
        return NativeIgtlSide(job, _print_listening)
    return PythonSide(job)


def _transport(job: Job, heard: dict[str, Arrivals]) -> BenchTransport:
    match job.side:
        case "ros" if job.zenoh:
            from igtl_gateway_lab.bench.zenoh_side import ZenohTransport  # here: it needs an extra

            return ZenohTransport(job, heard)
        case "ros":
            return RosTransport(job, heard)
        case "pyigtl":
            from igtl_gateway_lab.bench.pyigtl_side import PyigtlTransport

            return PyigtlTransport(job, heard)
        case _:
            return IgtlTransport(job, heard)


class _StdinCommands:
    """The commands on standard input."""

    def __init__(self, side: BenchSide) -> None:
        self.knocking, self.begun, self.ended = threading.Event(), threading.Event(), threading.Event()
        self._side = side
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
                    case b"stall" | b"resume":
                        self._side.stall(line == b"stall")
                    case b"count":
                        print_event({"event": "count", "messages": self._side.count()})
        self.ended.set()
        self.begun.set()
        self.knocking.set()
        self._side.stop_sending()


def _send(job: Job, side: BenchSide, orders: _StdinCommands) -> Sequence[Sequence[int] | Times]:
    """Knock, then send; when each message was sent."""
    size = sum(payload(part.stream.kind).size for part in job.sends)
    orders.knocking.wait()
    while not orders.begun.is_set():
        side.knock()
        orders.begun.wait(max(_KNOCK_S, size / _KNOCK_BYTES_PER_S))
    begin_ns = SystemClock().monotonic_ns() + _BEGIN_NS
    sent = side.send(begin_ns, begin_ns + round(job.seconds * NS_PER_S))
    if job.sends:
        print_event({"event": "sent", "messages": sum(map(len, sent))})
    return sent


def _report_firsts(job: Job, side: NativeRosSide | NativeIgtlSide, orders: _StdinCommands) -> None:
    """Check and report the first message of each stream; then nothing else runs beside the loops."""
    missing = {part.key for part in job.hears}
    while missing and not orders.ended.wait(_FIRST_LOOK_S):
        for part, message in side.firsts():
            if part.key in missing:
                _first_of(part, job.side)(message)
                missing.remove(part.key)


def _first_of(part: JobStream, side: str) -> Callable[[Buffer], None]:
    """Return what is done at the first message: check it, and report it to the runner, which waits for it."""

    def first(message: Buffer) -> None:
        if side == "igtl":
            content = decode(message).content  # raises if the CRC is wrong
            print_event({"event": "heard", "key": part.key, "as": type(content).__name__, "bytes": len(message)})
        else:
            print_event({"event": "heard", "key": part.key, "as": part.topic, "bytes": len(message)})

    return first


def _print_listening(host: str, port: int) -> None:
    print_event({"event": "listening", "host": host, "port": port})


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
