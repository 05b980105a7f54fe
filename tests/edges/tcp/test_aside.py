"""A message that takes long is handled beside the I/O thread: others pass, and its own link keeps its order."""

from __future__ import annotations

import socket
import struct
import threading
from collections.abc import Callable

import pytest

from igtl_gateway.edges.tcp.aside import Aside
from tests.costly import TABLE
from tests.edges.tcp.world import DEADLINE_S, World, header, message, number_of

LIST = header(70 * 1_000, b"TDATA") + bytes(70 * 1_000)


def test_what_is_aside_is_what_takes_long() -> None:
    assert not Aside.takes(message(1))
    assert not Aside.takes(message(1, 640 * 480, b"IMAGE"))  # a view: only copies take long
    assert Aside.takes(message(1, 8 << 20, b"IMAGE"))
    assert not Aside.takes(message(1, 48, b"TRANSFORM"))
    kept = [row.name for row in TABLE if not Aside.takes(row.data())]
    small = {"STRING", "SENSOR", "NDARRAY, dimensions", "BIND of rubbish", "BIND of queries"}
    assert set(kept) <= small | {name for name in kept if name.startswith("POLYDATA") and "attributes" in name}


@pytest.fixture
def held(world: World) -> tuple[World, Callable[[int, object], object], threading.Event, threading.Event]:
    begun, go_on = threading.Event(), threading.Event()

    def hook(number: int, frame: object) -> None:
        if bytes(memoryview(frame)[2:7]) == b"TDATA":  # type: ignore[arg-type]
            begun.set()
            assert go_on.wait(DEADLINE_S)

    return world, hook, begun, go_on


def test_others_pass_and_its_own_link_waits(
    held: tuple[World, Callable[[int, object], object], threading.Event, threading.Event],
) -> None:
    world, hook, begun, go_on = held
    edge, seen = world.edge()
    seen.on_frame_hook = hook
    _, port = edge.listen("127.0.0.1", 0)
    edge.start()
    slow, quick = world.peer(port), world.peer(port)
    seen.wait("up", 2)
    slow.send(message(1) + LIST + message(2))
    assert begun.wait(DEADLINE_S)
    quick.send(message(3))
    seen.wait("frame", 3)  # 1, the list, 3
    numbers = [number_of(frame) for _, frame in _frames(seen.events) if len(frame) < 1_000]
    assert numbers == [1, 3]
    go_on.set()
    seen.wait("frame", 4)
    assert number_of(seen.of("frame")[-1]) == 2


@pytest.mark.parametrize("ending", ["closes", "resets", "the edge stops"])
def test_the_end_of_a_link_waits_for_its_message(
    held: tuple[World, Callable[[int, object], object], threading.Event, threading.Event], ending: str
) -> None:
    world, hook, begun, go_on = held
    edge, seen = world.edge()
    seen.on_frame_hook = hook
    _, port = edge.listen("127.0.0.1", 0)
    edge.start()
    peer = world.peer(port)
    seen.wait("up")
    peer.send(LIST + message(2))
    assert begun.wait(DEADLINE_S)
    if ending == "closes":
        peer.close()
    elif ending == "resets":
        peer.sock.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        peer.close()
    else:
        threading.Timer(0.2, go_on.set).start()
        edge.stop(0)
    go_on.set()
    seen.wait("down")
    kinds = [kind for kind, _, _ in seen.events if kind in ("frame", "down")]
    assert kinds == ["frame", "frame", "down"] or (ending == "resets" and kinds == ["frame", "down"])


def _frames(events: list[tuple[str, int, bytes]]) -> list[tuple[int, bytes]]:
    return [(number, value) for kind, number, value in events if kind == "frame"]
