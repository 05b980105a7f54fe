"""The port of a bridge is taken before anything is imported, if the command line is clear; it opens when it is read."""

from __future__ import annotations

import socket
import sys
import threading
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing, suppress
from pathlib import Path

import pytest

from igtl_gateway.app.bridge import Bridge
from igtl_gateway.app.bridge_options import BridgeOptions
from igtl_gateway.app.recording import BridgeRecording
from igtl_gateway.base.buffers import join
from igtl_gateway.base.clock import SystemClock
from igtl_gateway.base.errors import Unavailable
from igtl_gateway.base.stamp import ns_to_ticks
from igtl_gateway.cli import main
from igtl_gateway.cli.early_port import early_ports
from igtl_gateway.config.configuration import Config
from igtl_gateway.edges.reserved import ReservedPorts
from igtl_gateway.edges.tcp import TcpEdge
from igtl_gateway.gateway.log.entry import Kind
from igtl_gateway.record.sessionfile.reader import SessionFile
from igtl_gateway.wire import Message, decode, encode
from igtl_gateway.wire.text import String
from tests.tables import table
from tests.timing import WAIT_S

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


def make_edge(reserved: ReservedPorts, on_frame: Callable[[int, object], None] = lambda link, frame: None) -> TcpEdge:
    return TcpEdge(
        on_frame=on_frame,
        on_link=lambda link, up, note: None,
        on_note=lambda link, note: None,
        clock=SystemClock(),
        reserved=reserved,
    )


def test_a_peer_that_tries_once_before_the_edge_exists_is_connected_when_it_is_read() -> None:
    address = "127.0.0.1", free_port()
    reserved = ReservedPorts([address, address, ("0.0.0.0", address[1] + 1), ("127.0.0.1", 0)])
    if sys.platform != "linux":
        with pytest.raises(OSError):
            socket.create_connection(address, 5)
    with ThreadPoolExecutor(1) as pool:
        trial = pool.submit(socket.create_connection, address, 20)
        edge = make_edge(reserved)
        assert edge.listen(*address) == address
        assert reserved.take(*address) is None, "it is the edge's now"
        with pytest.raises(TimeoutError):
            trial.result(0.1)
        edge.start()
        try:
            with trial.result() if sys.platform == "linux" else socket.create_connection(address, 5) as peer:
                assert edge.wait_links(1, 5)
                edge.send([1], [b"hello"], "STRING/", True)
                assert peer.recv(5) == b"hello"
        finally:
            edge.stop()


@pytest.mark.parametrize("has_filters", [True, False])
def test_no_peer_gets_through_before_the_port_is_read(has_filters: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    if not has_filters:
        monkeypatch.setattr("igtl_gateway.edges.reserved._drops_all", lambda sock: False)
    address = "127.0.0.1", free_port()
    with closing(ReservedPorts([address])) as reserved, pytest.raises(OSError):
        socket.create_connection(address, 0.1)
    edge = make_edge(reserved)
    for host in ("127.0.0.1", "::1"):
        place = edge.listen(host, 0)
        with pytest.raises(OSError):
            socket.create_connection(place, 0.1)
    edge.start()
    try:
        later = edge.listen("127.0.0.1", 0)
        for one in (place, later):
            socket.create_connection(one, 5).close()
    finally:
        edge.stop()


def test_a_port_that_another_program_takes_in_between_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("igtl_gateway.edges.reserved._drops_all", lambda sock: False)
    edge = make_edge(ReservedPorts())
    with socket.socket() as other:
        other.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        place = edge.listen("127.0.0.1", 0)
        other.bind(place)
        other.listen()
        with pytest.raises(Unavailable, match="taken by another program"):
            edge.start()
    edge.stop()


def test_nothing_is_sent_before_it_is_read_however_long_the_start_takes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The start lasts until a peer has tried three times; it sends numbers and its own time as soon as it can."""
    address, start = ("127.0.0.1", free_port()), BridgeRecording.start
    tried, done = threading.Semaphore(0), threading.Event()
    reserved, started_ns = ReservedPorts([address]), 0

    def slow_start(recording: BridgeRecording) -> None:
        nonlocal started_ns
        for _ in range(3):
            assert tried.acquire(timeout=WAIT_S)
        start(recording)
        started_ns = time.time_ns()

    def send() -> None:
        while True:
            tried.release()
            with suppress(OSError), socket.create_connection(address, 0.1) as peer:
                for number in range(1, 9):
                    text = String.of(f"{number}")
                    peer.sendall(join(encode(Message("STRING", "Numbers", text, ns_to_ticks(time.time_ns())))))
                assert done.wait(WAIT_S)
                return

    monkeypatch.setattr(BridgeRecording, "start", slow_start)
    options = BridgeOptions((address,), ros=False, record=tmp_path / "a.mcap", reserved=reserved)
    bridge = Bridge(Config(), options, SystemClock())
    with ThreadPoolExecutor(1) as pool:
        sent = pool.submit(send)
        try:
            bridge.start()
            assert bridge.tcp.wait_links(1, WAIT_S)
        finally:
            done.set()
            sent.result()
            bridge.stop()
    with SessionFile.open(tmp_path / "a.mcap") as file:
        entries = [each for each in file.entries() if each.kind is Kind.IGTL_IN]
    assert [getattr(decode(each.data()).content, "text", "") for each in entries] == [
        f"{number}" for number in range(1, 9)
    ]
    assert min(each.source_ns for each in entries) > started_ns > 0


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
