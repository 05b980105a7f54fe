"""What the kernel knows of a TCP connection on the loopback interface: whether all bytes are at the other end."""

from __future__ import annotations

import socket
import struct
import threading

from igtl_gateway.addon import SystemClock

#: Real time for bytes to arrive; on the loopback interface they are there at once, except beside a high load.
_PATIENCE_NS = 1_000_000_000
_PAUSE_S = 20e-6
#: What it is given where the kernel has no diagnosis of sockets.
_BLIND_S = 0.002
#: Bytes that are looked at; the caller reads, and asks again.
_PEEK_BYTES = 1 << 20

_NETLINK_SOCK_DIAG, _SOCK_DIAG_BY_FAMILY, _NLM_F_REQUEST = 4, 20, 1
_INET_DIAG_INFO = 2
_NLMSG = struct.Struct("=IHHII")
#: inet_diag_req_v2: family, protocol, extensions, padding, states; the socket: ports, addresses, interface, cookie.
_REQUEST = struct.Struct("=BBBBI")
_SOCKET = struct.Struct("!HH16s16s")
#: inet_diag_msg: family, state, timer, retransmissions, socket (48 bytes), expiry, rqueue, wqueue, uid, inode.
_ANSWER_SIZE, _QUEUES_AT = 72, 4 + 48 + 4
_QUEUES = struct.Struct("=II")
_ATTRIBUTE = struct.Struct("=HH")
#: In tcp_info: bytes_acked and bytes_received.
_BYTES, _BYTES_AT = struct.Struct("=QQ"), 120


class Connection:
    """The other end of a connected socket, in the same network namespace.

    ``sent`` and ``received`` are the bytes that this end has sent and read so far; the caller counts them.
    """

    def __init__(self, own: socket.socket) -> None:
        self._own = own
        self._clock, self._pause = SystemClock(), threading.Event()
        self.sent = self.received = 0
        self._netlink: socket.socket | None = None
        host, port = own.getsockname()
        other_host, other_port = own.getpeername()
        place = _SOCKET.pack(other_port, port, _address(other_host), _address(host))
        body = _REQUEST.pack(socket.AF_INET, socket.IPPROTO_TCP, 1 << (_INET_DIAG_INFO - 1), 0, 0xFFFFFFFF)
        body += place + struct.pack("=I", 0) + b"\xff" * 8
        self._query = _NLMSG.pack(_NLMSG.size + len(body), _SOCK_DIAG_BY_FAMILY, _NLM_F_REQUEST, 1, 0) + body
        try:
            self._netlink = socket.socket(socket.AF_NETLINK, socket.SOCK_RAW, _NETLINK_SOCK_DIAG)
            self._netlink.settimeout(_PATIENCE_NS / 1e9)
        except OSError:
            pass
        if self._netlink and self._counts() is None:
            self._netlink.close()
            self._netlink = None

    def wait(self, *, arrived: bool) -> None:
        """Wait until what was sent here has arrived there, or what was sent there has arrived here."""
        if not self._netlink:
            self._pause.wait(_BLIND_S)
            return
        begin_ns = self._clock.monotonic_ns()
        while not self._is_there(arrived) and self._clock.monotonic_ns() - begin_ns < _PATIENCE_NS:
            self._pause.wait(_PAUSE_S)

    def _is_there(self, arrived: bool) -> bool:
        counts = self._counts()
        if counts is None:
            return True  # it is closed
        got, written, _ = counts
        if arrived:
            return got + 1 >= self.sent  # the counts of the kernel may have the SYN in them
        if written <= self.received + 1:
            return True
        try:
            here = len(self._own.recv(_PEEK_BYTES, socket.MSG_PEEK))
        except OSError:
            here = 0
        return here == _PEEK_BYTES or written <= self.received + here + 1

    def unread(self) -> int:
        """Bytes that the other end has got and not read; 0 where that is not known."""
        counts = self._counts() if self._netlink else None
        return counts[2] if counts else 0

    def _counts(self) -> tuple[int, int, int] | None:
        """Bytes that the other end has got, has written, and has not read; None if there is no such connection."""
        assert self._netlink
        try:
            self._netlink.send(self._query)
            answer = self._netlink.recv(4096)
        except OSError:
            return None
        _, kind, *_ = _NLMSG.unpack_from(answer)
        if kind != _SOCK_DIAG_BY_FAMILY:
            return None
        unread, waiting = _QUEUES.unpack_from(answer, _NLMSG.size + _QUEUES_AT)
        at = _NLMSG.size + _ANSWER_SIZE
        while at + _ATTRIBUTE.size <= len(answer):
            size, what = _ATTRIBUTE.unpack_from(answer, at)
            if what == _INET_DIAG_INFO and size >= _ATTRIBUTE.size + _BYTES_AT + _BYTES.size:
                acknowledged, got = _BYTES.unpack_from(answer, at + _ATTRIBUTE.size + _BYTES_AT)
                return got, acknowledged + waiting, unread
            at += max(4, (size + 3) & ~3)
        return None

    def close(self) -> None:
        if self._netlink:
            self._netlink.close()


def _address(host: str) -> bytes:
    return socket.inet_aton(host) + bytes(12)
