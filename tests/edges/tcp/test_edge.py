"""The TCP edge as a whole: many links at once, and the end."""

from __future__ import annotations

import socket
import threading
from contextlib import suppress
from typing import Any

import pytest

from igtl_gateway.base.clock import SystemClock
from igtl_gateway.base.errors import ConfigError
from igtl_gateway.edges.tcp import LinkCounters, TcpEdge
from igtl_gateway.edges.tcp import edge as edge_module
from tests.edges.tcp.world import BIG, DEADLINE_S, HERE, Peer, World, message, number_of


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


@pytest.mark.parametrize("port", [0, 65536])
def test_connect_to_no_port(world: World, port: int) -> None:
    edge, _ = world.edge()
    with pytest.raises(ConfigError, match=r"connect 127\.0\.0\.1: found port"):
        edge.connect(HERE, port)


def test_unknown_links_are_ignored_and_counted(world: World) -> None:
    edge, seen, port = world.server()
    world.peer(port).close()
    seen.wait("down")
    edge.send([1, 99], [message(1)], "STRING/device", True)
    assert edge.counters() == {0: LinkCounters(ignored={"STRING/device": 2})}


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
    monkeypatch.setattr(edge_module, "_DRAIN_S", DEADLINE_S)
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

        def drain(peer: Peer = peer) -> None:
            with suppress(OSError):  # the edge lingers for a moment only, so the end may lie inside a message
                while peer.sock.recv(1 << 16):
                    pass

        threads = [threading.Thread(target=one) for one in (send, chat, drain)]
        for one in threads:
            one.start()
        seen.wait("frame", 100)
        edge.stop(0.2)
        stopped.set()
        with suppress(OSError):  # a peer whose window was closed may learn of the end a minute later
            peer.sock.shutdown(socket.SHUT_RDWR)
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


def test_nothing_begins_after_stop(world: World) -> None:
    edge, _, port = world.server()
    edge.stop()
    with pytest.raises(ConfigError, match=rf"^listen 127\.0\.0\.1:{port}: the edge was stopped"):
        edge.listen(HERE, port)
    with pytest.raises(ConfigError, match=rf"^connect 127\.0\.0\.1:{port}: the edge was stopped"):
        edge.connect(HERE, port)
    again, _ = world.edge()
    assert again.listen(HERE, port) == (HERE, port)  # nothing was left bound


def test_a_turn_that_fails_is_noted_and_the_thread_goes_on(world: World) -> None:
    class Clock(SystemClock):
        broken = 0

        def monotonic_ns(self) -> int:
            if self.broken:
                self.broken -= 1
                raise ArithmeticError("no time")
            return super().monotonic_ns()

    clock = Clock()
    edge, seen, port = world.server(clock=clock)
    peer = world.peer(port)
    assert edge.wait_links(1, DEADLINE_S)
    clock.broken = 1
    edge._loop.wake()
    (note,) = seen.wait("internal_error")
    assert note.data["error"] == "ArithmeticError: no time"
    peer.send(message(1))
    assert seen.wait("frame") == [message(1)]
