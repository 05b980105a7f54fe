"""The TCP edge as a client: servers that are late, that go, that do not answer."""

from __future__ import annotations

import socket
from typing import Any

import pytest

from igtl_gateway.edges.tcp import dialer
from igtl_gateway.edges.tcp.sockets import resolve
from tests.edges.tcp.world import DEADLINE_S, HERE, World, message, until


def test_client_finds_a_late_server_and_comes_back_when_it_goes(world: World, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(dialer, "_RETRY_FIRST_S", 0.001)
    monkeypatch.setattr(dialer, "_RETRY_LAST_S", 0.016)
    reserved = world.listener()
    port = reserved.getsockname()[1]
    reserved.close()
    edge, seen = world.edge()
    edge.connect(HERE, port)
    edge.start()
    (note,) = seen.wait("connect_failed")
    assert note.data == {"peer": f"{HERE}:{port}", "reason": "Connection refused"}
    (waiting,) = edge.links()
    assert (waiting.number, waiting.role, waiting.connected) == (0, "client", False)
    until(lambda: edge._addresses._dialers[0]._delay_s == 0.016)  # it tried several times

    listener = world.listener(port)
    first = world.accepted(listener)
    first.send(message(1))
    assert seen.wait("frame", 1, 1) == [message(1)]
    assert seen.of("up")[0].data["role"] == "client"
    # several attempts were refused, for one cause
    assert len(seen.of("connect_failed")) == 1

    listener.close()
    first.close()
    seen.wait("down")
    assert len(seen.wait("connect_failed", 2)) == 2  # a new outage

    second = world.accepted(world.listener(port))
    assert edge.wait_links(1, DEADLINE_S)
    edge.send([2], [message(2)], "STRING/device", True)
    assert second.receive() == message(2)
    assert [link.number for link in edge.links()] == [2]


def test_a_server_of_another_protocol_is_tried_ever_more_rarely(world: World, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(dialer, "_RETRY_FIRST_S", 0.001)
    monkeypatch.setattr(dialer, "_RETRY_LAST_S", 0.016)
    listener = world.listener()
    edge, seen = world.edge()
    edge.connect(*listener.getsockname())
    edge.start()
    for attempt in range(1, 6):
        world.accepted(listener).send(b"220 mail.clinic ESMTP ready, and what a server says that speaks first\r\n")
        seen.wait("too_large", attempt)
        seen.wait("down", attempt)
    until(lambda: edge._addresses._dialers[0]._delay_s == 0.016)
    peer = world.accepted(listener)
    peer.send(message(1))
    seen.wait("frame")
    peer.close()
    seen.wait("down", 6)
    until(lambda: edge._addresses._dialers[0]._delay_s < 0.016)  # a real one is tried at once


def test_client_by_name_and_an_unknown_name(world: World) -> None:
    listener = world.listener()
    edge, seen = world.edge()
    edge.connect("localhost", listener.getsockname()[1])
    edge.connect("no.such.host.invalid", 18944)
    edge.start()
    world.accepted(listener)
    seen.wait("up")
    (note,) = seen.wait("connect_failed")
    assert note.data["peer"] == "no.such.host.invalid:18944"


def test_client_gives_up_on_a_server_that_does_not_answer(world: World, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(dialer, "_CONNECT_TIMEOUT_S", 0.05)
    listener = world.listener()
    listener.listen(0)
    port = listener.getsockname()[1]
    for _ in range(3):  # the kernel drops further attempts, as a firewall would
        filler = socket.socket()
        filler.setblocking(False)
        filler.connect_ex((HERE, port))
        world.closes(filler.close)
    edge, seen = world.edge()
    edge.connect(HERE, port)
    edge.start()
    (note,) = seen.wait("connect_failed")
    assert note.data["reason"] == "Connection timed out"


def test_a_name_that_cannot_be_one(world: World) -> None:
    edge, seen = world.edge()
    edge.connect("a..b", 18944)
    edge.start()
    (note,) = seen.wait("connect_failed")
    assert "'a..b' is not a valid host name" in note.data["reason"]


def test_an_error_of_our_own_is_noted_and_the_next_attempt_made(world: World, monkeypatch: pytest.MonkeyPatch) -> None:
    left = [1]

    def fail(host: str, port: int, *, numeric: bool) -> list[tuple[int, Any]]:
        if left[0]:
            left[0] -= 1
            raise ZeroDivisionError("our own fault")
        return resolve(host, port, numeric=numeric)

    monkeypatch.setattr(dialer, "resolve", fail)
    waiting = world.listener()
    edge, seen = world.edge()
    edge.connect(HERE, waiting.getsockname()[1])
    edge.start()
    (note,) = seen.wait("internal_error")
    assert note.data["error"] == "ZeroDivisionError: our own fault"
    world.accepted(waiting).send(message(1))
    assert seen.wait("frame") == [message(1)]
