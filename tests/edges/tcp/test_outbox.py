"""What waits for a peer that reads too slowly, through the edge: what gives way, and when."""

from __future__ import annotations

import random
import socket
import threading
from collections import Counter
from collections.abc import Sequence
from typing import Any, NamedTuple

import pytest
from hypothesis import given
from hypothesis import strategies as st

from igtl_gateway.edges.tcp import PeerLimits, link, sender, tls
from igtl_gateway.edges.tcp.outbox import LARGE_BYTES, Outbox, QueuedMessage
from tests.edges.tcp.test_tls import SERVER, client
from tests.edges.tcp.world import BIG, DEADLINE_S, HERE, Peer, World, message, number_of

#: Of the test with a kernel that takes what it likes: messages of each sender, and senders.
EACH = 120
SENDERS = 4


def test_slow_reader_loses_old_transforms_and_no_string(world: World, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sender, "NOTE_EVERY_S", 3600)
    edge, seen, port = world.server(limits=PeerLimits(queue_messages=50))
    slow, fast = world.peer(port, 4096), world.peer(port)
    assert edge.wait_links(2, DEADLINE_S)
    got_fast: list[bytes] = []
    reader = threading.Thread(target=lambda: got_fast.extend(fast.receive_all()))
    reader.start()
    edge.send([1], [message(0, BIG, b"IMAGE")], "IMAGE/camera", False)  # fills the socket, and is begun
    for number in range(1, 1001):
        edge.send([1], [message(number, 48, b"TRANSFORM")], "TRANSFORM/tool", False)
        if number % 100 == 0:
            edge.send([1], [message(number, name=b"STRING")], "STRING/plan", True)
        if number == 100:
            seen.wait("queue_drop")  # of the first drops, before there are more
        edge.send([2], [message(number, name=b"STRING")], "STRING/plan", True)
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
    edge, _, port = world.server(limits=PeerLimits(queue_bytes=10_000))
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
    edge, _, port = world.server(limits=PeerLimits(queue_messages=7))
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


def test_a_pose_does_not_wait_for_pictures(world: World) -> None:
    """The picture that is on its way is completed; those behind it are overtaken, by what is small only."""
    edge, _, port = world.server()
    peer = world.peer(port, 4096)
    assert edge.wait_links(1, DEADLINE_S)
    edge.send([1], [message(0, BIG)], "IMAGE/camera", False)  # fills the socket, and is begun
    edge.send([1], [message(1, 100_000)], "IMAGE/camera", False)
    edge.send([1], [message(2, 100_000)], "IMAGE/other", False)
    for number in (3, 4):
        edge.send([1], [message(number)], "TRANSFORM/tool", False)
    edge.send([1], [message(5)], "IMAGE/camera", False)  # not before 1, which is of its stream
    edge.send([1], [message(6)], "STRING/plan", True)
    edge.send([1], [message(7, 100_000)], "POLYDATA/tumour", True)
    edge.send([1], [message(8)], "STRING/plan", True)  # what is kept keeps its order
    assert [number_of(peer.receive()) for _ in range(9)] == [0, 3, 4, 6, 7, 8, 1, 2, 5]


def test_who_waits_for_room_gets_the_order(world: World) -> None:
    """A replay sends what was recorded in the order of the recording."""
    edge, _ = world.edge(when_full="block")
    _, port = edge.listen(HERE, 0)
    edge.start()
    peer = world.peer(port, 4096)
    assert edge.wait_links(1, DEADLINE_S)
    for number, size in enumerate((BIG, 100_000, 48, 100_000, 48)):
        edge.send([1], [message(number, size)], "IMAGE/camera" if size > 48 else "TRANSFORM/tool", False)
    assert [number_of(peer.receive()) for _ in range(5)] == [0, 1, 2, 3, 4]


class _Waiting(NamedTuple):
    number: int
    stream: str
    size: int
    keep: bool


@given(
    st.lists(
        st.one_of(
            st.tuples(st.sampled_from("abcd"), st.sampled_from((100, 40_000, LARGE_BYTES, 300_000)), st.booleans()),
            st.integers(1, 400_000),
        ),
        max_size=80,
    )
)
def test_any_order_of_adding_and_sending(steps: list[tuple[str, int, bool] | int]) -> None:
    """Each stream keeps its order, kept messages keep theirs, and what is lost is counted."""
    box = Outbox(PeerLimits(queue_bytes=1_000_000, queue_messages=12))
    added: list[_Waiting] = []
    sent = bytearray()
    refused: Counter[str] = Counter()

    def advance(count: int) -> None:
        data = b"".join(map(bytes, box.parts()))[:count]
        sent.extend(data)
        box.advance(len(data))

    for step in steps:
        if isinstance(step, int):
            advance(step)
            continue
        stream, size, keep = step[0] + ("+" if step[2] else ""), step[1], step[2]
        added.append(_Waiting(len(added), stream, size, keep))
        parts = (added[-1].number.to_bytes(8, "big"), bytes(size - 8))
        if not box.add(QueuedMessage(parts, size, stream, keep)):
            refused[stream] += 1
    while not box.empty:
        before = len(sent)
        advance(1 << 20)
        assert len(sent) > before
    assert box.bytes == box.waiting_bytes == box.messages == 0
    arrived, at = [], 0
    while at < len(sent):
        arrived.append(added[int.from_bytes(sent[at : at + 8], "big")])
        at += arrived[-1].size
    assert at == len(sent) == box.sent_bytes
    for stream in {each.stream for each in added}:
        own = [each.number for each in arrived if each.stream == stream]
        assert own == sorted(set(own))
        assert len(own) + box.dropped[stream] + refused[stream] == sum(each.stream == stream for each in added)
    kept = [each.number for each in arrived if each.keep]
    assert kept == sorted(kept)


def test_a_picture_is_not_overtaken_without_end() -> None:
    box = Outbox(PeerLimits(queue_messages=100_000))
    box.begin(QueuedMessage((bytes(10),), 10, "IMAGE/begun", False), 5)
    box.add(QueuedMessage((b"first" * 20_000,), 100_000, "IMAGE/camera", False))
    box.add(QueuedMessage((b"large" * 20_000,), 100_000, "IMAGE/camera", False))
    small = bytes(60_000)
    before = 0
    for _ in range(200):  # 12 MB
        box.add(QueuedMessage((small,), len(small), "NDARRAY/flood", False))
    box.advance(5)
    while bytes(box.parts()[0][:5]) == small[:5]:
        before += len(small)
        box.advance(len(small))
    assert 8_000_000 < before < 9_000_000
    assert bytes(box.parts()[0][:5]) == b"first"


def test_one_message_larger_than_the_queue_may_wait(world: World) -> None:
    edge, _, port = world.server(limits=PeerLimits(queue_bytes=10_000))
    peer = world.peer(port, 4096)
    assert edge.wait_links(1, DEADLINE_S)
    edge.send([1], [message(0, BIG)], "a", False)
    edge.send([1], [message(1, BIG)], "a", False)
    edge.send([1], [message(2, BIG)], "a", False)
    assert [peer.receive() for _ in range(2)] == [message(0, BIG), message(2, BIG)]
    assert edge.counters()[1].dropped == {"a": 1}


def test_queue_full_of_what_must_not_be_dropped_ends_the_link(world: World) -> None:
    edge, seen, port = world.server(limits=PeerLimits(queue_messages=10))
    world.peer(port, 4096), world.peer(port)
    assert edge.wait_links(2, DEADLINE_S)
    edge.send([1], [message(0, BIG)], "STRING/plan", True)
    for number in range(11):
        edge.send([1], [message(number, name=b"STRING")], "STRING/plan", True)
    (note,) = seen.wait("queue_full")
    (down,) = seen.wait("down")
    assert "must not be dropped" in note.text
    assert down.data["dropped"] == {"STRING/plan": 11}
    assert down.data["unsent"] == 11
    total = edge.counters()[0]
    assert (total.dropped, total.ignored) == ({"STRING/plan": 11}, {"STRING/plan": 1})
    assert [link.number for link in edge.links()] == [2]


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
    """A kernel that takes what it likes: every message arrives whole and in its order, or is counted as dropped."""
    if secure:
        made = tls.TlsSocket.__init__

        def wrap(self: Any, sock: socket.socket, *args: Any, **settings: Any) -> None:
            made(self, Stingy(sock, seed), *args, **settings)  # type: ignore[arg-type]

        monkeypatch.setattr(tls.TlsSocket, "__init__", wrap)
    else:
        begun = link.Link.__init__

        def begin(self: Any, number: int, sock: socket.socket, *args: Any) -> None:
            begun(self, number, Stingy(sock, seed), *args)  # type: ignore[arg-type]

        monkeypatch.setattr(link.Link, "__init__", begin)
    blocks = when_full == "block"
    # what must not be dropped (of sender 0) has room all the same
    limits = PeerLimits(queue_bytes=100_000, queue_messages=20) if blocks else PeerLimits(queue_bytes=600_000)
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
    assert [one for one in got if one != made_message(number_of(one))] == [], "a message that was not sent"
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
