"""Addresses and sockets: the allow-list, resolving a host, and the options of a socket."""

from __future__ import annotations

import errno
import ipaddress
import socket
import struct
import sys
from collections.abc import Sequence
from contextlib import suppress
from functools import lru_cache
from typing import Any, Protocol

from igtl_gateway.base.errors import ConfigError, Unavailable
from igtl_gateway.edges.reserved import ReservedPorts, closed_port

PORT_MAX = 65535

_KEEPALIVE = (  # a peer that lost power is found after 10 + 3 x 5 s; silent ones that answer are kept
    (socket.SOL_SOCKET, "SO_KEEPALIVE", 1),
    (socket.IPPROTO_TCP, "TCP_KEEPIDLE", 10),
    (socket.IPPROTO_TCP, "TCP_KEEPINTVL", 5),
    (socket.IPPROTO_TCP, "TCP_KEEPCNT", 3),
)

#: The same time for a peer that is being sent something: there is no keepalive then, and TCP would retry for a quarter
#: of an hour.
UNANSWERED_S = 25.0
#: Of Linux's ``struct tcp_info``: unanswered probes, unanswered segments, and for how long (ms).
_TCP_INFO = struct.Struct("=3xB4x16xI28xI")
#: A probe checks a peer that does not read.  One might be lost, and the next might be on its way.
_PROBES = 3
_SIOCOUTQ = 0x5411
#: States of a connection whose end was sent and is not confirmed (FIN_WAIT1, LAST_ACK, CLOSING): it counts as a byte.
_END_UNCONFIRMED = (b"\x04", b"\x09", b"\x0b")
#: Bytes that a peer may send ahead.  Linux begins with 128 KiB, and a peer with a large message would stop and go.
_AHEAD_BYTES = 4 << 20


class Descriptor(Protocol):
    """What is needed of a socket here."""

    def fileno(self) -> int: ...
    def getsockopt(self, level: int, option: int, size: int, /) -> bytes: ...


class AllowList:
    """Who may connect beside this host: networks (CIDR), or ``"any"``.  Raises ConfigError for an invalid network.

    ``opens``: whether any other host may connect.
    """

    def __init__(self, allow: Sequence[str]) -> None:
        self._any = "any" in allow
        self._networks = [_network(text) for text in allow if text != "any"]
        self.opens = self._any or bool(self._networks)
        self._allows = lru_cache(maxsize=256)(self._look_up)  # as long as to accept a connection takes

    def __contains__(self, host: str) -> bool:
        return self._allows(host)

    def _look_up(self, host: str) -> bool:
        ip = _ip(host)
        return ip.is_loopback or self._any or any(ip in network for network in self._networks)


def tune_socket(sock: socket.socket) -> None:
    """Set up a connected socket: non-blocking, without delay, with keepalive, with room for a large message."""
    sock.setblocking(False)
    sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    if sys.platform == "linux":
        with suppress(OSError):  # what imitates Linux might not have it
            for least in (_AHEAD_BYTES, 1):  # the room stays; SO_RCVBUF would be bounded by rmem_max and end its growth
                sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVLOWAT, least)
    for level, option, value in _KEEPALIVE:
        if hasattr(socket, option):
            sock.setsockopt(level, getattr(socket, option), value)


def unanswered_s(sock: Descriptor) -> float:
    """Return for how long the peer has confirmed nothing of what it was sent; 0.0 if it has, or if that is unknown.

    A peer that does not read is different: its system answers that there is no room.  TCP_USER_TIMEOUT would
    end its connection as well, and a viewer that is busy for a minute would be lost.
    """
    if sys.platform != "linux":
        return 0.0
    try:
        info = sock.getsockopt(socket.IPPROTO_TCP, socket.TCP_INFO, _TCP_INFO.size)
        probes, segments, silent_ms = _TCP_INFO.unpack(info)
    except (OSError, struct.error):  # a system that imitates Linux might not support all of it
        return 0.0
    return silent_ms / 1000 if segments or probes >= _PROBES else 0.0


def unconfirmed_bytes(sock: Descriptor) -> int:
    """Return the number of sent bytes that the peer has not confirmed; 0 if that is unknown."""
    if sys.platform != "linux":
        return 0
    import fcntl

    try:
        count = int.from_bytes(fcntl.ioctl(sock, _SIOCOUTQ, bytes(4)), sys.byteorder)
        state = sock.getsockopt(socket.IPPROTO_TCP, socket.TCP_INFO, 1)
        return max(0, count - (state in _END_UNCONFIRMED))
    except OSError:
        return 0


def address_text(address: Any) -> str:
    """Return ``host:port`` of a socket address, ``[host]:port`` for IPv6."""
    host, port = address[:2]
    return f"[{host}]:{port}" if ":" in host else f"{host}:{port}"


def resolve(host: str, port: int, *, numeric: bool) -> list[tuple[int, Any]]:
    """Return families and addresses of a host, IPv4 first: that is where the peers listen.  Raises OSError."""
    flags = socket.AI_NUMERICHOST if numeric else 0
    try:
        found = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM, flags=flags)
    except ValueError as exc:  # an invalid name: an empty label, a zero byte
        raise OSError(errno.EINVAL, f"{host!r} is not a valid host name ({exc})") from None
    return sorted(((family, address) for family, _, _, _, address in found), key=lambda one: one[0] != socket.AF_INET)


def listening_socket(host: str, port: int, allow: AllowList, reserved: ReservedPorts | None = None) -> socket.socket:
    """Return the socket of a port that `open_port` opens, the reserved one if there is one; see ``TcpEdge.listen``.

    Raises ConfigError for an invalid address, Unavailable if the system refuses it now.
    """
    place = f"listen {address_text((host, port))}"
    family, address = check_listening(host, port, allow)
    try:
        return (reserved and reserved.take(host, port)) or closed_port(family, address)
    except OSError as exc:
        if exc.errno == errno.EADDRINUSE:
            raise Unavailable(f"{place}: the port is in use by another program; stop it or choose another") from None
        if exc.errno == errno.EADDRNOTAVAIL:
            raise ConfigError(f"{place}: found {address[0]}, expected an address of this machine") from None
        raise Unavailable(f"{place}: {exc.strerror or exc}") from None


def check_listening(host: str, port: int, allow: AllowList) -> tuple[int, Any]:
    """Return family and address to listen on.  Raises ConfigError if it is invalid, or if no peer may connect."""
    place = f"listen {address_text((host, port))}"
    if not 0 <= port <= PORT_MAX:
        raise ConfigError(f"{place}: found port {port}, expected 0 (any) to {PORT_MAX}")
    try:
        family, address = resolve(host, port, numeric=False)[0]
    except OSError as exc:
        raise ConfigError(f"{place}: found host {host!r} ({exc}), expected an address of this machine") from None
    if not (allow.opens or _ip(address[0]).is_loopback):
        raise ConfigError(
            f"{place}: open to other hosts, but none may connect; "
            "expected --allow NETWORK, such as --allow 192.168.1.0/24, or --allow any for all"
        )
    return family, address


def _ip(host: str) -> ipaddress.IPv4Address | ipaddress.IPv6Address:
    """The address without its scope, and without the IPv6 form of an IPv4 address."""
    ip = ipaddress.ip_address(host.partition("%")[0])
    return getattr(ip, "ipv4_mapped", None) or ip


def _network(text: str) -> ipaddress.IPv4Network | ipaddress.IPv6Network:
    try:
        network = ipaddress.ip_network(text)
        mapped = getattr(network.network_address, "ipv4_mapped", None)
        # peers are checked without the IPv6 form of an IPv4 address, see _ip
        return ipaddress.ip_network((mapped, network.prefixlen - 96)) if mapped else network
    except ValueError as exc:
        raise ConfigError(
            f'allow: found {text!r} ({exc}), expected "any" or a network such as 192.168.1.0/24'
        ) from None
