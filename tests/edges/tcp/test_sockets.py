"""Addresses of the TCP edge: what is refused, and in which words; what is known of who does not answer."""

from __future__ import annotations

import select
import socket
import sys
import threading
from contextlib import suppress
from pathlib import Path

import pytest

from igtl_gateway.base.errors import ConfigError, Unavailable
from igtl_gateway.edges.tcp.sockets import AllowList, tune_socket, unanswered_s, unconfirmed_bytes
from tests.edges.tcp.world import HERE, World, until
from tests.tables import table


def test_port_in_use(world: World) -> None:
    _, _, port = world.server()
    other, _ = world.edge()
    with pytest.raises(Unavailable, match=rf"^listen 127\.0\.0\.1:{port}: the port is in use by another program"):
        other.listen(HERE, port)


@pytest.mark.parametrize(
    ("host", "port", "words"),
    [
        ("0.0.0.0", 0, "--allow NETWORK"),
        ("::", 0, "--allow NETWORK"),
        ("no.such.host.invalid", 0, "expected an address of this machine"),
        ("203.0.113.77", 0, "open to other hosts"),
        (HERE, 65536, "expected 0"),
        (HERE, -1, "expected 0"),
    ],
)
def test_invalid_listen_address(world: World, host: str, port: int, words: str) -> None:
    edge, _ = world.edge()
    with pytest.raises(ConfigError, match=words) as caught:
        edge.listen(host, port)
    assert "\n" not in str(caught.value)


def test_address_of_another_machine(world: World) -> None:
    edge, _ = world.edge(allow=["any"])
    with pytest.raises(ConfigError, match=r"^listen 203\.0\.113\.77:0: "):
        edge.listen("203.0.113.77", 0)


def test_ipv6(world: World) -> None:
    edge, seen = world.edge()
    try:
        host, port = edge.listen("::1", 0)
    except ConfigError as exc:
        pytest.skip(str(exc))
    edge.connect("::1", port)
    edge.start()
    seen.wait("up", 2)
    assert {link.peer for link in edge.links() if link.role == "client"} == {f"[{host}]:{port}"}


def test_allow_list_with_nonsense(world: World) -> None:
    with pytest.raises(ConfigError, match=r"allow: found '192\.168\.1\.5/24'"):
        world.edge(allow=["192.168.1.5/24"])


@table(
    ("allow", "host", "allowed"),
    [
        ([], "127.0.0.1", True),
        ([], "127.200.3.4", True),
        ([], "::1", True),
        ([], "::ffff:127.0.0.1", True),  # how a socket for both families sees it
        ([], "192.168.1.7", False),
        ([], "::ffff:192.168.1.7", False),
        (["192.168.1.0/24"], "192.168.1.7", True),
        (["192.168.1.0/24"], "::ffff:192.168.1.7", True),
        (["::ffff:192.168.1.0/120"], "192.168.1.7", True),
        (["192.168.1.0/24"], "192.168.2.7", False),
        (["0.0.0.0/0"], "2001:db8::1", False),
        (["2001:db8::/32"], "2001:db8::1", True),
        (["fe80::/10"], "fe80::1%eth0", True),
        (["any"], "2001:db8::1", True),
    ],
)
def test_who_is_allowed(allow: list[str], host: str, allowed: bool) -> None:
    assert (host in AllowList(allow)) is allowed


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux reports it")
def test_who_does_not_read_is_no_dead_one_and_what_he_has_not_is_known(world: World) -> None:
    """He who lost power is in ``tests/integration/test_live_faults.py``: it takes a line that can be cut."""
    listener = world.listener()
    with socket.create_connection(listener.getsockname()) as sock:
        peer = world.accepted(listener)
        assert (unanswered_s(sock), unconfirmed_bytes(sock)) == (0.0, 0)
        sock.setblocking(False)
        sent = 0
        with suppress(BlockingIOError):
            while True:
                sent += sock.send(bytes(1 << 16))
        threading.Event().wait(0.7)  # the system asks whether there is room now, and is answered that there is none
        assert unanswered_s(sock) == 0.0
        assert 0 < (unconfirmed := unconfirmed_bytes(sock)) < sent
        sock.shutdown(socket.SHUT_WR)
        assert unconfirmed_bytes(sock) == unconfirmed  # the end is no byte of a message
        received = 0
        while received < sent:
            received += len(peer.sock.recv(1 << 20))
        until(lambda: unconfirmed_bytes(sock) == 0)


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux has this room")
def test_a_large_message_has_room_and_a_byte_is_heard() -> None:
    most = int(Path("/proc/sys/net/ipv4/tcp_rmem").read_text().split()[2])
    with socket.create_server((HERE, 0)) as listener, socket.create_connection(listener.getsockname()) as peer:
        link, _ = listener.accept()
        with link:
            tune_socket(link)
            assert link.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF) >= min(4 << 20, most // 2)
            peer.sendall(b"x")
            assert select.select([link], [], [], 5)[0]
