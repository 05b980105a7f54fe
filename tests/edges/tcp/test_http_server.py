"""The small HTTP server: who is cut off where more connect than it serves."""

from __future__ import annotations

import socket
import threading
from contextlib import ExitStack, closing

from igtl_gateway.edges.tcp.http_server import MAX_CONNECTIONS, Handler, LocalServer
from tests.tables import table


def test_half_requests_cut_off_each_other_and_no_whole_one() -> None:
    asked, may_answer = threading.Event(), threading.Event()

    class Slow(Handler):
        def get(self, path: str) -> None:
            asked.set()
            may_answer.wait(20)
            self.answer(200, "text/plain", "here\n")

    with ExitStack() as stack:
        server = LocalServer("127.0.0.1", 0, Slow, name="test-http")
        stack.callback(server.close)
        stack.callback(may_answer.set)
        host, _, port = server.address.rpartition(":")

        def connect() -> socket.socket:
            return stack.enter_context(socket.create_connection((host, int(port)), 20))

        honest = connect()
        honest.sendall(b"GET / HTTP/1.1\r\nHost: localhost\r\n\r\n")
        assert asked.wait(20)
        halves = [connect() for _ in range(MAX_CONNECTIONS + 8)]
        for one in halves:
            one.sendall(b"GET / HTTP/1.1\r\nHo")
        assert halves[0].recv(1) == b"", "the oldest of these is cut off"
        may_answer.set()
        assert b"here" in honest.makefile("rb").read()


@table(
    ("request", "expected"),
    [
        (b"GET / HTTP/1.1\r\nHost: localhost\r\n\r\n", 200),
        (b"GET / HTTP/1.1\r\n\r\n", 400),
        (b"HEAD / HTTP/1.1\r\n\r\n", 400),
        (b"POST / HTTP/1.1\r\nContent-Type: application/json\r\nContent-Length: 0\r\n\r\n", 400),
        (b"GET / HTTP/1.1\r\nHost: localhost\r\nHost: localhost\r\n\r\n", 400),
        (b"GET / HTTP/1.1\r\nHost: localhost\r\nHost: rebind.example\r\n\r\n", 400),
        (b"GET / HTTP/1.1\r\nHost: rebind.example\r\n\r\n", 403),
        (b"GET / HTTP/1.0\r\n\r\n", 200),  # an old program: browsers have sent a host since 1996
        (b"GET / HTTP/1.0\r\nHost: rebind.example\r\n\r\n", 403),
        (b"GET / HTTP/1.0\r\nHost: localhost\r\nHost: localhost\r\n\r\n", 400),
    ],
)
def test_a_request_names_one_host(request: bytes, expected: int) -> None:
    """RFC 9112, 3.2."""

    class Here(Handler):
        def get(self, path: str) -> None:
            self.answer(200, "text/plain", "here\n")

    with closing(LocalServer("127.0.0.1", 0, Here, name="test-http")) as server:
        host, _, port = server.address.rpartition(":")
        with socket.create_connection((host, int(port)), 20) as client:
            client.sendall(request)
            head, _, text = client.makefile("rb").read().partition(b"\r\n\r\n")
    assert head.startswith(b"HTTP/1.0 %d " % expected)
    assert (b"here" in text) is (expected == 200)
    assert (b"Host: found" in text) is (expected != 200 and not request.startswith(b"HEAD"))
