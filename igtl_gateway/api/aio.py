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
from typing import Any, Generic, TypeVar

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


class AsyncEndpoint(Endpoint):
    """What `AsyncPeer` and `AsyncServer` share; the methods are those of `Peer` and `Server`.

    All methods must be called in the event loop that created the object.
    """

    _handling: asyncio.Task[None] | None = None

    # ── receiving ─────────────────────────────────────────────────────────────────────────────────────────────

    async def receive(
        self, type: str = "", device: str = "", *, timeout_s: float | None = TIMEOUT_S
    ) -> ReceivedMessage:
        """Remove the first waiting message from the receive queue and return it; wait for one if there is none.

        A cancelled call takes no message.  Arguments and errors as of ``Peer.receive``.
        """
        return await self._run(self._talk.receive(type, device, timeout_s))

    async def __aiter__(self) -> AsyncIterator[ReceivedMessage]:
        """Iterate over all messages as they arrive, until the connection is closed."""
        while True:
            try:
                message = await self.receive(timeout_s=None)
            except LinkClosed:
                return
            yield message

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
        if self._talk.options.when_full == "block" and self.counts.queued:
            return self._sent(await asyncio.to_thread(self._talk.send, out, to))
        return self._sent(self._talk.send(out, to))

    async def flush(self, timeout_s: float = TIMEOUT_S) -> bool:
        """Wait until the system has taken all messages for sending; False if that took longer."""
        return await asyncio.to_thread(self._line.edge.flush, timeout_s)

    # ── queries and commands ──────────────────────────────────────────────────────────────────────────────────

    async def query(
        self, type: str, device: str = "", *, timeout_s: float | None = TIMEOUT_S, to: int | None = None
    ) -> ReceivedMessage:
        """Request one message (GET_…), and wait for it; as ``Peer.query``."""
        return await self._run(self._talk.query(type, device, timeout_s, to))

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
        await self._run(self._talk.stream("STT", type, device, content, timeout_s, to))

    async def stop_stream(
        self, type: str, device: str = "", *, timeout_s: float | None = TIMEOUT_S, to: int | None = None
    ) -> None:
        """End a stream (STP_…); as ``Peer.stop_stream``."""
        await self._run(self._talk.stream("STP", type, device, EmptyQuery(), timeout_s, to))

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
        return await self._run(self._talk.command(name, text, device, metadata, timeout_s, to))

    # ── state ─────────────────────────────────────────────────────────────────────────────────────────────────

    async def close(self) -> None:
        """Send what is queued (for 1 s at most), then close all connections.  A second call does nothing."""
        if self._handling and self._handling is not asyncio.current_task():
            self._handling.cancel()
            with suppress(asyncio.CancelledError):
                await self._handling
        await asyncio.to_thread(self._line.close)

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        await self.close()

    async def _run(self, wait: Wait[R]) -> R:
        """Repeat an attempt after each change, as ``BlockingEndpoint._run``."""
        talk, loop = self._talk, asyncio.get_running_loop()
        try:
            deadline_ns = talk.deadline_ns(wait.timeout_s)
            while True:
                changed = asyncio.Event()

                def wake(changed: asyncio.Event = changed) -> None:
                    with suppress(RuntimeError):  # the event loop is closed
                        loop.call_soon_threadsafe(changed.set)

                with talk.changed:
                    if (result := wait.attempt()) is not None:
                        break
                    left_s = talk.left_s(deadline_ns)
                    if left_s is not None and left_s <= 0:
                        raise talk.no_reply(wait)
                    talk.wakers.add(wake)
                timer = None if left_s is None else loop.call_later(left_s, changed.set)
                try:
                    await changed.wait()
                finally:
                    if timer:
                        timer.cancel()
                    with talk.changed:
                        talk.wakers.discard(wake)
        finally:
            wait.leave()
        return wait.finish(result)

    def _start_handling(self) -> None:
        if self._handling is None:
            self._handling = asyncio.get_running_loop().create_task(self._call_handlers())

    async def _call_handlers(self) -> None:
        while call := await self._run(self._talk.next_call()):
            result: Any = None
            error: Exception | None = None
            try:
                result = call.handler.function(call.message)
                if inspect.isawaitable(result):
                    result = await result
            except Exception as raised:  # of the user's function: the sender gets a reply all the same
                error = raised
            self._talk.finish(call, result, error)


class AsyncPeer(AsyncEndpoint, ClientEnd):
    """A connection to an OpenIGTLink server; `connect` creates it."""

    async def wait_connected(self, timeout_s: float | None = TIMEOUT_S) -> None:
        """Wait for the connection.  Raises NoReply or LinkClosed."""
        await self._run(self._talk.connected(1, timeout_s, "an OpenIGTLink server"))


class AsyncServer(AsyncEndpoint, ServerEnd):
    """A server for OpenIGTLink clients; `serve` creates it.

    Attributes:
        host: the address that it listens on.
        port: the port that it listens on.
    """

    async def wait_connected(self, count: int = 1, timeout_s: float | None = TIMEOUT_S) -> None:
        """Wait for ``count`` clients.  Raises NoReply or LinkClosed."""
        await self._run(self._talk.connected(count, timeout_s, f"{count} OpenIGTLink clients"))


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
    options = options_of(header_version, when_full, queue_messages, queue_bytes, limits, tls)

    async def open_it() -> AsyncPeer:
        peer = AsyncPeer(Line.dial(host, port, reconnect, options))
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
    options = options_of(header_version, when_full, queue_messages, queue_bytes, limits, tls, allow)

    async def open_it() -> AsyncServer:
        return AsyncServer(*await asyncio.to_thread(Line.listen, host, port, options))

    return Opening(open_it)
