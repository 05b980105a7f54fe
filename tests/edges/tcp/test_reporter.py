"""Callbacks that raise: noted, and nothing else comes of it."""

from __future__ import annotations

from typing import Any

from igtl_gateway.gateway.log.note import Note
from tests.edges.tcp.world import Seen, World, message


def test_callbacks_that_raise_are_noted_and_harm_nothing(world: World) -> None:
    _, seen, port = world.server()

    def fail(number: int, frame: Any) -> None:
        raise KeyError("no such stream")

    seen.on_frame_hook = fail
    peer = world.peer(port)
    peer.send(message(1) + message(2))
    note = seen.wait("callback_failed")[0]
    count = note.data.pop("count")  # of one turn, which may have ended between the two
    assert note.data == {"callback": "on_frame", "error": "KeyError: 'no such stream'"} and count in (1, 2)
    assert seen.wait("frame", 2) == [message(1), message(2)]
    peer.send(message(3))
    seen.wait("frame", 3)


def test_on_note_that_raises_harms_nothing(world: World) -> None:
    seen = Seen()
    told = seen.on_note

    def fail(number: int, note: Note) -> None:
        told(number, note)
        raise RuntimeError("on_note")

    seen.on_note = fail  # type: ignore[method-assign]
    _, _, port = world.server(seen=seen)
    first = world.peer(port)
    first.send(message(1)[:10])
    first.close()
    seen.wait("truncated")
    seen.wait("down")
    world.peer(port).send(message(2))
    assert seen.wait("frame") == [message(2)]
