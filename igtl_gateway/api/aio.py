"""OpenIGTLink peers for scripts with asyncio: ``connect`` and ``serve`` as in `igtl_gateway`, with ``await``.

Example:
    >>> async def show_poses():  # doctest: +SKIP
    ...     async with aio.connect("127.0.0.1", 18944) as peer:
    ...         async for message in peer:
    ...             print(message.device, message.matrix)
"""

from __future__ import annotations

import asyncio
import inspect
from collections.abc import AsyncIterator, Awaitable, Callable, Generator, Mapping, Sequence
from contextlib import suppress
from types import TracebackType
from typing import Any, Generic, Self, TypeVar

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
from igtl_gateway.api.peer import HOST, PORT, TIMEOUT_S, dialled, listening
from igtl_gateway.api.received import ReceivedMessage
from igtl_gateway.base.errors import LinkClosed
from igtl_gateway.edges.tcp import LinkInfo, PeerLimits, TlsFiles
from igtl_gateway.gateway.log.note import Note
from igtl_gateway.wire import Message
from igtl_gateway.wire.query import EmptyQuery

T = TypeVar("T")
F = TypeVar("F", bound=Callable[[ReceivedMessage], Any])


class AsyncEndpoint:
    """What `AsyncPeer` and `AsyncServer` share; the methods are those of `igtl_gateway.api.peer.Endpoint`.

    All methods must be called in the event loop that created the object.
    """

    def __init__(self, talk: Conversation) -> None:
        self._talk = talk
        self._handling: asyncio.Task[None] | None = None

    # ── receiving ─────────────────────────────────────────────────────────────────────────────────────────────

    async def receive(
        self, type: str = "", device: str = "", *, timeout_s: float | None = TIMEOUT_S
    ) -> ReceivedMessage:
        """Remove the first waiting message from the receive queue and return it; wait for one if there is none.

        A cancelled call takes no message.  Arguments and errors as of ``Peer.receive``.
        """
        expected = f"a message {type or '*'}/{device or '*'}"
        return await self._wait(lambda: self._talk.try_receive(type, device), timeout_s, expected)

    async def __aiter__(self) -> AsyncIterator[ReceivedMessage]:
        """Iterate over all messages as they arrive, until the connection is closed."""
        while True:
            try:
                message = await self.receive(timeout_s=None)
            except LinkClosed:
                return
            yield message

    def latest(self, device: str = "", type: str = "") -> ReceivedMessage | None:
        """Return the last message of a device, as ``Peer.latest``."""
        return self._talk.latest(device, type)

    def on_message(self, type: str = "", device: str = "") -> Callable[[F], F]:
        """Decorate a function, or a coroutine function, that handles messages, as ``Peer.on_message``.

        One task calls all handlers, one message after the other.
        """
        return self._handle(conversation.selector(type, device), None)

    def on_command(self, name: str = "**") -> Callable[[F], F]:
        """Decorate a function, or a coroutine function, that executes commands, as ``Peer.on_command``."""
        return self._handle(conversation.is_command(name), self._talk.respond_to_command)

    def on_query(self, type: str, prefix: str = "GET") -> Callable[[F], F]:
        """Decorate a function, or a coroutine function, that answers queries, as ``Peer.on_query``."""
        return self._handle(conversation.is_query(prefix, type), self._talk.respond_to_query)

    # ── sending ───────────────────────────────────────────────────────────────────────────────────────────────

    async def send(
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
        """Send a message; arguments, result and errors as of ``Peer.send``.

        While a full send queue makes it wait, other tasks run.
        """
        out = self._talk.message(message, device, value, matrix, unit, time_ns, metadata)
        if self._talk.options.when_full == "block" and self._talk.is_queueing():
            return self._sent(await asyncio.to_thread(self._talk.send, out, to))
        return self._sent(self._talk.send(out, to))

    async def flush(self, timeout_s: float = TIMEOUT_S) -> bool:
        """Wait until the system has taken all messages for sending; False if that took longer."""
        return await asyncio.to_thread(self._talk.edge.flush, timeout_s)

    # ── queries and commands ──────────────────────────────────────────────────────────────────────────────────

    async def query(
        self, type: str, device: str = "", *, timeout_s: float | None = TIMEOUT_S, to: int | None = None
    ) -> ReceivedMessage:
        """Request one message (GET_…), and wait for it; as ``Peer.query``."""
        expected = self._talk.ask("GET", type, device, EmptyQuery(), to)
        reply = await self._wait_for(expected, timeout_s, f"{type}/{device or '*'} as the answer to a query")
        return self._talk.answer_of(reply, "GET", type)

    async def start_stream(
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
        """Request a stream (STT_…), and wait for the acknowledgement; as ``Peer.start_stream``."""
        content = conversation.start_content(type, interval_ms, coordinate_name, codec)
        await self._acknowledged("STT", self._talk.ask("STT", type, device, content, to), type, timeout_s)

    async def stop_stream(
        self, type: str, device: str = "", *, timeout_s: float | None = TIMEOUT_S, to: int | None = None
    ) -> None:
        """End a stream (STP_…); as ``Peer.stop_stream``."""
        await self._acknowledged("STP", self._talk.ask("STP", type, device, EmptyQuery(), to), type, timeout_s)

    async def command(
        self,
        name: str,
        text: str = "",
        *,
        device: str = "",
        metadata: Mapping[str, str] | None = None,
        timeout_s: float | None = TIMEOUT_S,
        to: int | None = None,
    ) -> CommandReply:
        """Send a command, and wait for its reply; as ``Peer.command``."""
        expected = self._talk.command(name, text, device, metadata, to)
        return conversation.reply_of(await self._wait_for(expected, timeout_s, f"a reply to the command {name!r}"))

    # ── state ─────────────────────────────────────────────────────────────────────────────────────────────────

    @property
    def links(self) -> tuple[LinkInfo, ...]:
        """The connections that are up."""
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
        """The last 100 notes."""
        return tuple(self._talk.notes)

    async def close(self) -> None:
        """Send what is queued (for 1 s at most), then close all connections.  A second call does nothing."""
        if self._handling and self._handling is not asyncio.current_task():
            self._handling.cancel()
            with suppress(asyncio.CancelledError):
                await self._handling
        await asyncio.to_thread(self._talk.close)

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        await self.close()

    def _sent(self, number: int) -> int:
        return number

    async def _wait(self, attempt: Callable[[], T | None], timeout_s: float | None, expected: str) -> T:
        """Repeat an attempt after each change, as ``Conversation.wait``."""
        talk, loop = self._talk, asyncio.get_running_loop()
        deadline_ns = talk.deadline_ns(timeout_s)
        while True:
            changed = asyncio.Event()

            def wake(changed: asyncio.Event = changed) -> None:
                with suppress(RuntimeError):  # the event loop is closed
                    loop.call_soon_threadsafe(changed.set)

            with talk.changed:
                if (result := attempt()) is not None:
                    return result
                left_s = talk.left_s(deadline_ns)
                if left_s is not None and left_s <= 0:
                    raise talk.no_reply(expected, timeout_s)
                talk.wakers.add(wake)
            try:
                with suppress(TimeoutError):
                    async with asyncio.timeout(left_s):
                        await changed.wait()
            finally:
                with talk.changed:
                    talk.wakers.discard(wake)

    async def _wait_for(self, expected: Expected, timeout_s: float | None, text: str) -> ReceivedMessage:
        try:
            return await self._wait(lambda: self._talk.try_reply(expected), timeout_s, text)
        finally:
            self._talk.forget(expected)

    async def _acknowledged(self, prefix: str, expected: Expected, base: str, timeout_s: float | None) -> None:
        if timeout_s == 0:
            self._talk.forget(expected)
            return
        reply = await self._wait_for(expected, timeout_s, f"an acknowledgement of {prefix}_ {base}")
        self._talk.answer_of(reply, prefix, base)

    def _handle(
        self,
        selects: Callable[[ReceivedMessage], bool],
        respond: Callable[[ReceivedMessage, Any, Exception | None], None] | None,
    ) -> Callable[[F], F]:
        def add(function: F) -> F:
            self._talk.add_handler(Handler(selects, function, respond))
            if self._handling is None:
                self._handling = asyncio.get_running_loop().create_task(self._run_handlers())
            return function

        return add

    async def _run_handlers(self) -> None:
        while next_one := await self._wait(self._talk.try_handle, None, "a message"):
            (message,) = next_one
            handler = self._talk.handler_of(message)
            if handler is None:
                continue
            result, error = None, None
            try:
                result = handler.function(message)
                if inspect.isawaitable(result):
                    result = await result
            except Exception as raised:  # of the user's function: the sender gets a reply all the same
                error = raised
            self._talk.finish(message, handler, result, error)


class AsyncPeer(AsyncEndpoint):
    """A connection to an OpenIGTLink server; `connect` creates it."""

    @property
    def address(self) -> str:
        """Address of the server, ``host:port``."""
        return self._talk.place

    async def wait_connected(self, timeout_s: float | None = TIMEOUT_S) -> None:
        """Wait for the connection.  Raises NoReply or LinkClosed."""
        await self._wait(lambda: self._talk.try_connected(1), timeout_s, "an OpenIGTLink server")

    def _sent(self, number: int) -> int:
        if not number:
            raise LinkClosed(f"{self._talk.place}: found no connection, expected one to send to")
        return number


class AsyncServer(AsyncEndpoint):
    """A server for OpenIGTLink clients; `serve` creates it.

    Attributes:
        host: the address that it listens on.
        port: the port that it listens on.
    """

    def __init__(self, talk: Conversation, host: str, port: int) -> None:
        super().__init__(talk)
        self.host, self.port = host, port

    async def wait_connected(self, count: int = 1, timeout_s: float | None = TIMEOUT_S) -> None:
        """Wait for ``count`` clients.  Raises NoReply or LinkClosed."""
        await self._wait(lambda: self._talk.try_connected(count), timeout_s, f"{count} OpenIGTLink clients")

    def disconnect(self, link: int) -> None:
        """Close the connection of one client, after it was sent what is queued for it."""
        self._talk.edge.disconnect([link], "disconnected by the server")


E_co = TypeVar("E_co", bound=AsyncEndpoint, covariant=True)


class Opening(Generic[E_co]):
    """What `connect` and `serve` return: for ``await`` and for ``async with``."""

    def __init__(self, open_it: Callable[[], Awaitable[E_co]]) -> None:
        self._open_it = open_it
        self._opened: E_co | None = None

    def __await__(self) -> Generator[Any, None, E_co]:
        return self._open_it().__await__()

    async def __aenter__(self) -> E_co:
        self._opened = await self._open_it()
        return self._opened

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        if self._opened:
            await self._opened.close()


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
) -> Opening[AsyncPeer]:
    """Connect to an OpenIGTLink server: ``async with connect(…) as peer`` or ``peer = await connect(…)``.

    Arguments and errors as of `igtl_gateway.connect`.
    """
    options = PeerOptions(header_version, when_full, queue_messages, queue_bytes, limits or PeerLimits(), tls)

    async def open_it() -> AsyncPeer:
        peer = AsyncPeer(dialled(host, port, reconnect, options))
        try:
            if timeout_s != 0:
                await peer.wait_connected(timeout_s)
        except BaseException:
            await peer.close()
            raise
        return peer

    return Opening(open_it)


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
) -> Opening[AsyncServer]:
    """Listen for OpenIGTLink clients: ``async with serve(…) as server`` or ``server = await serve(…)``.

    Arguments and errors as of `igtl_gateway.serve`.
    """
    options = PeerOptions(
        header_version, when_full, queue_messages, queue_bytes, limits or PeerLimits(), tls, texts("allow", allow)
    )

    async def open_it() -> AsyncServer:
        return AsyncServer(*await asyncio.to_thread(listening, host, port, options))

    return Opening(open_it)
