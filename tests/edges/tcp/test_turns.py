"""Fair shares of a thread: whose turn it is, however much each one has to do."""

from __future__ import annotations

import threading
import time
from collections import Counter
from itertools import pairwise
from typing import Any

import pytest

from igtl_gateway.edges.tcp import PeerLimits, turns
from igtl_gateway.edges.tcp.receiver import Receiver
from igtl_gateway.edges.tcp.sockets import unconfirmed_bytes
from igtl_gateway.edges.tcp.turns import QUANTUM_NS, InvalidTime, Turn, Turns
from tests.edges.tcp.world import DEADLINE_S, World, message, number_of, until

US = 1_000
MANY = 20


def turn(name: str) -> Turn:
    return Turn(lambda _mask, name=name: name, lambda _exc: None)  # type: ignore[misc]


class Thread:
    """The takers of turns, and what their turns cost."""

    def __init__(self, **cost_ns: int) -> None:
        self.turns = Turns()
        self.takers = {name: turn(name) for name in cost_ns}
        self.cost_ns = cost_ns
        self.taken: list[str] = []

    def ask(self, *names: str) -> None:
        for name in names:
            self.turns.ask(self.takers[name])

    def take(self, floods: bool = True) -> str:
        """One turn; one that floods asks again."""
        now = self.turns.next()
        assert now
        name = next(name for name, taker in self.takers.items() if taker is now)
        now.has_more = floods and name.startswith("flood")
        if now.has_more:
            self.turns.ask(now)
        self.turns.used(now, self.cost_ns[name])
        self.taken.append(name)
        return name


def flooded(cost_ns: int = QUANTUM_NS, **others: int) -> Thread:
    """Twenty that always have more to do, of which each has had many turns."""
    thread = Thread(**{f"flood{number}": cost_ns for number in range(MANY)}, **others)
    thread.ask(*(name for name in thread.takers if name.startswith("flood")))
    for _ in range(50 * MANY):
        thread.take()
    return thread


def test_beside_any_number_that_flood_the_next_turn_is_that_of_the_one_that_was_silent() -> None:
    thread = flooded(good=300 * US)
    for _ in range(200):  # the machine lets it ask once in a round of the others
        thread.ask("good")
        waited = 0
        while thread.take() != "good":
            waited += 1
        assert waited <= 1
        for _ in range(MANY):
            thread.take()


def test_one_that_asks_again_at_once_waits_for_each_of_the_others_once_at_most() -> None:
    thread = flooded(good=300 * US)
    waits = []
    for _ in range(200):
        thread.ask("good")
        before = len(thread.taken)
        while thread.take() != "good":
            pass
        waits.append(len(thread.taken) - before - 1)
    assert max(waits) <= MANY
    assert sum(waits) / len(waits) <= 0.8 * MANY  # it pays a part of its time


def test_it_is_the_time_that_is_shared_and_not_the_turns() -> None:
    thread = Thread(flood_cheap=QUANTUM_NS, flood_dear=100 * QUANTUM_NS)
    thread.ask("flood_cheap", "flood_dear")
    for _ in range(10_000):
        thread.take()
    used = {name: number * thread.cost_ns[name] for name, number in Counter(thread.taken).items()}
    assert used["flood_dear"] == pytest.approx(used["flood_cheap"], rel=0.05)


def test_who_was_silent_has_saved_nothing_up() -> None:
    thread = flooded(flood_late=QUANTUM_NS)
    thread.ask("flood_late")
    begun = len(thread.taken)
    for _ in range(10 * (MANY + 1)):
        thread.take()
    assert Counter(thread.taken[begun:])["flood_late"] == pytest.approx(10, abs=1)


def test_a_turn_is_asked_for_once_and_can_be_given_up() -> None:
    turns, one, other = Turns(), turn("one"), turn("other")
    for asked in (one, other, one, one):
        turns.ask(asked)
    one.give_up()
    turns.ask(one)
    assert [turns.next(), turns.next(), turns.next()] == [other, one, None]
    turns.ask(one)
    one.give_up()
    assert turns.next() is None


# ── the edge ──────────────────────────────────────────────────────────────────────────────────────────────────────


def position(frames: list[tuple[int, Any]], link: int) -> int:
    """How many messages were handled before the first of this link."""
    return next(index for index, (number, _) in enumerate(frames) if number == link)


def test_a_message_does_not_wait_for_all_that_another_peer_has_sent(world: World) -> None:
    """The bytes of a flood are received at once, 600 messages in a chunk, and handled in turns."""
    edge, seen, port = world.server()
    handles, goes_on = threading.Event(), threading.Event()

    def hold(_number: int, _frame: Any) -> None:
        handles.set()
        goes_on.wait(DEADLINE_S)

    seen.on_frame_hook = hold
    flood, good = world.peer(port), world.peer(port)
    seen.wait("up", 2)
    flood.send(b"".join(message(number) for number in range(600)))
    assert handles.wait(DEADLINE_S)
    good.send(message(1))
    late = world.peer(port)  # … and it connects while the flood is handled
    late.send(message(2))
    # the kernel of a busy machine brings it across a little later than it takes it
    until(lambda: not any(unconfirmed_bytes(peer.sock) for peer in (good, late)))
    seen.on_frame_hook = lambda _number, _frame: None
    goes_on.set()
    seen.wait("frame", 602)
    frames = [(number, frame) for what, number, frame in seen.events if what == "frame"]
    assert position(frames, 2) <= 2
    assert position(frames, 3) <= 400  # its turn comes by time: how many are handled until then depends on the load
    assert [number_of(frame) for number, frame in frames if number == 1] == list(range(600))
    assert edge.counters()[1].received_messages == 600


def test_a_large_message_is_read_in_turns(world: World, monkeypatch: pytest.MonkeyPatch) -> None:
    rooms: list[int] = []
    receive = Receiver._receive

    def watched(receiver: Receiver) -> bool:
        rooms.append(len(receiver._room))
        return receive(receiver)

    monkeypatch.setattr(Receiver, "_receive", watched)
    _, seen, port = world.server()
    large = message(1, size=4 << 20)
    world.peer(port).send(large)
    (frame,) = seen.wait("frame")
    assert bytes(frame) == large
    assert max(rooms) == 512 << 10


def test_large_messages_without_valid_content_take_a_tenth_of_the_time() -> None:
    invalid, now_ns, size = InvalidTime(), 10**12, 6 << 20
    assert invalid.rest_s(100, now_ns) == 0
    for _ in range(1000):
        now_ns += round(invalid.rest_s(size, now_ns) * 10**9)
    assert now_ns - 10**12 == pytest.approx(1000 * 9 * size, rel=0.01)


def test_a_link_with_a_large_invalid_message_is_not_read_for_a_while(
    world: World, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(turns, "_BURST_NS", 0)
    times: list[int] = []

    def invalid(_number: int, _frame: Any) -> bool:
        times.append(time.monotonic_ns())
        return True

    _, seen, port = world.server()
    seen.on_frame_hook = invalid
    world.peer(port).send(message(1, size=1 << 20) * 3)
    seen.wait("frame", 3)
    assert min(b - a for a, b in pairwise(times)) >= 9 << 20


def test_what_was_received_before_the_end_of_a_link_is_handled(world: World) -> None:
    _, seen, port = world.server()
    seen.on_frame_hook = lambda _number, _frame: time.sleep(0.0005)  # several turns
    peer = world.peer(port)
    peer.send(b"".join(message(number) for number in range(300)))
    peer.close()
    (down,) = seen.wait("down")
    assert [number_of(frame) for frame in seen.of("frame")] == list(range(300))
    assert down.data["received_messages"] == 300


def test_what_was_received_before_the_edge_stops_is_handled(world: World) -> None:
    edge, seen, port = world.server()
    begun = threading.Event()

    def slowly(_number: int, _frame: Any) -> None:
        begun.set()
        time.sleep(0.0005)

    seen.on_frame_hook = slowly
    world.peer(port).send(b"".join(message(number) for number in range(300)))
    assert begun.wait(DEADLINE_S)
    edge.stop()
    assert [number_of(frame) for frame in seen.of("frame")] == list(range(300))


# ── the rate of messages ──────────────────────────────────────────────────────────────────────────────────────────


def steadily(send: Any, messages: list[bytes], per_s: float) -> None:
    """Send them evenly; a machine that is late sends them later, and not faster."""
    due = time.monotonic()
    for one in messages:
        send(one)
        due = max(due + 1 / per_s, time.monotonic())
        time.sleep(max(0.0, due - time.monotonic()))


def test_a_steady_rate_below_the_limit_is_never_limited(world: World) -> None:
    _, seen, port = world.server(limits=PeerLimits(messages_per_s=1_000))
    steadily(world.peer(port).send, [message(number) for number in range(1_300)], 800)
    assert len(seen.wait("frame", 1_300)) == 1_300
    assert seen.of("rate_limited") == []
