"""Ports that are open before what serves them is loaded.

A peer that connects meanwhile waits in the queue of the kernel, with all that it sends, until the edge accepts it.  So
a peer that starts together with the bridge need not try twice, and nothing that it sends is lost.
"""

from __future__ import annotations

import re
import socket
import sys
from collections.abc import Iterable

#: Connections that may wait while one callback runs, or before the edge starts; beyond that they come a second later.
BACKLOG = 2048

#: Only addresses of this machine itself: for others the list of allowed networks has to be known first.
_LOOPBACK = re.compile(r"127\.[0-9]{1,3}\.[0-9]{1,3}\.[0-9]{1,3}")


class ReservedPorts:
    """Listening sockets by their address, until an edge takes them.

    An address that cannot be reserved is left out: the edge then reports the reason.

    Args:
        addresses: hosts and ports; only loopback addresses of IPv4 and fixed ports are reserved.
    """

    def __init__(self, addresses: Iterable[tuple[str, int]] = ()) -> None:
        self._sockets: dict[tuple[str, int], socket.socket] = {}
        for host, port in addresses:
            if port and _LOOPBACK.fullmatch(host) and (host, port) not in self._sockets:
                try:
                    self._sockets[host, port] = listener(socket.AF_INET, (host, port))
                except (OSError, OverflowError):
                    continue

    def take(self, host: str, port: int) -> socket.socket | None:
        """Return the socket of an address, which is the caller's from here on; None if there is none."""
        return self._sockets.pop((host, port), None)

    def close(self) -> None:
        """Close the sockets that were not taken."""
        while self._sockets:
            self._sockets.popitem()[1].close()


def listener(family: int, address: object) -> socket.socket:
    """Return a listening socket, which does not block.  Raises OSError."""
    sock = socket.socket(family, socket.SOCK_STREAM)
    try:
        if sys.platform == "win32":  # there SO_REUSEADDR would share the port with another program
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_EXCLUSIVEADDRUSE, 1)
        else:  # a restart must not wait for the connections of the run before to time out
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        sock.bind(address)  # type: ignore[arg-type]
        sock.listen(BACKLOG)
        sock.setblocking(False)
    except BaseException:
        sock.close()
        raise
    return sock
