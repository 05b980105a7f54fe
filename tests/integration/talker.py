"""A peer that sends numbered strings without end, and keeps the numbered strings that it receives.

Also a program of its own, to be stopped and killed: ``talker.py PORT DEVICE`` is a client, ``talker.py 0 DEVICE`` a
server (of one client at a time) that prints ``port N`` first.  It prints ``received N`` for each string.  On the word
``half`` on stdin it sends half a message, prints ``half``, and sends nothing from then on.
"""

from __future__ import annotations

import socket
import struct
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path

if __name__ == "__main__":  # what it needs is not installed
    sys.path.insert(0, str(Path(__file__).parents[2]))

from tests.integration.bridge import HEADER_SIZE, TIMEOUT_S, string

#: The device name of the peer's numbers.
TICK = "Tick"
PERIOD_S = 0.1


class Talker:
    """Speaks and listens on a connection until that ends, or ``close``.

    Attributes:
        name: its address, as the gateway calls it where it is a client.
        began: when, by the monotonic clock.
        first, sent: the first and the last number that it has sent.
        received: the numbers of ``TICK`` that it has received, in order.
        bytes_received: of all that came.
        ended: why it stopped receiving, or ``""``.
    """

    def __init__(
        self,
        sock: socket.socket,
        device: str,
        *,
        first: int = 1,
        period_s: float = PERIOD_S,
        on_received: Callable[[int], None] | None = None,
    ) -> None:
        self.socket = sock
        self.device = device
        self.name = "{}:{}".format(*sock.getsockname())
        self.began = time.monotonic()
        self.first = first
        self.sent = first - 1
        self.received: list[int] = []
        self.bytes_received = 0
        self.ended = ""
        self._period_s = period_s
        self._on_received = on_received
        self._quiet = threading.Event()
        self._changed = threading.Condition()
        sock.settimeout(None)
        self._speaker = threading.Thread(target=self._speak, daemon=True)
        self._listener = threading.Thread(target=self._listen, daemon=True)
        self._speaker.start()
        self._listener.start()

    def hush(self) -> int:
        """Stop sending; return the last number that was sent."""
        self._quiet.set()
        self._speaker.join(TIMEOUT_S)
        return self.sent

    def wait(self, condition: Callable[[], bool], what: str, timeout_s: float = TIMEOUT_S) -> None:
        """Wait for a condition that depends on the received numbers."""
        with self._changed:
            assert self._changed.wait_for(condition, timeout_s), f"{self.device} at {self.name}: no {what}: {self}"

    def wait_some(self) -> None:
        self.wait(lambda: len(self.received) >= 5, "ticks")

    def wait_received(self, number: int) -> None:
        self.wait(lambda: bool(self.received) and self.received[-1] >= number, f"tick {number}")

    def wait_end(self) -> None:
        """Wait until the other side is gone, or ``close``."""
        self._listener.join()

    def close(self) -> None:
        self._quiet.set()
        try:
            self.socket.shutdown(socket.SHUT_RDWR)
        except OSError:
            pass
        self.socket.close()

    def __repr__(self) -> str:
        return f"sent {self.sent}, received {len(self.received)} up to {self.received[-1:]}, {self.ended or 'listens'}"

    def _speak(self) -> None:
        try:
            while not self._quiet.wait(self._period_s):
                self.socket.sendall(string(str(self.sent + 1), self.device))
                self.sent += 1
        except OSError as error:
            self._end(f"{error}")

    def _listen(self) -> None:
        try:
            while True:
                head = self._exactly(HEADER_SIZE)
                kind, device, size = struct.unpack_from(">12s20s8xQ", head, 2)
                body = self._exactly(size)
                if kind.startswith(b"STRING") and device.rstrip(b"\0").decode() == TICK:
                    self._hear(int(body[4 : 4 + struct.unpack_from(">H", body, 2)[0]]))
        except (OSError, EOFError) as error:
            self._end(f"{type(error).__name__}: {error}")

    def _hear(self, number: int) -> None:
        with self._changed:
            self.received.append(number)
            self._changed.notify_all()
        if self._on_received:
            self._on_received(number)

    def _exactly(self, size: int) -> bytes:
        data = b""
        while len(data) < size:
            part = self.socket.recv(size - len(data))
            if not part:
                raise EOFError("closed")
            self.bytes_received += len(part)
            data += part
        return data

    def _end(self, why: str) -> None:
        with self._changed:
            self.ended = self.ended or why
            self._changed.notify_all()


class Server:
    """Serves the clients of a listening socket, one after the other, with one row of numbers."""

    def __init__(self, sock: socket.socket, device: str, on_received: Callable[[int], None] | None = None) -> None:
        self.port: int = sock.getsockname()[1]
        self.talkers: list[Talker] = []
        self._device = device
        self._on_received = on_received
        self._socket = sock
        self._changed = threading.Condition()
        threading.Thread(target=self._accept, daemon=True).start()

    def wait_talkers(self, count: int) -> Talker:
        """The latest of as many talkers, at least."""
        with self._changed:
            assert self._changed.wait_for(lambda: len(self.talkers) >= count, TIMEOUT_S), self.talkers
            return self.talkers[-1]

    def close(self) -> None:
        self._socket.close()
        for talker in self.talkers:
            talker.close()

    def _accept(self) -> None:
        while True:
            try:
                sock, _ = self._socket.accept()
            except OSError:
                return
            first = self.talkers[-1].hush() + 1 if self.talkers else 1
            talker = Talker(sock, self._device, first=first, on_received=self._on_received)
            with self._changed:
                self.talkers.append(talker)
                self._changed.notify_all()


def main() -> None:
    port, device = int(sys.argv[1]), sys.argv[2]

    def told(number: int) -> None:
        print(f"received {number}", flush=True)  # noqa: T201 (the protocol)

    if port:
        talkers = [Talker(socket.create_connection(("127.0.0.1", port)), device, on_received=told)]
    else:
        again = int(sys.argv[3]) if len(sys.argv) > 3 else 0
        server = Server(socket.create_server(("127.0.0.1", again)), device, told)
        talkers = server.talkers
        print(f"port {server.port}", flush=True)  # noqa: T201
    for _ in sys.stdin:
        talkers[-1].hush()
        talkers[-1].socket.sendall(string("half of it arrives", device)[: HEADER_SIZE + 5])
        print("half", flush=True)  # noqa: T201


if __name__ == "__main__":
    main()
