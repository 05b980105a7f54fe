"""Who may connect to the TCP edge."""

from __future__ import annotations

import ipaddress
import os
import resource
import socket
from collections.abc import Iterator
from contextlib import contextmanager, suppress

import pytest
from hypothesis.stateful import run_state_machine_as_test

from igtl_gateway.edges.tcp import PeerLimits, listener, registry
from igtl_gateway.edges.tcp.sockets import tune_socket
from tests.edges.tcp import listener_model
from tests.edges.tcp.listener_model import NONE, OWN_FAULT, Model
from tests.edges.tcp.world import DEADLINE_S, HERE, World, message


def test_one_client_too_many(world: World) -> None:
    edge, seen, port = world.server(limits=PeerLimits(max_clients=2))
    peers = [world.peer(port), world.peer(port)]
    seen.wait("up", 2)
    third = world.peer(port)
    assert third.receive() is None
    (note,) = seen.wait("refused")
    assert note.data["peer"] == "{}:{}".format(*third.sock.getsockname())
    peers[0].close()
    seen.wait("down")
    world.peer(port)
    seen.wait("up", 3)
    assert [link.number for link in edge.links()] == [2, 3]


@pytest.mark.parametrize("allow", [["any"], ["10.0.0.0/8", "2001:db8::/32"]])
def test_allow_list_opens_other_addresses_and_this_host_is_always_allowed(world: World, allow: list[str]) -> None:
    edge, seen = world.edge(allow=allow)
    host, port = edge.listen("0.0.0.0", 0)
    assert host == "0.0.0.0"
    edge.start()
    world.peer(port).send(message(1))
    seen.wait("frame")


def own_address() -> str | None:
    """An address of this machine that is not loopback (nothing is sent)."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe, suppress(OSError):
        probe.connect(("192.0.2.1", 9))
        host = str(probe.getsockname()[0])
        return None if host.startswith("127.") else host
    return None


def test_allow_list_refuses_others(world: World) -> None:
    host = own_address()
    if host is None:
        pytest.skip("this machine has no address but loopback")
    edge, seen = world.edge(allow=[f"{ipaddress.ip_address(host) + 1}/32"])
    _, port = edge.listen("0.0.0.0", 0)
    edge.start()
    with socket.create_connection((host, port), DEADLINE_S) as stranger:
        assert stranger.recv(1) == b""
    (note,) = seen.wait("refused")
    assert note.data["reason"] == "not in the allow-list"
    assert seen.of("up") == []

    friendly, seen_too = world.edge(allow=[f"{host}/32"])
    _, port = friendly.listen("0.0.0.0", 0)
    friendly.start()
    with socket.create_connection((host, port), DEADLINE_S) as friend:
        friend.sendall(message(1))
        seen_too.wait("frame")


@contextmanager
def no_descriptors() -> Iterator[None]:
    limits = resource.getrlimit(resource.RLIMIT_NOFILE)
    free = os.open(os.devnull, os.O_RDONLY)
    os.close(free)
    resource.setrlimit(resource.RLIMIT_NOFILE, (free, limits[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, limits)


@pytest.mark.parametrize("pause_s", [0.05, 3600])
def test_no_descriptors_left_to_accept(world: World, monkeypatch: pytest.MonkeyPatch, pause_s: float) -> None:
    monkeypatch.setattr(listener, "NOTE_EVERY_S", pause_s)
    _, seen, port = world.server()
    peer = world.peer(port)
    seen.wait("up")
    client = socket.socket()
    world.closes(client.close)
    with no_descriptors():
        client.connect((HERE, port))
        seen.wait("accept_failed")
        for turn in range(5):  # the others are served, and the loop does not spin on the listener
            peer.send(message(turn))
            seen.wait("frame", turn + 1)
    if pause_s < 1:
        client.sendall(message(9))
        assert seen.wait("frame", 1, 2) == [message(9)]
    else:
        assert len(seen.of("accept_failed")) == 1


def test_an_error_of_our_own_is_noted_and_the_next_peer_is_served(
    world: World, monkeypatch: pytest.MonkeyPatch
) -> None:
    left = [1]

    def fail(sock: socket.socket) -> None:
        if left[0]:
            left[0] -= 1
            raise ZeroDivisionError("our own fault")
        tune_socket(sock)

    monkeypatch.setattr(registry, "tune_socket", fail)
    monkeypatch.setattr(listener, "NOTE_EVERY_S", 0.01)
    _, seen, port = world.server()
    assert world.peer(port).receive() is None
    (note,) = seen.wait("internal_error")
    assert note.data["error"] == "ZeroDivisionError: our own fault"
    world.peer(port).send(message(1))
    assert seen.wait("frame", 1, 1) == [message(1)]


def test_in_any_order_of_events_every_client_is_served(monkeypatch: pytest.MonkeyPatch) -> None:
    listener_model.make_small(monkeypatch)
    run_state_machine_as_test(Model)


def test_who_came_before_an_error_of_our_own_is_served(monkeypatch: pytest.MonkeyPatch) -> None:
    listener_model.make_small(monkeypatch)
    model = Model()
    model.come(2, HERE)
    model.system.faults.extend([NONE, OWN_FAULT])
    model.teardown()
    assert model.linked == [f"{HERE}:1"]
