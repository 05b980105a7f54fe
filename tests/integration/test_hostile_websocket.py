"""The table of hostile peers over WebSocket: each is answered, noted and counted as over TCP.

A whole message is sent as one, rubbish in a frame of its own, and a message that is cut off in a frame as long as its
header announces.  ``tests/edges/tcp/websocket`` has those that break a rule of WebSocket.
"""

from __future__ import annotations

import socket
import struct
from collections import Counter
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

from igtl_gateway.cli import main
from igtl_gateway.gateway.log.note import Note
from igtl_gateway.record.sessionfile.reader import SessionFile
from tests.edges.tcp.websocket.hostile_websockets import frame, request
from tests.integration.bridge import HEADER_SIZE, Bridge, RawPeer, string
from tests.integration.hostile_cases import CASES, Case, Manner
from tests.integration.test_hostile import EVERYDAY
from tests.tables import all_hold

#: Longest message whose rest a frame may still announce: a header of garbage announces more.
MOST = 2 << 20


def frames(data: bytes) -> Iterator[bytes]:
    """The frames that data is sent in."""
    while len(data) >= HEADER_SIZE:
        size = HEADER_SIZE + int.from_bytes(data[42:50], "big")
        if size > len(data):
            break
        yield frame(data[:size])
        data = data[size:]
    if data:
        whole = HEADER_SIZE + int.from_bytes(data[42:50], "big") if len(data) >= HEADER_SIZE else HEADER_SIZE
        yield frame(data, size=max(len(data), whole if whole <= MOST else 0))


def messages(data: bytes) -> Iterator[bytes]:
    """The messages in frames of a server, up to that which closes."""
    while data and data[0] == 0x82:
        size, at = data[1], 2
        if size >= 126:
            at = 4 if size == 126 else 10
            size = int.from_bytes(data[2:at], "big")
        yield data[at : at + size]
        data = data[at + size :]


def play(bridge: Bridge, port: int, case: Case) -> tuple[int, tuple[str, ...]]:
    """Be the peer; return the number of its link, and the types of its answers."""
    with RawPeer(port) as peer:
        peer.send(request())
        answer = b""
        while not answer.endswith(b"\r\n\r\n"):
            answer += peer.socket.recv(1)
        (up,) = bridge.wait_events(
            lambda event: event.get("code") == "link_up" and event["data"].get("peer") == peer.name, "link"
        )
        got = bytearray()
        with suppress(OSError):  # it may be closed before it has sent all
            for one in frames(case.data):
                if case.manner is Manner.BYTEWISE:
                    for byte in one:
                        peer.send(bytes([byte]))
                else:
                    peer.send(one)
            if case.manner is Manner.RESETS:
                peer.socket.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
                peer.close()
            elif case.kept or case.manner is Manner.LEAVES:
                peer.socket.shutdown(socket.SHUT_WR)
            while part := peer.socket.recv(1 << 16):
                got += part
    (number,) = up["links"]
    bridge.wait_code("link_down", links=[number])
    return number, tuple(one[2:14].rstrip(b"\0").decode() for one in messages(bytes(got)))


def test_each_is_answered_noted_and_counted_as_over_tcp(tmp_path: Path) -> None:
    recording = tmp_path / "hostile.mcap"
    bridge = Bridge("--no-ros", "--record", str(recording), "--listen", "ws://127.0.0.1:0")
    try:
        (started,) = bridge.wait_events(lambda event: event["event"] == "started", "start")
        port = started["listen"][1]["port"]
        played = {case.name: play(bridge, port, case) for case in CASES}
        with RawPeer(bridge.port) as good:
            good.send(string("still there", "good"))
            bridge.wait_code("stream", stream="STRING/good")
        result = bridge.end()
        assert (result.code, result.err) == (0, "")
        ledger = bridge.events[-1]["ledger"]
        links = Counter(code for case in CASES if not case.kept for code in case.noted)
    finally:
        bridge.close()
    noted: dict[int, set[str]] = {number: set() for number, _ in played.values()}
    with SessionFile.open(recording) as session:
        for entry in session.entries():
            if entry.kind.value in ("note", "edge_note", "link"):
                for number in entry.links:
                    noted.setdefault(number, set()).add(Note.unpack(entry.data()).code)

    def check(case: Case) -> None:
        number, answers = played[case.name]
        assert noted[number] - EVERYDAY == set(case.noted)
        row = ledger["streams"]["igtl_in"].get(case.ledger_stream, {})
        fates = {word: count for word, count in row.items() if word in ("converted", "unheard", "recorded_only")}
        assert fates | row.get("dropped", {}) == case.counted
        if case.manner is not Manner.RESETS:
            assert answers == case.answer

    all_hold({case.name: case for case in CASES}, check)
    assert ledger["link_faults"] == dict(links)
    assert (ledger["gaps"], main(["verify", str(recording)])) == ([], 0)
