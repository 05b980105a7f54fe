"""Pairs of links: a client and its own connection to the server."""

from __future__ import annotations

import hashlib
import threading
from typing import Any

import pytest

from igtl_gateway.base.errors import ConfigError
from igtl_gateway.edges.tcp import PeerLimits, TcpEdge
from igtl_gateway.edges.tcp.dialer import Dialer
from tests.edges.tcp.world import BIG, HERE, Peer, Seen, World, header, message, number_of


def between(world: World, server_port: int, **settings: Any) -> tuple[TcpEdge, Seen, int]:
    """An edge whose frames go to the partner, as the core of the relay has it; and its port."""
    edge, seen = world.edge(**settings)

    def pass_on(number: int, frame: Any) -> None:
        partner = number + 1 if number % 2 else number - 1
        edge.send((partner,), (frame,), "s", True)

    seen.on_frame_hook = pass_on
    _, port = edge.relay(HERE, 0, (HERE, server_port))
    edge.start()
    return edge, seen, port


def test_each_client_gets_a_connection_of_its_own(world: World) -> None:
    server = world.listener()
    _, seen, port = between(world, server.getsockname()[1])
    pairs = []
    for number in range(3):
        client = world.peer(port)
        client.send(message(number))  # before its connection to the server is made
        pairs.append((client, world.accepted(server)))
    for number, (client, behind) in enumerate(pairs):
        assert behind.receive() == message(number)
        behind.send(message(10 + number))
        assert client.receive() == message(10 + number)
    ups = [(number, note.data["role"], note.data.get("partner")) for what, number, note in seen.events if what == "up"]
    assert ups == [(n, *row) for n in (1, 3, 5) for n, row in ((n, ("server", None)), (n + 1, ("client", n)))]


def test_the_end_of_one_side_is_the_end_of_the_other_and_of_no_other_pair(world: World) -> None:
    server = world.listener()
    _, seen, port = between(world, server.getsockname()[1])
    first, behind_first = world.peer(port), world.accepted(server)
    second, behind_second = world.peer(port), world.accepted(server)
    first.send(message(1))
    first.close()
    assert behind_first.receive_all() == [message(1)]
    behind_first.close()
    seen.wait("down", 2)
    behind_second.send(message(2))
    behind_second.close()
    assert second.receive_all() == [message(2)]
    second.close()
    downs = {number: note.data["reason"] for what, number, note in seen.events if what == "down"}
    seen.wait("down", 4)
    assert downs[1] == "closed by the peer"
    assert downs[2] == "the other side disconnected"


def test_a_client_is_closed_where_no_server_is_and_served_when_it_is_there(world: World) -> None:
    server = world.listener()
    server_port = server.getsockname()[1]
    server.close()
    _, seen, port = between(world, server_port)
    early = world.peer(port)
    assert early.receive() is None
    (note,) = seen.wait("connect_failed")
    assert note.data["count"] == 1
    assert f"cannot connect to {HERE}:{server_port}" in note.text
    server = world.listener(server_port)
    late = world.peer(port)
    behind = world.accepted(server)
    behind.send(message(3))
    assert late.receive() == message(3)
    assert not seen.of("up", 3)


def test_broken_framing_costs_the_pair(world: World) -> None:
    server = world.listener()
    _, seen, port = between(world, server.getsockname()[1])
    client, behind = world.peer(port), world.accepted(server)
    client.send(message(1) + header(1 << 50))
    assert behind.receive_all() == [message(1)]
    assert client.receive() is None
    behind.close()
    seen.wait("down", 2)
    assert seen.of("too_large", 1)


@pytest.mark.slow
def test_a_slow_reader_slows_its_partner_down_and_loses_nothing(world: World) -> None:
    server = world.listener()
    edge, seen, port = between(world, server.getsockname()[1], limits=PeerLimits(queue_bytes=4 * BIG))
    client = world.peer(port, receive_buffer=4096)
    behind = world.accepted(server)
    small, big = [message(number) for number in range(20_000)], [message(7, BIG), message(8, BIG)]
    sent = b"".join([*small, *big, *small])

    def flood() -> None:
        behind.send(sent)
        assert behind.receive() == message(1)  # who closes with unread bytes resets the connection
        behind.close()

    sender = threading.Thread(target=flood)
    sender.start()
    try:
        # the other direction goes on while this one is stuck
        client.send(message(1))
        got = [client.receive() for _ in range(len(small))]
        assert sender.is_alive(), "the relay took everything at once: nothing made the sender wait"
        assert edge.counters()[1].queued_bytes <= BIG + 2**17
        got += client.receive_all()
    finally:
        client.close()
        sender.join()
    assert hashlib.sha256(b"".join(filter(None, got))).digest() == hashlib.sha256(sent).digest()
    seen.wait("down", 2)
    assert not seen.of("queue_drop") + seen.of("queue_full") + seen.of("stalled")
    assert [number_of(frame) for frame in seen.of("frame", 1)] == [1]


def test_stop_closes_pairs_and_clients_that_wait(world: World, monkeypatch: pytest.MonkeyPatch) -> None:
    # a server whose queue of connections is full answers nothing
    monkeypatch.setattr(Dialer, "dial", lambda self: None)
    edge, seen, port = between(world, 1)
    client = world.peer(port)
    client.send(message(1))
    edge.stop(0)
    with pytest.raises(ConnectionResetError):
        client.receive()
    assert seen.of("up") == []


def test_a_crowd_is_refused_with_those_that_wait_counted(world: World, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Dialer, "dial", lambda self: None)
    _, seen, port = between(world, 1, limits=PeerLimits(max_clients=1))
    waiting: Peer = world.peer(port)
    assert world.peer(port).receive() is None
    (note,) = seen.wait("refused")
    assert "1 client is connected already" in note.text
    waiting.close()


def test_a_port_that_is_none(world: World) -> None:
    edge, _ = world.edge()
    with pytest.raises(ConfigError, match="found port 0"):
        edge.relay(HERE, 0, (HERE, 0))
