"""What waits for a peer that reads too slowly, through the edge: what gives way, and when."""

from __future__ import annotations

import threading

import pytest

from igtl_gateway.edges.tcp import Limits, link
from tests.edges.tcp.world import BIG, DEADLINE_S, World, message, number_of


def test_slow_reader_loses_old_transforms_and_no_string(world: World, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(link, "NOTE_EVERY_S", 3600)
    edge, seen, port = world.server(limits=Limits(queue_messages=50))
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
    edge, _, port = world.server(limits=Limits(queue_bytes=10_000))
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
    edge, _, port = world.server(limits=Limits(queue_messages=7))
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


def test_one_message_larger_than_the_queue_may_wait(world: World) -> None:
    edge, _, port = world.server(limits=Limits(queue_bytes=10_000))
    peer = world.peer(port, 4096)
    assert edge.wait_links(1, DEADLINE_S)
    edge.send([1], [message(0, BIG)], "a", False)
    edge.send([1], [message(1, BIG)], "a", False)
    edge.send([1], [message(2, BIG)], "a", False)
    assert [peer.receive() for _ in range(2)] == [message(0, BIG), message(2, BIG)]
    assert edge.counters()[1].dropped == {"a": 1}


def test_queue_full_of_what_must_not_be_dropped_ends_the_link(world: World) -> None:
    edge, seen, port = world.server(limits=Limits(queue_messages=10))
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
