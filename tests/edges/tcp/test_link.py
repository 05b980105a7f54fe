"""Links of the TCP edge over real sockets: receiving, sending, and how they end."""

from __future__ import annotations

import socket
import threading
from typing import Any

import numpy as np
import pytest

from igtl_gateway.base.clock import ManualClock
from igtl_gateway.edges.tcp import PeerLimits, link, liveness
from igtl_gateway.edges.tcp.receiver import Receiver
from igtl_gateway.edges.tcp.sockets import UNANSWERED_S
from igtl_gateway.wire.framer import Framer
from tests.edges.tcp.world import BIG, DEADLINE_S, HERE, Seen, World, header, message, number_of, until


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
    edge, seen, port = world.server(limits=PeerLimits(max_body=10_000))
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


def test_a_string_may_not_be_as_long_as_an_image(world: World) -> None:
    _, seen, port = world.server(limits=PeerLimits(max_body=10_000, bodies=(("STRING", 1_000),)))
    peer = world.peer(port)
    peer.send(message(1, 10_000, b"IMAGE") + message(2, 1_000, b"STRING") + header(1_001, b"STRING"))
    (note,) = seen.wait("too_large")
    assert "'STRING', body size: found 1001 bytes, expected at most 1000 bytes" in note.text
    assert len(seen.of("frame")) == 2 and peer.receive() is None


def test_who_sends_too_many_messages_is_read_no_faster_and_loses_nothing(world: World) -> None:
    clock = ManualClock()
    _, seen, port = world.server(clock=clock, limits=PeerLimits(messages_per_s=10))
    flood, calm = world.peer(port), world.peer(port)
    seen.wait("up", 2)
    flood.send(b"".join(message(number) for number in range(25)))
    (note,) = seen.wait("rate_limited", 1, 1)
    assert note.data == {"peer": note.data["peer"], "limit": 10, "rests": 1}
    flood.send(message(99))
    for turn in range(3):  # the others are received
        calm.send(message(turn))
        seen.wait("frame", turn + 1, 2)
    assert len(seen.of("frame", 1)) == 25, "beyond the limit by what one reception held"
    clock.advance(1_400_000_000)  # 15 messages above the limit are 1.5 s
    calm.send(message(3))
    seen.wait("frame", 4, 2)
    calm.send(message(4))
    seen.wait("frame", 5, 2)
    assert len(seen.of("frame", 1)) == 25
    clock.advance(200_000_000)
    calm.send(message(5))
    assert number_of(seen.wait("frame", 26, 1)[-1]) == 99
    assert seen.of("down") == []


class _Gate:
    """Admits on request."""

    def __init__(self) -> None:
        self.is_open = False
        self.passing = 0

    def admit(self, size: int) -> bool:
        self.passing += size * self.is_open
        return self.is_open

    def enter(self, size: int) -> None:
        self.passing += size

    def leave(self, size: int) -> None:
        self.passing -= size


def test_a_large_message_waits_until_it_is_admitted_and_only_its_own_link_with_it(world: World) -> None:
    gate = _Gate()
    _, seen, port = world.server(admission=gate)
    first, second = world.peer(port), world.peer(port)
    seen.wait("up", 2)
    large = message(2, 100_000)
    first.sock.sendall(message(1) + large + message(3))
    seen.wait("frame", 1, 1)
    second.sock.sendall(message(4))
    seen.wait("frame", 1, 2)
    assert len(seen.of("frame", 1)) == 1
    gate.is_open = True
    assert list(map(number_of, seen.wait("frame", 3, 1))) == [1, 2, 3]
    gate.is_open = False
    second.sock.sendall(large)
    second.close()
    with pytest.raises(AssertionError, match="0 of 1 down"):
        seen.wait("down", 1, 2, deadline_s=0.2)
    gate.is_open = True
    seen.wait("down", 1, 2)
    assert len(seen.of("frame", 2)) == 2 and gate.passing == 0


def test_who_neither_speaks_nor_listens_is_let_go_where_that_is_wanted(world: World) -> None:
    clock = ManualClock()
    edge, seen, port = world.server(clock=clock, limits=PeerLimits(idle_s=60))
    world.peer(port)
    talks, hears = world.peer(port), world.peer(port)
    seen.wait("up", 3)
    for turn in range(5):
        clock.advance(20 * 10**9)
        edge.send([3], [message(turn)], "a", True)
        talks.send(message(turn))
        seen.wait("frame", turn + 1, 2)
        assert number_of(hears.receive()) == turn
    (note,) = seen.wait("idle")
    assert "60 s" in note.text and seen.wait("down", 1, 1)[0].data["reason"] == "idle"
    assert [link.number for link in edge.links()] == [2, 3]


def test_who_cannot_be_reached_is_let_go_and_what_may_be_lost_is_told(
    world: World, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A line that is really cut is in ``tests/integration/test_live_faults.py``."""
    silent_s = 0.0
    monkeypatch.setattr(liveness, "unanswered_s", lambda sock: silent_s)
    monkeypatch.setattr(link, "unconfirmed_bytes", lambda sock: 1234)
    edge, seen, port = world.server(limits=PeerLimits(stall_s=0.1))  # the interval of the checks depends on it
    world.peer(port)
    seen.wait("up")
    silent_s = UNANSWERED_S
    threading.Event().wait(0.2)
    assert not seen.of("down")
    silent_s += 1
    (note,) = seen.wait("unreachable")
    assert "26 s" in note.text
    (down,) = seen.wait("down")
    assert (down.data["reason"], down.data["unconfirmed_bytes"]) == ("unreachable", 1234)
    assert "1,234 bytes" in down.text
    assert edge.links() == []


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
    assert note.data["reason"] == seen.of("down")[0].data["reason"]
    assert [event[0] for event in seen.events] == ["up", "frame", "truncated", "down"]


def test_silence_inside_a_message_ends_the_link(world: World) -> None:
    clock = ManualClock()
    _, seen, port = world.server(clock=clock, limits=PeerLimits(stall_s=10))
    quiet, dribbling, half, busy = [world.peer(port) for _ in range(4)]
    seen.wait("up", 4)
    quiet.send(message(1))
    half.send(message(2) + message(2)[:30])  # what is read with a frame is there before the clock goes on
    seen.wait("frame", 2)
    data = message(3)
    turns = 6
    for turn in range(turns):
        if turn >= 2:
            dribbling.send(data[turn - 2 : turn - 1])
        busy.send(message(4))  # once it is through, the clock was looked at
        seen.wait("frame", turn + 3)
        clock.advance(2 * 10**9)
    busy.send(message(4))
    seen.wait("frame", turns + 3)
    (note,) = seen.wait("stalled")
    assert (note.data["received"], note.data["expected"]) == (30, None)
    assert half.receive() is None
    dribbling.send(data[turns - 2 :])
    quiet.send(message(5))
    seen.wait("frame", turns + 5)
    assert len(seen.of("down")) == 1


class Pace:
    """Manual time that the I/O thread sees step by step, as a peer that is busy makes it look."""

    def __init__(self, world: World, port: int, seen: Seen, clock: ManualClock) -> None:
        self._busy, self._seen, self._clock = world.peer(port), seen, clock
        self.turns = 0

    def step(self, seconds: float) -> None:
        """What was sent so far is received, then time passes, and is noticed."""
        for advance_ns in (0, round(seconds * 10**9)):
            self._clock.advance(advance_ns)
            self._busy.send(message(4))
            self.turns += 1
            self._seen.wait("frame", self.turns)


@pytest.mark.parametrize("tempo_s", [0.9, 9.0])
def test_a_header_that_comes_byte_by_byte_has_no_more_time_than_any_other(world: World, tempo_s: float) -> None:
    """Never silent for ``stall_s``, it would keep its place forever."""
    clock = ManualClock()
    _, seen, port = world.server(clock=clock, limits=PeerLimits(stall_s=10))
    pace, loris = Pace(world, port, seen, clock), world.peer(port)
    seen.wait("up", 2)
    sent = 0
    while not seen.of("stalled"):
        assert sent * tempo_s < 30
        loris.send(header(10**8)[sent : sent + 1])
        sent += 1
        for _ in range(max(1, round(tempo_s))):
            pace.step(min(tempo_s, 1.0))
    (note,) = seen.of("stalled")
    assert note.data["received"] >= 1 and note.data["expected"] is None
    assert note.text.endswith(" s: too slow")
    assert sent * tempo_s > 10
    assert loris.receive() is None


def test_a_long_message_over_a_slow_line_has_its_time_and_one_that_hardly_moves_has_not(world: World) -> None:
    clock = ManualClock()
    _, seen, port = world.server(clock=clock, limits=PeerLimits(stall_s=10, min_rate=1000))
    pace, slow, slower = Pace(world, port, seen, clock), world.peer(port), world.peer(port)
    seen.wait("up", 3)
    data = message(1, 90_000)
    slower.send(data[:1000])
    for at in range(0, 60_000, 1000):  # a minute at 1,000 bytes per second, and one tenth of it
        slow.send(data[at : at + 1000])
        if not seen.of("stalled"):
            slower.send(data[1000 + at // 10 : 1100 + at // 10])
        pace.step(1.0)
    (note,) = seen.of("stalled")
    assert note.data["expected"] == len(data) and 1000 < note.data["received"] < 3000
    assert [entry[:2] for entry in seen.events if entry[0] == "down"] == [("down", 3)]
    slow.send(data[60_000:])
    assert seen.wait("frame", 1, 2) == [data]


def test_time_that_we_had_not_ourselves_is_not_held_against_a_peer(world: World) -> None:
    clock = ManualClock()
    _, seen, port = world.server(clock=clock, limits=PeerLimits(stall_s=10))
    going, release = threading.Event(), threading.Event()

    def hang(number: int, frame: Any) -> None:
        if number_of(frame) == 99:
            going.set()
            release.wait(DEADLINE_S)

    seen.on_frame_hook = hang
    pace, half, hanging = Pace(world, port, seen, clock), world.peer(port), world.peer(port)
    seen.wait("up", 3)
    data = message(7)
    half.send(data[:20])
    pace.step(1.0)
    pace.step(1.0)
    hanging.send(message(99))
    assert going.wait(DEADLINE_S)
    pace.turns += 1
    half.send(data[20:30])  # it waits in the kernel while the gateway does nothing for an hour
    clock.advance(3600 * 10**9)
    release.set()
    pace.step(1.0)
    half.send(data[30:])
    assert seen.wait("frame", 1, 2) == [data]
    assert seen.of("stalled") == []


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


def test_block_mode_loses_nothing_with_a_slow_reader(world: World) -> None:
    edge, seen, port = world.server(limits=PeerLimits(queue_messages=5), when_full="block")
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
    edge, seen, port = world.server(limits=PeerLimits(queue_messages=2), when_full="block")
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


@pytest.mark.slow
def test_threads_never_interleave_and_keep_their_order(world: World) -> None:
    edge, _, port = world.server(limits=PeerLimits(queue_messages=100_000))
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


def test_a_peer_that_half_closes_gets_what_is_queued_for_it(world: World) -> None:
    edge, seen, port = world.server()
    answers = [message(number, BIG // 2) for number in range(4)]

    def answer(number: int, frame: Any) -> None:
        for one in answers:
            edge.send([number], [one], "IMAGE/camera", True)

    seen.on_frame_hook = answer
    peer = world.peer(port, 4096)
    peer.send(message(1))
    peer.sock.shutdown(socket.SHUT_WR)
    assert peer.receive_all() == answers
    (down,) = seen.wait("down")
    assert (down.data["reason"], down.data["unsent"], down.data["sent_messages"]) == ("closed by the peer", 0, 4)
    assert edge.flush(DEADLINE_S)


def test_a_peer_that_half_closes_and_reads_slowly_gets_all_the_same(world: World) -> None:
    clock = ManualClock()
    edge, seen, port = world.server(clock=clock)
    peer, other = world.peer(port, 4096), world.peer(port)
    seen.wait("up", 2)
    peer.sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    edge.send([1], [message(0, BIG)], "IMAGE/camera", False)
    peer.sock.shutdown(socket.SHUT_WR)
    got = bytearray()

    def sent() -> int:
        counters = edge.counters().get(1)  # none: all of it was, for a kernel may take much at once
        return counters.sent_bytes if counters else len(message(0, BIG))

    for turn in range(5):  # five times what one that does not read would have
        goal = min(sent() + 100_000, len(message(0, BIG)))
        while sent() < goal:
            got += peer.sock.recv(1 << 16)
        clock.advance(round(PeerLimits().stall_s * 10**9))
        other.send(message(turn))
        seen.wait("frame", turn + 1)
    while part := peer.sock.recv(1 << 20):
        got += part
    assert got == message(0, BIG)
    assert seen.wait("down")[0].data["unsent"] == 0


def test_a_peer_that_half_closes_and_does_not_read_is_closed_in_time(world: World) -> None:
    clock = ManualClock()
    edge, seen, port = world.server(clock=clock)
    peer, other = world.peer(port, 4096), world.peer(port)
    seen.wait("up", 2)
    edge.send([1], [message(0, BIG)], "IMAGE/camera", False)
    edge.send([1], [message(1)], "STRING/plan", True)
    peer.sock.shutdown(socket.SHUT_WR)

    def refused() -> bool:
        edge.send([1], [message(2)], "late", False)
        return bool(edge.counters()[0].ignored)

    until(refused)  # the end was seen: nothing more is taken
    assert [link.number for link in edge.links()] == [1, 2]
    late = edge.counters()[1].queued_messages - 2
    clock.advance(round(PeerLimits().stall_s * 10**9))
    other.send(message(3))
    (down,) = seen.wait("down")
    assert (down.data["reason"], down.data["unsent"]) == ("closed by the peer", 2 + late)
    assert [link.number for link in edge.links()] == [2]


@pytest.mark.parametrize("half_closed", [False, True])
def test_stop_while_a_peer_does_not_read(world: World, half_closed: bool) -> None:
    edge, seen, port = world.server()
    peer = world.peer(port, 4096)
    seen.wait("up")
    edge.send([1], [message(0, BIG)], "IMAGE/camera", False)
    if half_closed:
        peer.sock.shutdown(socket.SHUT_WR)
    edge.stop(0)
    (down,) = seen.of("down")
    assert down.data["unsent"] == 1


def failing(monkeypatch: pytest.MonkeyPatch, times: int) -> None:
    """Reading of link 1 raises this number of times."""
    left = [times]
    read = Receiver.read

    def fail(self: Receiver) -> None:
        if self._link.number == 1 and left[0]:
            left[0] -= 1
            raise ZeroDivisionError("our own fault")
        read(self)

    monkeypatch.setattr(Receiver, "read", fail)


def test_an_error_of_our_own_is_noted_and_things_go_on(world: World, monkeypatch: pytest.MonkeyPatch) -> None:
    failing(monkeypatch, 2)
    edge, seen, port = world.server()
    world.peer(port).send(message(1))
    assert seen.wait("frame") == [message(1)]
    assert [note.data["count"] for note in seen.of("internal_error", 1)] == [1, 2]
    (note, _) = seen.of("internal_error")
    assert note.data["error"] == "ZeroDivisionError: our own fault"
    assert note.data["place"].endswith(" fail")
    assert [one.number for one in edge.links()] == [1]


def test_an_error_of_our_own_that_comes_again_costs_its_link(world: World, monkeypatch: pytest.MonkeyPatch) -> None:
    failing(monkeypatch, 10**9)
    _, seen, port = world.server()
    bad, good = world.peer(port), world.peer(port)
    seen.wait("up", 2)
    bad.send(message(1))
    (down,) = seen.wait("down", 1, 1)
    assert down.data["reason"] == "internal_error"
    assert len(seen.of("internal_error", 1)) == 3
    good.send(message(2))
    assert seen.wait("frame") == [message(2)]


def test_an_error_that_loses_the_place_in_the_stream_costs_its_link(
    world: World, monkeypatch: pytest.MonkeyPatch
) -> None:
    received = Framer.received

    def fail(self: Framer, count: int) -> list[bytes | memoryview]:
        if count == 66:
            raise ZeroDivisionError("our own fault")
        return received(self, count)

    monkeypatch.setattr(Framer, "received", fail)
    _, seen, port = world.server()
    bad, good = world.peer(port), world.peer(port)
    seen.wait("up", 2)
    bad.send(message(1, 8))
    (down,) = seen.wait("down")
    assert (down.data["peer"], down.data["reason"]) == ("{}:{}".format(*bad.sock.getsockname()), "internal_error")
    assert len(seen.of("internal_error", 1)) == 1
    good.send(message(2))
    assert seen.wait("frame") == [message(2)]


@pytest.mark.parametrize("ends", ["read", "hurry", "peer"])
def test_several_messages_go_together(world: World, ends: str) -> None:
    edge, seen, port = world.server(when_full="block")
    peer = world.peer(port, 4096)
    assert edge.wait_links(1, DEADLINE_S)
    hurry = threading.Event()
    sizes = [4000 if number % 100 else 200_000 for number in range(3000)]
    messages = [message(number, size) for number, size in enumerate(sizes)]

    def replay() -> None:
        for begin in range(0, len(messages), 500):
            if hurry.is_set():
                del messages[begin:]
                return
            edge.send_all([1, 7], [((each,), "a") for each in messages[begin : begin + 500]], hurry.is_set)

    sender = threading.Thread(target=replay)
    sender.start()
    until(lambda: edge.counters()[1].queued_messages > 0)  # the kernel has taken what it can
    if ends == "peer":
        peer.close()
    elif ends == "hurry":
        hurry.set()
        sender.join(DEADLINE_S)
        assert not sender.is_alive()
    if ends != "peer":
        assert [peer.receive() for _ in messages] == messages
    sender.join(DEADLINE_S)
    assert not sender.is_alive()
    if ends == "peer":
        seen.wait("down")
        total = edge.counters()[0]
        assert total.sent_messages + total.dropped["a"] + total.ignored["a"] == 2 * len(messages)
    else:
        edge.flush(DEADLINE_S)
        sent = edge.counters()[1]
        assert (sent.sent_messages, sent.sent_bytes) == (len(messages), sum(map(len, messages)))
        assert edge.counters()[0].ignored == {"a": len(messages)}, "of the link that is not there"
