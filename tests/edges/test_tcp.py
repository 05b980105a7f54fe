"""The TCP edge over real loopback sockets.  Waiting is on conditions, with a deadline that only a failure reaches."""

from __future__ import annotations

import ipaddress
import os
import resource
import socket
import struct
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import Any

import numpy as np
import pytest

from igtl_gateway.clock import ManualClock, SystemClock
from igtl_gateway.edges import tcp
from igtl_gateway.edges.tcp import Limits, LinkCounters, TcpEdge
from igtl_gateway.errors import ConfigError
from igtl_gateway.session.note import Note
from igtl_gateway.wire.framer import Framer

DEADLINE_S = 20.0
HERE = "127.0.0.1"
BIG = 8 * 2**20  # more than loopback sockets hold by themselves


def header(body_size: int, name: bytes = b"STRING") -> bytes:
    return struct.pack(">H12s20sQQQ", 1, name, b"device", 0, body_size, 0)


def message(number: int = 0, size: int = 48, name: bytes = b"STRING") -> bytes:
    """A message that carries its number."""
    return header(max(size, 8), name) + struct.pack(">Q", number) + bytes(max(size, 8) - 8)


def number_of(frame: Any) -> int:
    return int.from_bytes(bytes(frame[58:66]), "big")


class Seen:
    """What the callbacks told, in order."""

    def __init__(self) -> None:
        self.events: list[tuple[str, int, Any]] = []
        self._changed = threading.Condition()
        self.on_frame_hook: Callable[[int, Any], None] = lambda number, frame: None

    def _add(self, what: str, number: int, value: Any) -> None:
        with self._changed:
            self.events.append((what, number, value))
            self._changed.notify_all()

    def on_frame(self, number: int, frame: Any) -> None:
        self._add("frame", number, frame)
        self.on_frame_hook(number, frame)

    def on_link(self, number: int, up: bool, note: Note) -> None:
        self._add("up" if up else "down", number, note)

    def on_note(self, number: int, note: Note) -> None:
        self._add(note.code, number, note)

    def of(self, what: str, number: int | None = None) -> list[Any]:
        return [value for kind, link, value in self.events if kind == what and number in (None, link)]

    def wait(self, what: str, count: int = 1, number: int | None = None) -> list[Any]:
        with self._changed:
            enough = self._changed.wait_for(lambda: len(self.of(what, number)) >= count, DEADLINE_S)
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


@pytest.fixture
def world() -> Iterator[World]:
    world = World()
    yield world
    world.close()


def until(condition: Callable[[], bool]) -> None:
    """For the few facts that no callback tells: the kernel's buffers, counters."""
    pause = threading.Event()
    for _ in range(round(DEADLINE_S / 0.005)):
        if condition():
            return
        pause.wait(0.005)
    raise AssertionError("not within the deadline")


# ── receiving ─────────────────────────────────────────────────────────────────────────────────────────────────


def test_several_clients_at_once_each_with_its_own_link(world: World) -> None:
    edge, seen, port = world.server()
    peers = [world.peer(port) for _ in range(5)]
    assert edge.wait_links(5, DEADLINE_S)
    for turn in range(10):
        for index, peer in enumerate(peers):
            peer.send(message(100 * index + turn))
    seen.wait("frame", 50)
    assert [link.number for link in edge.links()] == [1, 2, 3, 4, 5]
    addresses = {link.peer: link.number for link in edge.links()}
    for index, peer in enumerate(peers):
        number = addresses["{}:{}".format(*peer.sock.getsockname())]
        assert [number_of(frame) for frame in seen.of("frame", number)] == [100 * index + turn for turn in range(10)]
    edge.send([1, 3], [message(7)], "STRING/device", True)
    by_number = {
        number: peer
        for peer in peers
        for address, number in addresses.items()
        if address == "{}:{}".format(*peer.sock.getsockname())
    }
    assert [by_number[number].receive() for number in (1, 3)] == [message(7)] * 2
    edge.stop()
    assert [by_number[number].receive() for number in (1, 2, 3, 4, 5)] == [None] * 5


def test_order_of_callbacks_and_facts_of_a_link(world: World) -> None:
    _, seen, port = world.server()
    peer = world.peer(port)
    own = "{}:{}".format(*peer.sock.getsockname())
    peer.send(message(1) + message(2, 200_000))
    peer.close()
    (down,) = seen.wait("down")
    assert [event[:2] for event in seen.events] == [("up", 1), ("frame", 1), ("frame", 1), ("down", 1)]
    (up,) = seen.of("up")
    assert (up.code, up.data) == ("link_up", {"peer": own, "local": f"{HERE}:{port}", "role": "server"})
    assert (down.code, down.data["reason"]) == ("link_down", "closed by the peer")
    assert (down.data["received_messages"], down.data["received_bytes"]) == (2, 106 + 200_058)


def test_a_dribbling_peer_does_not_hold_up_the_others(world: World) -> None:
    _, seen, port = world.server()
    slow, fast = world.peer(port), world.peer(port)
    slow.sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    seen.wait("up", 2)
    for turn, byte in enumerate(message(5) + message(6)):
        slow.send(bytes([byte]))
        fast.send(message(1000 + turn))
        # every message of the fast one arrives while the slow one is inside its own
        seen.wait("frame", turn + 1, 2)
    assert [number_of(frame) for frame in seen.wait("frame", 2, 1)] == [5, 6]
    assert seen.of("frame", 1) == [message(5), message(6)]


@pytest.mark.parametrize("size", [2**62, 2**64 - 1, 10_001])
def test_oversize_header_costs_its_own_link(world: World, size: int) -> None:
    edge, seen, port = world.server(limits=Limits(max_body=10_000))
    good, bad = world.peer(port), world.peer(port)
    seen.wait("up", 2)
    bad.send(message(1) + header(size))
    (note,) = seen.wait("too_large")
    seen.wait("down", 1, 2)
    assert note.data["head"] == header(size).hex()
    assert (note.data["received"], note.data["expected"]) == (58, 58 + size)
    assert seen.of("frame", 2) == [message(1)]
    assert seen.of("truncated") == []
    good.send(message(2, 10_000))
    assert seen.wait("frame", 1, 1) == [message(2, 10_000)]
    assert [link.number for link in edge.links()] == [1]


@pytest.mark.parametrize(("part", "expected"), [(20, None), (58, 106), (100, 106)])
def test_peer_gone_inside_a_message(world: World, part: int, expected: int | None) -> None:
    _, seen, port = world.server()
    peer = world.peer(port)
    peer.send(message(1) + message(2)[:part])
    peer.close()
    seen.wait("down")
    (note,) = seen.of("truncated")
    assert note.data["head"] == message(2)[: min(part, 58)].hex()
    assert (note.data["received"], note.data["expected"]) == (part, expected)
    assert [event[0] for event in seen.events] == ["up", "frame", "truncated", "down"]


def test_silence_inside_a_message_ends_the_link(world: World) -> None:
    clock = ManualClock()
    _, seen, port = world.server(clock=clock, limits=Limits(stall_s=10))
    quiet, dribbling, half, busy = [world.peer(port) for _ in range(4)]
    seen.wait("up", 4)
    quiet.send(message(1))
    half.send(message(2)[:30])
    data = message(3)
    turns = 12
    for turn in range(turns):
        dribbling.send(data[turn : turn + 1])
        busy.send(message(4))  # once it is through, the earlier bytes are, too, and the clock was looked at
        seen.wait("frame", turn + 2)
        clock.advance(2 * 10**9)
    busy.send(message(4))
    seen.wait("frame", turns + 2)
    (note,) = seen.wait("stalled")
    assert (note.data["received"], note.data["expected"]) == (30, None)
    assert half.receive() is None
    dribbling.send(data[turns:])
    quiet.send(message(5))
    seen.wait("frame", turns + 4)
    assert len(seen.of("down")) == 1


def test_callbacks_that_raise_are_noted_and_harm_nothing(world: World) -> None:
    _, seen, port = world.server()

    def fail(number: int, frame: Any) -> None:
        raise KeyError("no such stream")

    seen.on_frame_hook = fail
    peer = world.peer(port)
    peer.send(message(1) + message(2))
    (note,) = seen.wait("callback_failed")
    assert note.data == {"callback": "on_frame", "error": "KeyError: 'no such stream'", "count": 2}
    assert seen.wait("frame", 2) == [message(1), message(2)]
    peer.send(message(3))
    seen.wait("frame", 3)


def test_on_note_that_raises_harms_nothing(world: World) -> None:
    seen = Seen()
    told = seen.on_note

    def fail(number: int, note: Note) -> None:
        told(number, note)
        raise RuntimeError("on_note")

    seen.on_note = fail  # type: ignore[method-assign]
    _, _, port = world.server(seen=seen)
    first = world.peer(port)
    first.send(message(1)[:10])
    first.close()
    seen.wait("truncated")
    seen.wait("down")
    world.peer(port).send(message(2))
    assert seen.wait("frame") == [message(2)]


# ── who may connect ───────────────────────────────────────────────────────────────────────────────────────────


def test_one_client_too_many(world: World) -> None:
    edge, seen, port = world.server(limits=Limits(max_clients=2))
    peers = [world.peer(port), world.peer(port)]
    seen.wait("up", 2)
    third = world.peer(port)
    assert third.receive() is None
    (note,) = seen.wait("refused")
    assert note.data["peer"] == "{}:{}".format(*third.sock.getsockname())
    peers[0].close()
    seen.wait("down")
    world.peer(port)
    seen.wait("up", 3)
    assert [link.number for link in edge.links()] == [2, 3]


def test_port_in_use(world: World) -> None:
    _, _, port = world.server()
    other, _ = world.edge()
    with pytest.raises(ConfigError, match=rf"^listen 127\.0\.0\.1:{port}: the port is in use by another program"):
        other.listen(HERE, port)


@pytest.mark.parametrize(
    ("host", "port", "words"),
    [
        ("0.0.0.0", 0, "allow networks"),
        ("no.such.host.invalid", 0, "expected an address of this machine"),
        ("203.0.113.77", 0, "open to other hosts"),
        (HERE, 65536, "expected 0"),
        (HERE, -1, "expected 0"),
    ],
)
def test_invalid_listen_address(world: World, host: str, port: int, words: str) -> None:
    edge, _ = world.edge()
    with pytest.raises(ConfigError, match=words) as caught:
        edge.listen(host, port)
    assert "\n" not in str(caught.value)


def test_address_of_another_machine(world: World) -> None:
    edge, _ = world.edge(allow=["any"])
    with pytest.raises(ConfigError, match=r"^listen 203\.0\.113\.77:0: "):
        edge.listen("203.0.113.77", 0)


@pytest.mark.parametrize("allow", [["any"], ["10.0.0.0/8", "2001:db8::/32"]])
def test_allow_list_opens_other_addresses_and_this_host_is_always_allowed(world: World, allow: list[str]) -> None:
    edge, seen = world.edge(allow=allow)
    host, port = edge.listen("0.0.0.0", 0)
    assert host == "0.0.0.0"
    edge.start()
    world.peer(port).send(message(1))
    seen.wait("frame")


def own_address() -> str | None:
    """An address of this machine that is not loopback (nothing is sent)."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe, suppress(OSError):
        probe.connect(("192.0.2.1", 9))
        host = str(probe.getsockname()[0])
        return None if host.startswith("127.") else host
    return None


def test_allow_list_refuses_others(world: World) -> None:
    host = own_address()
    if host is None:
        pytest.skip("this machine has no address but loopback")
    edge, seen = world.edge(allow=[f"{ipaddress.ip_address(host) + 1}/32"])
    _, port = edge.listen("0.0.0.0", 0)
    edge.start()
    with socket.create_connection((host, port), DEADLINE_S) as stranger:
        assert stranger.recv(1) == b""
    (note,) = seen.wait("refused")
    assert note.data["reason"] == "not in the allow-list"
    assert seen.of("up") == []

    friendly, seen_too = world.edge(allow=[f"{host}/32"])
    _, port = friendly.listen("0.0.0.0", 0)
    friendly.start()
    with socket.create_connection((host, port), DEADLINE_S) as friend:
        friend.sendall(message(1))
        seen_too.wait("frame")


def test_ipv6(world: World) -> None:
    edge, seen = world.edge()
    try:
        host, port = edge.listen("::1", 0)
    except ConfigError as exc:
        pytest.skip(str(exc))
    edge.connect("::1", port)
    edge.start()
    seen.wait("up", 2)
    assert {link.peer for link in edge.links() if link.role == "client"} == {f"[{host}]:{port}"}


@contextmanager
def no_descriptors() -> Iterator[None]:
    limits = resource.getrlimit(resource.RLIMIT_NOFILE)
    free = os.open(os.devnull, os.O_RDONLY)
    os.close(free)
    resource.setrlimit(resource.RLIMIT_NOFILE, (free, limits[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, limits)


@pytest.mark.parametrize("pause_s", [0.05, 3600])
def test_no_descriptors_left_to_accept(world: World, monkeypatch: pytest.MonkeyPatch, pause_s: float) -> None:
    monkeypatch.setattr(tcp, "_NOTE_EVERY_S", pause_s)
    _, seen, port = world.server()
    peer = world.peer(port)
    seen.wait("up")
    client = socket.socket()
    world.closes(client.close)
    with no_descriptors():
        client.connect((HERE, port))
        seen.wait("accept_failed")
        for turn in range(5):  # the others are served, and the loop does not spin on the listener
            peer.send(message(turn))
            seen.wait("frame", turn + 1)
    if pause_s < 1:
        client.sendall(message(9))
        assert seen.wait("frame", 1, 2) == [message(9)]
    else:
        assert len(seen.of("accept_failed")) == 1


def test_allow_list_with_nonsense(world: World) -> None:
    with pytest.raises(ConfigError, match=r"allow: found '192\.168\.1\.5/24'"):
        world.edge(allow=["192.168.1.5/24"])


@pytest.mark.parametrize("name", ["max_clients", "queue_bytes", "queue_messages", "stall_s", "max_body"])
def test_limits_are_positive(name: str) -> None:
    with pytest.raises(ConfigError, match=f"limit {name}"):
        Limits(**{name: 0})


# ── client ────────────────────────────────────────────────────────────────────────────────────────────────────


def test_client_finds_a_late_server_and_comes_back_when_it_goes(world: World, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tcp, "_RETRY_FIRST_S", 0.001)
    monkeypatch.setattr(tcp, "_RETRY_LAST_S", 0.016)
    reserved = world.listener()
    port = reserved.getsockname()[1]
    reserved.close()
    edge, seen = world.edge()
    edge.connect(HERE, port)
    edge.start()
    (note,) = seen.wait("connect_failed")
    assert note.data == {"peer": f"{HERE}:{port}", "reason": "Connection refused"}
    (waiting,) = edge.links()
    assert (waiting.number, waiting.role, waiting.connected) == (0, "client", False)
    until(lambda: edge._dialers[0].delay_s == 0.016)  # it tried several times

    listener = world.listener(port)
    first = world.accepted(listener)
    first.send(message(1))
    assert seen.wait("frame", 1, 1) == [message(1)]
    assert seen.of("up")[0].data["role"] == "client"
    # several attempts were refused, for one cause
    assert len(seen.of("connect_failed")) == 1

    listener.close()
    first.close()
    seen.wait("down")
    assert len(seen.wait("connect_failed", 2)) == 2  # a new outage

    second = world.accepted(world.listener(port))
    assert edge.wait_links(1, DEADLINE_S)
    edge.send([2], [message(2)], "STRING/device", True)
    assert second.receive() == message(2)
    assert [link.number for link in edge.links()] == [2]


def test_client_by_name_and_an_unknown_name(world: World) -> None:
    listener = world.listener()
    edge, seen = world.edge()
    edge.connect("localhost", listener.getsockname()[1])
    edge.connect("no.such.host.invalid", 18944)
    edge.start()
    world.accepted(listener)
    seen.wait("up")
    (note,) = seen.wait("connect_failed")
    assert note.data["peer"] == "no.such.host.invalid:18944"


def test_server_and_client_of_one_edge(world: World) -> None:
    one, seen_one, port = world.server()
    other, seen_other = world.edge()
    other.connect(HERE, port)
    _, other_port = other.listen(HERE, 0)
    other.start()
    world.peer(other_port).send(message(1))
    seen_other.wait("up", 2)
    seen_other.wait("frame")
    roles = {link.role: link.number for link in other.links()}
    other.send([roles["client"]], [message(2)[:50], message(2)[50:]], "STRING/device", True)
    assert seen_one.wait("frame") == [message(2)]
    one.send([1], [message(3)], "STRING/device", True)
    seen_other.wait("frame", 1, roles["client"])


def test_client_gives_up_on_a_server_that_does_not_answer(world: World, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tcp, "_CONNECT_TIMEOUT_S", 0.05)
    listener = world.listener()
    listener.listen(0)
    port = listener.getsockname()[1]
    for _ in range(3):  # the kernel drops further attempts, as a firewall would
        filler = socket.socket()
        filler.setblocking(False)
        filler.connect_ex((HERE, port))
        world.closes(filler.close)
    edge, seen = world.edge()
    edge.connect(HERE, port)
    edge.start()
    (note,) = seen.wait("connect_failed")
    assert note.data["reason"] == "Connection timed out"


@pytest.mark.parametrize("port", [0, 65536])
def test_connect_to_no_port(world: World, port: int) -> None:
    edge, _ = world.edge()
    with pytest.raises(ConfigError, match=r"connect 127\.0\.0\.1: found port"):
        edge.connect(HERE, port)


# ── sending ───────────────────────────────────────────────────────────────────────────────────────────────────


def test_many_buffers_of_any_shape(world: World) -> None:
    edge, _, port = world.server()
    peer = world.peer(port)
    assert edge.wait_links(1, DEADLINE_S)
    data = message(1, 5000)
    pieces = [data[at : at + 1] for at in range(len(data))]  # more than one system call takes
    edge.send([1], pieces, "a", True)
    assert peer.receive() == data
    for rows in (3, 3000):
        shaped, nothing = np.arange(4 * rows, dtype=np.float32).reshape(rows, 4), np.empty((0, 3), np.float32)
        edge.send([1], [header(shaped.nbytes), b"", shaped.data, nothing.data], "a", True)
        assert peer.receive() == header(shaped.nbytes) + shaped.tobytes()
    counters = edge.counters()[1]
    assert (counters.sent_messages, counters.sent_bytes) == (3, len(data) + 2 * 58 + 16 * 3003)


def test_buffers_that_are_not_contiguous_are_refused_before_anything_is_sent(world: World) -> None:
    edge, _, port = world.server()
    peer = world.peer(port)
    assert edge.wait_links(1, DEADLINE_S)
    for size in (48, 20_000):
        with pytest.raises((TypeError, BufferError)):
            edge.send([1], [header(size // 2), memoryview(bytes(size))[::2]], "a", True)
    edge.send([1], [message(1)], "a", True)
    assert peer.receive() == message(1)


def test_unknown_links_are_ignored_and_counted(world: World) -> None:
    edge, seen, port = world.server()
    world.peer(port).close()
    seen.wait("down")
    edge.send([1, 99], [message(1)], "STRING/device", True)
    assert edge.counters() == {0: LinkCounters(ignored={"STRING/device": 2})}


def test_slow_reader_loses_old_transforms_and_no_string(world: World, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tcp, "_NOTE_EVERY_S", 3600)
    edge, seen, port = world.server(limits=Limits(queue_messages=50))
    slow, fast = world.peer(port, 4096), world.peer(port)
    assert edge.wait_links(2, DEADLINE_S)
    got_fast: list[bytes] = []
    reader = threading.Thread(target=lambda: got_fast.extend(fast.receive_all()))
    reader.start()
    edge.send([1], [message(0, BIG, b"IMAGE")], "IMAGE/camera", False)  # fills the socket, and is begun
    for number in range(1, 1001):
        edge.send([1], [message(number, 48, b"TRANSFORM")], "TRANSFORM/tool", False)
        if number % 100 == 0:
            edge.send([1], [message(number)], "STRING/plan", True)
        edge.send([2], [message(number)], "STRING/plan", True)
        assert edge.flush(0) or edge.counters()[1].queued_messages <= 51
    (first, *_) = seen.wait("queue_drop")
    assert set(first.data["dropped"]) == {"TRANSFORM/tool"}
    dropped = edge.counters()[1].dropped["TRANSFORM/tool"]
    assert dropped == 1000 - 40

    received = [slow.receive() for _ in range(1 + 10 + 40)]
    assert received[0] == message(0, BIG, b"IMAGE")  # begun, so finished
    strings = [number_of(one) for one in received if one and one[2:8] == b"STRING"]
    transforms = [number_of(one) for one in received if one and one[2:11] == b"TRANSFORM"]
    assert strings == list(range(100, 1001, 100))
    assert transforms == list(range(961, 1001))  # the newest
    assert edge.flush(DEADLINE_S)
    edge.stop()
    reader.join()
    assert [number_of(one) for one in got_fast] == list(range(1, 1001))
    assert seen.of("queue_drop", 2) == []
    notes = seen.of("queue_drop", 1)
    assert (len(notes), notes[-1].data["dropped"]) == (2, {"TRANSFORM/tool": dropped})  # one at once, one at the end
    (down,) = seen.of("down", 1)
    assert down.data["dropped"] == {"TRANSFORM/tool": dropped}
    assert down.data["unsent"] == 0


def test_the_stream_that_holds_most_gives_way(world: World) -> None:
    edge, _, port = world.server(limits=Limits(queue_bytes=10_000))
    world.peer(port, 4096)
    assert edge.wait_links(1, DEADLINE_S)
    edge.send([1], [message(0, BIG)], "begun", True)
    for number in range(4):
        edge.send([1], [message(number, 2000)], "IMAGE/camera", False)
        for _ in range(2):
            edge.send([1], [message(number)], "TRANSFORM/tool", False)
    edge.send([1], [message(9, 2000)], "POLYDATA/tumour", True)
    assert edge.counters()[1].dropped == {"IMAGE/camera": 1}
    # too large for what the kept one leaves: it goes itself, the others stay
    edge.send([1], [message(9, 9000)], "IMAGE/camera", False)
    assert edge.counters()[1].dropped == {"IMAGE/camera": 2}
    assert edge.counters()[1].queued_messages == 1 + 3 + 8 + 1


def test_a_newer_message_replaces_the_oldest_of_its_own_stream(world: World) -> None:
    edge, _, port = world.server(limits=Limits(queue_messages=7))
    peer = world.peer(port, 4096)
    assert edge.wait_links(1, DEADLINE_S)
    edge.send([1], [message(0, BIG)], "begun", True)
    edge.send([1], [message(1, 3000)], "IMAGE/camera", False)
    for number in (2, 3, 4, 5):
        edge.send([1], [message(number)], "TRANSFORM/tool", False)
    for number in (6, 7):
        edge.send([1], [message(number)], "POINT/marker", False)
    edge.send([1], [message(8)], "POINT/marker", False)  # pushes 6, of its own, not 2 of those that are most
    edge.send([1], [message(9)], "STRING/plan", True)  # pushes 2, of those that are most, not the large 1
    frames = [peer.receive() for _ in range(8)]
    assert [number_of(frame) for frame in frames] == [0, 1, 3, 4, 5, 7, 8, 9]


def test_one_message_larger_than_the_queue_may_wait(world: World) -> None:
    edge, _, port = world.server(limits=Limits(queue_bytes=10_000))
    peer = world.peer(port, 4096)
    assert edge.wait_links(1, DEADLINE_S)
    edge.send([1], [message(0, BIG)], "a", False)
    edge.send([1], [message(1, BIG)], "a", False)
    edge.send([1], [message(2, BIG)], "a", False)
    assert [peer.receive() for _ in range(2)] == [message(0, BIG), message(2, BIG)]
    assert edge.counters()[1].dropped == {"a": 1}


def test_queue_full_of_what_must_not_be_dropped_ends_the_link(world: World) -> None:
    edge, seen, port = world.server(limits=Limits(queue_messages=10))
    world.peer(port, 4096), world.peer(port)
    assert edge.wait_links(2, DEADLINE_S)
    edge.send([1], [message(0, BIG)], "STRING/plan", True)
    for number in range(11):
        edge.send([1], [message(number)], "STRING/plan", True)
    (note,) = seen.wait("queue_full")
    (down,) = seen.wait("down")
    assert "must not be dropped" in note.text
    assert down.data["dropped"] == {"STRING/plan": 11}
    assert down.data["unsent"] == 11
    total = edge.counters()[0]
    assert (total.dropped, total.ignored) == ({"STRING/plan": 11}, {"STRING/plan": 1})
    assert [link.number for link in edge.links()] == [2]


def test_block_mode_loses_nothing_with_a_slow_reader(world: World) -> None:
    edge, seen, port = world.server(limits=Limits(queue_messages=5), when_full="block")
    peer = world.peer(port, 4096)
    assert edge.wait_links(1, DEADLINE_S)
    lock = threading.Lock()  # held while sending and taken by callbacks: must not lock up
    count = 200

    def take_the_lock(number: int, frame: Any) -> None:
        with lock:
            pass

    seen.on_frame_hook = take_the_lock

    def replay() -> None:
        for number in range(count):
            with lock:
                edge.send([1], [message(number, 20_000 if number % 10 else BIG // 4)], "TRANSFORM/tool", False)

    sender = threading.Thread(target=replay)
    sender.start()
    until(lambda: edge.counters()[1].queued_messages >= 5)
    peer.send(message(1))  # the I/O thread now waits for the lock, which the blocked sender holds
    assert [number_of(peer.receive()) for _ in range(count)] == list(range(count))
    sender.join(DEADLINE_S)
    assert not sender.is_alive()
    seen.wait("frame")
    assert edge.counters()[1].dropped == {}


@pytest.mark.parametrize("how", ["stop", "peer"])
def test_a_blocked_sender_is_released(world: World, how: str) -> None:
    edge, seen, port = world.server(limits=Limits(queue_messages=2), when_full="block")
    peer = world.peer(port, 4096)
    assert edge.wait_links(1, DEADLINE_S)
    edge.send([1], [message(0, BIG)], "a", True)

    def fill() -> None:
        for number in range(3):
            edge.send([1], [message(number)], "a", True)

    sender = threading.Thread(target=fill)
    sender.start()
    until(lambda: edge.counters()[1].queued_messages == 3)
    stopper = threading.Thread(target=edge.stop, args=(10 * DEADLINE_S,))
    if how == "stop":
        stopper.start()  # and goes on trying to send what is queued
    else:
        peer.close()
    sender.join(DEADLINE_S)
    assert not sender.is_alive()
    if how == "stop":
        peer.close()
        stopper.join(DEADLINE_S)
    seen.wait("down")
    total = edge.counters()[0]
    assert (total.dropped, total.ignored) == ({"a": 3}, {"a": 1})


def test_threads_never_interleave_and_keep_their_order(world: World) -> None:
    edge, _, port = world.server(limits=Limits(queue_messages=100_000))
    peers = [world.peer(port, 8192), world.peer(port)]
    assert edge.wait_links(2, DEADLINE_S)
    each, threads = 1500, 4

    def work(thread: int) -> None:
        for number in range(each):
            data = message(thread * each + number, 48 + 7 * (number % 200))
            edge.send([1, 2], [data[:58], data[58:70], data[70:]], f"{thread}", True)

    got: list[list[bytes]] = [[], []]
    readers = [threading.Thread(target=lambda i=i: got[i].extend(peers[i].receive_all())) for i in range(2)]
    senders = [threading.Thread(target=work, args=(thread,)) for thread in range(threads)]
    for one in senders + readers:
        one.start()
    for one in senders:
        one.join(DEADLINE_S)
    assert edge.flush(DEADLINE_S)
    edge.stop()
    for one in readers:
        one.join(DEADLINE_S)
    for received in got:
        assert len(received) == each * threads
        for thread in range(threads):
            own = [n for n in map(number_of, received) if n // each == thread]
            assert own == list(range(thread * each, (thread + 1) * each))
        for frame in received:
            number = number_of(frame)
            assert frame == message(number, 48 + 7 * (number % each % 200))


def test_answers_from_a_callback_under_the_lock_that_other_senders_hold(world: World) -> None:
    edge, seen, port = world.server()
    lock = threading.Lock()

    def echo(number: int, frame: Any) -> None:
        with lock:
            edge.send([number], [frame], "echo", True)

    seen.on_frame_hook = echo
    peer = world.peer(port)
    assert edge.wait_links(1, DEADLINE_S)
    stop = threading.Event()

    def chatter() -> None:
        while not stop.is_set():
            with lock:
                edge.send([1], [message(10**6)], "TRANSFORM/tool", False)

    sender = threading.Thread(target=chatter)
    sender.start()
    for number in range(300):
        peer.send(message(number))
        while (answer := peer.receive()) and number_of(answer) == 10**6:
            pass
        assert answer == message(number)
    stop.set()
    sender.join(DEADLINE_S)


# ── the end ───────────────────────────────────────────────────────────────────────────────────────────────────


def test_stop_sends_what_is_queued_and_ends_cleanly(world: World) -> None:
    edge, seen, port = world.server()
    peer = world.peer(port, 4096)
    assert edge.wait_links(1, DEADLINE_S)
    for number in range(20):
        edge.send([1], [message(number, BIG // 10)], "IMAGE/camera", False)
    assert not edge.flush(0)
    got: list[bytes] = []
    reader = threading.Thread(target=lambda: got.extend(peer.receive_all()))
    reader.start()
    edge.stop(DEADLINE_S)
    reader.join(DEADLINE_S)
    assert [number_of(one) for one in got] == list(range(20))
    (down,) = seen.of("down")
    assert (down.data["reason"], down.data["unsent"]) == ("stopped", 0)
    edge.stop()
    edge.send([1], [message(1)], "late", True)
    total = edge.counters()[0]
    assert (total.sent_messages, total.ignored, total.dropped) == (20, {"late": 1}, {})
    assert edge.links() == []


def test_stop_reads_what_peers_still_send_and_the_port_is_free_at_once(
    world: World, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tcp, "_DRAIN_S", DEADLINE_S)
    edge, seen, port = world.server()
    peer = world.peer(port)
    assert edge.wait_links(1, DEADLINE_S)

    def answer_the_end() -> None:
        assert peer.receive() is None
        peer.send(message(9))
        peer.close()

    reader = threading.Thread(target=answer_the_end)
    reader.start()
    edge.stop()
    reader.join(DEADLINE_S)
    assert [event[0] for event in seen.events] == ["up", "frame", "down"]
    again, _ = world.edge()
    assert again.listen(HERE, port) == (HERE, port)


def test_stop_during_traffic_and_restart_on_the_same_port(world: World) -> None:
    port = 0
    for _ in range(3):
        edge, seen = world.edge()
        _, port = edge.listen(HERE, port)
        edge.start()
        peer = world.peer(port)
        assert edge.wait_links(1, DEADLINE_S)
        stopped = threading.Event()

        def send(edge: TcpEdge = edge, stopped: threading.Event = stopped) -> None:
            while not stopped.is_set():
                edge.send([1], [message(1, 2000)], "IMAGE/camera", False)

        def chat(peer: Peer = peer) -> None:
            with suppress(OSError):
                while True:
                    peer.send(message(2))

        threads = [threading.Thread(target=send), threading.Thread(target=chat)]
        threads.append(threading.Thread(target=lambda peer=peer: [*iter(peer.receive, None)]))
        for one in threads:
            one.start()
        seen.wait("frame", 100)
        edge.stop(0.2)
        stopped.set()
        for one in threads:
            one.join(DEADLINE_S)
            assert not one.is_alive()
        assert seen.events[-1][0] == "down"
        total = edge.counters()[0]
        assert total.received_messages == len(seen.of("frame"))


def test_stop_before_start_and_from_a_callback(world: World) -> None:
    idle, _ = world.edge()
    _, port = idle.listen(HERE, 0)
    idle.stop()
    idle.stop()
    edge, seen = world.edge()
    assert edge.listen(HERE, port) == (HERE, port)
    edge.start()
    seen.on_frame_hook = lambda number, frame: edge.stop(0)
    peer = world.peer(port)
    peer.send(message(1))
    assert peer.receive() is None
    seen.wait("down")


def test_waiting_has_an_end(world: World) -> None:
    edge, _, _ = world.server()
    assert not edge.wait_links(1, 0.01)
    waited: list[bool] = []
    waiter = threading.Thread(target=lambda: waited.append(edge.wait_links(1, None)))
    waiter.start()
    edge.stop()
    waiter.join(DEADLINE_S)
    assert waited == [False]
