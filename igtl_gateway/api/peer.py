"""OpenIGTLink peers for scripts: ``connect`` to a server, ``serve`` clients, synchronously.

`igtl_gateway.aio` has the same for asyncio.
"""

from __future__ import annotations

import threading
from collections.abc import Iterator, Mapping, Sequence
from types import TracebackType
from typing import Any, TypeVar

from igtl_gateway.api import conversation
from igtl_gateway.api.conversation import QUEUE_BYTES, QUEUE_MESSAGES, CommandReply, HeaderVersion, Wait, WhenFull
from igtl_gateway.api.endpoint import HOST, PORT, TIMEOUT_S, ClientEnd, Endpoint, Line, ServerEnd, options_of
from igtl_gateway.api.received import ReceivedMessage
from igtl_gateway.base.errors import LinkClosed
from igtl_gateway.base.versions import Self
from igtl_gateway.edges.tcp import PeerLimits, TlsFiles
from igtl_gateway.wire import Message
from igtl_gateway.wire.query import EmptyQuery

R = TypeVar("R")


class BlockingEndpoint(Endpoint):
    """What `Peer` and `Server` share: messages in and out, queries, commands.  Any thread may call it."""

    _handling: threading.Thread | None = None

    # ── receiving ─────────────────────────────────────────────────────────────────────────────────────────────

    def receive(self, type: str = "", device: str = "", *, timeout_s: float | None = TIMEOUT_S) -> ReceivedMessage:
        """Remove the first waiting message from the receive queue and return it; wait for one if there is none.

        Messages of other types and devices stay in the queue.

        Args:
            type: message type, or a glob such as ``"*TDATA"``; "": any.
            device: device name, or a glob; "": any.
            timeout_s: longest wait in seconds; None: forever; 0: only what has arrived already.

        Returns:
            The message.

        Raises:
            NoReply: no such message arrived in time (a TimeoutError).
            LinkClosed: the connection is closed, and no such message waits (a ConnectionError).

        Examples:
            >>> pose = peer.receive("TRANSFORM", "Probe").matrix  # doctest: +SKIP
        """
        return self._run(self._talk.receive(type, device, timeout_s))

    def __iter__(self) -> Iterator[ReceivedMessage]:
        """Iterate over all messages as they arrive, until the connection is closed."""
        while True:
            try:
                yield self.receive(timeout_s=None)
            except LinkClosed:
                return

    # ── sending ───────────────────────────────────────────────────────────────────────────────────────────────

    def send(
        self,
        message: str | Message | ReceivedMessage,
        device: str = "",
        value: object = None,
        *,
        matrix: object = None,
        unit: str = "",
        time_ns: int | None = None,
        metadata: Mapping[str, str] | None = None,
        to: int | None = None,
    ) -> int:
        """Send a message.

        Args:
            message: a message type such as ``"TRANSFORM"``, or a whole message, which is sent as it is.
            device: device name, at most 20 bytes (19 for C++ programs).
            value: the content: a (4, 4) matrix in millimetres for TRANSFORM and POSITION, a string for STRING, an array
                for IMAGE (shape (j, i), (k, j, i) or (k, j, i, components)), SENSOR, NDARRAY and POINT (n, 3), points
                or (points, triangles) for POLYDATA, poses by name for TDATA and QTDATA, type names for CAPABILITY, a
                string or a code for STATUS; for every type an object of `igtl_gateway.wire` or the bytes of the body.
            matrix: with IMAGE: (4, 4), voxel index (i, j, k) → RAS, in millimetres.
            unit: with SENSOR: unit of the numbers, such as ``"mm/s"``.
            time_ns: time stamp, UTC nanoseconds; None: now; 0: unset.
            metadata: strings by key; the message then has header version 2.
            to: number of the only connection that gets it; None: all connections.

        Returns:
            The number of connections that it was sent to.

        Raises:
            ConversionError: a value that the type cannot hold.
            WireError: a name or a number that does not fit into the message.
            LinkClosed: there is no connection (of a `Server`: it was closed).
        """
        out = self._talk.message(message, device, value, matrix, unit, time_ns, metadata)
        return self._sent(self._talk.send(out, to))

    def flush(self, timeout_s: float = TIMEOUT_S) -> bool:
        """Wait until the system has taken all messages for sending; False if that took longer."""
        return self._line.edge.flush(timeout_s)

    # ── queries and commands ──────────────────────────────────────────────────────────────────────────────────

    def query(
        self, type: str, device: str = "", *, timeout_s: float | None = TIMEOUT_S, to: int | None = None
    ) -> ReceivedMessage:
        """Request one message (GET_…), and wait for it.  It does not enter the receive queue.

        Args:
            type: type of the data, such as ``"TRANSFORM"``.
            device: device name; "": the peer chooses.
            timeout_s: longest wait in seconds; None: forever.
            to: number of the connection; None: the only one.

        Returns:
            The answer.

        Raises:
            NoReply: no answer in time.
            Refused: the peer has no such message, or denies it.
            LinkClosed: the connection is closed.
        """
        return self._run(self._talk.query(type, device, timeout_s, to))

    def start_stream(
        self,
        type: str,
        device: str = "",
        *,
        interval_ms: float = 0,
        coordinate_name: str = "",
        codec: str = "H264",
        timeout_s: float | None = TIMEOUT_S,
        to: int | None = None,
    ) -> None:
        """Request a stream (STT_…), and wait for the acknowledgement (RTS_…).  Then `receive` its messages.

        Args:
            type: type of the data, such as ``"TDATA"``.
            device: device name; "": the peer chooses.
            interval_ms: least time between two messages, milliseconds; of TDATA, QTDATA, VIDEO, POLYDATA and BIND.
            coordinate_name: of TDATA and QTDATA: coordinate system of the poses.
            codec: of VIDEO.
            timeout_s: longest wait in seconds; None: forever; 0: do not wait, for programs that do not acknowledge.
            to: number of the connection; None: the only one.

        Raises:
            NoReply: no acknowledgement in time.
            Refused: the peer refuses.
            LinkClosed: the connection is closed.
        """
        content = conversation.start_content(type, interval_ms, coordinate_name, codec)
        self._run(self._talk.stream("STT", type, device, content, timeout_s, to))

    def stop_stream(
        self, type: str, device: str = "", *, timeout_s: float | None = TIMEOUT_S, to: int | None = None
    ) -> None:
        """End a stream (STP_…); arguments and errors as of `start_stream`."""
        self._run(self._talk.stream("STP", type, device, EmptyQuery(), timeout_s, to))

    def command(
        self,
        name: str,
        text: str = "",
        *,
        device: str = "",
        metadata: Mapping[str, str] | None = None,
        timeout_s: float | None = TIMEOUT_S,
        to: int | None = None,
    ) -> CommandReply:
        """Send a command, and wait for its reply.

        Args:
            name: name of the command.
            text: its text, mostly XML.
            device: device name.
            metadata: strings by key; the message then has header version 2.
            timeout_s: longest wait in seconds; None: forever.
            to: number of the connection; None: the only one.

        Returns:
            The reply, also that of a failure.

        Raises:
            NoReply: no reply in time.
            LinkClosed: the connection is closed.
        """
        return self._run(self._talk.command(name, text, device, metadata, timeout_s, to))

    # ── state ─────────────────────────────────────────────────────────────────────────────────────────────────

    def close(self) -> None:
        """Send what is queued (for 1 s at most), then close all connections.  A second call does nothing."""
        self._line.close()
        if self._handling and self._handling is not threading.current_thread():
            self._handling.join()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.close()

    def _run(self, wait: Wait[R]) -> R:
        """Repeat an attempt until it has a result.  Raises NoReply, ConfigError, and what the attempt raises."""
        talk = self._talk
        try:
            deadline_ns = talk.deadline_ns(wait.timeout_s)
            with talk.changed:
                while (result := wait.attempt()) is None:
                    left_s = talk.left_s(deadline_ns)
                    if left_s is not None and left_s <= 0:
                        raise talk.no_reply(wait)
                    talk.changed.wait(left_s)
        finally:
            wait.leave()
        return wait.finish(result)

    def _start_handling(self) -> None:
        if self._handling is None:
            self._handling = threading.Thread(target=self._call_handlers, name="igtl-handlers", daemon=True)
            self._handling.start()

    def _call_handlers(self) -> None:
        while call := self._run(self._talk.next_call()):
            result: Any = None
            error: Exception | None = None
            try:
                result = call.handler.function(call.message)
            except Exception as raised:  # of the user's function: the sender gets a reply all the same
                error = raised
            self._talk.finish(call, result, error)


class Peer(BlockingEndpoint, ClientEnd):
    """A connection to an OpenIGTLink server; a context manager and an iterator over the received messages.

    `connect` creates it.
    """

    def wait_connected(self, timeout_s: float | None = TIMEOUT_S) -> None:
        """Wait for the connection.  Raises NoReply or LinkClosed."""
        self._run(self._talk.connected(1, timeout_s, "an OpenIGTLink server"))


class Server(BlockingEndpoint, ServerEnd):
    """A server for OpenIGTLink clients; a context manager and an iterator over the received messages.

    `serve` creates it.  `send` sends to all clients.  ``message.link`` is the number of the client that sent a message.

    Attributes:
        host: the address that it listens on.
        port: the port that it listens on.
    """

    def wait_connected(self, count: int = 1, timeout_s: float | None = TIMEOUT_S) -> None:
        """Wait for ``count`` clients.  Raises NoReply or LinkClosed."""
        self._run(self._talk.connected(count, timeout_s, f"{count} OpenIGTLink clients"))


def connect(
    host: str = HOST,
    port: int = PORT,
    *,
    timeout_s: float | None = TIMEOUT_S,
    reconnect: bool = False,
    header_version: HeaderVersion | None = None,
    when_full: WhenFull = "block",
    queue_messages: int = QUEUE_MESSAGES,
    queue_bytes: int = QUEUE_BYTES,
    limits: PeerLimits | None = None,
    tls: TlsFiles | None = None,
) -> Peer:
    """Connect to an OpenIGTLink server, such as 3D Slicer, PLUS or ``igtl-gateway bridge``.

    The receive queue is bounded.  When it is full, the oldest message of the stream with the most waiting messages (or
    bytes) is dropped; ``peer.counts.dropped`` has the numbers.

    Args:
        host: name or address of the server.
        port: its port.
        timeout_s: longest wait for the server, which need not be there yet; None: forever; 0: return at once, and
            connect in the background.
        reconnect: connect again whenever the connection ends.
        header_version: header version of sent messages; None: 1 until the server sends version 2, as some old programs
            misread version 2.  A message with metadata always has version 2.
        when_full: what `send` does if the server does not read and the send queue (`PeerLimits`) is full: ``"block"``
            waits, ``"drop"`` drops the oldest queued message of the same stream.
        queue_messages: bound of the receive queue in messages.
        queue_bytes: bound of the receive queue in bytes.
        limits: what the server may cost: body size, rate, pauses.
        tls: files for TLS; ``TlsFiles()`` trusts the certificates of the system; None: no TLS.

    Returns:
        The connection.

    Raises:
        NoReply: no server in time.
        ConfigError: an argument is out of range.

    Examples:
        >>> with connect("127.0.0.1", 18944) as peer:  # doctest: +SKIP
        ...     peer.send("STRING", "Greeting", "hello")
        ...     print(peer.receive("TRANSFORM", "ToolToReference").matrix)
    """
    options = options_of(header_version, when_full, queue_messages, queue_bytes, limits, tls)
    peer = Peer(Line.dial(host, port, reconnect, options))
    try:
        if timeout_s != 0:
            peer.wait_connected(timeout_s)
    except BaseException:
        peer.close()
        raise
    return peer


def serve(
    port: int = PORT,
    host: str = HOST,
    *,
    allow: str | Sequence[str] = (),
    header_version: HeaderVersion | None = None,
    when_full: WhenFull = "block",
    queue_messages: int = QUEUE_MESSAGES,
    queue_bytes: int = QUEUE_BYTES,
    limits: PeerLimits | None = None,
    tls: TlsFiles | None = None,
) -> Server:
    """Listen for OpenIGTLink clients.

    Args:
        port: port to listen on; 0: a free one, see ``Server.port``.
        host: address to listen on; ``"0.0.0.0"`` for all, with ``allow``.
        allow: networks (CIDR) whose clients may connect beside those of this host, or ``"any"``.
        header_version: as of `connect`, for each client.
        when_full: as of `connect`; ``"block"`` waits for the slowest client.
        queue_messages: as of `connect`.
        queue_bytes: as of `connect`.
        limits: what a client may cost; the number of clients.
        tls: files for TLS, with at least a certificate; None: no TLS.

    Returns:
        The server, which listens already.

    Raises:
        ConfigError: an argument is out of range, or an address is open to other hosts without ``allow``.
        Unavailable: the port is in use.

    Examples:
        >>> with serve(0) as server:
        ...     server.links
        ()
    """
    options = options_of(header_version, when_full, queue_messages, queue_bytes, limits, tls, allow)
    return Server(*Line.listen(host, port, options))
