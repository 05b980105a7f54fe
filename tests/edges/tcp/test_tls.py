"""TLS at the TCP edge, both roles: real sockets, certificates for tests only (``pems``)."""

from __future__ import annotations

import os
import socket
import ssl
import threading
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest

from igtl_gateway.base.clock import ManualClock
from igtl_gateway.base.errors import ConfigError
from igtl_gateway.edges.tcp import PeerLimits, TcpEdge, TlsFiles
from igtl_gateway.edges.tcp.handshake import Handshake
from igtl_gateway.edges.tcp.loop import READ, WRITE, Loop
from igtl_gateway.edges.tcp.tls import PLAIN_TO_TLS, TLS_TO_PLAIN, TlsSocket
from tests.edges.tcp.world import BIG, DEADLINE_S, HERE, Peer, Seen, World, message, number_of, until

PEMS = Path(__file__).parent / "pems"


def files(name: str, ca: str = "ca") -> TlsFiles:
    return TlsFiles(PEMS / f"{name}.pem", None, PEMS / f"{ca}.pem" if ca else None)


SERVER, VIEWER = files("server"), files("viewer")


def secure(world: World, tls: TlsFiles = SERVER, **settings: Any) -> tuple[TcpEdge, Seen, int]:
    """A server with TLS."""
    edge, seen = world.edge(tls=tls, **settings)
    _, port = edge.listen(HERE, 0, tls=True)
    edge.start()
    return edge, seen, port


def context(name: str = "viewer") -> ssl.SSLContext:
    made = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    made.load_verify_locations(PEMS / "ca.pem")
    if name:
        made.load_cert_chain(PEMS / f"{name}.pem")
    return made


def client(world: World, port: int, using: ssl.SSLContext | None = None, receive_buffer: int = 0) -> Peer:
    """An independent TLS client: Python's own, blocking."""
    raw = Peer.to(port, receive_buffer).sock
    peer = Peer((using or context()).wrap_socket(raw, server_hostname=HERE))
    world.closes(peer.close)
    return peer


@pytest.mark.parametrize("version", [ssl.TLSVersion.TLSv1_2, ssl.TLSVersion.TLSv1_3])
def test_messages_of_all_sizes_both_ways_and_an_end_that_is_said(world: World, version: ssl.TLSVersion) -> None:
    edge, seen, port = secure(world)
    using = context()
    using.maximum_version = version
    peer = client(world, port, using)
    (up,) = seen.wait("up")
    assert up.data["tls"] == peer.sock.version()  # type: ignore[attr-defined]
    assert up.data["certificate"] == "commonName=TEST ONLY viewer"
    sent = [message(number, size) for number, size in enumerate((8, 100, 16_384, 70_000, 3_000_000))]
    for one in sent:
        edge.send([1], [one], "a", True)
    assert [peer.receive() for _ in sent] == sent
    peer.send(b"".join(sent))
    assert seen.wait("frame", len(sent)) == sent
    edge.stop()
    peer.sock.suppress_ragged_eofs = False  # type: ignore[attr-defined]
    assert peer.receive() is None, "an orderly close, not a reset"
    (down,) = seen.wait("down")
    assert down.data["reason"] == "stopped"


def test_a_goodbye_of_the_peer_is_no_loss(world: World) -> None:
    edge, seen, port = secure(world)
    peer = client(world, port)
    seen.wait("up")
    edge.send([1], [message(1)], "a", True)
    assert peer.receive() == message(1)
    peer.send(message(2))
    peer.sock.unwrap()  # type: ignore[attr-defined]
    (down,) = seen.wait("down")
    assert (down.data["reason"], seen.of("frame")) == ("closed by the peer", [message(2)])


@pytest.mark.parametrize("together", [True, False])
def test_a_goodbye_right_behind_a_message_is_seen(world: World, together: bool) -> None:
    """In one reception with it, and nothing follows: the peer waits for our orderly close."""
    _, seen, port = secure(world)
    raw = world.peer(port).sock
    incoming, outgoing = ssl.MemoryBIO(), ssl.MemoryBIO()
    theirs = context().wrap_bio(incoming, outgoing, server_hostname=HERE)

    def tell(step: Callable[[], object]) -> None:
        while True:
            try:
                step()
            except ssl.SSLWantReadError:
                raw.sendall(outgoing.read())
                data = raw.recv(1 << 16)
                incoming.write(data) if data else incoming.write_eof()
            else:
                raw.sendall(outgoing.read())
                return

    tell(theirs.do_handshake)
    seen.wait("up")
    theirs.write(message(1))
    if not together:
        raw.sendall(outgoing.read())
        seen.wait("frame")
    tell(theirs.unwrap)  # which returns after the orderly close of the edge
    (down,) = seen.wait("down")
    assert (down.data["reason"], seen.of("frame")) == ("closed by the peer", [message(1)])


def test_garbage_behind_the_handshake_costs_its_link_only(world: World) -> None:
    edge, seen, port = secure(world)
    good, bad = client(world, port), client(world, port)
    seen.wait("up", 2)
    bad.send(message(1))
    seen.wait("frame")
    os.write(bad.sock.fileno(), bytes(range(200)))
    (note,) = seen.wait("tls_failed")
    assert note.data["peer"] in seen.wait("down", 1, 2)[0].text
    assert edge.link_faults() == {"tls_failed": 1}
    good.send(message(2))
    assert seen.wait("frame", 1, 1) == [message(2)]


def test_two_edges_flood_each_other_from_several_threads(world: World) -> None:
    """One lock, two directions, senders in threads of their own: nothing is lost, mixed up or stuck."""
    server, served, port = secure(world, when_full="block", limits=PeerLimits(queue_bytes=2**20))
    dialer, dialled = world.edge(tls=VIEWER, when_full="block", limits=PeerLimits(queue_bytes=2**20))
    dialer.connect(HERE, port, tls=True)
    dialer.start()
    assert server.wait_links(1, DEADLINE_S) and dialer.wait_links(1, DEADLINE_S)
    count = 150

    def flood(edge: TcpEdge, base: int) -> None:
        for number in range(count):
            edge.send([1], [message(base + number, (number * 7919) % 90_000)], "a", True)

    senders = [
        threading.Thread(target=flood, args=(edge, base)) for edge in (server, dialer) for base in (0, 1_000_000)
    ]
    for sender in senders:
        sender.start()
    for sender in senders:
        sender.join()
    for seen in (served, dialled):
        numbers = [number_of(frame) for frame in seen.wait("frame", 2 * count)]
        for base in (0, 1_000_000):
            assert [n - base for n in numbers if 0 <= n - base < count] == list(range(count))


def test_a_slow_reader_gets_whole_messages_while_old_ones_are_dropped(world: World) -> None:
    edge, seen, port = secure(world, limits=PeerLimits(queue_messages=20))
    peer = client(world, port, receive_buffer=4096)
    assert edge.wait_links(1, DEADLINE_S)
    for number in range(400):
        edge.send([1], [message(number, 100_000)], "a", False)
    seen.wait("queue_drop")
    dropped = edge.counters()[1].dropped["a"]
    numbers = [number_of(peer.receive()) for _ in range(400 - dropped)]
    assert numbers == sorted(set(numbers)) and numbers[-1] == 399
    assert edge.flush(DEADLINE_S)


def test_what_was_encrypted_is_sent_before_the_end(world: World) -> None:
    edge, seen, port = secure(world)
    peer = client(world, port, receive_buffer=4096)
    assert edge.wait_links(1, DEADLINE_S)
    edge.send([1], [message(1, BIG)], "a", True)
    stopper = threading.Thread(target=lambda: edge.stop(DEADLINE_S))
    stopper.start()
    assert peer.receive() == message(1, BIG)
    assert peer.receive() is None
    peer.close()
    stopper.join()
    assert seen.of("down")[0].data["unsent"] == 0


@pytest.mark.parametrize(
    ("name", "reason"),
    [("", "no certificate"), ("expired", "certificate expired"), ("stranger", "certificate unknown")],
)
def test_a_client_without_a_good_certificate_is_refused(world: World, name: str, reason: str) -> None:
    edge, seen, port = secure(world)
    with pytest.raises(OSError):  # in the handshake, or, with TLS 1.3, behind it
        client(world, port, context(name)).receive()
        raise AssertionError("disconnected without an alert")
    (note,) = seen.wait("refused")
    assert note.data["reason"] == reason
    assert edge.refused() == {reason: 1}
    assert seen.of("up") == []


def test_without_a_ca_a_server_takes_everybody(world: World) -> None:
    _, seen, port = secure(world, files("server", ""))
    client(world, port, context("")).send(message(1))
    seen.wait("frame")
    assert seen.of("up")[0].data["certificate"] == ""


def test_plain_text_spoken_to_tls_and_tls_to_plain(world: World) -> None:
    edge, seen, port = secure(world)
    _, plain = edge.listen(HERE, 0)
    world.peer(port).send(message(1))
    (note,) = seen.wait("refused")
    assert (note.data["reason"], edge.refused()) == (PLAIN_TO_TLS, {PLAIN_TO_TLS: 1})
    with pytest.raises(OSError):
        client(world, plain)
    assert TLS_TO_PLAIN in seen.wait("refused", 2)[1].text
    assert edge.refused() == {PLAIN_TO_TLS: 1, TLS_TO_PLAIN: 1}
    client(world, port).send(message(2))  # and the next is served
    assert seen.wait("frame") == [message(2)]


def test_a_plain_client_is_told_what_the_server_speaks(world: World) -> None:
    server = world.listener()
    edge, seen = world.edge()
    edge.connect(*server.getsockname())
    edge.start()
    peer = world.accepted(server)
    peer.send(b"\x15\x03\x01\x00\x02\x02\x46")  # how OpenSSL answers what it cannot read
    peer.close()
    assert seen.wait("truncated")[0].text.endswith("; it speaks TLS")


def test_who_says_nothing_is_refused_in_time(world: World) -> None:
    clock = ManualClock()
    edge, seen, port = secure(world, clock=clock, limits=PeerLimits(max_clients=2, handshake_s=10))
    silent, client_ = world.peer(port), client(world, port)
    client_.send(message(1))
    seen.wait("frame")
    clock.advance(11 * 10**9)
    client_.send(message(2))  # the loop looks at the clock
    assert silent.receive() is None
    until(lambda: edge.refused() == {"no TLS handshake in time": 1})


def test_nobody_is_kept_out_by_those_who_say_nothing(world: World) -> None:
    edge, seen, port = secure(world, limits=PeerLimits(max_clients=3))
    first = client(world, port)
    first.send(message(1))
    seen.wait("frame")
    silent = [world.peer(port) for _ in range(20)]
    second = client(world, port)
    second.send(message(2))
    seen.wait("frame", 2)
    until(lambda: edge.refused() == {"no TLS handshake before others came": 18})
    assert [one.receive() for one in silent[:18]] == [None] * 18, "the oldest gave way"
    client(world, port).send(message(3))
    seen.wait("frame", 3)
    with suppress(OSError):
        assert client(world, port).receive() is None
    assert edge.refused()["3 clients are connected already"] == 1
    first.send(message(4))
    assert len(seen.wait("frame", 4)) == 4


def test_who_has_begun_gives_way_last(world: World) -> None:
    edge, seen, port = secure(world, limits=PeerLimits(max_clients=2))
    begun = world.peer(port)
    begun.send(b"\x16\x03\x01\x02\x00")  # of a first word, the beginning
    silent = world.peer(port)
    client(world, port).send(message(1))
    seen.wait("frame")
    assert silent.receive() is None
    assert edge.refused() == {"no TLS handshake before others came": 1}


def test_one_that_gave_way_in_the_turn_in_which_it_spoke_is_over() -> None:
    ours, theirs = socket.socketpair()
    ours.setblocking(False)
    told: list[str] = []
    loop = Loop(ManualClock(), lambda: None, lambda exc: told.append(f"{exc}"))
    secured = TlsSocket(ours, SERVER.server(), server_side=True)

    def refused(reason: str, detail: str) -> None:
        told.append(reason)
        secured.close()

    handshake = Handshake(secured, loop, lambda: told.append("done"), refused, lambda exc: told.append(f"{exc}"))
    handshake.begin(10)
    theirs.send(b"\x16\x03\x01")
    # both are ready: the listener, whose peer makes this one give way, and this one
    loop.watch(theirs, WRITE, lambda _: handshake.yield_to_newer() if not told else None)
    loop.run_once(0)
    handshake._step(READ)
    assert told == ["no TLS handshake before others came"]
    loop.close()
    theirs.close()


def test_a_stopped_edge_lets_go_of_who_is_in_the_handshake(world: World) -> None:
    edge, _, port = secure(world)
    silent, other = world.peer(port), client(world, port)
    assert edge.wait_links(1, DEADLINE_S)
    edge.stop()
    assert silent.receive() is None and other.receive() is None


@pytest.mark.parametrize(
    ("tls", "cause"),
    [
        (files("elsewhere"), "certificate of another host"),
        (files("expired"), "certificate expired"),
        (files("stranger", ""), "certificate unknown"),
    ],
)
def test_a_server_without_a_good_certificate_is_not_talked_to(world: World, tls: TlsFiles, cause: str) -> None:
    _, served, port = secure(world, tls)
    edge, seen = world.edge(tls=VIEWER)
    edge.connect(HERE, port, tls=True)
    edge.start()
    assert seen.wait("connect_failed")[0].data["reason"].startswith(cause)
    assert served.wait("refused")[0].data["reason"] == "the other side refuses our certificate"
    assert seen.of("up") == served.of("up") == []


def test_a_client_that_is_refused_says_so_and_is_never_up(world: World) -> None:
    _, served, port = secure(world)
    edge, seen = world.edge(tls=files("stranger"))
    edge.connect(HERE, port, tls=True)
    edge.start()
    assert seen.wait("connect_failed")[0].data["reason"].startswith("the other side refuses our certificate (")
    served.wait("refused")
    assert seen.of("up") == served.of("up") == []


@pytest.mark.parametrize("speaks_first", [True, False])
def test_a_server_without_tickets_is_believed_after_a_moment(world: World, speaks_first: bool) -> None:
    using = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    using.load_cert_chain(PEMS / "server.pem")
    using.num_tickets = 0
    server = world.listener()
    edge, seen = world.edge(tls=VIEWER)
    edge.connect(*server.getsockname(), tls=True)
    edge.start()
    peer = Peer(using.wrap_socket(world.accepted(server).sock, server_side=True))
    world.closes(peer.close)
    first = message(1, 100_000) + message(2)
    if speaks_first:
        peer.send(first)
    seen.wait("up")
    if not speaks_first:
        peer.send(first)
    assert seen.wait("frame", 2) == [message(1, 100_000), message(2)]


def test_a_server_that_speaks_no_tls_is_tried_again(world: World) -> None:
    server = world.listener()
    edge, seen = world.edge(tls=VIEWER)
    edge.connect(*server.getsockname(), tls=True)
    edge.start()
    world.accepted(server).send(message(1))
    (note,) = seen.wait("connect_failed")
    assert note.data["reason"] == "the server does not speak TLS"
    world.accepted(server)


@pytest.mark.parametrize("tls_to", [True, False])
def test_a_relay_with_tls_to_the_client_and_perhaps_to_the_server(world: World, tls_to: bool) -> None:
    server, served = world.edge(tls=SERVER)
    _, back = server.listen(HERE, 0, tls=tls_to)
    server.start()
    relay, seen = world.edge(tls=SERVER)
    seen.on_frame_hook = lambda number, frame: relay.send([3 - number], [frame], "a", True)
    _, front = relay.relay(HERE, 0, (HERE, back), tls=True, tls_to=tls_to)
    relay.start()
    peer = client(world, front)
    peer.send(message(1, 500_000) + message(2))
    assert served.wait("frame", 2) == [message(1, 500_000), message(2)]
    server.send([1], [message(3, 300_000)], "a", True)
    assert peer.receive() == message(3, 300_000)
    server.stop()
    assert peer.receive() is None, "the end of one is the end of the other"


@pytest.mark.parametrize(
    ("tls", "role", "text"),
    [
        (TlsFiles(), "server", "found no certificate"),
        (TlsFiles(PEMS / "none.pem"), "server", "No such file"),
        (TlsFiles(PEMS / "ca.pem"), "client", "expected a certificate and its own key"),
        (TlsFiles(PEMS / "server.pem", PEMS / "viewer.pem"), "server", "expected a certificate and its own key"),
        (TlsFiles(None, PEMS / "viewer.pem"), "client", "found no --tls-cert"),
        (TlsFiles(PEMS / "server.pem", None, PEMS / "README.md"), "server", "expected certificates as PEM"),
        (TlsFiles(None, None, PEMS / "none.pem"), "client", "No such file"),
    ],
)
def test_files_that_are_of_no_use(tls: TlsFiles, role: str, text: str) -> None:
    with pytest.raises(ConfigError, match=text):
        getattr(tls, role)()


@pytest.mark.parametrize("kind", ["a FIFO", "a device"])
def test_nothing_waits_for_what_is_no_file(kind: str, tmp_path: Path) -> None:
    path, good = tmp_path / "some.pem", PEMS / "server.pem"
    if kind == "a FIFO":
        os.mkfifo(path)
    else:
        path.symlink_to("/dev/zero")
    for option, tls in (
        ("--tls-cert", TlsFiles(path)),
        ("--tls-key", TlsFiles(good, path)),
        ("--tls-ca", TlsFiles(good, None, path)),
    ):
        with pytest.raises(ConfigError, match=f"{option} {path}: found {kind}, expected a file"):
            tls.server()
