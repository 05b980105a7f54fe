"""Which connection becomes a link next, and that crowds which come and leave keep no new peer waiting."""

from __future__ import annotations

import socket
import sys
import threading
from collections.abc import Iterator

import pytest

from igtl_gateway.edges.tcp import lobby
from igtl_gateway.edges.tcp.lobby import KEPT, Lobby, Waiting
from tests.edges.tcp.world import DEADLINE_S, World, message

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="only Linux shows who has left")


class Crowd:
    """Peers with names, and their connections in a lobby."""

    def __init__(self) -> None:
        self.lobby = Lobby()
        self.peers: dict[str, socket.socket] = {}

    def come(self, *names: str, host: str = "here") -> None:
        for name in names:
            ours, self.peers[name] = socket.socketpair()
            self.lobby.add(Waiting(ours, host, name))

    def leave(self, *names: str, message: bytes = b"") -> None:
        for name in names:
            with self.peers.pop(name) as peer:
                if message:
                    peer.sendall(message)

    def take(self, number: int) -> list[str]:
        return [self._close(self.lobby.take()) for _ in range(number)]

    def give_way(self) -> set[str]:
        return {self._close(one) for one in self.lobby.make_room()}

    def close(self) -> None:
        self.lobby.close()
        for peer in self.peers.values():
            peer.close()

    def _close(self, one: Waiting) -> str:
        one.sock.close()
        return one.peer


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
    assert not crowd.lobby


def test_who_has_gone_without_a_word_is_last(crowd: Crowd) -> None:
    crowd.come("gone", "a", "b")
    crowd.leave("gone")
    assert crowd.take(3) == ["a", "b", "gone"]


def test_a_program_with_a_connection_for_each_message_keeps_their_order(crowd: Crowd) -> None:
    crowd.come("start", "stop")
    crowd.leave("start", message=b"start")
    assert crowd.take(2) == ["start", "stop"]


def test_a_new_peer_does_not_wait_for_a_crowd_that_has_left(crowd: Crowd) -> None:
    crowd.come(*names(KEPT + 1), "new")
    crowd.leave(*names(KEPT + 1), message=b"x")
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
    crowd.leave("left", "also left", message=b"x")
    crowd.leave("gone")
    assert crowd.give_way() == {"gone"}
    crowd.come("new")
    assert crowd.give_way() == {"left", "also left"}
    assert crowd.take(2) == ["stays", "new"]


def test_of_those_that_left_a_message_half_give_way(crowd: Crowd, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(lobby, "ROOM", 4)
    crowd.come(*names(4))
    crowd.leave(*names(4), message=b"x")
    assert crowd.give_way() == {"left 0", "left 1", "left 2"}


# ── the edge ──────────────────────────────────────────────────────────────────────────────────────────────────────


def test_beside_a_thousand_that_came_and_left_a_new_peer_is_served_at_once(world: World) -> None:
    edge, seen = world.edge()
    _, port = edge.listen("127.0.0.1", 0)
    for number in range(1000):  # before: the system's own queue had room for 256, and the next one came a second later
        with socket.create_connection(("127.0.0.1", port), DEADLINE_S) as sock:
            sock.sendall(message(number))
    world.peer(port).send(message(5000))
    served = threading.Event()
    seen.on_frame_hook = lambda _link, frame: served.set() if frame == message(5000) else None
    edge.start()
    assert served.wait(DEADLINE_S)
    assert seen.of("frame").index(message(5000)) < 100


def test_who_gives_way_is_counted_and_noted(world: World, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(lobby, "ROOM", 8)
    edge, seen = world.edge()
    _, port = edge.listen("127.0.0.1", 0)
    for _ in range(50):
        socket.create_connection(("127.0.0.1", port), DEADLINE_S).close()
    edge.start()
    (note,) = seen.wait("refused")
    assert note.data["reason"] == "it left before its turn"
    seen.wait("down", 50 - edge.refused()["it left before its turn"])
    assert edge.refused()["it left before its turn"] + len(seen.of("down")) == 50
