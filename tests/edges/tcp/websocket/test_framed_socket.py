"""WebSocket at the TCP edge: real sockets, and the client of an independent library (``websockets``)."""

from __future__ import annotations

import socket
import threading
from collections import Counter, deque
from collections.abc import Sequence
from contextlib import suppress
from itertools import accumulate
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from websockets.client import ClientProtocol
from websockets.exceptions import ConnectionClosed
from websockets.frames import Opcode
from websockets.protocol import OPEN
from websockets.sync.client import ClientConnection, connect
from websockets.uri import parse_uri

from igtl_gateway.base.clock import ManualClock
from igtl_gateway.edges.tcp import PeerLimits, TcpEdge
from igtl_gateway.edges.tcp.layered_link import PING_S
from igtl_gateway.edges.tcp.sockets import UNANSWERED_S
from igtl_gateway.edges.tcp.tls import TLS_TO_PLAIN
from igtl_gateway.edges.tcp.websocket import Origins, WebSocketSocket
from tests.edges.tcp.test_tls import SERVER, context
from tests.edges.tcp.websocket.hostile_websockets import BEGIN, CASES, END, PAGE, Case, frame, request, table
from tests.edges.tcp.world import BIG, DEADLINE_S, HERE, Peer, Seen, World, message, number_of, until
from tests.tables import all_hold

SIZES = (8, 60, 67, 68, 100, 65_477, 65_478, 70_000, 3_000_000)


def serving(world: World, *, tls: bool = False, **settings: Any) -> tuple[TcpEdge, Seen, int]:
    """A server for WebSocket."""
    edge, seen = world.edge(**settings)
    _, port = edge.listen(HERE, 0, tls=tls, websocket=True)
    edge.start()
    return edge, seen, port


def client(world: World, port: int, scheme: str = "ws", **settings: Any) -> ClientConnection:
    settings = {
        "user_agent_header": "Python",
        "compression": None,
        "max_size": None,
        "open_timeout": DEADLINE_S,
        "ping_interval": None,
    } | settings
    made = connect(f"{scheme}://{HERE}:{port}/", **settings).__enter__()
    world.closes(lambda: made.__exit__(None, None, None))
    return made


def raw(world: World, port: int, behind: bytes = b"") -> Peer:
    """A peer behind its handshake, whose bytes are its own."""
    peer = world.peer(port)
    peer.send(request())
    answer = b""
    while not answer.endswith(b"\r\n\r\n"):
        answer += peer.sock.recv(1)
    assert answer.startswith(b"HTTP/1.1 101")
    peer.send(behind)
    return peer


def code_of(data: bytes) -> int:
    """The code with which the conversation ended: of HTTP, or of the frame that closes it."""
    if data.startswith(b"HTTP/1.1 101"):
        data = data.partition(b"\r\n\r\n")[2]
        assert data[0] == 0x88, "not a frame that closes"
        return int.from_bytes(data[2:4], "big")
    return int(data.split(b" ", 2)[1])


@pytest.mark.parametrize("scheme", ["ws", "wss"])
def test_messages_of_all_sizes_both_ways_and_an_end_that_is_said(world: World, scheme: str) -> None:
    tls = {"tls": SERVER} if scheme == "wss" else {}
    edge, seen = world.edge(**tls)
    _, port = edge.listen(HERE, 0, tls=bool(tls), websocket=True)
    edge.start()
    peer = client(world, port, scheme, **({"ssl": context()} if tls else {}))
    (up,) = seen.wait("up")
    facts = {"transport": "websocket", "origin": "", "agent": "Python"}
    facts |= {"tls": "TLSv1.3", "certificate": "commonName=TEST ONLY viewer"} if tls else {}
    assert {name: up.data[name] for name in facts} == facts
    assert up.text.endswith(" over WebSocket")
    sent = [message(number, size) for number, size in enumerate(SIZES)]
    for one in sent:
        edge.send([1], [memoryview(one)[:58], memoryview(one)[58:]], "a", True)
    assert [peer.recv() for _ in sent] == sent
    edge.send_all([1], [([one], "a") for one in sent], lambda: False)
    assert [peer.recv() for _ in sent] == sent
    for one in sent:
        peer.send(one)
    peer.send([sent[5][:1], b"", sent[5][1:60], sent[5][60:]])  # in parts, one of them empty
    assert seen.wait("frame", len(sent) + 1) == [*sent, sent[5]]
    assert peer.ping().wait(DEADLINE_S)
    counts = edge.counters()[1]
    total = sum(map(len, sent))
    assert (counts.sent_messages, counts.sent_bytes) == (2 * len(sent), 2 * total), "without what frames them"
    assert (counts.received_messages, counts.received_bytes) == (len(sent) + 1, total + len(sent[5]))
    edge.stop()
    with pytest.raises(ConnectionClosed) as end:
        peer.recv()
    assert end.value.rcvd and (end.value.rcvd.code, end.value.rcvd.reason) == (1001, "stopped")


def test_a_goodbye_is_no_loss(world: World) -> None:
    edge, seen, port = serving(world)
    peer = client(world, port)
    peer.send(message(1))
    peer.close(1001, "page left")
    (down,) = seen.wait("down")
    assert (down.data["reason"], down.data["unconfirmed_bytes"]) == ("closed by the peer", 0)
    assert seen.of("frame") == [message(1)]
    assert edge.link_faults() == {}


def test_hostile_peers_are_refused_or_disconnected_as_the_table_has_it(world: World) -> None:
    edge, seen, port = serving(world)
    good = client(world, port)
    refused: Counter[str] = Counter()
    faults: Counter[str] = Counter()

    def check(case: Case) -> None:
        frames, notes = len(seen.of("frame")), len(seen.of(case.noted))
        if case.answer < 1000:
            peer = world.peer(port)
            peer.send(case.data or request(case.headers))
            refused[case.noted] += 1
        else:
            peer = raw(world, port, case.data)
            faults[case.noted] += 1
        data = bytearray(b"" if case.answer < 1000 else b"HTTP/1.1 101\r\n\r\n")
        with suppress(ConnectionResetError):  # what it has sent beyond is not read
            while part := peer.sock.recv(1 << 16):
                data += part
        assert code_of(bytes(data)) == case.answer, bytes(data)
        if case.answer < 1000:
            until(lambda: edge.refused() == dict(refused))
        else:
            seen.wait(case.noted, notes + 1)
        assert len(seen.of("frame")) == frames + case.taken
        good.send(message(2))
        seen.wait("frame", frames + case.taken + 1)

    all_hold({case.what: case for case in CASES}, check)
    until(lambda: edge.link_faults() == dict(faults))
    assert PAGE.read_text("utf-8").partition(BEGIN)[2].partition(END)[0] == table()


def test_tls_spoken_to_a_port_without_it_is_told(world: World) -> None:
    edge, _, port = serving(world)
    with pytest.raises(OSError):
        context().wrap_socket(world.peer(port).sock, server_hostname=HERE)
    until(lambda: edge.refused() == {TLS_TO_PLAIN: 1})


def test_pages_that_are_named_may_come(world: World) -> None:
    _, seen, port = serving(world, origins=("https://viewer.clinic",))
    client(world, port, origin="https://viewer.clinic").send(message(1))
    seen.wait("frame")
    assert seen.of("up")[0].data["origin"] == "https://viewer.clinic"


def test_who_leaves_inside_of_a_frame_has_lost_a_message(world: World) -> None:
    edge, seen, port = serving(world)
    peer = raw(world, port, frame(message(1, 100_000))[:50_000])
    until(lambda: edge.counters().get(1, edge.counters()[0]).received_bytes > 40_000)
    peer.close()
    (note,) = seen.wait("truncated")
    assert (note.data["expected"], seen.wait("down")[0].data["reason"]) == (100_058, "closed by the peer")


def test_a_slow_reader_gets_whole_messages_while_old_ones_are_dropped(world: World) -> None:
    edge, seen, port = serving(world, limits=PeerLimits(queue_messages=20))
    peer = raw(world, port)
    assert edge.wait_links(1, DEADLINE_S)
    for number in range(400):
        edge.send([1], [message(number, 100_000)], "a", False)
        if number % 40 == 0:
            peer.send(frame(b"%d" % number, 9))  # a ping: its answer must not come inside of a message
    seen.wait("queue_drop")
    dropped = edge.counters()[1].dropped["a"]
    protocol = ClientProtocol(parse_uri(f"ws://{HERE}/"), state=OPEN, max_size=None)
    numbers: list[int] = []
    pongs: list[bytes] = []
    while len(numbers) < 400 - dropped or pongs[-1:] != [b"360"]:
        protocol.receive_data(peer.sock.recv(1 << 16))
        events: Any = protocol.events_received()
        assert protocol.parser_exc is None
        for event in events:
            if event.opcode is Opcode.BINARY:
                numbers.append(number_of(event.data))
            else:
                pongs.append(event.data)
    assert numbers == sorted(set(numbers)) and numbers[-1] == 399
    assert edge.flush(DEADLINE_S)


def test_what_is_queued_is_sent_before_the_end(world: World) -> None:
    edge, seen, port = serving(world)
    peer = client(world, port)
    assert edge.wait_links(1, DEADLINE_S)
    edge.send([1], [message(1, BIG)], "a", True)
    edge.send([1], [message(2)], "a", True)
    stopper = threading.Thread(target=lambda: edge.stop(DEADLINE_S))
    stopper.start()
    assert [peer.recv(), peer.recv()] == [message(1, BIG), message(2)]
    with pytest.raises(ConnectionClosed):
        peer.recv()
    stopper.join()
    assert seen.of("down")[0].data["unsent"] == 0


def test_senders_in_several_threads_and_a_peer_that_talks_meanwhile(world: World) -> None:
    edge, seen, port = serving(world, when_full="block", limits=PeerLimits(queue_bytes=2**20))
    peer = client(world, port)
    assert edge.wait_links(1, DEADLINE_S)
    count = 100

    def flood(base: int) -> None:
        for number in range(count):
            edge.send([1], [message(base + number, (number * 7919) % 90_000)], "a", True)

    def talk() -> None:
        for number in range(count):
            peer.send(message(number, (number * 7919) % 90_000))
            peer.ping()

    threads = [threading.Thread(target=flood, args=(base,)) for base in (0, 1000)] + [threading.Thread(target=talk)]
    for thread in threads:
        thread.start()
    numbers = [number_of(peer.recv()) for _ in range(2 * count)]
    for thread in threads:
        thread.join()
    for base in (0, 1000):
        assert [n - base for n in numbers if base <= n < base + count] == list(range(count))
    assert [number_of(one) for one in seen.wait("frame", count)] == list(range(count))


def test_a_relay_has_browsers_on_one_side_and_tcp_on_the_other(world: World) -> None:
    server = world.listener()
    edge, seen = world.edge()
    seen.on_frame_hook = lambda number, data: edge.send((3 - number,), (data,), "s", True)
    _, port = edge.relay(HERE, 0, server.getsockname(), websocket=True)
    edge.start()
    browser = client(world, port)
    behind = world.accepted(server)
    for one in (message(1), message(2, 100_000)):
        browser.send(one)
        assert behind.receive() == one
        behind.send(one)
        assert browser.recv() == one
    behind.close()
    with pytest.raises(ConnectionClosed) as end:
        browser.recv()
    assert end.value.rcvd and end.value.rcvd.code == 1000


def test_one_client_too_many_is_asked_to_come_later(world: World) -> None:
    edge, _, port = serving(world, limits=PeerLimits(max_clients=2))
    client(world, port)
    assert edge.wait_links(1, DEADLINE_S)
    first, second = world.peer(port), world.peer(port)
    until(lambda: len(edge._addresses._handshakes) == 2)
    first.send(request())
    assert edge.wait_links(2, DEADLINE_S)
    second.send(request())
    data = b""
    while part := second.sock.recv(1 << 16):
        data += part
    assert code_of(data) == 1013
    assert edge.refused() == {"2 clients are connected already": 1}


def test_who_does_not_end_the_handshake_is_refused_in_time(world: World) -> None:
    clock = ManualClock()
    edge, seen, port = serving(world, clock=clock)
    slow = world.peer(port)
    slow.send(request()[:-2])
    other = client(world, port)
    other.send(message(1))
    seen.wait("frame")
    clock.advance(11 * 10**9)
    other.send(message(2))  # the loop looks at the clock
    assert slow.receive() is None
    until(lambda: edge.refused() == {"no WebSocket handshake in time": 1})


@pytest.mark.parametrize("answers", [True, False])
def test_a_silent_peer_is_asked_whether_it_is_there(world: World, answers: bool) -> None:
    clock = ManualClock()
    edge, seen, port = serving(world, clock=clock)
    peer = raw(world, port)
    nudge = client(world, port)
    seen.wait("up", 2)

    def pass_s(seconds: float) -> None:
        """Let time pass in steps that the check takes for its own."""
        for step in range(round(2 * seconds)):
            clock.advance(5 * 10**8)
            frames = len(seen.of("frame"))
            nudge.send(message(step))  # the loop looks at the clock
            seen.wait("frame", frames + 1)

    pass_s(PING_S + 2)
    assert peer.sock.recv(2) == b"\x89\x00", "an empty ping"
    if answers:
        peer.send(frame(b"", 10))
    pass_s(UNANSWERED_S + 2)
    if answers:
        assert seen.of("unreachable") == []
        assert peer.sock.recv(2) == b"\x89\x00", "the next one"
    else:
        (note,) = seen.wait("unreachable")
        assert "has not answered a ping for 2" in note.text
        assert edge.link_faults() == {"unreachable": 1}


class NarrowSocket(socket.socket):
    """Takes as many bytes at a time as it has room for."""

    def __init__(self) -> None:
        super().__init__()
        self.rooms: deque[int] = deque()
        self.got = b""
        self.incoming = b""

    def sendmsg(self, parts: Sequence[Any], *_: Any) -> int:  # type: ignore[override]
        if not self.rooms:
            raise BlockingIOError
        taken = b"".join(map(bytes, parts))[: self.rooms.popleft()]
        self.got += taken
        if not taken:
            raise BlockingIOError
        return len(taken)

    def send(self, part: Any, *_: Any) -> int:
        return self.sendmsg((part,))

    def recv_into(self, room: Any, *_: Any) -> int:
        if not self.incoming:
            raise BlockingIOError
        count = min(len(room), len(self.incoming))
        room[:count], self.incoming = self.incoming[:count], self.incoming[count:]
        return count


@given(
    st.lists(st.integers(8, 300), min_size=1, max_size=5),
    st.lists(st.tuples(st.integers(0, 90), st.booleans(), st.booleans()), max_size=40),
    st.booleans(),
)
def test_whatever_the_kernel_takes_frames_are_whole_and_pongs_between_them(
    sizes: list[int], turns: list[tuple[int, bool, bool]], joined: bool
) -> None:
    """A model of the sender: bytes that were taken are never offered again, and all others are.

    Where nothing waits, the native passage may send a message in its frame, or the beginning of it.
    """
    sock = NarrowSocket()
    layer = WebSocketSocket(sock, Origins())
    sock.incoming = request()
    sock.rooms = deque([1000])
    assert layer.do_handshake()
    sock.got = b""
    messages = [message(number, size) for number, size in enumerate(sizes)]
    stream = b"".join(messages)
    starts = [0, *accumulate(map(len, messages))]
    sent, pings = 0, 0
    for room, pings_too, is_native in [*turns, *[(1000, True, False)] * 10]:
        if pings_too:
            sock.incoming += frame(b"%d" % pings, 9)
            pings += 1
            with suppress(BlockingIOError):
                layer.recv_into(memoryview(bytearray(100)))
        sock.rooms = deque([room, 3])
        if is_native and not layer.pending and sent in starts[:-1] and room:
            whole = messages[starts.index(sent)]
            framed = frame(whole, mask=False)
            sock.got += framed[:room]
            sent += len(whole) if room >= len(framed) else layer.take_over(whole, room)
        elif sent < len(stream):
            with suppress(BlockingIOError):
                sent += layer.sendmsg([stream[sent:]] if joined else rest_of(messages, sent))
        sock.rooms.clear()
    sock.rooms = deque([10_000] * 4)
    assert (sent, layer.flush(), layer.pending) == (len(stream), True, 0)
    sock.close()
    protocol = ClientProtocol(parse_uri(f"ws://{HERE}/"), state=OPEN)
    protocol.receive_data(sock.got)
    found: Any = protocol.events_received()
    assert protocol.parser_exc is None
    assert [one.data for one in found if one.opcode is Opcode.BINARY] == messages
    pongs = [int(one.data) for one in found if one.opcode is Opcode.PONG]
    assert pongs == sorted(set(pongs)) and pongs[-1] == pings - 1, "in order, the newest at last"


def rest_of(parts: Sequence[bytes], sent: int) -> list[bytes]:
    """What follows the first bytes of parts."""
    rest: list[bytes] = []
    for part in parts:
        if sent < len(part):
            rest.append(part[sent:])
        sent = max(0, sent - len(part))
    return rest


def test_one_system_call_at_most_and_few_frames_in_a_turn() -> None:
    """A flood of pings, or of tiny messages, is decoded a few at a time: others have their turns."""
    sock = NarrowSocket()
    layer = WebSocketSocket(sock, Origins())
    sock.incoming, sock.rooms = request(), deque([1000] * 50)
    assert layer.do_handshake()
    sock.incoming = frame(message(1)) * 20 + frame(b"", 9) * 20
    room = memoryview(bytearray(1 << 20))
    counts = [layer.recv_into(room), layer.recv_into(room), layer.recv_into(room)]
    assert counts == [8 * 106 for _ in range(2)] + [4 * 106] and layer.more
    for more in (True, True, False):
        with pytest.raises(BlockingIOError):
            layer.recv_into(room)
        assert layer.more is more
    sock.close()


def test_facts_are_bounded(world: World) -> None:
    _, seen, port = serving(world)
    client(world, port, user_agent_header="x" * 5000)
    (up,) = seen.wait("up")
    assert up.data["agent"] == "x" * 200


def test_a_flood_of_pings_fills_no_memory(world: World) -> None:
    """The newest answer is enough (RFC 6455, 5.5.3): this peer reads none."""
    edge, seen, port = serving(world)
    peer = raw(world, port)
    for _ in range(20):
        peer.send(frame(bytes(125), 9) * 1000)
    peer.send(frame(message(1)))
    seen.wait("frame")
    assert edge.counters()[1].queued_bytes == 0
