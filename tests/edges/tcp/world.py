"""Edges, peers and messages of the tests: real loopback sockets.  Waiting is on conditions, with a deadline
that only a failure reaches."""

from __future__ import annotations

import socket
import struct
import threading
from collections.abc import Callable
from typing import Any

from igtl_gateway.base.clock import SystemClock
from igtl_gateway.edges.tcp import TcpEdge
from igtl_gateway.gateway.log.note import Note
from igtl_gateway.wire.framer import Framer

#: Where other programs have the processors, what takes 0.4 s alone has taken 20.
DEADLINE_S = 60.0
HERE = "127.0.0.1"
BIG = 8 * 2**20  # more than loopback sockets hold by themselves


def header(body_size: int, name: bytes = b"IMAGE") -> bytes:
    return struct.pack(">H12s20sQQQ", 1, name, b"device", 0, body_size, 0)


def message(number: int = 0, size: int = 48, name: bytes = b"IMAGE") -> bytes:
    """A message that carries its number."""
    return header(max(size, 8), name) + struct.pack(">Q", number) + bytes(max(size, 8) - 8)


def number_of(frame: Any) -> int:
    return int.from_bytes(bytes(frame[58:66]), "big")


class Seen:
    """What the callbacks reported, in order."""

    def __init__(self) -> None:
        self.events: list[tuple[str, int, Any]] = []
        self._changed = threading.Condition()
        self.on_frame_hook: Callable[[int, Any], object] = lambda number, frame: None

    def _add(self, what: str, number: int, value: Any) -> None:
        with self._changed:
            self.events.append((what, number, value))
            self._changed.notify_all()

    def on_frame(self, number: int, frame: Any) -> object:
        self._add("frame", number, frame)
        return self.on_frame_hook(number, frame)

    def on_link(self, number: int, up: bool, note: Note) -> None:
        self._add("up" if up else "down", number, note)

    def on_note(self, number: int, note: Note) -> None:
        self._add(note.code, number, note)

    def of(self, what: str, number: int | None = None) -> list[Any]:
        return [value for kind, link, value in self.events if kind == what and number in (None, link)]

    def wait(self, what: str, count: int = 1, number: int | None = None, deadline_s: float = DEADLINE_S) -> list[Any]:
        with self._changed:
            enough = self._changed.wait_for(lambda: len(self.of(what, number)) >= count, deadline_s)
            assert enough, f"{len(self.of(what, number))} of {count} {what}; {[e[:2] for e in self.events][-20:]}"
            return self.of(what, number)


class Peer:
    """A blocking client or accepted connection of the test."""

    def __init__(self, sock: socket.socket) -> None:
        self.sock = sock
        self.sock.settimeout(DEADLINE_S)
        self._framer = Framer()
        self._ready: list[Any] = []

    @classmethod
    def to(cls, port: int, receive_buffer: int = 0) -> Peer:
        sock = socket.socket()
        if receive_buffer:
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, receive_buffer)
        sock.connect((HERE, port))
        return cls(sock)

    def send(self, data: bytes) -> None:
        self.sock.sendall(data)

    def receive(self) -> bytes | None:
        """The next message; None at the end of the stream."""
        while not self._ready:
            count = self.sock.recv_into(self._framer.buffer())
            if not count:
                assert self._framer.pending == 0, "the stream ended inside a message"
                return None
            self._ready = self._framer.received(count)
        return bytes(self._ready.pop(0))

    def receive_all(self) -> list[bytes]:
        return list(iter(self.receive, None))

    def close(self) -> None:
        self.sock.close()


class World:
    """Edges and peers of one test, closed at its end."""

    def __init__(self) -> None:
        self._closers: list[Callable[[], None]] = []

    def closes(self, closer: Callable[[], None]) -> None:
        self._closers.append(closer)

    def edge(self, **settings: Any) -> tuple[TcpEdge, Seen]:
        seen = settings.pop("seen", None) or Seen()
        settings.setdefault("clock", SystemClock())
        edge = TcpEdge(on_frame=seen.on_frame, on_link=seen.on_link, on_note=seen.on_note, **settings)
        self._closers.append(lambda: edge.stop(0))
        return edge, seen

    def server(self, **settings: Any) -> tuple[TcpEdge, Seen, int]:
        edge, seen = self.edge(**settings)
        _, port = edge.listen(HERE, 0)
        edge.start()
        return edge, seen, port

    def peer(self, port: int, receive_buffer: int = 0) -> Peer:
        peer = Peer.to(port, receive_buffer)
        self._closers.append(peer.close)
        return peer

    def listener(self, port: int = 0) -> socket.socket:
        listener = socket.socket()
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listener.bind((HERE, port))
        listener.listen()
        listener.settimeout(DEADLINE_S)
        self._closers.append(listener.close)
        return listener

    def accepted(self, listener: socket.socket) -> Peer:
        peer = Peer(listener.accept()[0])
        self._closers.append(peer.close)
        return peer

    def close(self) -> None:
        for closer in reversed(self._closers):
            closer()


def until(condition: Callable[[], bool]) -> None:
    """For the few facts that no callback reports: the kernel's buffers, counters."""
    pause = threading.Event()
    for _ in range(round(DEADLINE_S / 0.005)):
        if condition():
            return
        pause.wait(0.005)
    raise AssertionError("not within the deadline")
