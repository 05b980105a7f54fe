"""The small HTTP server: who is cut off where more connect than it serves."""

from __future__ import annotations

import socket
import threading
from contextlib import ExitStack

from igtl_gateway.edges.tcp.http_server import MAX_CONNECTIONS, Handler, LocalServer


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
