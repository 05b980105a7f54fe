"""Which connection becomes a link next, and that crowds which come and leave keep no new peer waiting."""

from __future__ import annotations

import socket
import struct
import sys
import threading
from collections.abc import Iterator

import pytest

from igtl_gateway.edges.tcp import TcpEdge, lobby
from igtl_gateway.edges.tcp.lobby import CROWD, KEPT, WAIT_NS, WITHIN_NS, Lobby, Waiting
from igtl_gateway.wire.header import HEADER_SIZE
from tests.edges.tcp.world import DEADLINE_S, World, message, until

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="only Linux shows who has left")


class Crowd:
    """Peers with names, and their connections in a lobby, at a time of its own."""

    def __init__(self) -> None:
        self.lobby = Lobby()
        self.now_ns = 1
        self.peers: dict[str, socket.socket] = {}

    def come(self, *names: str, host: str = "here") -> None:
        for name in names:
            ours, self.peers[name] = socket.socketpair()
            self.lobby.arrived(self.now_ns)
            self.lobby.add(Waiting(ours, (host, name)), self.now_ns)

    def leave(self, *names: str, message: bytes = b"") -> None:
        for name in names:
            with self.peers.pop(name) as peer:
                if message:
                    peer.sendall(message)

    def take(self, number: int) -> list[str]:
        taken = []
        for _ in range(number):
            one, gone = self.lobby.take(self.now_ns)
            assert not gone
            assert one
            taken.append(self._close(one))
        return taken

    def sift(self) -> tuple[set[str], list[str]]:
        """All that are due now: those that have left, and the others in their order."""
        left, stay = set[str](), list[str]()
        while True:
            one, gone = self.lobby.take(self.now_ns)
            left.update(map(self._close, gone))
            if one:
                stay.append(self._close(one))
            elif not gone:
                return left, stay

    def give_way(self) -> set[str]:
        return {self._close(one) for one in self.lobby.make_room()}

    def close(self) -> None:
        self.lobby.close()
        for peer in self.peers.values():
            peer.close()

    def _close(self, one: Waiting) -> str:
        one.sock.close()
        return str(one.address[1])


@pytest.fixture
def crowd() -> Iterator[Crowd]:
    made = Crowd()
    yield made
    made.close()


def names(number: int) -> list[str]:
    return [f"left {index}" for index in range(number)]


def test_they_come_in_their_order(crowd: Crowd) -> None:
    crowd.come("a", "b", "c")
    assert crowd.take(3) == ["a", "b", "c"]
    assert crowd.lobby.due_ns is None


def test_who_has_gone_without_a_word_is_last(crowd: Crowd) -> None:
    crowd.come("gone", "a", "b")
    crowd.leave("gone")
    assert crowd.take(3) == ["a", "b", "gone"]


def test_a_program_with_a_connection_for_each_message_keeps_their_order(crowd: Crowd) -> None:
    crowd.come("start", "stop")
    crowd.leave("start", message=bytes(HEADER_SIZE))
    assert crowd.take(2) == ["start", "stop"]


def test_a_new_peer_does_not_wait_for_a_crowd_that_has_left(crowd: Crowd) -> None:
    crowd.come(*names(KEPT + 1), "new")
    crowd.leave(*names(KEPT + 1), message=bytes(HEADER_SIZE))
    assert crowd.take(2) == ["new", "left 0"]


def test_hosts_take_turns(crowd: Crowd) -> None:
    crowd.come("a", "b", "c", host="crowd")
    crowd.come("new", host="other")
    crowd.come("late", host="third")
    assert crowd.take(5) == ["a", "new", "late", "b", "c"]


def test_where_there_is_no_room_those_that_have_left_give_way(crowd: Crowd, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(lobby, "ROOM", 4)
    crowd.come("gone", "left", "also left")
    assert crowd.give_way() == set()
    crowd.come("stays")
    assert crowd.lobby.is_full and crowd.give_way() == set()
    crowd.leave("left", "also left", message=bytes(HEADER_SIZE))
    crowd.leave("gone")
    assert crowd.give_way() == {"gone"}
    crowd.come("new")
    assert crowd.give_way() == {"left", "also left"}
    assert crowd.take(2) == ["stays", "new"]


def test_of_those_that_left_a_message_half_give_way(crowd: Crowd, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(lobby, "ROOM", 4)
    crowd.come(*names(4))
    crowd.leave(*names(4), message=bytes(HEADER_SIZE))
    assert crowd.give_way() == {"left 0", "left 1", "left 2"}


def test_in_a_crowd_each_waits_and_who_leaves_without_a_message_is_gone(crowd: Crowd) -> None:
    begun = [f"begun {index}" for index in range(3)]
    crowd.come(*names(CROWD), *begun, "says", "stays")
    crowd.leave("left 0")
    # those that came before it was a crowd are due at once: their links report that they have left
    assert crowd.sift() == (set(), [*names(CROWD - 1)[1:], "left 0"])
    crowd.leave(*names(CROWD)[CROWD - 1 :])
    crowd.leave(*begun, message=bytes(HEADER_SIZE - 1))
    crowd.leave("says", message=bytes(HEADER_SIZE))
    crowd.now_ns += WAIT_NS - 1
    assert crowd.sift() == (set(), [])
    crowd.now_ns += 1
    assert crowd.sift() == ({names(CROWD)[-1], *begun}, ["says", "stays"])


def test_who_is_reset_has_nothing_to_read_any_more(crowd: Crowd) -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        for number in range(CROWD):
            peer = socket.create_connection(server.getsockname())
            crowd.lobby.arrived(crowd.now_ns)
            crowd.lobby.add(Waiting(server.accept()[0], ("here", str(number))), crowd.now_ns)
            peer.sendall(bytes(HEADER_SIZE))
            peer.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
            peer.close()
    crowd.now_ns += WAIT_NS
    left, stay = crowd.sift()
    assert left == {str(CROWD - 1)}
    assert sorted(stay) == sorted(map(str, range(CROWD - 1)))


def test_who_comes_after_a_crowd_keeps_the_order(crowd: Crowd) -> None:
    crowd.come(*names(CROWD))
    crowd.now_ns += WITHIN_NS
    before_ns = crowd.lobby.due_ns
    crowd.come("new")
    assert crowd.sift() == (set(), [*names(CROWD), "new"])
    crowd.come("later")
    assert before_ns is not None
    assert crowd.lobby.due_ns == crowd.now_ns
    assert not crowd.lobby.is_crowd(crowd.now_ns)


# ── the edge ──────────────────────────────────────────────────────────────────────────────────────────────────────


def gone(edge: TcpEdge) -> int:
    return edge.refused().get("it left before its turn", 0)


def listen_without_reading(edge: TcpEdge) -> int:
    """Open a port as of an edge that does not come to read it; return its number."""
    _, port = edge.listen("127.0.0.1", 0)
    edge._addresses.open()
    return port


def test_beside_a_thousand_that_came_and_left_a_new_peer_is_served_at_once(world: World) -> None:
    edge, seen = world.edge()
    port = listen_without_reading(edge)
    for number in range(1000):  # before: the system's own queue had room for 256, and the next one came a second later
        with socket.create_connection(("127.0.0.1", port), DEADLINE_S) as sock:
            sock.sendall(message(number))
    world.peer(port).send(message(5000))
    served = threading.Event()
    seen.on_frame_hook = lambda _link, frame: served.set() if frame == message(5000) else None
    edge.start()
    assert served.wait(DEADLINE_S)
    assert seen.of("frame").index(message(5000)) < 100


def test_each_of_two_hundred_that_leave_a_message_at_once_is_heard(world: World) -> None:
    """A program may have a connection for each message."""
    edge, seen = world.edge()
    port = listen_without_reading(edge)
    for number in range(200):
        with socket.create_connection(("127.0.0.1", port), DEADLINE_S) as sock:
            sock.sendall(message(number))
    edge.start()
    assert seen.wait("frame", 200) == [message(number) for number in range(200)]
    assert not edge.refused()


def test_a_crowd_that_comes_and_leaves_makes_few_links(world: World) -> None:
    edge, seen = world.edge()
    port = listen_without_reading(edge)
    for _ in range(200):
        socket.create_connection(("127.0.0.1", port), DEADLINE_S).close()
    edge.start()
    peer = world.peer(port)
    peer.send(message(1))
    seen.wait("frame")
    until(lambda: gone(edge) + len(seen.of("down")) == 200)
    assert gone(edge) > 200 - 2 * CROWD


def test_who_gives_way_is_counted_and_noted(world: World, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(lobby, "ROOM", 8)
    edge, seen = world.edge()
    port = listen_without_reading(edge)
    for _ in range(50):
        socket.create_connection(("127.0.0.1", port), DEADLINE_S).close()
    edge.start()
    (note,) = seen.wait("refused")
    assert note.data["reason"] == "it left before its turn"
    until(lambda: gone(edge) + len(seen.of("down")) == 50)
