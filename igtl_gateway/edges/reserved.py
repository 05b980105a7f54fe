"""Ports that are taken before what serves them is loaded, and open when they are read.

The receipt of a message is the moment at which it is read.  If a peer could connect before, all that it sends until
then would wait in the kernel, and its receipt would be seconds late: the kernel's own stamps (SO_TIMESTAMPNS) do not
help, because it joins up to 17 segments that wait, and keeps the stamp of the last one.

So a port is closed until it is read: on Linux a filter drops the requests to connect.  The peer's kernel repeats them
(after a second, and again), and `connect` returns soon after the port is open: a program that tries once is not
refused, and another program that has the port is found at once.  Elsewhere the port is bound but does not listen:
peers are refused, and have to try again.
"""

from __future__ import annotations

import ctypes
import re
import socket
import struct
import sys
from collections.abc import Iterable
from contextlib import suppress

#: Connections that may wait while one callback runs, or before the edge starts; beyond that they come a second later.
BACKLOG = 2048

#: Only addresses of this machine itself: for others the list of allowed networks has to be known first.
_LOOPBACK = re.compile(r"127\.[0-9]{1,3}\.[0-9]{1,3}\.[0-9]{1,3}")


#: Linux's options of a socket, and a filter of one instruction: return 0, so drop.
_ATTACH_FILTER, _DETACH_FILTER = 26, 27
_DROP_ALL = struct.pack("=HBBI", 6, 0, 0, 0)


class ReservedPorts:
    """Closed ports (`closed_port`) by their address, until an edge takes them.

    An address that cannot be reserved is left out: the edge then reports the reason.

    Args:
        addresses: hosts and ports; only loopback addresses of IPv4 and fixed ports are reserved.
    """

    def __init__(self, addresses: Iterable[tuple[str, int]] = ()) -> None:
        self._sockets: dict[tuple[str, int], socket.socket] = {}
        for host, port in addresses:
            if port and _LOOPBACK.fullmatch(host) and (host, port) not in self._sockets:
                try:
                    self._sockets[host, port] = closed_port(socket.AF_INET, (host, port))
                except (OSError, OverflowError):
                    continue

    def take(self, host: str, port: int) -> socket.socket | None:
        """Return the socket of an address, which is the caller's from here on; None if there is none."""
        return self._sockets.pop((host, port), None)

    def close(self) -> None:
        """Close the sockets that were not taken."""
        while self._sockets:
            self._sockets.popitem()[1].close()


def closed_port(family: int, address: object) -> socket.socket:
    """Return the socket of a port that no peer gets through yet; it does not block.  Raises OSError."""
    sock = socket.socket(family, socket.SOCK_STREAM)
    try:
        if sys.platform == "win32":  # there SO_REUSEADDR would share the port with another program
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_EXCLUSIVEADDRUSE, 1)
        else:  # a restart must not wait for the connections of the run before to time out
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        sock.bind(address)  # type: ignore[arg-type]
        sock.setblocking(False)
        if _drops_all(sock):
            sock.listen(BACKLOG)
    except BaseException:
        sock.close()
        raise
    return sock


def open_port(sock: socket.socket) -> None:
    """Let peers through: from here on the port has to be read.  Raises OSError if another program listens there."""
    if sys.platform == "linux":
        with suppress(OSError):  # it has no filter
            sock.setsockopt(socket.SOL_SOCKET, _DETACH_FILTER, 0)
    sock.listen(BACKLOG)  # where it does so already, nothing changes


def _drops_all(sock: socket.socket) -> bool:
    """Have the kernel drop what comes; whether it does."""
    if sys.platform != "linux":
        return False
    code = ctypes.create_string_buffer(_DROP_ALL)
    try:
        sock.setsockopt(socket.SOL_SOCKET, _ATTACH_FILTER, struct.pack("@HP", 1, ctypes.addressof(code)))
    except OSError:  # a kernel without filters, such as one of a sandbox
        return False
    return True
