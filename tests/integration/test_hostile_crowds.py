"""Many connections at the running bridge: one after the other, and such that never begin to speak TLS.

``HOSTILE_RECONNECTS=10000`` is the long version of the first.  Nothing that the bridge keeps may grow with the number
of peers that have been: threads, descriptors and memory are looked at, and the tables of the ledger, which has a row
for each of the first 2,000 peers and one for all others together.
"""

from __future__ import annotations

import os
import socket
import ssl
import struct
import threading
import time
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

from igtl_gateway.gateway.log.ledger import MAX_STREAMS, OTHERS
from tests.integration.bridge import HEADER_SIZE, TIMEOUT_S, Bridge, RawPeer, header, message, string
from tests.places import PEMS

RECONNECTS = int(os.environ.get("HOSTILE_RECONNECTS", "1000"))


@dataclass(frozen=True)
class Use:
    """What the bridge's process has."""

    threads: int
    descriptors: int
    resident_bytes: int

    @classmethod
    def of(cls, bridge: Bridge) -> Use:
        place = Path(f"/proc/{bridge.process.pid}")
        threads, descriptors = (len(list((place / what).iterdir())) for what in ("task", "fd"))
        return cls(threads, descriptors, bridge.resident_bytes())


def leaves(peer: RawPeer) -> None:
    """With a whole message, in good order."""
    peer.send(string("hello", "Guest"))
    peer.socket.shutdown(socket.SHUT_WR)
    assert peer.everything() == b""


def resets(peer: RawPeer) -> None:
    """Behind a whole message."""
    peer.send(string("hello", "Guest"))
    peer.socket.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))


def breaks_off(peer: RawPeer) -> None:
    """In the middle of a header."""
    peer.send(string("hello", "Guest")[: HEADER_SIZE // 2])


def says_nothing(peer: RawPeer) -> None:
    """And goes."""


GUESTS: tuple[Callable[[RawPeer], None], ...] = (leaves, resets, breaks_off, says_nothing)


def asks(peer: RawPeer) -> None:
    """A good one, who is served."""
    peer.send(message("GET_STATUS", b"", device="Good"))
    assert peer.receive("Good").type == "STATUS"


def all_gone(bridge: Bridge, good: RawPeer, alone: Use) -> Use:
    """Resources in use when all peers are disconnected; after the last one no connection waits to be accepted."""
    with RawPeer(bridge.port) as last:
        asks(last)
    deadline = time.monotonic() + TIMEOUT_S
    while (use := Use.of(bridge)).descriptors > alone.descriptors:
        assert time.monotonic() < deadline, (alone, use)
        asks(good)
    return use


def test_one_after_the_other(tmp_path: Path) -> None:
    # on a busy machine many peers disconnect before the bridge accepts them: none of these may be refused
    bridge = Bridge("--no-ros", "--max-clients", "500", "--record", str(tmp_path / "guests.mcap"))
    try:
        with RawPeer(bridge.port) as good:
            asks(good)
            alone = before = Use.of(bridge)
            for number in range(RECONNECTS):
                with RawPeer(bridge.port) as guest:
                    GUESTS[number % len(GUESTS)](guest)
                if number % 100 == 0:
                    asks(good)
                if number == RECONNECTS // 4:  # tables and caches have their size
                    before = Use.of(bridge)
            after = all_gone(bridge, good, alone)
        assert after.threads <= alone.threads
        # of each peer the ledger keeps a line as long as there are less than MAX_STREAMS
        assert after.resident_bytes - before.resident_bytes < 8 << 20, (before, after)
        told = bridge.end()
        assert (told.code, told.err) == (0, "")
        last = bridge.events[-1]
        assert last["recording"]["dropped"] == 0
        ledger = last["ledger"]
        each = RECONNECTS // len(GUESTS)
        gone = ledger["refused"].get("it left before its turn", 0)
        links = RECONNECTS + 2 - gone
        assert ledger["gaps"] == []
        # in a crowd no link is made for who has left without a whole message, or was reset
        assert each <= ledger["streams"]["igtl_in"]["STRING/Guest"]["received"] <= 2 * each
        assert ledger["link_faults"].get("truncated", 0) <= each
        assert gone <= 3 * each
        peers = ledger["streams"]["peers"]
        assert len(peers) == min(links, MAX_STREAMS + (links > MAX_STREAMS))
        assert (OTHERS in peers) == (links > MAX_STREAMS)
        assert ledger["links"].keys() == {"0"}
    finally:
        bridge.close()


def test_200_that_never_begin_the_tls_handshake() -> None:
    """They keep out no peer that has a certificate, and disturb no connected peer."""
    most = 8
    pems = ("--tls-cert", str(PEMS / "server.pem"), "--tls-ca", str(PEMS / "ca.pem"))
    bridge = Bridge("--no-ros", "--max-clients", str(most), *pems)
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    context.load_verify_locations(PEMS / "ca.pem")
    context.load_cert_chain(PEMS / "viewer.pem")

    def good(stack: ExitStack) -> RawPeer:
        peer = stack.enter_context(RawPeer(bridge.port))
        peer.socket = context.wrap_socket(peer.socket, server_hostname="127.0.0.1")
        return peer

    try:
        with ExitStack() as stack:
            early = good(stack)
            asks(early)
            silent = [stack.enter_context(RawPeer(bridge.port)) for _ in range(200)]
            asks(early)
            late = good(stack)
            asks(late)
            asks(early)
            assert all(peer.closed_by_peer() for peer in silent[: 200 - most])
        assert bridge.end().code == 0
        assert bridge.events[-1]["ledger"]["refused"]["no TLS handshake before others came"] > 200 - most - 1
    finally:
        bridge.close()


def test_memory_of_large_messages_with_wrong_checksums_is_returned(tmp_path: Path) -> None:
    """Within idle + 100 MB; the memory that the recorder shares with the bridge does not count."""
    peers, size = 6, 40 << 20
    data = header("IMAGE", size, 1) + bytes(size)
    bridge = Bridge("--no-ros", "--record", str(tmp_path / "out.mcap"))
    try:
        idle = bridge.resident_bytes()
        crowd = [RawPeer(bridge.port) for _ in range(peers)]
        threads = [threading.Thread(target=peer.send, args=(data,)) for peer in crowd]
        for thread in threads:
            thread.start()
        most = idle
        while any(thread.is_alive() for thread in threads):
            most = max(most, bridge.resident_bytes())
            time.sleep(0.01)
        bridge.wait_code("bad_crc")
        for peer in crowd:
            peer.close()
        deadline = time.monotonic() + 60
        while bridge.resident_bytes() > idle + 100_000_000 and time.monotonic() < deadline:
            time.sleep(0.5)
        assert most > idle + 100_000_000 > bridge.resident_bytes()
        assert bridge.end().code == 0
    finally:
        bridge.close()
