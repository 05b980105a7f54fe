"""The port of a bridge opens before anything is imported, and only where the command line is clear."""

from __future__ import annotations

import socket

import pytest

from igtl_gateway.base.clock import SystemClock
from igtl_gateway.base.errors import Unavailable
from igtl_gateway.cli import main
from igtl_gateway.cli.early_port import early_ports
from igtl_gateway.edges.reserved import ReservedPorts
from igtl_gateway.edges.tcp import TcpEdge
from tests.tables import table

USUAL = ("127.0.0.1", 18944)


@table(
    ("words", "expected"),
    [
        ("", [USUAL]),
        ("--record a.mcap --no-ros", [USUAL]),
        ("--listen 127.0.0.1:5", [("127.0.0.1", 5)]),
        ("--listen=:5 --listen tls://0.0.0.0:6", [("127.0.0.1", 5), ("0.0.0.0", 6)]),
        ("--listen :5 --config a.toml", [("127.0.0.1", 5)]),
        ("--config a.toml", []),
        ("--connect 127.0.0.1:5", []),
        ("--connect=127.0.0.1:5 --listen :6", [("127.0.0.1", 6)]),
        ("--lis :5", []),
        ("--co 127.0.0.1:5", []),
        ("--listen nonsense:x", []),
        ("--listen", [USUAL]),  # the parser refuses it
        ("--types", []),
        ("--help", []),
    ],
)
def test_the_addresses_of_a_command_line(words: str, expected: list[tuple[str, int]]) -> None:
    assert early_ports(["bridge", *words.split()]) == expected


def free_port() -> int:
    with socket.socket() as sock:
        sock.bind(("127.0.0.1", 0))
        return int(sock.getsockname()[1])


def test_a_peer_that_connects_before_the_edge_exists_is_served() -> None:
    address = "127.0.0.1", free_port()
    reserved = ReservedPorts([address, address, ("0.0.0.0", address[1] + 1), ("127.0.0.1", 0)])
    with socket.create_connection(address, 5) as peer:
        edge = TcpEdge(
            on_frame=lambda link, frame: None,
            on_link=lambda link, up, note: None,
            on_note=lambda link, note: None,
            clock=SystemClock(),
            reserved=reserved,
        )
        assert edge.listen(*address) == address
        assert reserved.take(*address) is None, "it is the edge's now"
        edge.start()
        try:
            assert edge.wait_links(1, 5)
            edge.send([1], [b"hello"], "STRING/", True)
            assert peer.recv(5) == b"hello"
        finally:
            edge.stop()


def test_a_port_in_use_is_reported_by_the_edge() -> None:
    address = "127.0.0.1", free_port()
    first, second = ReservedPorts([address]), ReservedPorts([address])
    try:
        assert second.take(*address) is None
        edge = TcpEdge(
            on_frame=lambda link, frame: None,
            on_link=lambda link, up, note: None,
            on_note=lambda link, note: None,
            clock=SystemClock(),
            reserved=second,
        )
        with pytest.raises(Unavailable, match="in use"):
            edge.listen(*address)
        edge.stop()
    finally:
        first.close()


def test_a_bridge_that_cannot_start_leaves_no_port_open(capsys: pytest.CaptureFixture[str]) -> None:
    port = free_port()
    assert main(["bridge", "--no-ros", "--duration", "-1", "--listen", f":{port}"]) == 2
    assert "--duration" in capsys.readouterr().err
    with pytest.raises(ConnectionRefusedError):
        socket.create_connection(("127.0.0.1", port), 5)
