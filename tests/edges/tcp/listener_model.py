"""A listener in a loop whose time and turns are chosen: arrivals, departures, faults and jumps of time in any order."""

from __future__ import annotations

import errno
import socket
from collections import deque

import pytest
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, rule

from igtl_gateway.base.clock import ManualClock
from igtl_gateway.base.stamp import NS_PER_MS, NS_PER_S
from igtl_gateway.edges.tcp import listener, lobby
from igtl_gateway.edges.tcp.link_parts import Refusals
from igtl_gateway.edges.tcp.listener import Listener
from igtl_gateway.edges.tcp.loop import Loop
from igtl_gateway.edges.tcp.reporter import Reporter
from igtl_gateway.edges.tcp.sockets import AllowList
from igtl_gateway.wire.header import HEADER_SIZE

#: Of the model, so that few connections reach them.
ROOM, KEPT, CROWD, AT_ONCE = 4, 1, 3, 2
HERE = "127.0.0.1"
#: What ``accept`` does next: an error of the system, one of our own, or nothing wrong.
OWN_FAULT, NONE = -1, 0
FAULTS = [errno.EMFILE, errno.ECONNABORTED, errno.EINTR, errno.EAGAIN, OWN_FAULT, NONE]


class System:
    """The queue of the kernel: its descriptor is readable while it has connections."""

    def __init__(self) -> None:
        self._here, self._there = socket.socketpair()
        self.connections: deque[tuple[socket.socket, tuple[str, int]]] = deque()
        self.faults: deque[int] = deque()
        self.lost = 0  # by an error of our own

    def fileno(self) -> int:
        return self._here.fileno()

    def getsockname(self) -> tuple[str, int]:
        return (HERE, 1)

    def come(self, sock: socket.socket, address: tuple[str, int]) -> None:
        self.connections.append((sock, address))
        self._there.send(b"!")

    def accept(self) -> tuple[socket.socket, tuple[str, int]]:
        fault = self.faults.popleft() if self.faults else NONE
        if fault > 0:
            raise OSError(fault, "as asked for")
        if not self.connections:
            raise BlockingIOError
        self._here.recv(1)
        sock, address = self.connections.popleft()
        if fault == OWN_FAULT:
            sock.close()
            self.lost += 1
            raise ZeroDivisionError("our own fault")
        return sock, address

    def close(self) -> None:
        self._here.close()
        self._there.close()


class Model(RuleBasedStateMachine):
    """At the end of each run every client that connected has been served."""

    def __init__(self) -> None:
        super().__init__()
        self.clock = ManualClock()
        self.loop = Loop(self.clock, lambda: None, lambda exc: None)
        self.system = System()
        reporter = Reporter(self.loop, lambda number, note: None)
        self.refusals = Refusals(reporter)
        self.listener = Listener(
            self.system,  # type: ignore[arg-type]
            AllowList(()),
            lambda: "full" if self.is_full else "",
            self._up,
            self.loop,
            reporter,
            self.refusals,
        )
        self.is_full = False
        self.link_faults = 0
        self.linked: list[str] = []
        self.failed = 0
        self.peers: dict[str, socket.socket] = {}
        self.come_number = 0
        self.listener.open()

    def _up(self, sock: socket.socket, peer: str) -> None:
        sock.close()
        if self.link_faults:
            self.link_faults -= 1
            self.failed += 1
            raise ZeroDivisionError("our own fault")
        self.linked.append(peer)

    @initialize(number=st.integers(ROOM, 4 * ROOM))
    def begin(self, number: int) -> None:
        self.come(number, HERE)

    @rule(number=st.integers(1, 2 * ROOM), host=st.sampled_from([HERE, "127.0.0.2", "192.0.2.1"]))
    def come(self, number: int, host: str) -> None:
        for _ in range(number):
            self.come_number += 1
            ours, peer = socket.socketpair()
            self.peers[f"{host}:{self.come_number}"] = peer
            self.system.come(ours, (host, self.come_number))

    @rule(data=st.data(), size=st.sampled_from([0, HEADER_SIZE - 1, HEADER_SIZE]), everyone=st.booleans())
    def leave(self, data: st.DataObject, size: int, everyone: bool) -> None:
        if not self.peers:
            return
        names = list(self.peers) if everyone else [data.draw(st.sampled_from(list(self.peers)))]
        for name in names:
            with self.peers.pop(name) as peer:
                if size:
                    try:
                        peer.sendall(bytes(size))
                    except OSError:
                        continue  # refused

    @rule(times=st.integers(1, 5))
    def run(self, times: int) -> None:
        for _ in range(times):
            self.loop.run_once(0)

    @rule(ns=st.sampled_from([1, NS_PER_MS, 2 * NS_PER_MS, lobby.WAIT_NS - 1, lobby.WAIT_NS, NS_PER_S, 100 * NS_PER_S]))
    def time_passes(self, ns: int) -> None:
        self.clock.advance(ns)

    @rule(codes=st.lists(st.sampled_from(FAULTS), max_size=3), links=st.integers(0, 2), is_full=st.booleans())
    def trouble(self, codes: list[int], links: int, is_full: bool) -> None:
        self.system.faults.extend(codes)
        self.link_faults += links
        self.is_full = is_full

    def teardown(self) -> None:
        try:
            self._settles()
        finally:
            self.listener.close()
            self.loop.close()
            self.system.close()
            for sock, _ in self.system.connections:
                sock.close()
            for peer in self.peers.values():
                peer.close()

    def _settles(self) -> None:
        """When nothing happens any more, all have been served: each has become a link or was refused."""
        for _ in range(20 * self.come_number + 100):
            self.loop.run_once(0)
            self.clock.advance(NS_PER_S // 4)
        assert not self.system.connections
        assert self.listener._lobby.due_ns is None
        ended = len(self.linked) + self.failed + self.system.lost + sum(self.refusals.counts.values())
        assert ended == self.come_number


def make_small(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let few connections be a crowd, and fill the lobby."""
    for name, value in {"ROOM": ROOM, "KEPT": KEPT, "CROWD": CROWD}.items():
        monkeypatch.setattr(lobby, name, value)
    monkeypatch.setattr(listener, "_AT_ONCE", AT_ONCE)
