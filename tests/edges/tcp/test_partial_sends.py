"""A kernel that takes what it likes: every message arrives whole and in its order, or is counted as dropped."""

from __future__ import annotations

import random
import socket
import threading
from collections import Counter
from collections.abc import Sequence
from typing import Any

import pytest

from igtl_gateway.edges.tcp import Limits, tls
from igtl_gateway.edges.tcp import link as link_module
from tests.edges.tcp.test_tls import SERVER, client
from tests.edges.tcp.world import DEADLINE_S, HERE, Peer, World, message, number_of

EACH = 120
SENDERS = 4


class Stingy:
    """A socket whose ``send`` takes a part, or nothing for now, by chance."""

    def __init__(self, sock: Any, seed: int) -> None:
        self._sock = sock
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 4096)
        self._chance = random.Random(seed)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._sock, name)

    def send(self, data: Any) -> int:
        chance = self._chance.random()
        if chance < 0.3:
            raise BlockingIOError
        view = memoryview(data)
        return int(self._sock.send(view if chance > 0.9 else view[: self._chance.randint(1, len(view))]))

    def sendmsg(self, parts: Sequence[Any]) -> int:
        return self.send(b"".join(parts))


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("when_full", ["block", "drop"])
@pytest.mark.parametrize("secure", [False, True])
def test_random_partial_sends(
    world: World, monkeypatch: pytest.MonkeyPatch, seed: int, when_full: str, secure: bool
) -> None:
    if secure:
        made = tls.TlsSocket.__init__

        def wrap(self: Any, sock: socket.socket, *args: Any, **settings: Any) -> None:
            made(self, Stingy(sock, seed), *args, **settings)  # type: ignore[arg-type]

        monkeypatch.setattr(tls.TlsSocket, "__init__", wrap)
    else:
        begun = link_module.Link.__init__

        def begin(self: Any, number: int, sock: socket.socket, *args: Any) -> None:
            begun(self, number, Stingy(sock, seed), *args)  # type: ignore[arg-type]

        monkeypatch.setattr(link_module.Link, "__init__", begin)
    blocks = when_full == "block"
    # what must not be dropped (of sender 0) has room all the same
    limits = Limits(queue_bytes=100_000, queue_messages=20) if blocks else Limits(queue_bytes=600_000)
    edge, _ = world.edge(tls=SERVER, when_full=when_full, limits=limits)
    _, port = edge.listen(HERE, 0, tls=secure)
    edge.start()
    peer = client(world, port, receive_buffer=8192) if secure else world.peer(port, 8192)
    assert edge.wait_links(1, DEADLINE_S)
    got: list[bytes] = []
    reader = threading.Thread(target=read, args=(peer, got))
    senders = [threading.Thread(target=speak, args=(edge, seed, who, blocks)) for who in range(SENDERS)]
    for one in (reader, *senders) if blocks else senders:
        one.start()
    for one in senders:
        one.join(DEADLINE_S)
        assert not one.is_alive()
    if not blocks:
        reader.start()
    assert edge.flush(DEADLINE_S)
    counted = edge.counters()[1]
    ignored = edge.counters()[0].ignored
    edge.stop()
    reader.join(DEADLINE_S)
    assert not reader.is_alive()
    numbers = [number_of(one) for one in got]
    assert [one for one in got if one != made_message(number_of(one))] == [], "a message that nobody sent"
    arrived = Counter(f"{number // EACH}" for number in numbers)
    lost = Counter(counted.dropped) + Counter(ignored)
    assert {f"{who}": arrived[f"{who}"] + lost[f"{who}"] for who in range(SENDERS)} == dict.fromkeys(
        map(str, range(SENDERS)), EACH
    )
    assert counted.sent_messages == len(got)
    assert counted.sent_bytes == sum(map(len, got))
    assert bool(lost) != blocks and "0" not in lost
    for who in range(SENDERS):
        own = [number for number in numbers if number // EACH == who]
        assert own == sorted(set(own))


def made_message(number: int) -> bytes:
    """The message of that number: its size follows from it."""
    return message(number, 8 + (number * 7919) % (60_000 if number % 10 == 0 else 900))


def speak(edge: Any, seed: int, who: int, blocks: bool) -> None:
    """A quarter of all messages: one by one, in parts, or several together."""
    chance, number, last = random.Random(f"{seed}/{who}"), who * EACH, (who + 1) * EACH
    while number < last:
        if who == 0 or (who == 1 and blocks):
            run = range(number, min(last, number + chance.randint(1, 9)))
            edge.send_all([1], [([made_message(one)], f"{who}") for one in run], lambda: False)
            number = run.stop
        else:
            data = made_message(number)
            cut = chance.randint(1, len(data) - 1)
            edge.send([1], [data[:cut], data[cut:]], f"{who}", False)
            number += 1


def read(peer: Peer, got: list[bytes]) -> None:
    while (one := peer.receive()) is not None:
        got.append(one)
