"""Peers for scripts over real sockets: messages of every type, queries, commands, handlers, the end of connections."""

from __future__ import annotations

import socket
import threading
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

import igtl_gateway
from igtl_gateway import Peer, Server
from igtl_gateway.api.conversation import Wait
from igtl_gateway.api.received import ReceivedMessage
from igtl_gateway.base.errors import (
    ConfigError,
    ConversionError,
    GatewayError,
    LinkClosed,
    MalformedBody,
    NoReply,
    Refused,
    Unavailable,
)
from igtl_gateway.edges.tcp import PeerLimits, TlsFiles
from igtl_gateway.wire import Message, decode, encode
from igtl_gateway.wire.framer import Framer
from igtl_gateway.wire.query import StartTracking
from igtl_gateway.wire.text import String
from tests.places import PEMS
from tests.wire.handmade import CORPUS

POSE = np.array([[0.0, -1, 0, 1], [1, 0, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]])


@pytest.fixture
def server() -> Iterator[Server]:
    with igtl_gateway.serve(0) as server:
        yield server


@pytest.fixture
def peer(server: Server) -> Iterator[Peer]:
    with igtl_gateway.connect(server.host, server.port) as peer:
        server.wait_connected()
        yield peer


def corpus() -> Iterator[bytes]:
    for path in sorted(CORPUS.glob("*.bin")):
        framer = Framer()
        yield from map(bytes, framer.feed(path.read_bytes()))


def test_every_type_passes_unchanged(server: Server, peer: Peer) -> None:
    messages = list(corpus())
    for data in messages:
        assert peer.send(decode(data)) == 1
    found = [server.receive() for _ in messages]
    assert [b"".join(encode(message.wire)) for message in found] == messages
    for message in found[:20]:
        server.send(message)  # a received message is sent as it is
    assert [b"".join(encode(peer.receive().wire)) for _ in found[:20]] == messages[:20]


def test_values_stamps_and_metadata(server: Server, peer: Peer) -> None:
    peer.send("TRANSFORM", "Tool", POSE, time_ns=5)
    pose = server.receive("TRANSFORM", "Tool")
    assert (pose.matrix.tolist(), pose.source_ns, pose.header_version) == (POSE.tolist(), 5, 1)
    peer.send("STRING", "Text", "now", metadata={"operator": "A. B."})
    text = server.receive()
    assert (text.text, text.metadata, text.header_version) == ("now", {"operator": "A. B."}, 2)
    assert abs(text.source_ns - text.received_ns) < 60e9
    # the client has shown that it speaks version 2
    server.send("STRING", "Text", "reply", time_ns=0)
    reply = peer.receive()
    assert (reply.header_version, reply.source_ns) == (2, 0)


def test_an_array_may_be_changed_after_sending(server: Server, peer: Peer) -> None:
    pixels = np.full((500, 2000), 1, np.uint8)
    for number in range(40):  # more than the buffers of the kernel hold
        pixels[:] = number
        peer.send("IMAGE", "Camera", pixels)
    assert [int(server.receive("IMAGE").array.max()) for _ in range(40)] == list(range(40))


def test_receive_selects_and_keeps_the_order(server: Server, peer: Peer) -> None:
    for number, device in enumerate("abab"):
        peer.send("STRING", device, str(number))
    assert server.receive(device="b").text == "1"
    assert [server.receive().text for _ in range(3)] == ["0", "2", "3"]
    found = server.latest("b")
    assert found
    assert found.text == "3"
    assert server.latest("missing") is None
    assert server.latest(type="IMAGE") is None
    with pytest.raises(NoReply) as caught:
        server.receive("TRANSFORM", timeout_s=0.01)
    assert isinstance(caught.value, TimeoutError)
    assert "expected a message TRANSFORM/*; received so far: STRING/a (2), STRING/b (2)" in str(caught.value)


def test_iteration_ends_with_the_connection(server: Server, peer: Peer) -> None:
    peer.send("STRING", "a", "1")
    peer.send("STRING", "a", "2")
    assert server.receive().text == "1"
    server.send("STRING", "b", "x")
    threading.Timer(0.05, server.disconnect, [1]).start()
    assert [message.text for message in peer] == ["x"]
    with pytest.raises(LinkClosed, match="closed by the peer") as caught:
        peer.receive()
    assert isinstance(caught.value, ConnectionError)
    with pytest.raises(LinkClosed):
        peer.send("STRING", "a", "3")


def test_a_full_receive_queue_drops_and_counts() -> None:
    with (
        igtl_gateway.serve(0, queue_messages=10) as server,
        igtl_gateway.connect(port=server.port) as peer,
    ):
        peer.send("STRING", "rare", "kept")
        for number in range(100):
            peer.send("STRING", "fast", str(number))
        peer.send("STATUS", "end", 1)
        server._run(Wait(lambda: server.latest("end") and True, 5, "the end"))
        counts = server.counts
        assert counts.received == 102
        assert counts.dropped == {"STRING/fast": 92}
        assert [server.receive().describe().get("string") for _ in range(10)] == [
            "kept",
            *map(str, range(92, 100)),
            None,
        ]


def test_queries(server: Server, peer: Peer) -> None:
    poses = {"Tool": POSE}
    server.on_query("TRANSFORM")(lambda query: poses.get(query.device))
    server.on_query("TDATA", "STT")(lambda query: query.content == StartTracking(50, "RAS"))
    server.on_query("TDATA", "STP")(lambda query: None)

    @server.on_query("IMAGE")
    def broken(query: ReceivedMessage) -> object:
        return "no picture" if query.device else 1 / 0

    assert peer.query("TRANSFORM", "Tool").matrix.tolist() == POSE.tolist()
    with pytest.raises(Refused, match=r"GET_TRANS of Missing: found STATUS .*NotFound.*, expected TRANSFORM"):
        peer.query("TRANSFORM", "Missing")
    with pytest.raises(Refused, match="division by zero"):
        peer.query("IMAGE")
    with pytest.raises(Refused, match="IMAGE: found shape"):  # a value that cannot be sent
        peer.query("IMAGE", "Camera")
    peer.start_stream("TDATA", interval_ms=50, coordinate_name="RAS")
    peer.stop_stream("TDATA")
    with pytest.raises(Refused, match="STT_TDATA"):
        peer.start_stream("TDATA")
    peer.start_stream("POLYDATA", timeout_s=0)  # of a program that does not acknowledge
    assert server.receive().query == ("STT", "POLYDATA")
    with pytest.raises(NoReply, match="POINT/Fiducials as the answer"):
        peer.query("POINT", "Fiducials", timeout_s=0.05)
    with pytest.raises(ConfigError, match="STT_STRING: found a type without streams"):
        peer.start_stream("STRING")
    assert [note.code for note in server.notes].count("callback_failed") == 2
    assert len(peer._talk.inbox) == 0  # answers do not enter the queue


def test_commands(server: Server, peer: Peer) -> None:
    @server.on_command("Get*")
    def get(command: ReceivedMessage) -> str:
        return f"<{command.name}>{command.text}</{command.name}>"

    @server.on_command("Fail")
    def fail(command: ReceivedMessage) -> str:
        raise ValueError('no <such> "thing"')

    reply = peer.command("GetPose", "Tool")
    assert (reply.succeeded, reply.text, reply.name) == (True, "<GetPose>Tool</GetPose>", "GetPose")
    for metadata in (None, {"by": "test"}):  # in version 1 the text has the failure, in version 2 the metadata
        reply = peer.command("Fail", metadata=metadata)
        assert (reply.succeeded, reply.reason) == (False, 'no <such> "thing"')
    with pytest.raises(NoReply, match="a reply to the command 'Other'"):
        peer.command("Other", timeout_s=0.05)
    assert server.receive("COMMAND").name == "Other"  # without a handler it is a message
    numbers = [decode(b"".join(encode(reply.message.wire))).content for reply in (peer.command("Get"), reply)]
    assert numbers[0] != numbers[1]


def test_handlers_may_call_everything(server: Server, peer: Peer) -> None:
    @server.on_message("TRANSFORM")
    def mirror(message: ReceivedMessage) -> None:
        reply = server.command("Ask", "how far?")
        server.send("STRING", message.device, reply.text, to=message.link)

    peer.on_command("Ask")(lambda command: command.text.upper())
    peer.send("TRANSFORM", "Tool", POSE)
    peer.send("STRING", "other", "in the queue")
    assert peer.receive("STRING").text == "HOW FAR?"
    assert server.receive().text == "in the queue"


def test_one_of_several_clients(server: Server) -> None:
    with igtl_gateway.connect(port=server.port) as one, igtl_gateway.connect(port=server.port) as other:
        server.wait_connected(2)
        assert len(server.links) == 2
        assert server.send("STRING", "all", "both") == 2
        assert (one.receive().text, other.receive().text) == ("both", "both")
        with pytest.raises(ConfigError, match=r"found 2 connections, expected to=…"):
            server.query("TRANSFORM")
        other.send("STRING", "me", "me")
        link = server.receive().link
        assert server.send("STRING", "one", "only", to=link) == 1
        assert other.receive().text == "only"
        with pytest.raises(LinkClosed, match="expected connection 99"):
            server.query("TRANSFORM", to=99)
        server.disconnect(link)
        assert list(other) == []
    with pytest.raises(NoReply, match="expected 3 OpenIGTLink clients"):
        server.wait_connected(3, timeout_s=0.01)


def test_a_reply_that_cannot_come_any_more(server: Server, peer: Peer) -> None:
    @server.on_query("TRANSFORM")
    def leave(query: ReceivedMessage) -> object:
        server.disconnect(query.link)
        server._run(Wait(lambda: not server.links or None, 5, "the end"))
        return POSE

    with pytest.raises(LinkClosed, match="expected a reply"):
        peer.query("TRANSFORM", timeout_s=5)


def test_invalid_messages_are_counted(server: Server) -> None:
    good = b"".join(encode(Message("STRING", "a", String.of("good"))))
    with socket.create_connection((server.host, server.port)) as sock:
        sock.sendall(good[:-1] + b"X" + good)
        assert server.receive().text == "good"
        assert (server.counts.invalid, server.notes[-1].code) == (1, "bad_crc")


def test_limits_hold_for_foreign_peers() -> None:
    with igtl_gateway.serve(0, limits=PeerLimits(max_body=1000)) as server:
        with igtl_gateway.connect(port=server.port) as peer:
            peer.send("IMAGE", "Camera", np.zeros((100, 100), np.uint8))
            assert list(peer) == []
        assert any(note.code == "too_large" for note in server.notes)


def test_reconnect() -> None:
    with igtl_gateway.serve(0) as server:
        port = server.port
        peer = igtl_gateway.connect(port=port, reconnect=True)
        server.wait_connected()
    with peer, igtl_gateway.serve(port) as server:
        server.wait_connected()
        server.send("STRING", "a", "again")
        assert peer.receive().text == "again"


def test_without_a_server() -> None:
    with igtl_gateway.serve(0) as server:
        port = server.port
        with pytest.raises(Unavailable, match="port is in use"):
            igtl_gateway.serve(port)
    with pytest.raises(
        NoReply, match=f"127.0.0.1:{port}: found nothing within 0.2 s, expected an OpenIGTLink server; .*refused"
    ):
        igtl_gateway.connect(port=port, timeout_s=0.2)
    with igtl_gateway.connect(port=port, timeout_s=0) as peer:
        assert not peer.is_connected
        with pytest.raises(LinkClosed, match="found no connection"):
            peer.send("STRING", "a", "b")


def test_a_slow_reader_and_drops(server: Server) -> None:
    limits = PeerLimits(queue_messages=4)
    with (
        socket.create_server(("127.0.0.1", 0)) as listener,
        igtl_gateway.connect(port=listener.getsockname()[1], when_full="drop", limits=limits) as peer,
    ):
        sock, _ = listener.accept()
        for _ in range(60):
            peer.send("IMAGE", "Camera", np.zeros((1000, 1000), np.uint8))
        assert sum(peer.counts.unsent.values()) + peer.counts.sent + peer.counts.queued == 60
        assert peer.counts.unsent["IMAGE/Camera"] > 10
        sock.close()


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ({"header_version": 3}, "header_version: found 3, expected 1, 2 or None"),
        ({"when_full": "wait"}, "when_full: found 'wait', expected 'block' or 'drop'"),
        ({"queue_messages": 0}, "queue_messages: found 0"),
        ({"timeout_s": -1}, "timeout_s: found -1, expected seconds from 0 up"),
        ({"port": 99_999}, "found port 99999, expected 1 to 65535"),
    ],
)
def test_arguments(options: dict[str, Any], text: str) -> None:
    with pytest.raises(ConfigError, match=text):
        igtl_gateway.connect(**options)


def test_what_cannot_be_sent(peer: Peer) -> None:
    for arguments, error in (
        (("STRING", "a", 5), ConversionError),
        (("STRING", "a" * 21, "b"), MalformedBody),
        (("STRING", "a", "b" * 70_000), MalformedBody),
    ):
        with pytest.raises(error):
            peer.send(*arguments)
    with pytest.raises(GatewayError, match="metadata: found"):
        peer.send("STRING", "a", "b", metadata={"a": 5})  # type: ignore[dict-item]


def test_a_closed_peer(server: Server, peer: Peer) -> None:
    peer.send("STRING", "a", "last")
    peer.close()
    peer.close()
    assert server.receive().text == "last"  # what was queued is sent
    with pytest.raises(LinkClosed, match=r"closed by close\(\)"):
        peer.receive()


def test_tls() -> None:
    def files(name: str) -> TlsFiles:
        return TlsFiles(PEMS / f"{name}.pem", None, PEMS / "ca.pem")

    with igtl_gateway.serve(0, tls=files("server")) as server:
        with igtl_gateway.connect(port=server.port, tls=files("viewer")) as peer:
            server.wait_connected()
            peer.send("TRANSFORM", "Tool", POSE)
            assert server.receive().matrix.tolist() == POSE.tolist()
    with pytest.raises(ConfigError, match="found no certificate"):
        igtl_gateway.serve(0, tls=TlsFiles())
