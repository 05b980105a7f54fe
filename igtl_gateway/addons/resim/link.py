"""The socket between the coordinator and the processes of the programs."""

from __future__ import annotations

import socket
import struct
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Protocol

from igtl_gateway.addons.resim import frames

_SIZE = struct.Struct("=I")
#: What the file of frames that are not sent begins with (`struct outbox` of ``preload/_preload.c``): bytes before those
#: here, bytes of complete frames here, and session time.
_OUTBOX = struct.Struct("=QQq")
#: How often it is read if the program sends meanwhile.
_MOST_READINGS = 10
#: Of the process at the other end: its number, user and group.
_CREDENTIALS = struct.Struct("=3i")
_READ_BYTES = 1 << 18
#: How often a wait looks after the processes, and after how many bytes without a wait.
_PATIENCE_S, _PATIENCE_BYTES = 0.1, 1 << 20


class Gone(Exception):
    """The process has closed its connection."""


class AnyLink(Protocol):
    """What gives and takes the frames of one program."""

    def send(self, data: bytes) -> None: ...

    def receive(self) -> frames.FromProgram: ...

    def rest(self) -> Iterator[frames.FromProgram]: ...


class Waiting(Protocol):
    """Is called now and then while a frame is awaited; ``is_flowing``: others arrive.  It may raise."""

    def __call__(self, *, is_flowing: bool = False) -> None: ...


class Link:
    """The connection of one process."""

    def __init__(self, connection: socket.socket, waiting: Waiting, place: Path) -> None:
        self._socket = connection
        self._waiting = waiting
        self._buffer = bytearray()
        self._at = self._unwatched_bytes = self._received_bytes = 0
        self._outbox = Path(f"{place}.{_peer_of(connection)}.out")
        connection.settimeout(_PATIENCE_S)

    def send(self, data: bytes) -> None:
        """Send frames.  Raises Gone."""
        view = memoryview(data)
        while view:
            try:
                view = view[self._socket.send(view) :]
            except TimeoutError:
                self._waiting()
            except OSError as error:
                raise Gone from error

    def receive(self) -> frames.FromProgram:
        """Return the next frame.  Raises Gone."""
        while not (frame := self._next()):
            self._buffer, self._at = self._buffer[self._at :], 0
            if self._unwatched_bytes >= _PATIENCE_BYTES:
                self._unwatched_bytes = 0
                self._waiting(is_flowing=True)
            try:
                more = self._socket.recv(_READ_BYTES)
            except TimeoutError:
                self.look()
                continue
            except OSError as error:
                raise Gone from error
            if not more:
                raise Gone
            self._take(more)
            self._unwatched_bytes += len(more)
        return frames.parse(frame)

    def _next(self) -> bytes:
        """The next frame, without its size; nothing if it is not here."""
        buffer, at = self._buffer, self._at
        if len(buffer) - at < _SIZE.size:
            return b""
        (size,) = _SIZE.unpack_from(buffer, at)
        end = at + _SIZE.size + size
        if len(buffer) < end:
            return b""
        self._at = end
        return bytes(memoryview(buffer)[at + _SIZE.size : end])

    def _take(self, data: bytes) -> None:
        self._buffer += data
        self._received_bytes += len(data)

    def rest(self) -> Iterator[frames.FromProgram]:
        """Yield what a process that has ended, or does not go on, has left behind.  Afterwards, nothing is received."""
        self._socket.setblocking(False)
        with suppress(OSError):
            while more := self._socket.recv(_READ_BYTES):
                self._take(more)
        now_ns = self._read_outbox()
        while frame := self._next():
            yield frames.parse(frame)
        if now_ns:
            yield frames.Progress(now_ns)

    def _read_outbox(self) -> int:
        """Take what was not sent; session time, 0 if it is not known."""
        with suppress(OSError, struct.error):
            for _ in range(_MOST_READINGS):
                data = self._outbox.read_bytes()
                sent, size, now_ns = _OUTBOX.unpack_from(data)
                with self._outbox.open("rb") as file:
                    sent_later, size_later, _ = _OUTBOX.unpack(file.read(_OUTBOX.size))
                if sent == sent_later and size <= size_later:
                    self._take(data[_OUTBOX.size + max(0, self._received_bytes - sent) : _OUTBOX.size + size])
                    return int(now_ns)
        return 0

    def look(self) -> None:
        """Look after the processes.  Raises what the one who waits does."""
        self._waiting()

    def close(self) -> None:
        self._socket.close()


class Listener:
    """Where the processes connect: a socket in a folder."""

    def __init__(self, folder: Path) -> None:
        self.path = folder / "resim"
        self._socket = socket.socket(socket.AF_UNIX)
        self._socket.bind(str(self.path))
        self._socket.listen()
        self._socket.settimeout(_PATIENCE_S)
        self._strangers: list[socket.socket] = []

    def accept(self, waiting: Waiting) -> Link:
        """Return the connection of the next process; ``waiting`` as of `Link`, also while there is none."""
        while True:
            with suppress(TimeoutError):
                connection, _ = self._socket.accept()
                return Link(connection, waiting, self.path)
            waiting()

    def stranger(self) -> int:
        """Return the number of a process that has connected, which none was to; 0 for none.  It waits until `close`."""
        self._socket.setblocking(False)
        try:
            connection, _ = self._socket.accept()
        except BlockingIOError:
            return 0
        finally:
            self._socket.settimeout(_PATIENCE_S)
        self._strangers.append(connection)
        return _peer_of(connection)

    def close(self) -> None:
        for each in (*self._strangers, self._socket):
            each.close()
        self.path.unlink(missing_ok=True)


def _peer_of(connection: socket.socket) -> int:
    """Number of the process at the other end."""
    credentials = connection.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, _CREDENTIALS.size)
    return int(_CREDENTIALS.unpack(credentials)[0])
