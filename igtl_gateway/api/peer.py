"""OpenIGTLink peers for scripts: ``connect`` to a server, ``serve`` clients, synchronously.

`igtl_gateway.aio` has the same for asyncio.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from types import TracebackType
from typing import Any, Self, TypeVar

from igtl_gateway.api import conversation
from igtl_gateway.api.conversation import (
    QUEUE_BYTES,
    QUEUE_MESSAGES,
    CommandReply,
    Conversation,
    Expected,
    Handler,
    HeaderVersion,
    PeerCounts,
    PeerOptions,
    WhenFull,
)
from igtl_gateway.api.keywords import texts
from igtl_gateway.api.received import ReceivedMessage
from igtl_gateway.base.errors import LinkClosed
from igtl_gateway.edges.tcp import LinkInfo, PeerLimits, TlsFiles
from igtl_gateway.gateway.log.note import Note
from igtl_gateway.wire import Message
from igtl_gateway.wire.query import EmptyQuery

#: Address and port of OpenIGTLink programs by default.
HOST, PORT = "127.0.0.1", 18944
TIMEOUT_S = 5.0

F = TypeVar("F", bound=Callable[[ReceivedMessage], Any])


class Endpoint:
    """What `Peer` and `Server` share: messages in and out, queries, commands, handlers.  Any thread may call it."""

    def __init__(self, talk: Conversation) -> None:
        self._talk = talk
        self._handling: threading.Thread | None = None

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
        expected = f"a message {type or '*'}/{device or '*'}"
        return self._talk.wait(lambda: self._talk.try_receive(type, device), timeout_s, expected)

    def __iter__(self) -> Iterator[ReceivedMessage]:
        """Iterate over all messages as they arrive, until the connection is closed."""
        while True:
            try:
                yield self.receive(timeout_s=None)
            except LinkClosed:
                return

    def latest(self, device: str = "", type: str = "") -> ReceivedMessage | None:
        """Return the last message of a device, also if it was returned before; None if there is none.

        Args:
            device: device name, or a glob; "": any.
            type: message type, or a glob; "": any.

        Returns:
            The message, which stays in the receive queue if it waits there.
        """
        return self._talk.latest(device, type)

    def on_message(self, type: str = "", device: str = "") -> Callable[[F], F]:
        """Decorate a function that handles the messages of a type and a device, instead of the receive queue.

        One thread calls all handlers, one message after the other.  A handler may call everything of this object.
        If a handler raises, a note reports it.

        Args:
            type: message type, or a glob; "": any.
            device: device name, or a glob; "": any.

        Returns:
            The decorator.
        """
        return self._handle(conversation.selector(type, device), None)

    def on_command(self, name: str = "**") -> Callable[[F], F]:
        """Decorate a function that executes the commands with a name.

        The function gets the message (``message.name``, ``message.text``) and returns the text of the reply, or None.
        If it raises, the sender gets a reply with the status FAIL and the text of the exception.

        Args:
            name: name of the command, or a glob.

        Returns:
            The decorator.
        """
        return self._handle(conversation.is_command(name), self._talk.respond_to_command)

    def on_query(self, type: str, prefix: str = "GET") -> Callable[[F], F]:
        """Decorate a function that answers the queries of a type.

        The function gets the query.  For GET it returns the value to send, as for `send`, or a `wire.Message`; None
        refuses the query.  For STT and STP it returns False to refuse it.

        Args:
            type: type of the data, such as ``"TRANSFORM"``.
            prefix: ``"GET"``, ``"STT"`` or ``"STP"``.

        Returns:
            The decorator.
        """
        return self._handle(conversation.is_query(prefix, type), self._talk.respond_to_query)

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
        return self._talk.edge.flush(timeout_s)

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
        expected = self._talk.ask("GET", type, device, EmptyQuery(), to)
        reply = self._wait_for(expected, timeout_s, f"{type}/{device or '*'} as the answer to a query")
        return self._talk.answer_of(reply, "GET", type)

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
        self._acknowledged("STT", self._talk.ask("STT", type, device, content, to), type, timeout_s)

    def stop_stream(
        self, type: str, device: str = "", *, timeout_s: float | None = TIMEOUT_S, to: int | None = None
    ) -> None:
        """End a stream (STP_…); arguments and errors as of `start_stream`."""
        self._acknowledged("STP", self._talk.ask("STP", type, device, EmptyQuery(), to), type, timeout_s)

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
        expected = self._talk.command(name, text, device, metadata, to)
        return conversation.reply_of(self._wait_for(expected, timeout_s, f"a reply to the command {name!r}"))

    # ── state ─────────────────────────────────────────────────────────────────────────────────────────────────

    @property
    def links(self) -> tuple[LinkInfo, ...]:
        """The connections that are up: number, address of the peer, TCP role of this program."""
        return self._talk.links()

    @property
    def is_connected(self) -> bool:
        """Whether a connection is up."""
        return bool(self.links)

    @property
    def counts(self) -> PeerCounts:
        """Counts of messages: received, invalid, dropped, sent."""
        return self._talk.counts()

    @property
    def notes(self) -> tuple[Note, ...]:
        """The last 100 notes: connections, invalid messages, errors of handlers."""
        return tuple(self._talk.notes)

    def close(self) -> None:
        """Send what is queued (for 1 s at most), then close all connections.  A second call does nothing."""
        self._talk.close()
        if self._handling and self._handling is not threading.current_thread():
            self._handling.join()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.close()

    def _sent(self, number: int) -> int:
        return number

    def _wait_for(self, expected: Expected, timeout_s: float | None, text: str) -> ReceivedMessage:
        try:
            return self._talk.wait(lambda: self._talk.try_reply(expected), timeout_s, text)
        finally:
            self._talk.forget(expected)

    def _acknowledged(self, prefix: str, expected: Expected, base: str, timeout_s: float | None) -> None:
        if timeout_s == 0:
            self._talk.forget(expected)
            return
        reply = self._wait_for(expected, timeout_s, f"an acknowledgement of {prefix}_ {base}")
        self._talk.answer_of(reply, prefix, base)

    def _handle(
        self,
        selects: Callable[[ReceivedMessage], bool],
        respond: Callable[[ReceivedMessage, Any, Exception | None], None] | None,
    ) -> Callable[[F], F]:
        def add(function: F) -> F:
            self._talk.add_handler(Handler(selects, function, respond))
            if self._handling is None:
                self._handling = threading.Thread(target=self._run_handlers, name="igtl-handlers", daemon=True)
                self._handling.start()
            return function

        return add

    def _run_handlers(self) -> None:
        while next_one := self._talk.wait(self._talk.try_handle, None, "a message"):
            (message,) = next_one
            handler = self._talk.handler_of(message)
            if handler is None:
                continue
            result, error = None, None
            try:
                result = handler.function(message)
            except Exception as raised:  # of the user's function: the sender gets a reply all the same
                error = raised
            self._talk.finish(message, handler, result, error)


class Peer(Endpoint):
    """A connection to an OpenIGTLink server; a context manager and an iterator over the received messages.

    `connect` creates it.
    """

    @property
    def address(self) -> str:
        """Address of the server, ``host:port``."""
        return self._talk.place

    def wait_connected(self, timeout_s: float | None = TIMEOUT_S) -> None:
        """Wait for the connection.  Raises NoReply or LinkClosed."""
        self._talk.wait(lambda: self._talk.try_connected(1), timeout_s, "an OpenIGTLink server")

    def _sent(self, number: int) -> int:
        if not number:
            raise LinkClosed(f"{self._talk.place}: found no connection, expected one to send to")
        return number


class Server(Endpoint):
    """A server for OpenIGTLink clients; a context manager and an iterator over the received messages.

    `serve` creates it.  `send` sends to all clients.  ``message.link`` is the number of the client that sent a message.

    Attributes:
        host: the address that it listens on.
        port: the port that it listens on.
    """

    def __init__(self, talk: Conversation, host: str, port: int) -> None:
        super().__init__(talk)
        self.host, self.port = host, port

    def wait_connected(self, count: int = 1, timeout_s: float | None = TIMEOUT_S) -> None:
        """Wait for ``count`` clients.  Raises NoReply or LinkClosed."""
        self._talk.wait(lambda: self._talk.try_connected(count), timeout_s, f"{count} OpenIGTLink clients")

    def disconnect(self, link: int) -> None:
        """Close the connection of one client, after it was sent what is queued for it."""
        self._talk.edge.disconnect([link], "disconnected by the server")


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
    talk = dialled(
        host,
        port,
        reconnect,
        PeerOptions(header_version, when_full, queue_messages, queue_bytes, limits or PeerLimits(), tls),
    )
    peer = Peer(talk)
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
    options = PeerOptions(
        header_version, when_full, queue_messages, queue_bytes, limits or PeerLimits(), tls, texts("allow", allow)
    )
    return Server(*listening(host, port, options))


def dialled(host: str, port: int, reconnect: bool, options: PeerOptions) -> Conversation:
    """Return a conversation that connects to a server.  Raises ConfigError."""
    place = f"[{host}]:{port}" if ":" in host else f"{host}:{port}"
    talk = Conversation(place, options, ends=not reconnect)
    try:
        talk.edge.connect(host, port, tls=options.tls is not None)
    except BaseException:
        talk.close()
        raise
    talk.edge.start()
    return talk


def listening(host: str, port: int, options: PeerOptions) -> tuple[Conversation, str, int]:
    """Return a conversation that listens, with its address.  Raises ConfigError or Unavailable."""
    place = f"[{host}]:{port}" if ":" in host else f"{host}:{port}"
    talk = Conversation(place, options, ends=False)
    try:
        bound = talk.edge.listen(host, port, tls=options.tls is not None)
    except BaseException:
        talk.close()
        raise
    talk.place = f"[{bound[0]}]:{bound[1]}" if ":" in bound[0] else f"{bound[0]}:{bound[1]}"
    talk.edge.start()
    return talk, *bound
