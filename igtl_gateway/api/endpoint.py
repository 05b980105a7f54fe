"""A conversation over TCP, and what the blocking and the asyncio endpoints have in common."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from typing import Any, TypeVar

from igtl_gateway.api import conversation
from igtl_gateway.api.conversation import Conversation, Handler, HeaderVersion, PeerCounts, PeerOptions, WhenFull
from igtl_gateway.api.keywords import texts
from igtl_gateway.api.received import ReceivedMessage
from igtl_gateway.base.buffers import Buffer
from igtl_gateway.base.clock import SystemClock
from igtl_gateway.base.errors import LinkClosed
from igtl_gateway.base.versions import Self
from igtl_gateway.edges.tcp import LinkInfo, PeerLimits, TcpEdge, TlsFiles
from igtl_gateway.gateway.log.note import Note

#: Address and port of OpenIGTLink programs by default.
HOST, PORT = "127.0.0.1", 18944
TIMEOUT_S = 5.0

F = TypeVar("F", bound=Callable[[ReceivedMessage], Any])


class Line:
    """A conversation with its edge: one I/O thread that connects, accepts, frames, sends, and limits foreign peers.

    Args:
        place: address for error messages.
        options: see `PeerOptions`.
        ends: whether the first connection that ends is the end of all (a client that does not reconnect).
    """

    def __init__(self, place: str, options: PeerOptions, *, ends: bool) -> None:
        clock = SystemClock()
        self.talk = Conversation(place, options, clock, self._send, ends=ends)
        self.edge = TcpEdge(
            on_frame=self.talk.received,
            on_link=self._on_link,
            on_note=lambda _link, note: self.talk.add_note(note),
            clock=clock,
            limits=options.limits,
            allow=options.allow,
            tls=options.tls or TlsFiles(),
            when_full=options.when_full,
        )

    @classmethod
    def dial(cls, host: str, port: int, reconnect: bool, options: PeerOptions) -> Self:
        """Return a line that connects to a server.  Raises ConfigError."""
        line = cls(_place(host, port), options, ends=not reconnect)
        try:
            line.edge.connect(host, port, tls=options.tls is not None)
        except BaseException:
            line.close()
            raise
        line.edge.start()
        return line

    @classmethod
    def listen(cls, host: str, port: int, options: PeerOptions) -> tuple[Self, str, int]:
        """Return a line that listens, with its address.  Raises ConfigError or Unavailable."""
        line = cls(_place(host, port), options, ends=False)
        try:
            bound = line.edge.listen(host, port, tls=options.tls is not None)
        except BaseException:
            line.close()
            raise
        line.talk.place = _place(*bound)
        line.edge.start()
        return line, *bound

    def close(self) -> None:
        """Send what is queued, and close all connections; a second call does nothing."""
        if self.talk.close():
            self.edge.stop()

    def _send(self, links: Sequence[int], buffers: Sequence[Buffer], stream: str, keep: bool) -> None:
        self.edge.send(links, buffers, stream, keep)

    def _on_link(self, link: int, up: bool, note: Note) -> None:
        self.talk.link_changed(link, up, note)
        if self.talk.ended:
            self.edge.stop()  # or it would connect again


def _place(host: str, port: int) -> str:
    return f"[{host}]:{port}" if ":" in host else f"{host}:{port}"


def options_of(
    header_version: HeaderVersion | None,
    when_full: WhenFull,
    queue_messages: int,
    queue_bytes: int,
    limits: PeerLimits | None,
    tls: TlsFiles | None,
    allow: str | Sequence[str] = (),
) -> PeerOptions:
    """Return the options of ``connect`` and ``serve``.  Raises ConfigError."""
    limits = limits or PeerLimits()
    return PeerOptions(header_version, when_full, queue_messages, queue_bytes, limits, tls, texts("allow", allow))


class Endpoint(ABC):
    """What all endpoints have, blocking or not: the last messages, handlers and counts."""

    def __init__(self, line: Line) -> None:
        self._line = line
        self._talk = line.talk

    def __repr__(self) -> str:
        peers = ", ".join(link.peer for link in self.links)
        return f"<{type(self).__name__}: {f'connected to {peers}' if peers else 'not connected'}>"

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

        One thread, or with asyncio one task, calls all handlers, one message after the other.  With asyncio a handler
        may be a coroutine function.  It may call everything of this object.  If it raises, a note reports it.

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

        The function gets the query.  For GET it returns the value to send, as for ``send``, or a `wire.Message`; None
        refuses the query.  For STT and STP it returns False to refuse it.

        Args:
            type: type of the data, such as ``"TRANSFORM"``.
            prefix: ``"GET"``, ``"STT"`` or ``"STP"``.

        Returns:
            The decorator.
        """
        return self._handle(conversation.is_query(prefix, type), self._talk.respond_to_query)

    @property
    def links(self) -> tuple[LinkInfo, ...]:
        """The connections that are up: number, address of the peer, TCP role of this program."""
        return tuple(link for link in self._line.edge.links() if link.connected)

    @property
    def is_connected(self) -> bool:
        """Whether a connection is up."""
        return bool(self.links)

    @property
    def counts(self) -> PeerCounts:
        """Counts of messages: received, invalid, dropped, sent."""
        return self._talk.counts(self._line.edge.counters().values())

    @property
    def notes(self) -> tuple[Note, ...]:
        """The last 100 notes: connections, invalid messages, errors of handlers."""
        return tuple(self._talk.notes)

    def _handle(
        self,
        selects: Callable[[ReceivedMessage], bool],
        respond: Callable[[ReceivedMessage, Any, Exception | None], None] | None,
    ) -> Callable[[F], F]:
        def add(function: F) -> F:
            self._talk.add_handler(Handler(selects, function, respond))
            self._start_handling()
            return function

        return add

    @abstractmethod
    def _start_handling(self) -> None:
        """Start what calls the handlers, unless it has started."""

    def _sent(self, number: int) -> int:
        """Return to how many a message was sent; may raise."""
        return number


class ClientEnd(Endpoint):
    """What both kinds of peers have."""

    @property
    def address(self) -> str:
        """Address of the server, ``host:port``."""
        return self._talk.place

    def _sent(self, number: int) -> int:
        if not number:
            raise LinkClosed(f"{self._talk.place}: found no connection, expected one to send to")
        return number


class ServerEnd(Endpoint):
    """What both kinds of servers have."""

    def __init__(self, line: Line, host: str, port: int) -> None:
        super().__init__(line)
        self.host, self.port = host, port

    def disconnect(self, link: int) -> None:
        """Close the connection of one client, after it was sent what is queued for it."""
        self._line.edge.disconnect([link], "disconnected by the server")
