"""``bridge --relay`` between programs that know nothing of it: what arrives, what is recorded, how it ends."""

from __future__ import annotations

import json
import socket
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from urllib.request import urlopen

import pytest

from igtl_gateway.app.replay_plan import plan_replay, planned_entries
from igtl_gateway.cli import main
from igtl_gateway.gateway.log.entry import Kind
from igtl_gateway.record.sessionfile.reader import SessionFile
from igtl_gateway.replay.recorded_config import config_to_run
from tests.integration.bridge import (
    TIMEOUT_S,
    Bridge,
    RawPeer,
    Wire,
    extended,
    free_port,
    gateway,
    header,
    message,
    string,
)
from tests.peers import reference
from tests.peers.pyigtl_peer import PyigtlPeer
from tests.peers.reference import ReferencePeer

needs_library = pytest.mark.skipif(reference.available() is not None, reason=str(reference.available()))


class Server:
    """The far end as a plain socket."""

    def __init__(self) -> None:
        self.socket = socket.create_server(("127.0.0.1", 0))
        self.socket.settimeout(TIMEOUT_S)
        self.port: int = self.socket.getsockname()[1]

    def accepted(self) -> RawPeer:
        peer = RawPeer.__new__(RawPeer)
        peer.socket, _ = self.socket.accept()
        peer.socket.settimeout(TIMEOUT_S)
        return peer

    def close(self) -> None:
        self.socket.close()


@pytest.fixture
def server() -> Iterator[Server]:
    with closing(Server()) as server:
        yield server


def relay(server_port: int, *arguments: str) -> Bridge:
    return Bridge("--relay", "--connect", f"127.0.0.1:{server_port}", *arguments)


def received(peer: RawPeer, count: int) -> bytes:
    wires: list[Wire] = [peer.receive() for _ in range(count)]
    return b"".join(wire.data for wire in wires)


HELLO = string("hello", "Client")
#: What only an honest man in the middle passes on.
ODD = [
    HELLO,
    HELLO[:50] + bytes(8) + HELLO[58:],  # a wrong CRC
    b"\0\7" + HELLO[2:],  # a header version of the future
    message("STRING", extended(b"\0\3\0\2hi", {"key": "value"}), version=2),
    message("MYSTERY", bytes(range(256)) * 4096),
    header("GET_STATUS", 0, 0),
    header("TRANSFORM", 3, 1, device="Short") + b"abc",
]


def test_bytes_are_unchanged_in_both_directions_and_recorded(
    server: Server, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "talk.mcap"
    with closing(relay(server.port, "--record", str(path))) as bridge:
        with RawPeer(bridge.port) as first, closing(server.accepted()) as behind_first:
            with RawPeer(bridge.port) as second, closing(server.accepted()) as behind_second:
                first.send(b"".join(ODD))
                behind_second.send(b"".join(reversed(ODD)))
                assert received(behind_first, len(ODD)) == b"".join(ODD)
                assert received(second, len(ODD)) == b"".join(reversed(ODD))
                second.close()
                assert behind_second.closed_by_peer()
            behind_first.send(HELLO)
            assert received(first, 1) == HELLO, "the other pair lives"
            behind_first.close()
            assert first.closed_by_peer()
        bridge.wait_code("link_down", count=4)
        assert bridge.end().code == 0
    with SessionFile.open(path) as file:
        entries = list(file.entries())
        assert json.loads(file.session["config"])["relay"] is True
    by_link: dict[tuple[Kind, int], bytes] = {}
    for entry in entries:
        if entry.kind in (Kind.IGTL_IN, Kind.IGTL_OUT):
            key = (entry.kind, entry.links[0])
            by_link[key] = by_link.get(key, b"") + entry.data()
    assert by_link == {
        (Kind.IGTL_IN, 1): b"".join(ODD),
        (Kind.IGTL_OUT, 2): b"".join(ODD),
        (Kind.IGTL_IN, 4): b"".join(reversed(ODD)),
        (Kind.IGTL_OUT, 3): b"".join(reversed(ODD)),
        (Kind.IGTL_IN, 2): HELLO,
        (Kind.IGTL_OUT, 1): HELLO,
    }
    assert main(("verify", str(path))) == 0
    assert main(("info", str(path))) == 0
    assert "MYSTERY/Raw" in capsys.readouterr().out


def test_a_replay_says_the_words_of_the_side_that_it_stands_for(server: Server, tmp_path: Path) -> None:
    path = tmp_path / "talk.mcap"
    with closing(relay(server.port, "--record", str(path))) as bridge:
        with RawPeer(bridge.port) as client, closing(server.accepted()) as behind:
            for number in range(3):
                client.send(string(f"question {number}"))
                behind.receive()
                behind.send(string(f"answer {number}"))
                client.receive()
        bridge.wait_code("link_down", count=2)
        assert bridge.end().code == 0
    replay = ("replay", str(path), "--to", "igtl", "--as-fast-as-possible")
    with closing(gateway(*replay, "--listen", "127.0.0.1:0")) as program:
        program.wait_until(lambda: any("server on" in line for line in program.lines), "start")
        port = next(line for line in program.lines if "server on" in line).rpartition(":")[2]
        with RawPeer(int(port)) as peer:
            assert received(peer, 3) == b"".join(string(f"answer {number}") for number in range(3))
            assert peer.closed_by_peer()
        assert program.end(None).code == 0
    with closing(gateway(*replay, "--connect", f"127.0.0.1:{server.port}")), closing(server.accepted()) as peer:
        assert received(peer, 3) == b"".join(string(f"question {number}") for number in range(3))
        assert peer.closed_by_peer()


def test_over_a_bad_line_the_recording_has_what_was_really_sent(
    server: Server, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "bad.mcap"
    faults = ("--fault", "delay=20ms,jitter=5ms,loss=10%,reorder=10%,corrupt=10%,disconnect=2%", "--seed", "3")
    with closing(relay(server.port, "--record", str(path), "--metrics", "0", *faults)) as bridge:
        started = bridge.events[0]
        assert started["time"].startswith("20")
        with urlopen(started["metrics"], timeout=TIMEOUT_S) as answer:
            assert b"igtl_gateway_recording{" in answer.read()
        with RawPeer(bridge.port) as client, closing(server.accepted()) as behind:
            client.send(b"".join(string(f"number {number}") for number in range(200)))
            heard = behind.everything()
            behind.close()
            assert client.closed_by_peer()
        bridge.wait_code("fault_disconnect")
        bridge.wait_code("link_down", count=2)
        assert bridge.end().code == 0
    with SessionFile.open(path) as file:
        entries = list(file.entries())
        assert file.ledger
        (ledger,) = file.ledger["streams"]["igtl_in"].values()
    sent = [entry for entry in entries if entry.kind is Kind.IGTL_OUT]
    assert b"".join(entry.data() for entry in sent) == heard
    assert 0 < len(sent) < 200
    assert ledger["received"] == ledger["relayed"] + sum(ledger["dropped"].values())
    assert ledger["relayed"] == len(sent)
    assert main(("verify", str(path))) == 0
    assert main(("info", str(path))) == 0
    capsys.readouterr()
    with SessionFile.open(path) as file:
        again = planned_entries(file, config_to_run(file.session), plan_replay(file, "igtl", False), [], role="client")
        assert b"".join(entry.data() for entry in again) == heard, "several of a stream behind one tick are several"


@needs_library
def test_the_library_and_pyigtl_talk_through_it() -> None:
    with ReferencePeer.server() as far, closing(relay(far.port)) as bridge:
        with closing(PyigtlPeer.client("127.0.0.1", bridge.port)) as near:
            far.wait_connected()
            near.send("STRING", "Near", {"string": "from pyigtl"})
            assert far.receive("STRING", "Near")["content"]["string"] == "from pyigtl"
            far.send("STRING", "Far", {"encoding": 3, "string": "from the library"})
            assert near.receive("STRING", "Far")["content"]["string"] == "from the library"
        far.wait_for_event("disconnected")


def test_a_client_comes_before_the_server() -> None:
    port = free_port()
    with closing(relay(port)) as bridge:
        with RawPeer(bridge.port) as early:
            assert early.closed_by_peer()
        bridge.wait_code("connect_failed")
        with socket.create_server(("127.0.0.1", port)) as listener, RawPeer(bridge.port) as late:
            listener.settimeout(TIMEOUT_S)
            behind, _ = listener.accept()
            with closing(behind):
                behind.sendall(HELLO)
                assert received(late, 1) == HELLO


@pytest.mark.parametrize("servers", [[], ["--connect", "127.0.0.1:1", "--connect", "127.0.0.1:2"]])
def test_a_relay_has_one_server(servers: list[str]) -> None:
    program = gateway("bridge", "--relay", *servers)
    with closing(program):
        result = program.end(None)
    assert result.code == 2
    assert "--connect HOST:PORT" in result.err
