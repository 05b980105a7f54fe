"""The program of one actor, over a real TCP connection."""

from __future__ import annotations

import socket
import threading
from collections.abc import Callable, Iterable, Iterator
from typing import Any

import pytest

from igtl_gateway.base.buffers import join
from igtl_gateway.base.clock import SystemClock
from igtl_gateway.base.stamp import NS_PER_MS
from igtl_gateway.config.configuration import Config
from igtl_gateway.wire import Message, decode, encode
from igtl_gateway.wire.text import String
from igtl_gateway_lab.simulate.actor import ActorProtocol, ActorReport, Publishes, Received, Sent
from igtl_gateway_lab.stage.actor import ActorProgram, IgtlEndpoint
from tests.timing import WAIT_S


class Echo:
    """Sends ``hello``, then answers each message, until that is ``bye``."""

    name = "echo"
    side = ActorProtocol.IGTL

    def __init__(self) -> None:
        self.subscribes: dict[str, str] = {}
        self.publishes: dict[str, Publishes] = {}
        self.due_ns: int | None = None
        self.done = False
        self.began_ns = 0
        self.prepared = False

    def prepare(self) -> None:
        self.prepared = True

    def begin(self, now_ns: int) -> None:
        assert self.prepared
        self.began_ns = now_ns
        self.due_ns = now_ns + 20 * NS_PER_MS

    def act(self, now_ns: int) -> Iterable[Sent]:
        assert self.due_ns is not None and now_ns >= self.due_ns
        self.due_ns = None
        return [Message("STRING", "Echo", String.of("hello"))]

    def receive(self, now_ns: int, heard: Received) -> Iterable[Sent]:
        assert isinstance(heard, Message) and isinstance(heard.content, String)
        self.done = heard.content.text == "bye"
        return [Message("STRING", "Echo", heard.content)]

    def report(self) -> ActorReport:
        return ActorReport(self.done, ("received all",))


class Peer:
    """A plain socket: whole messages in and out."""

    def __init__(self, connection: socket.socket) -> None:
        self._socket = connection
        self._socket.settimeout(WAIT_S)

    def send(self, text: str) -> None:
        self._socket.sendall(join(encode(Message("STRING", "Peer", String.of(text)))))

    def raw(self, data: bytes) -> None:
        self._socket.sendall(data)

    def receive(self) -> str:
        header = self._exactly(58)
        content = decode(header + self._exactly(int.from_bytes(header[42:50], "big"))).content
        assert isinstance(content, String)
        return content.text

    def _exactly(self, size: int) -> bytes:
        data = b""
        while len(data) < size:
            part = self._socket.recv(size - len(data))
            assert part, "closed"
            data += part
        return data


class Running:
    """A program in a thread, and the events that it reported."""

    def __init__(self, connection: IgtlEndpoint, actor: Echo) -> None:
        self.actor = actor
        self.to_row: list[dict[str, Any]] = []
        self._changed = threading.Condition()
        self.program = ActorProgram(self.actor, (self.actor,), Config(), 1, connection, SystemClock(), self._tell)
        self._thread = threading.Thread(target=self.program.run)
        self._thread.start()

    def _tell(self, event: dict[str, Any]) -> None:
        with self._changed:
            self.to_row.append(event)
            self._changed.notify_all()

    def wait(self, name: str) -> dict[str, Any]:
        with self._changed:
            assert self._changed.wait_for(lambda: name in self.names(), WAIT_S), self.to_row
        return next(event for event in self.to_row if event["event"] == name)

    def names(self) -> list[str]:
        return [event["event"] for event in self.to_row]

    def end(self) -> dict[str, Any]:
        self.program.end()
        self._thread.join(WAIT_S)
        assert not self._thread.is_alive()
        return self.to_row[-1]


Run = Callable[..., Running]


@pytest.fixture
def running() -> Iterator[Run]:
    started: list[Running] = []

    def run(connection: IgtlEndpoint, actor: Echo | None = None) -> Running:
        started.append(Running(connection, actor or Echo()))
        return started[-1]

    yield run
    for one in started:
        one.end()


@pytest.fixture
def listener() -> Iterator[socket.socket]:
    with socket.create_server(("127.0.0.1", 0)) as sock:
        sock.settimeout(WAIT_S)
        yield sock


def test_it_says_nothing_before_it_begins_and_reports_at_the_end(running: Run, listener: socket.socket) -> None:
    echo = running(IgtlEndpoint(listener.getsockname()))
    with listener.accept()[0] as connection:
        peer = Peer(connection)
        echo.wait("ready")
        peer.send("early")
        assert echo.actor.began_ns == 0
        echo.program.begin()
        # it receives earlier messages after the beginning; an act that is due waits for its time
        assert sorted((peer.receive(), peer.receive())) == ["early", "hello"]
        peer.send("bye")
        assert peer.receive() == "bye"
        echo.wait("done")
        assert echo.end() == {
            "event": "report",
            "good": True,
            "lines": ("received all",),
            "facts": {},
            "sent": {"STRING/Echo": 3},
            "received": {"STRING/Peer": 2},
        }
    assert echo.names() == ["ready", "done", "report"]


def test_as_a_server_it_tells_its_port(running: Run) -> None:
    echo = running(IgtlEndpoint(("127.0.0.1", 0), server=True))
    port = echo.wait("listening")["port"]
    with socket.create_connection(("127.0.0.1", port), WAIT_S) as connection:
        echo.wait("ready")
        echo.program.begin()
        assert Peer(connection).receive() == "hello"
        report = echo.end()
    assert not report["good"] and report["sent"] == {"STRING/Echo": 1}


def test_it_says_for_whom_it_waits_and_ends_when_told(running: Run, listener: socket.socket) -> None:
    address = listener.getsockname()
    listener.close()
    echo = running(IgtlEndpoint(address))
    assert echo.wait("waiting")["for"] == f"a server at 127.0.0.1:{address[1]}"
    assert echo.end()["event"] == "report"
    assert "ready" not in echo.names()


def test_a_message_that_cannot_be_read_is_told_of_and_costs_only_itself(running: Run, listener: socket.socket) -> None:
    echo = running(IgtlEndpoint(listener.getsockname()))
    with listener.accept()[0] as connection:
        peer = Peer(connection)
        echo.wait("ready")
        echo.program.begin()
        assert peer.receive() == "hello"
        good = join(encode(Message("STRING", "Peer", String.of("good"))))
        peer.raw(good[:-1] + b"?")
        peer.raw(good)
        assert peer.receive() == "good"
        assert echo.wait("warning")["text"].startswith("echo: refused a message: ")


class Slow(Echo):
    """Always late: each act takes longer than until the next one is due; it sends what it has received."""

    def act(self, now_ns: int) -> Iterable[Sent]:
        threading.Event().wait(0.03)
        self.due_ns = now_ns + NS_PER_MS
        return [Message("STRING", "Echo", String.of(str(self.heard)))]

    def receive(self, now_ns: int, heard: Received) -> Iterable[Sent]:
        self.heard += 1
        return ()

    heard = 0


def test_who_is_always_late_hears_everything_all_the_same(running: Run, listener: socket.socket) -> None:
    slow = running(IgtlEndpoint(listener.getsockname()), Slow())
    with listener.accept()[0] as connection:
        peer = Peer(connection)
        slow.wait("ready")
        slow.program.begin()
        assert peer.receive() == "0"
        for _ in range(100):
            peer.send("news")
        # one by one it would take as many acts
        assert any(peer.receive() == "100" for _ in range(50))
