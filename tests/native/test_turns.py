"""Fair shares of the native passage: links take turns, and a steady rate is not a flood."""

from __future__ import annotations

import socket
import time
from pathlib import Path

import pytest

from igtl_gateway.convert.rosmsg import String
from igtl_gateway.edges.tcp import PeerLimits
from igtl_gateway.gateway.log.entry import Kind
from igtl_gateway.gateway.log.note import Note
from igtl_gateway.native.passage import is_compiled
from igtl_gateway.wire.framer import Framer
from tests.gateway.fastpath.test_passage_streams import (
    Peer,
    Scene,
    check_recording,
    counted_by_python,
    entries_of,
    scene,
    transform,
    wait_for,
)

pytestmark = pytest.mark.skipif(not is_compiled(), reason="without the native passage")


def make_native(here: Scene, peer: Peer, device: str) -> None:
    """Send until the stream of the device passes natively."""
    before = here.native
    for number in range(200):
        peer.send(transform(1000.0 + number, device=device))  # of the size of those that follow: no jump
        time.sleep(0.002)
        if here.native > before:
            break
    number = len([link for link in here.bridge.tcp.links() if link.connected])
    wait_for(lambda: (link := here.bridge.tcp.native_link(number)) is not None and link.is_native)


def test_a_message_does_not_wait_for_all_that_another_peer_has_sent(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    path = tmp_path / "session.mcap"
    with scene(monkeypatch, path=path) as here:
        flood = here.connect()
        make_native(here, flood, "FloodToBase")
        good = here.connect()
        make_native(here, good, "GoodToBase")
        received = here.received("igtl_in")
        with here.bridge.hub.sequence:  # the passage has the first message, and waits for the lock
            flood.send(b"".join(transform(1000.0, device="FloodToBase") for _ in range(500)))
            time.sleep(0.2)
            good.send(transform(2000.0, device="GoodToBase"))
            time.sleep(0.2)
        wait_for(lambda: here.received("igtl_in") == received + 501)
        assert here.native == 2
    check_recording(path, here.bridge.gateway.config, here.bridge.losses)
    last = [entry.channel for entry in entries_of(path) if entry.kind is Kind.IGTL_IN][-501:]
    assert last.index("TRANSFORM/GoodToBase") <= 5


def test_a_steady_rate_below_the_limit_is_never_limited(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Also not where the whole of it is counted at once, when Python takes over."""
    path = tmp_path / "session.mcap"
    with scene(monkeypatch, path=path, limits=PeerLimits(messages_per_s=1_000)) as here:
        peer = here.connect()
        due = time.monotonic()
        for number in range(1_300):
            peer.send(transform(number))
            due = max(due + 1 / 800, time.monotonic())
            time.sleep(max(0.0, due - time.monotonic()))
        wait_for(lambda: here.received("igtl_in") == 1_300)
        link = here.bridge.tcp.native_link(1)
        assert link and link.received_messages > 1_000
    codes = {Note.of(entry.data()).code for entry in entries_of(path) if entry.kind is Kind.EDGE_NOTE}
    assert "rate_limited" not in codes


def test_a_flood_is_limited_natively(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    path = tmp_path / "session.mcap"
    with scene(monkeypatch, path=path, limits=PeerLimits(messages_per_s=500)) as here:
        peer = here.connect()
        make_native(here, peer, "FloodToBase")
        passed = here.received("igtl_in")
        with counted_by_python(here) as handled:
            for _ in range(4):
                peer.send(b"".join(transform(1000.0 + number, device="FloodToBase") for number in range(500)))
            wait_for(lambda: here.received("igtl_in") == passed + 2_000)
        assert handled == [], "what is above the limit waits in the connection"
        link = here.bridge.tcp.native_link(1)
        assert link and link.is_native
    codes = {Note.of(entry.data()).code for entry in entries_of(path) if entry.kind is Kind.EDGE_NOTE}
    assert "rate_limited" in codes


@pytest.mark.slow
def test_a_peer_that_does_not_read_leaves_the_others_native(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """What it is sent waits in its own queue, in order; before, the whole stream went through Python."""
    path = tmp_path / "session.mcap"
    texts = [f"{number:06} " + "x" * 20_000 for number in range(500)]
    with scene(monkeypatch, path=path) as here, socket.socket() as slow:
        good = here.connect()
        slow.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        slow.connect(here.bridge.addresses[0])
        wait_for(lambda: len([one for one in here.bridge.tcp.links() if one.connected]) == 2)
        first = 0
        while here.native == 0 and first < 100:  # these pass in Python, until the stream is copied
            here.send_ros(String(texts[first]), "/igtl/out/text")
            first += 1
            wait_for(lambda sent=first: len(strings(good.received)) == sent)
        for text in texts[first:]:
            here.send_ros(String(text), "/igtl/out/text")
        wait_for(lambda: len(strings(good.received)) == len(texts))
        wait_for(lambda: here.bridge.tcp.counters()[2].queued_messages > 100)
        assert here.native == 1
        links = [here.bridge.tcp.native_link(number) for number in (1, 2)]
        assert [bool(link and link.sent_messages >= 400) for link in links] == [True, False]
        framer = Framer()
        received: list[bytes] = []
        while len(strings(received)) < len(texts):
            received += [bytes(message) for message in framer.feed(slow.recv(1 << 20))]
        assert strings(received) == strings(good.received) == [text.encode() for text in texts]
    check_recording(path, here.bridge.gateway.config, here.bridge.losses)


def strings(messages: list[bytes]) -> list[bytes]:
    """The contents of the STRINGs among these messages."""
    return [message[62:] for message in messages if message[2:8] == b"STRING"]
