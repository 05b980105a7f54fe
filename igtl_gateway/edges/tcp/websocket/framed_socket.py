"""A socket with WebSocket on it (RFC 6455), as a server.

Strategy: wsproto reads, without I/O of its own: the handshake, frames, masks, fragments and the rules for them.  It
passes the bytes of a message on as they come, so the framer of the link sees the header of OpenIGTLink before the rest
is there: its limits, and those for slow messages, hold as over TCP, and no message is stored twice.  What is sent gets
its frame here, because the library would copy each message: from 2 to 10 bytes before it (section 5.2).

A message whose frame has begun is completed, whatever the queue drops behind it: with the frame, at least one byte of
the message counts as sent.  Control frames wait until the message is over, the newest of each kind.
"""

from __future__ import annotations

import socket
import struct
import threading
from collections import deque
from collections.abc import Iterator, Sequence
from contextlib import suppress
from http import HTTPStatus

from wsproto.connection import Connection, ConnectionState, ConnectionType
from wsproto.events import (
    AcceptConnection,
    BytesMessage,
    CloseConnection,
    Event,
    Ping,
    RejectConnection,
    RejectData,
    Request,
    TextMessage,
)
from wsproto.frame_protocol import CloseReason
from wsproto.handshake import H11Handshake
from wsproto.utilities import RemoteProtocolError

from igtl_gateway.base.quantities import count_text
from igtl_gateway.edges.tcp.layer import AnySocket, Layer, LayerError, send_parts
from igtl_gateway.edges.tcp.outbox import IOV_MAX, Part
from igtl_gateway.edges.tcp.tls import TLS_TO_PLAIN
from igtl_gateway.edges.tcp.websocket.origins import Origins
from igtl_gateway.gateway.log.note import STOPPED
from igtl_gateway.wire.header import BODY_SIZE_AT, HEADER_SIZE, U64

FOREIGN = "page of a foreign origin"
NO_WEBSOCKET = "no WebSocket spoken to a WebSocket port"

_BATCH = 64 * 2**10  # received at once
_FRAMES = 8  # decoded at once: 15 µs each
_TLS_RECORD = 0x16
_AGENT = 200  # characters of the name of a program
_BINARY, _SHORT, _LONG = 0x82, 126, 127  # final frame of a binary message; how its size is written
#: Code of a note that ends a link, or reason → why, as WebSocket has it; others are a normal end.
_CLOSE = {
    "": CloseReason.TRY_AGAIN_LATER,  # it has not become a link: there are too many
    STOPPED: CloseReason.GOING_AWAY,
    "too_large": CloseReason.MESSAGE_TOO_BIG,
    **dict.fromkeys(("internal_error", "out_of_memory"), CloseReason.INTERNAL_ERROR),
    **dict.fromkeys(("stalled", "idle", "queue_full", "refused", "unreachable"), CloseReason.POLICY_VIOLATION),
}


class WebSocketError(LayerError):
    """WebSocket has failed."""

    code = "websocket_failed"
    what = "invalid WebSocket messages"


class WebSocketSocket(Layer):
    """The server's side of a connection with WebSocket on it; see ``Layer``."""

    NAME = "WebSocket"
    PINGS = True
    manner = " over WebSocket"

    def __init__(self, sock: AnySocket, origins: Origins) -> None:
        super().__init__(sock)
        self._below = sock if isinstance(sock, Layer) else None
        self.is_framed = self._below is None
        self._origins = origins
        self._lock = threading.Lock()  # guards all below; that of the layer below is taken under it
        self._handshake = H11Handshake(ConnectionType.SERVER)
        self._request: Request | None = None
        self._connection = Connection(ConnectionType.SERVER)
        self._storage = memoryview(bytearray(_BATCH))
        self._events: Iterator[Event] = iter(())
        self._is_decoded = True  # the library has nothing left of what was received
        self._rest = memoryview(b"")  # of messages, decoded
        self._failure: WebSocketError | None = None  # behind that rest
        self._head = b""  # the first bytes of the message that is being received, up to a header
        self._size = 0  # and its size so far
        self._unsent = memoryview(b"")  # frames that have begun
        self._left = 0  # bytes of the message whose frame has been sent
        self._control: dict[str, bytes] = {}  # frames that wait for its end
        self._reason = ""  # of the end

    @property
    def pending(self) -> int:
        control = 0 if self._left else sum(map(len, self._control.values()))
        return len(self._unsent) + control + (self._below.pending if self._below else 0)

    def facts(self) -> dict[str, str]:
        assert self._request
        headers = _texts(self._request)
        facts = {"transport": "websocket", "origin": headers.get("origin", "")}
        facts["agent"] = headers.get("user-agent", "")[:_AGENT]
        return facts | (self._below.facts() if self._below else {})

    # ── the handshake ─────────────────────────────────────────────────────────────────────────────────────────

    def do_handshake(self) -> bool:
        with self._lock:
            while self._request is None:
                try:
                    count = self._sock.recv_into(self._storage)
                except (BlockingIOError, InterruptedError):
                    return False
                if not count:
                    raise WebSocketError("connection lost in the WebSocket handshake")
                self._answer(bytes(self._storage[:count]))
            return self._flush()

    def _answer(self, data: bytes) -> None:
        """Take bytes of the request, and answer it once it is whole.  Raises WebSocketError for one that is refused."""
        if not self.begun and data[0] == _TLS_RECORD and self._below is None:
            raise WebSocketError(TLS_TO_PLAIN)
        self.begun = True
        try:
            self._handshake.receive_data(data)
            request = next(self._handshake.events(), None)
        except RemoteProtocolError as error:
            rejection = error.event_hint
            status = rejection.status_code if isinstance(rejection, RejectConnection) else HTTPStatus.BAD_REQUEST
            raise self._refusal(HTTPStatus(status), NO_WEBSOCKET, str(error)) from None
        except ValueError as error:  # such as a header that is not text
            raise self._refusal(HTTPStatus.BAD_REQUEST, NO_WEBSOCKET, str(error)) from None
        if not isinstance(request, Request):
            return
        if not data.endswith((b"\n\r\n", b"\n\n")):
            raise self._refusal(HTTPStatus.BAD_REQUEST, NO_WEBSOCKET, "data before the answer to the handshake")
        origin = _texts(request).get("origin")
        if not self._origins.allow(origin, request.host):
            raise self._refusal(HTTPStatus.FORBIDDEN, FOREIGN, f"{origin}; --allow-origin would permit it")
        self._control["answer"] = self._handshake.send(AcceptConnection())
        self._request = request
        self.more = bool(self._below and self._below.more)

    def _refusal(self, status: HTTPStatus, reason: str, detail: str) -> WebSocketError:
        """Answer that the connection is refused, as far as that is possible; return the error to be raised."""
        text = f"{status.phrase}: {reason}: {detail}\n".encode("utf-8", "replace")
        headers = [(b"content-type", b"text/plain; charset=utf-8"), (b"connection", b"close")]
        headers.append((b"content-length", b"%d" % len(text)))
        with suppress(Exception):  # the library may be in a state in which it answers no more
            answer = self._handshake.send(RejectConnection(status_code=status, headers=headers, has_body=True))
            self._control["answer"] = answer + self._handshake.send(RejectData(data=text))
            self._flush()
        return WebSocketError(reason, detail)

    # ── sending ───────────────────────────────────────────────────────────────────────────────────────────────

    def sendmsg(self, parts: Sequence[Part]) -> int:
        taken = 0
        with self._lock:
            if not self._flush():
                raise BlockingIOError
            views = deque([memoryview(part) for part in parts])
            while views:
                pieces, sizes = self._framed(views)
                try:
                    count = send_parts(self._sock, pieces)
                except (BlockingIOError, InterruptedError):
                    break
                taken += self._advance(pieces, sizes, count)
                if count < sum(map(len, pieces)):
                    break
            self._flush()
        if not taken and views:
            raise BlockingIOError
        return taken

    def _framed(self, views: deque[memoryview]) -> tuple[list[Part], list[int]]:
        """Take buffers, as many as one system call does, and put the frames between them.

        Returns:
            The buffers, and for each the size of the message whose frame it is; 0: it is of a message.
        """
        pieces: list[Part] = []
        sizes: list[int] = []
        left, control = self._left, b"".join(self._control.values())
        while views and len(pieces) < IOV_MAX - 1:
            view = views.popleft()
            if not left:
                left = HEADER_SIZE + U64.unpack_from(view, BODY_SIZE_AT)[0]
                pieces.append(control + _frame_head(left))
                sizes.append(left)
                control = b""
            pieces.append(view[:left])
            sizes.append(0)
            if len(view) > left:
                views.appendleft(view[left:])
            left -= len(pieces[-1])
        return pieces, sizes

    def _advance(self, pieces: Sequence[Part], sizes: Sequence[int], count: int) -> int:
        """The kernel has taken the first ``count`` bytes of them: return how many of messages are off our hands."""
        taken = 0
        for index, (piece, size) in enumerate(zip(pieces, sizes, strict=True)):
            if not count:
                break
            now = min(count, len(piece))
            count -= now
            if not size:
                self._left -= now
                taken += now
                continue
            self._control.clear()  # of which the first frame had what there was
            self._left = size
            if not count:
                self._unsent = memoryview(bytes(piece[now:]) + bytes(pieces[index + 1][:1]))
                self._left -= 1
                taken += 1
        return taken

    def take_over(self, message: bytes, sent: int) -> int:
        head = _frame_head(len(message))
        taken = max(1, sent - len(head))  # as in ``_advance``
        with self._lock:
            if sent <= len(head):
                self._unsent = memoryview(head[sent:] + message[:1])
            self._left = len(message) - taken
        return taken

    def flush(self) -> bool:
        with self._lock:
            return self._flush()

    def _flush(self) -> bool:
        while self._unsent or (self._control and not self._left):
            if not self._unsent:
                self._unsent = memoryview(b"".join(self._control.values()))
                self._control.clear()
            try:
                count = self._sock.send(self._unsent)
            except (BlockingIOError, InterruptedError):
                return False
            self._unsent = self._unsent[count:]
        return self._below is None or self._below.flush()

    # ── receiving ─────────────────────────────────────────────────────────────────────────────────────────────

    def recv_into(self, room: memoryview) -> int:
        with self._lock:
            if not (self._rest or self._failure or self.has_left) and self._is_decoded and not self._receive():
                self.more = False
                return 0
            count, frames = 0, 0
            while count < len(room):
                if self._rest:
                    now = min(len(self._rest), len(room) - count)
                    room[count : count + now] = self._rest[:now]
                    self._rest = self._rest[now:]
                    count += now
                elif self._failure or self.has_left or self._is_decoded or frames == _FRAMES:
                    break
                else:
                    self._decode()
                    frames += 1
            if count:
                self.more = bool(self._rest or self._failure or self.has_left or not self._is_decoded)
                self.more = self.more or bool(self._below and self._below.more)
                return count
            if self._failure:
                raise self._failure
            self.more = not self.has_left and (not self._is_decoded or bool(self._below and self._below.more))
            if self.has_left:
                return 0
            raise BlockingIOError

    def _receive(self) -> bool:
        """Give the library what the socket has; False at the end of the stream.  Raises OSError."""
        try:
            count = self._sock.recv_into(self._storage)
        except (BlockingIOError, InterruptedError):
            self.more = False
            raise
        if count:
            self.received_bytes += count
            self._connection.receive_data(bytes(self._storage[:count]))
            self._events = self._connection.events()
            self._is_decoded = False
        return count > 0

    def _decode(self) -> None:
        """Take the next frame, or what there is of it."""
        match next(self._events, None):
            case None:
                self._is_decoded = True
            case BytesMessage(data=data, message_finished=is_whole):
                self._take(data, is_whole)
            case TextMessage():
                self._fail(CloseReason.UNSUPPORTED_DATA, "found a message of text, expected a binary one")
            case Ping() as ping if self._connection.state is ConnectionState.OPEN:
                self._control["pong"] = self._connection.send(ping.response())
            case CloseConnection() as close:
                if self._connection.state is ConnectionState.OPEN:  # the library has found an error
                    self._fail(close.code, close.reason or "")
                else:
                    self.has_left = True
                    if self._connection.state is ConnectionState.REMOTE_CLOSING:
                        self._control["close"] = self._connection.send(close.response())
                    self.is_ending = True

    def _take(self, data: bytes | bytearray, is_whole: bool) -> None:
        """Take a piece of a message.  A message is as long as its header announces."""
        if len(self._head) < HEADER_SIZE:
            self._head += data[: HEADER_SIZE - len(self._head)]
        expected = None
        if len(self._head) == HEADER_SIZE:
            expected = HEADER_SIZE + U64.unpack_from(self._head, BODY_SIZE_AT)[0]
        beyond = self._size + len(data) - expected if expected is not None else 0
        self._rest = memoryview(data)[: len(data) - max(0, beyond)]
        self._size += len(data)
        if beyond > 0:
            self._fail(CloseReason.INVALID_FRAME_PAYLOAD_DATA, "a message that is longer than its header announces")
        elif is_whole and self._size != expected:
            least = expected or HEADER_SIZE
            text = f"a message of {count_text(self._size, 'byte')}, expected {count_text(least, 'byte')}"
            self._fail(CloseReason.INVALID_FRAME_PAYLOAD_DATA, text)
        elif is_whole:
            self._head, self._size = b"", 0

    def _fail(self, code: int, text: str) -> None:
        self._failure = WebSocketError(text)
        self._announce_end(code, text)

    # ── the end ───────────────────────────────────────────────────────────────────────────────────────────────

    def ping(self) -> None:
        with self._lock:
            if self._connection.state is ConnectionState.OPEN:
                self._control["ping"] = self._connection.send(Ping())

    def farewell(self, reason: str) -> None:
        self._reason = reason

    def _announce_end(self, code: int, text: str) -> None:
        """Have the frame sent that ends the conversation; under the lock."""
        if self._request and not self.is_ending and self._connection.state is ConnectionState.OPEN:
            self.is_ending = True
            self._control["close"] = self._connection.send(CloseConnection(code=code, reason=text))

    def _leave(self) -> None:
        with self._lock:
            self._announce_end(_CLOSE.get(self._reason, CloseReason.NORMAL_CLOSURE), self._reason.replace("_", " "))
            with suppress(OSError):
                self._flush()

    def shutdown(self, how: int) -> None:
        if how == socket.SHUT_WR:
            self._leave()
        self._sock.shutdown(how)

    def close(self) -> None:
        self._leave()
        self._sock.close()


def _frame_head(size: int) -> bytes:
    """The head of an unmasked frame with a whole binary message."""
    if size < _SHORT:
        return bytes((_BINARY, size))
    if size < 1 << 16:
        return struct.pack(">BBH", _BINARY, _SHORT, size)
    return struct.pack(">BBQ", _BINARY, _LONG, size)


def _texts(request: Request) -> dict[str, str]:
    """The headers of a request."""
    return {name.decode("ascii", "replace"): value.decode("utf-8", "replace") for name, value in request.extra_headers}
