"""The socket between the coordinator and the processes of the programs."""

from __future__ import annotations

import socket
import struct
from contextlib import suppress
from pathlib import Path
from typing import Protocol

from igtl_gateway.addons.resim import frames

_SIZE = struct.Struct("=I")
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


class Waiting(Protocol):
    """Is called now and then while a frame is awaited; ``is_flowing``: others arrive.  It may raise."""

    def __call__(self, *, is_flowing: bool = False) -> None: ...


class Link:
    """The connection of one process."""

    def __init__(self, connection: socket.socket, waiting: Waiting) -> None:
        self._socket = connection
        self._waiting = waiting
        self._buffer = bytearray()
        self._at = self._unwatched_bytes = 0
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
        while True:
            buffer, at = self._buffer, self._at
            if len(buffer) - at >= _SIZE.size:
                (size,) = _SIZE.unpack_from(buffer, at)
                end = at + _SIZE.size + size
                if len(buffer) >= end:
                    frame = bytes(memoryview(buffer)[at + _SIZE.size : end])
                    self._at = end
                    return frames.parse(frame)
            self._buffer, self._at = buffer[at:], 0
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
            self._buffer += more
            self._unwatched_bytes += len(more)

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
                return Link(connection, waiting)
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
        of_process = connection.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, _CREDENTIALS.size)
        return int(_CREDENTIALS.unpack(of_process)[0])

    def close(self) -> None:
        for each in (*self._strangers, self._socket):
            each.close()
        self.path.unlink(missing_ok=True)
