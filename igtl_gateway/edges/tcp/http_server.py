"""A small HTTP server that no client can hold up: for counts of a bridge, and for pages.

Each connection has a thread and a deadline.  There is a bound of connections; if it is reached, the oldest one without
the whole head of a request is cut off, or the oldest one of all: a new client is served at once, however many silent
ones come.  A request must name this machine as its host: otherwise the page of a foreign site, whose name an attacker
lets point here, could read the answers in the browser of a user (DNS rebinding).
"""

from __future__ import annotations

import ipaddress
import socket
import threading
from collections.abc import Sequence
from contextlib import suppress
from functools import partial
from http.server import BaseHTTPRequestHandler, HTTPServer
from typing import Any

from igtl_gateway.base.clock import SystemClock
from igtl_gateway.base.quantities import count_text
from igtl_gateway.base.stamp import NS_PER_S
from igtl_gateway.base.untrusted.numbers import whole_number
from igtl_gateway.edges.reserved import open_port
from igtl_gateway.edges.tcp.sockets import AllowList, address_text, listening_socket
from igtl_gateway.edges.tcp.tls import Context

#: Longest time from the first byte of a request to the last byte of its answer.
DEADLINE_S = 5.0
#: Maximum number of connections that are served at the same time.
MAX_CONNECTIONS = 32

#: Maximum number of bytes of a request's body.
MAX_BODY = 8192

#: Longest time until the server's thread detects `LocalServer.close`.
_POLL_S = 0.1
_MOST_PORT = 65_535
_LOOPBACK_NAMES = frozenset({"localhost", "localhost.localdomain", "ip6-localhost"})


class KnownHosts:
    """The names of this machine that a request may have as its host.

    Args:
        given: the name or address that the user listens on.
        bound: the address of the socket; if it is that of all networks (``every``), each IP address is accepted, and
            the name of this machine.
    """

    def __init__(self, given: str, bound: str) -> None:
        self.every = ipaddress.ip_address(bound.partition("%")[0]).is_unspecified
        self._names = {_name(given), _name(bound), *_LOOPBACK_NAMES}
        if self.every:
            own = _name(socket.gethostname())
            self._names |= {own, own.partition(".")[0], own.partition(".")[0] + ".local"}
        self.expected = "an IP address or the name of this machine" if self.every else f"localhost or {given}"

    def __contains__(self, host: str) -> bool:
        """Return whether a ``Host`` of a request, with or without a port, is this machine."""
        place, _, port = host.removeprefix("[").partition("]" if host.startswith("[") else ":")
        name, port = _name(place), port.removeprefix(":")
        if port and whole_number(port, _MOST_PORT) is None:
            return False
        if name in self._names:
            return True
        try:
            address = ipaddress.ip_address(name.partition("%")[0])
        except ValueError:
            return False
        return self.every or address.is_loopback


def _name(host: str) -> str:
    return host.strip().lower().removesuffix(".")


class LocalServer:
    """Serves requests with ``handler`` until closed.

    Attributes:
        address: ``host:port`` that it listens on.
        reachable: the same for a link: with the name of this machine if it listens on all networks.

    Args:
        host, port: address to listen on; port 0 chooses a free port.
        handler: class of the requests; it inherits ``Handler``.
        allow: networks (CIDR) whose clients may connect in addition to those of this host.
        deadline_s: longest duration of a request, in seconds; see ``DEADLINE_S``.
        tls: encrypts the connections; None: they are not encrypted.

    Raises ConfigError and Unavailable as ``TcpEdge.listen`` does.
    """

    def __init__(
        self,
        host: str,
        port: int,
        handler: type[Handler],
        *,
        name: str,
        allow: Sequence[str] = (),
        deadline_s: float = DEADLINE_S,
        tls: Context | None = None,
    ) -> None:
        self._server = _Server(host, port, handler, AllowList(allow), deadline_s, tls)
        self.address = address_text(self._server.server_address)
        port = self._server.server_address[1]
        self.reachable = f"{socket.gethostname()}:{port}" if self._server.hosts.every else self.address
        serve = partial(self._server.serve_forever, _POLL_S)
        self._thread = threading.Thread(target=serve, name=name, daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Stop the server, cut off its connections, and close its socket."""
        self._server.shutdown()
        self._thread.join()
        self._server.server_close()
        self._server.cut_off_all()


class _Server(HTTPServer):
    def __init__(
        self,
        host: str,
        port: int,
        handler: type[Handler],
        allow: AllowList,
        deadline_s: float,
        tls: Context | None,
    ) -> None:
        listener = listening_socket(host, port, allow)
        open_port(listener)
        super().__init__(listener.getsockname()[:2], handler, bind_and_activate=False)
        self.socket.close()  # the library's socket: errors of `listening_socket` name the address and the cause
        self.socket = listener
        self.hosts = KnownHosts(host, listener.getsockname()[0])
        self._allow = allow
        self._patience_ns = round(deadline_s * NS_PER_S)
        self._tls = tls
        self._clock = SystemClock()
        self._lock = threading.Lock()
        self._open: dict[socket.socket, int] = {}  # connection → its deadline (monotonic ns), the oldest first
        self._asked: set[socket.socket] = set()  # those with the whole head of a request

    def verify_request(self, request: Any, client_address: Any) -> bool:
        return client_address[0] in self._allow

    def process_request(self, request: Any, client_address: Any) -> None:
        """Serve a connection in a thread of its own; cut off the oldest one if there are too many."""
        if self._tls:  # the handshake is part of the first read: it has its deadline, too
            request = self._tls.wrap_socket(request, server_side=True, do_handshake_on_connect=False)
        with self._lock:
            if len(self._open) >= MAX_CONNECTIONS:
                oldest = next((one for one in self._open if one not in self._asked), next(iter(self._open)))
                del self._open[oldest]
                _cut_off(oldest)
            self._open[request] = self._clock.monotonic_ns() + self._patience_ns
        serve = partial(self._serve, request, client_address)
        threading.Thread(target=serve, name="igtl-http", daemon=True).start()

    def has_asked(self, request: socket.socket) -> None:
        """The head of the request of this connection is whole."""
        with self._lock:
            self._asked.add(request)

    def service_actions(self) -> None:
        """Cut off the connections whose deadline has passed; called every ``_POLL_S`` at least."""
        now_ns = self._clock.monotonic_ns()
        with self._lock:
            for request, deadline_ns in self._open.items():
                if now_ns < deadline_ns:
                    break
                _cut_off(request)

    def _serve(self, request: socket.socket, client_address: Any) -> None:
        try:
            # the client has disconnected, was cut off, or the deadline has passed
            with suppress(OSError, ValueError):
                self.finish_request(request, client_address)
        finally:
            with self._lock:
                self._open.pop(request, None)
                self._asked.discard(request)
            self.shutdown_request(request)

    def cut_off_all(self) -> None:
        with self._lock:
            for request in self._open:
                _cut_off(request)


def _cut_off(request: socket.socket) -> None:
    """End a connection: a blocked read or write of its thread returns."""
    with suppress(OSError):  # already disconnected
        request.shutdown(socket.SHUT_RDWR)


class Handler(BaseHTTPRequestHandler):
    """A request: ``get`` or ``post`` answers it."""

    server: _Server

    def get(self, path: str) -> None:
        """Answer a GET or HEAD of a path, without its query."""
        raise NotImplementedError

    def do_GET(self) -> None:
        if self._is_for_us():
            self.get(self.path.partition("?")[0])

    def _is_for_us(self) -> bool:
        """Return whether a request names this machine as its host; if not, it is answered.

        RFC 9112, 3.2: a request has one host, except for one of HTTP/1.0, which may have none.
        """
        self.server.has_asked(self.connection)
        hosts = self.headers.get_all("Host") or []
        if len(hosts) > 1 or (not hosts and self.request_version not in ("HTTP/0.9", "HTTP/1.0")):
            self.answer(400, "text/plain; charset=utf-8", f"Host: found {len(hosts)}, expected one\n")
            return False
        if hosts and hosts[0] not in self.server.hosts:
            text = f"Host: found {hosts[0][:100]!r}, expected {self.server.hosts.expected}\n"
            self.answer(403, "text/plain; charset=utf-8", text)
            return False
        return True

    def post(self, path: str, body: bytes) -> None:
        """Answer a POST of JSON to a path, without its query."""
        self.answer(405, "text/plain; charset=utf-8", f"{path}: found POST, expected GET\n")

    def do_POST(self) -> None:
        """Refuse what the page of a foreign site can send without asking: other types than JSON, another origin."""
        if not self._is_for_us():
            return
        origin, kind = self.headers.get("Origin"), self.headers.get_content_type()
        size = whole_number(given := self.headers.get("Content-Length", ""))
        if origin is not None and origin.partition("://")[2] != self.headers.get("Host"):
            why = 403, f"Origin: found {origin[:100]!r}, expected none or this server"
        elif kind != "application/json":
            why = 415, f"Content-Type: found {kind[:100]!r}, expected application/json"
        elif size is None:
            why = 411, f"Content-Length: found {given[:100]!r}, expected the number of bytes"
        elif size > MAX_BODY:
            why = 413, f"Content-Length: found {count_text(size, 'byte')}, expected at most {MAX_BODY:,}"
        else:
            self.post(self.path.partition("?")[0], self.rfile.read(size))
            return
        self.answer(why[0], "text/plain; charset=utf-8", why[1] + "\n")

    def do_HEAD(self) -> None:
        self.do_GET()

    def answer(self, code: int, kind: str, text: str) -> None:
        """Send text as the answer."""
        data = text.encode("utf-8", "backslashreplace")
        self.begin(code, kind, len(data))
        if self.command != "HEAD":
            self.wfile.write(data)

    def begin(self, code: int, kind: str, size: int | None, **more: str) -> None:
        """Send the head of an answer; ``more`` are further fields, with ``_`` for ``-``.

        ``size``: None: the answer ends with the connection.
        """
        self.send_response(code)
        length = {} if size is None else {"Content-Length": str(size)}
        for name, value in {"Content-Type": kind, **length, **more}.items():
            self.send_header(name.replace("_", "-"), value)
        self.end_headers()

    def log_message(self, format: str, *args: Any) -> None:
        """Do not log requests: they are not part of the session."""
