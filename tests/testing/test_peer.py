"""A recording as a peer: the messages to the program under test, and the messages from it."""

from __future__ import annotations

import socket
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from igtl_gateway.app.faulty import DISCONNECT, FaultyFeed
from igtl_gateway.base.buffers import join
from igtl_gateway.base.errors import ConfigError, UnsupportedRecording
from igtl_gateway.config.configuration import Config
from igtl_gateway.config.faults import Faults
from igtl_gateway.convert.rosmsg import String as RosString
from igtl_gateway.gateway import PARTNER
from igtl_gateway.gateway.log.entry import Kind
from igtl_gateway.record.sessionfile.reader import SessionFile
from igtl_gateway.testing.gateway import ManualGateway
from igtl_gateway.testing.peer import ReplayPeer
from igtl_gateway.wire import Header, Message, decode, encode
from igtl_gateway.wire.framer import Framer
from igtl_gateway.wire.text import String
from tests.places import FIXTURES
from tests.timing import WAIT_S

STAR = FIXTURES / "star.mcap"
HELLO = Message("STRING", "Greeting", String.of("hello"), 7 << 32)


def sent_that_day(path: Path, *streams: str) -> list[bytes]:
    with SessionFile.open(path) as file:
        return [
            entry.data()
            for entry in file.entries()
            if entry.kind is Kind.IGTL_OUT and (not streams or entry.channel in streams)
        ]


class Program:
    """The program under test: a blocking socket."""

    def __init__(self, sock: socket.socket) -> None:
        self.socket = sock
        sock.settimeout(WAIT_S)

    @classmethod
    def of(cls, peer: ReplayPeer) -> Program:
        return cls(socket.create_connection((peer.host, peer.port)))

    def messages(self, count: int) -> list[bytes]:
        framer, found = Framer(), list[bytes]()
        while len(found) < count:
            got = self.socket.recv_into(framer.buffer())
            assert got, f"closed after {len(found)} of {count} messages"
            found += [bytes(data) for data in framer.received(got)]
        return found


@pytest.fixture
def program() -> Iterator[Any]:
    programs: list[Program] = []

    def connect(peer: ReplayPeer) -> Program:
        programs.append(Program.of(peer))
        peer.wait_connected()
        return programs[-1]

    yield connect
    for one in programs:
        one.socket.close()


def test_the_recorded_bytes_are_sent(program: Any) -> None:
    expected = sent_that_day(STAR)
    with ReplayPeer(STAR) as peer:
        client = program(peer)
        for _ in range(2):
            peer.play()
            assert client.messages(len(expected)) == expected
            peer.wait_done()
            assert peer.done
            assert peer.sent == len(expected)


def test_streams_are_selected_at_each_rate(program: Any) -> None:
    with ReplayPeer(STAR, streams=("TRANSFORM/CameraToBase", "StarStatus"), rate=100.0) as peer:
        client = program(peer)
        peer.play()
        found = client.messages(26)
        peer.wait_done()
    assert found == sent_that_day(STAR, "TRANSFORM/CameraToBase", "STRING/StarStatus")


@pytest.mark.parametrize("version", [1, 2])
def test_one_header_version_for_all(program: Any, version: int, tmp_path: Path) -> None:
    gateway = ManualGateway(profile="default")
    gateway.connect()
    gateway.from_ros("/igtl/out/Greeting", join(_cdr("hello")), "std_msgs/msg/String")
    gateway.save(tmp_path / "s.mcap")
    with ReplayPeer(tmp_path / "s.mcap", header=version) as peer:  # type: ignore[arg-type]
        client = program(peer)
        peer.play()
        (data,) = client.messages(1)
    assert Header.unpack(data).version == version
    assert decode(data).content == String.of("hello")


def _cdr(text: str) -> tuple[bytes, ...]:
    size = len(text) + 1
    return b"\0\1\0\0", size.to_bytes(4, "little"), text.encode() + b"\0"


def test_messages_of_the_program_are_decoded_and_invalid_ones_noted(program: Any) -> None:
    with ReplayPeer(STAR) as peer:
        client = program(peer)
        data = join(encode(HELLO))
        client.socket.sendall(data[:50] + bytes(8) + data[58:] + data)
        assert peer.wait_received(1, "STRING") == [HELLO] == peer.received
        assert "bad_crc" in [note.code for note in peer.notes]
        with pytest.raises(TimeoutError, match="not 2 messages received within"):
            peer.wait_received(2, timeout_s=0.01)


def test_it_connects_to_a_program_that_listens() -> None:
    with socket.create_server(("127.0.0.1", 0)) as listener:
        listener.settimeout(WAIT_S)
        with ReplayPeer(STAR, side="peers", connect=listener.getsockname()) as peer:
            server = Program(listener.accept()[0])
            with server.socket:
                peer.wait_connected()
                peer.play()
                found = [Header.unpack(data) for data in server.messages(4)]
                peer.wait_done()
    assert sorted((header.type, header.device_name) for header in found) == [
        ("POINT", "PlanPoints"),
        ("STATUS", "Navigation"),
        ("STRING", "Navigation"),
        ("STRING", "Navigation"),
    ]


def test_of_a_relay_each_side_sends_its_own_messages(program: Any, tmp_path: Path) -> None:
    gateway = ManualGateway(Config(relay=True))
    client, server = gateway.connect(), gateway.connect(role="client", **{PARTNER: 1})
    gateway.from_peer(Message("STRING", "FromClient", String.of("hello")), client)
    gateway.from_peer(Message("STRING", "FromServer", String.of("hello")), server)
    gateway.save(tmp_path / "relay.mcap")
    with ReplayPeer(tmp_path / "relay.mcap") as peer:
        reader = program(peer)
        peer.play()
        assert [Header.unpack(data).device_name for data in reader.messages(1)] == ["FromServer"]
        peer.wait_done()
        assert peer.sent == 1


def test_ros_messages_are_converted_by_the_gateway(program: Any, tmp_path: Path) -> None:
    gateway = ManualGateway()  # no peer is connected: nothing is sent
    gateway.from_ros("/igtl/out/Greeting", join(_cdr("hello")), "std_msgs/msg/String")
    gateway.from_ros("/status", join(_cdr("good")), "std_msgs/msg/String")
    gateway.save(tmp_path / "ros.mcap")
    (tmp_path / "lab.toml").write_text('[[to_igtl]]\ntopic = "/status"\ndevice = "Lab"\n')
    for config, devices in ((None, ["Greeting"]), (tmp_path / "lab.toml", ["Greeting", "Lab"])):
        with ReplayPeer(tmp_path / "ros.mcap", config=config) as peer:
            client = program(peer)
            peer.play()
            assert [decode(data).device_name for data in client.messages(len(devices))] == devices
            peer.wait_done()
            assert peer.sent == len(devices)


def test_closing_during_playback_stops_it(program: Any) -> None:
    with ReplayPeer(STAR, rate=0.001) as peer:
        program(peer)
        peer.play()
        with pytest.raises(RuntimeError, match="playback in progress"):
            peer.play()
        with pytest.raises(TimeoutError, match="not all messages sent"):
            peer.wait_done(0.01)
    assert not peer.done
    peer.close()
    with pytest.raises(ConnectionRefusedError):
        Program.of(peer)


def test_no_program_connects() -> None:
    with ReplayPeer(STAR) as peer, pytest.raises(TimeoutError, match=f"{peer.port}: not 1 program connected"):
        peer.wait_connected(timeout_s=0.01)


def test_invalid_arguments_are_errors_before_listening(tmp_path: Path) -> None:
    with pytest.raises(UnsupportedRecording):
        ReplayPeer(tmp_path / "none.mcap")
    with pytest.raises(ConfigError, match="found 0, expected a number above 0"):
        ReplayPeer(STAR, rate=0)


def test_streams_that_are_not_there_are_an_error_of_the_test(program: Any) -> None:
    with pytest.raises(ConfigError, match=r"streams: found 'ToolToBas', .*did you mean 'TRANSFORM/ToolToBase'"):
        ReplayPeer(STAR, streams=["ToolToBas"])
    with pytest.raises(ConfigError, match=r"streams: Toool: matches no recorded stream"):
        ReplayPeer(STAR, streams=["TRANSFORM/*", "Toool"])


def test_a_stream_that_the_gateway_does_not_compute_is_an_error_at_the_end(tmp_path: Path, program: Any) -> None:
    gateway = ManualGateway(to_igtl=[{"topic": "/a", "device": "A"}])
    gateway.from_ros("/a", RosString("one"))
    gateway.log = [entry for entry in gateway.log if entry.kind.is_input]
    gateway.save(tmp_path / "inputs.mcap")
    with ReplayPeer(tmp_path / "inputs.mcap", streams=["STRING/A", "STRING/B"]) as peer:
        program(peer)
        peer.play()
        with pytest.raises(ConfigError, match="STRING/B: matches no stream of the replay; did you mean 'STRING/A'"):
            peer.wait_done()


def test_what_the_gateway_only_asked_is_not_what_it_sent(tmp_path: Path, program: Any) -> None:
    gateway = ManualGateway(profile="plus")
    for _ in range(3):
        gateway.from_peer(HELLO)
        gateway.advance(10)
    gateway.save(tmp_path / "plus.mcap")
    with ReplayPeer(tmp_path / "plus.mcap") as peer:
        client = program(peer)
        peer.play()
        assert {decode(data).type for data in client.messages(3)} == {"STRING"}


def test_a_seed_has_the_same_faults_on_each_connection(program: Any) -> None:
    fault = "loss=10%,corrupt=5%,truncate=1%,disconnect=1%"
    with SessionFile.open(STAR) as file:
        outputs = [e for e in file.entries() if e.kind is Kind.IGTL_OUT and e.type == "TRANSFORM"]
    feed = FaultyFeed(Faults.parse(fault), 4)
    parts, part = [], b""
    for entry in feed(outputs):
        part += entry.data()
        if entry.links == DISCONNECT:
            parts.append(part)
            part = b""
    assert 3 < len(parts) < 40
    with ReplayPeer(STAR, streams=["TRANSFORM/*"], fault=fault, seed=4) as peer:
        client = program(peer)
        peer.play()
        for wanted in parts:
            received = b""
            while data := client.socket.recv(1 << 16):
                received += data
            assert received == wanted
            client.socket.close()
            client = program(peer)
        peer.wait_done()
        assert peer.faults == feed.counts
    with pytest.raises(ConfigError, match="fault: loss"):
        ReplayPeer(STAR, fault="loss=2")


def test_a_session_without_checked_checksums_reaches_a_program_that_checks_them(tmp_path: Path) -> None:
    gateway, data = ManualGateway(check_crc=False), join(encode(HELLO))
    gateway.from_peer(data[:50] + bytes(8) + data[58:])
    gateway.save(path := tmp_path / "unchecked.mcap")
    with ReplayPeer(path) as peer:
        program = Program.of(peer)
        peer.wait_connected()
        peer.play()
        assert program.messages(1) == [data]
        peer.wait_done()
