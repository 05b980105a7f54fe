"""What a peer or a server sends, expects and matches, without I/O: for any thread, and for any driver.

``endpoint`` connects a `Conversation` with the edge of the bridge (`igtl_gateway.edges.tcp`): what arrives is given to
``received`` and ``link_changed``, what is sent goes to ``out``.  So scripts and the bridge have one implementation of
the protocol.

A request returns a `Wait`: ``attempt()`` returns a result, None to wait on, or raises, and the driver repeats it after
each change.  ``peer`` waits on a condition, ``aio`` on an event of its loop.
"""

from __future__ import annotations

import threading
from collections import Counter, OrderedDict, deque
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from typing import Any, Generic, Literal, TypeVar

from igtl_gateway.api.contents import content_of
from igtl_gateway.api.inbox import Inbox
from igtl_gateway.api.received import ReceivedMessage, items_of
from igtl_gateway.base.buffers import Buffer, join, total_size
from igtl_gateway.base.clock import Clock
from igtl_gateway.base.errors import ConfigError, LinkClosed, NoReply, Refused, WireError
from igtl_gateway.base.globs import matches
from igtl_gateway.base.quantities import counted
from igtl_gateway.base.stamp import NS_PER_MS, NS_PER_S, ns_to_ticks
from igtl_gateway.convert.commands import failure_text, reply_result
from igtl_gateway.convert.igtl_msgs import CommandReply as RosReply
from igtl_gateway.convert.igtl_msgs import MetadataItem
from igtl_gateway.edges.tcp import LinkCounters, PeerLimits, TlsFiles
from igtl_gateway.gateway.log.note import Level, Note
from igtl_gateway.wire import Item, Message, decode, encode
from igtl_gateway.wire.body import Body
from igtl_gateway.wire.command import Command
from igtl_gateway.wire.header import READING
from igtl_gateway.wire.message import sorted_items
from igtl_gateway.wire.query import (
    QUERIES,
    EmptyQuery,
    QueryReply,
    StartBind,
    StartPolyData,
    StartTracking,
    StartVideo,
    query_name,
)
from igtl_gateway.wire.registry import ALIASES
from igtl_gateway.wire.text import Status

R = TypeVar("R")
WhenFull = Literal["block", "drop"]
HeaderVersion = Literal[1, 2]

#: Bounds of the receive queue: 20 s of transforms at 50 Hz, or 50 images in full HD.
QUEUE_MESSAGES, QUEUE_BYTES = 1000, 256 * 2**20
#: Streams whose last message is stored, as many as the bridge has.
_STREAMS = 512
_NOTES = 100
_STATUS_OK, _OK = 1, 0
_SHOWN = 5
#: Header version of a message until its link is known: that of the link.
_AS_LINK = 0
_MAX_COMMAND_ID = 0xFFFF_FFFF


@dataclass(frozen=True, slots=True)
class PeerOptions:
    """Options of `connect` and `serve`, which document them."""

    header_version: HeaderVersion | None = None
    when_full: WhenFull = "block"
    queue_messages: int = QUEUE_MESSAGES
    queue_bytes: int = QUEUE_BYTES
    limits: PeerLimits = field(default_factory=PeerLimits)
    tls: TlsFiles | None = None
    allow: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if self.header_version not in (None, 1, 2):
            raise ConfigError(f"header_version: found {self.header_version!r}, expected 1, 2 or None")
        if self.when_full not in ("block", "drop"):
            raise ConfigError(f"when_full: found {self.when_full!r}, expected 'block' or 'drop'")


@dataclass(frozen=True, slots=True)
class CommandReply:
    """The reply to a command.

    Attributes:
        name: name of the command.
        text: text of the reply, mostly XML.
        succeeded: whether the reply has no status, or that of a success.
        reason: reason of a failure; "" if the reply has none.
        message: the whole reply.
    """

    name: str
    text: str
    succeeded: bool
    reason: str
    message: ReceivedMessage


@dataclass(frozen=True, slots=True)
class PeerCounts:
    """The traffic of a peer or a server so far.

    Attributes:
        received: messages that arrived.
        invalid: received messages that violate the protocol; a note has the reason.
        dropped: messages that the full receive queue dropped, by stream.
        sent: messages that the system took for sending, once for each connection.
        queued: messages that wait in the send queues.
        unsent: messages that were not sent, by stream: pushed out of a full send queue (``when_full="drop"``), or left
            in it when the connection ended.
    """

    received: int
    invalid: int
    dropped: dict[str, int]
    sent: int
    queued: int
    unsent: dict[str, int]


@dataclass(slots=True, eq=False)
class Expected:
    """A reply that a caller waits for; it does not enter the receive queue."""

    link: int
    selects: Callable[[ReceivedMessage], bool]
    reply: ReceivedMessage | None = None


@dataclass(frozen=True, slots=True)
class Handler:
    """A function of the user that takes messages."""

    selects: Callable[[ReceivedMessage], bool]
    function: Callable[[ReceivedMessage], Any]
    respond: Callable[[ReceivedMessage, Any, Exception | None], None] | None = None


@dataclass(frozen=True, slots=True)
class Call:
    """A received message, and the handler that takes it."""

    message: ReceivedMessage
    handler: Handler


def _same(result: Any) -> Any:
    return result


def _nothing() -> None:
    return None


@dataclass(frozen=True, slots=True)
class Wait(Generic[R]):
    """What a caller waits for.

    Attributes:
        attempt: returns the result, None to wait on, or raises; called under the lock.
        timeout_s: longest wait in seconds; None: forever.
        expected: what NoReply names.
        finish: makes what the caller gets of the result; may raise.
        leave: called once, when the caller waits no longer.
    """

    attempt: Callable[[], Any]
    timeout_s: float | None
    expected: str
    finish: Callable[[Any], R] = _same
    leave: Callable[[], None] = _nothing


class Conversation:
    """The state of a peer or a server.

    Args:
        place: address for error messages.
        options: see `PeerOptions`.
        clock: gives the stamps of messages, and the time of waits.
        out: sends a message: links, buffers, stream, and whether to wait where the send queue is full.
        ends: whether the first connection that ends is the end of all (a client that does not reconnect).
    """

    def __init__(
        self,
        place: str,
        options: PeerOptions,
        clock: Clock,
        out: Callable[[Sequence[int], Sequence[Buffer], str, bool], None],
        *,
        ends: bool,
    ) -> None:
        self.place = place
        self.options = options
        self.changed = threading.Condition()  # guards all attributes below
        self.notes: deque[Note] = deque(maxlen=_NOTES)
        self.inbox = Inbox(options.queue_messages, options.queue_bytes)
        self.to_handle = Inbox(options.queue_messages, options.queue_bytes)
        self.handlers: list[Handler] = []
        self.wakers: set[Callable[[], None]] = set()
        self.ended = ""
        self.is_closed = False
        self._ends = ends
        self._up: set[int] = set()
        self._versions: dict[int, int] = {}
        self._latest: OrderedDict[str, ReceivedMessage] = OrderedDict()
        self._arrived: Counter[str] = Counter()
        self._expected: list[Expected] = []
        self._command_id = 0
        self._received = self._invalid = 0
        self._clock = clock
        self._out = out

    # ── waiting ───────────────────────────────────────────────────────────────────────────────────────────────

    def deadline_ns(self, timeout_s: float | None) -> int | None:
        """Return the end of a wait, in monotonic nanoseconds.  Raises ConfigError."""
        if timeout_s is None:
            return None
        if not 0 <= timeout_s < threading.TIMEOUT_MAX:
            raise ConfigError(f"timeout_s: found {timeout_s}, expected seconds from 0 up, or None to wait forever")
        return self._clock.monotonic_ns() + round(timeout_s * NS_PER_S)

    def left_s(self, deadline_ns: int | None) -> float | None:
        """Return the seconds until a deadline."""
        return None if deadline_ns is None else (deadline_ns - self._clock.monotonic_ns()) / NS_PER_S

    def no_reply(self, wait: Wait[Any]) -> NoReply:
        """Return the error of a wait that took too long; under the lock."""
        causes = [note.text for note in self.notes if note.level >= Level.WARN][-1:]
        arrived = [f"{stream} ({number:,})" for stream, number in self._arrived.most_common(_SHOWN)]
        received = [f"received so far: {', '.join(arrived)}"] if arrived else []
        text = f"{self.place}: found nothing within {wait.timeout_s or 0:g} s, expected {wait.expected}"
        return NoReply("; ".join([text, *received, *causes]))

    def _changed_now(self) -> None:
        """Wake everybody who waits; under the lock."""
        self.changed.notify_all()
        for wake in tuple(self.wakers):
            wake()

    def connected(self, count: int, timeout_s: float | None, expected: str) -> Wait[None]:
        """Wait until ``count`` connections are up."""

        def attempt() -> bool | None:
            if len(self._up) >= count:
                return True
            self._raise_if_ended()
            return None

        return Wait(attempt, timeout_s, expected, lambda _: None)

    def receive(self, type_name: str, device: str, timeout_s: float | None) -> Wait[ReceivedMessage]:
        """Wait for the first message of a type and a device (globs) in the receive queue."""
        selects = selector(type_name, device)

        def attempt() -> ReceivedMessage | None:
            found = self.inbox.take(selects)
            if found is None:
                self._raise_if_ended()
            return found

        return Wait(attempt, timeout_s, f"a message {type_name or '*'}/{device or '*'}")

    def next_call(self) -> Wait[Call | None]:
        """Wait for the next message for a handler; None after the last one."""

        def attempt() -> tuple[Call | None] | None:
            found = self.to_handle.take(lambda _message: True)
            if found is None:
                return (None,) if self.is_closed else None
            return (Call(found, next(handler for handler in self.handlers if handler.selects(found))),)

        return Wait(attempt, None, "a message", lambda result: result[0])

    def _reply(
        self, expected: Expected, timeout_s: float | None, text: str, finish: Callable[[ReceivedMessage], R]
    ) -> Wait[R]:
        def attempt() -> ReceivedMessage | None:
            if expected.reply is None and expected.link not in self._up:
                raise LinkClosed(f"{self.place}: found the connection closed, expected a reply; {self._last_note()}")
            return expected.reply

        return Wait(attempt, timeout_s, text, finish, lambda: self._forget(expected))

    def _raise_if_ended(self) -> None:
        if self.is_closed:
            raise LinkClosed(f"{self.place}: found it closed by close(), expected an open connection")
        if self.ended:
            raise LinkClosed(f"{self.place}: found the connection closed, expected a message; {self.ended}")

    def _last_note(self) -> str:
        return self.notes[-1].text if self.notes else "no note"

    # ── state ─────────────────────────────────────────────────────────────────────────────────────────────────

    def latest(self, device: str, type_name: str) -> ReceivedMessage | None:
        """The last message of a device and a type (globs)."""
        selects = selector(type_name, device)
        with self.changed:
            return next((message for message in reversed(self._latest.values()) if selects(message)), None)

    def counts(self, per_link: Collection[LinkCounters]) -> PeerCounts:
        """The counts so far; ``per_link``: those of the edge."""
        unsent: Counter[str] = Counter()
        for counts in per_link:
            unsent.update(counts.dropped)
        with self.changed:
            return PeerCounts(
                self._received,
                self._invalid,
                dict(sorted((self.inbox.dropped + self.to_handle.dropped).items())),
                sum(counts.sent_messages for counts in per_link),
                sum(counts.queued_messages for counts in per_link),
                dict(sorted(unsent.items())),
            )

    def add_note(self, note: Note) -> None:
        """Store a note."""
        with self.changed:
            self.notes.append(note)

    def add_handler(self, handler: Handler) -> None:
        """Give the messages that a handler selects to it, from now on; the first handler that selects one applies."""
        with self.changed:
            self.handlers.append(handler)

    def finish(self, call: Call, result: Any, error: Exception | None) -> None:
        """A handler has returned, or raised: respond to the message."""
        message, handler = call.message, call.handler
        if error is not None:
            text = f"handler of {message}: {type(error).__name__}: {error}"
            self.add_note(Note(Level.ERROR, "callback_failed", text, str(message)))
        if handler.respond:
            try:
                handler.respond(message, result, error)
            except Exception as failure:  # of a value that cannot be sent: the sender of the query must not wait
                text = f"response to {message}: {failure}"
                self.add_note(Note(Level.ERROR, "callback_failed", text, str(message)))
                if error is None:
                    with suppress(Exception):
                        handler.respond(message, None, failure)

    def close(self) -> bool:
        """End all waits; False if it was closed before."""
        with self.changed:
            if self.is_closed:
                return False
            self.is_closed = True
            self._changed_now()
        return True

    # ── sending ───────────────────────────────────────────────────────────────────────────────────────────────

    def message(
        self,
        what: str | Message | ReceivedMessage,
        device: str,
        value: object,
        matrix: object,
        unit: str,
        time_ns: int | None,
        metadata: Mapping[str, str] | None,
    ) -> Message:
        """Return the message of the arguments of ``send``; header version 0 stands for "as the link has it"."""
        if isinstance(what, ReceivedMessage):
            return what.wire
        if isinstance(what, Message):
            return what
        items = sorted_items(Item.of(key, text) for key, text in items_of(metadata or {}))
        ticks = ns_to_ticks(self._clock.utc_ns() if time_ns is None else time_ns)
        content = content_of(what, value, matrix, unit)
        return Message(what, device, content, ticks, 2 if items else _AS_LINK, 0, items)

    def send(self, message: Message, to: int | None = None) -> int:
        """Send a message to one link, or to all; return to how many.  May wait, see ``when_full``."""
        with self.changed:
            if self.is_closed:
                self._raise_if_ended()
            links = sorted(self._up) if to is None else sorted(self._up & {to})
            versions = {link: self._version(message, link) for link in links}
        for version in sorted(set(versions.values())):
            data = join(encode(message if message.header_version == version else _as_version(message, version)))
            stream = f"{message.type}/{message.device_name}"
            keeps = self.options.when_full == "block"
            self._out([link for link in links if versions[link] == version], (data,), stream, keeps)
        return len(links)

    def _version(self, message: Message, link: int) -> int:
        """The header version of a message to a link; under the lock."""
        return message.header_version or self.options.header_version or self._versions.get(link, 1)

    def _the_link(self, to: int | None) -> int:
        """Return the link of a request: ``to``, or the only one.  Raises LinkClosed or ConfigError."""
        with self.changed:
            if to is not None and to in self._up:
                return to
            if to is not None or not self._up:
                self._raise_if_ended()
                wanted = "an open connection" if to is None else f"connection {to}"
                raise LinkClosed(f"{self.place}: found {counted(len(self._up), 'other connection')}, expected {wanted}")
            if len(self._up) > 1:
                raise ConfigError(
                    f"{self.place}: found {counted(len(self._up), 'connection')}, expected to=… to choose one"
                )
            return next(iter(self._up))

    # ── queries and commands ──────────────────────────────────────────────────────────────────────────────────

    def _expect(self, expected: Expected) -> Expected:
        """Keep the first message that ``expected`` selects for it."""
        with self.changed:
            self._expected.append(expected)
        return expected

    def _forget(self, expected: Expected) -> None:
        """The caller waits no longer."""
        with self.changed, suppress(ValueError):
            self._expected.remove(expected)

    def query(self, base: str, device: str, timeout_s: float | None, to: int | None) -> Wait[ReceivedMessage]:
        """Request one message (GET_…); wait for it."""
        expected = self._ask("GET", base, device, EmptyQuery(), to)
        text = f"{base}/{device or '*'} as the answer to a query"
        return self._reply(expected, timeout_s, text, lambda reply: self.answer_of(reply, "GET", base))

    def stream(
        self, prefix: str, base: str, device: str, content: Body, timeout_s: float | None, to: int | None
    ) -> Wait[None]:
        """Request a stream (STT_…) or its end (STP_…); wait for the acknowledgement, except with ``timeout_s=0``."""
        expected = self._ask(prefix, base, device, content, to)
        if timeout_s == 0:
            return Wait(lambda: True, timeout_s, "", lambda _: None, lambda: self._forget(expected))

        def finish(reply: ReceivedMessage) -> None:
            self.answer_of(reply, prefix, base)

        return self._reply(expected, timeout_s, f"an acknowledgement of {prefix}_ {base}", finish)

    def _ask(self, prefix: str, base: str, device: str, content: Body, to: int | None) -> Expected:
        """Send a query; return the expected reply."""
        base = ALIASES.get(base, base)
        name = query_name(prefix, base)
        if name not in QUERIES and prefix != "GET":
            raise ConfigError(f"{name}: found a type without streams, expected one such as TDATA, IMAGE or POLYDATA")
        link = self._the_link(to)

        def selects(message: ReceivedMessage) -> bool:
            if device and message.device != device:
                return False
            if prefix == "GET" and message.type == base:
                return True
            if message.query is not None:
                return message.query == ("RTS", base)
            failed = isinstance(message.content, Status) and message.content.code != _STATUS_OK
            return failed and message.device == device

        expected = self._expect(Expected(link, selects))
        try:
            self.send(Message(name, device, content, ns_to_ticks(self._clock.utc_ns()), _AS_LINK), link)
        except BaseException:
            self._forget(expected)
            raise
        return expected

    def answer_of(self, reply: ReceivedMessage, prefix: str, base: str) -> ReceivedMessage:
        """Return the reply to a query.  Raises Refused."""
        base = ALIASES.get(base, base)
        status = reply.content.status if isinstance(reply.content, QueryReply) else _OK
        # the library's RTS_POLYDATA has the opposite values
        acknowledged = reply.query == ("RTS", base) and (status == _OK or base == "POLYDATA")
        if acknowledged if prefix != "GET" else (reply.type == base and not reply.is_empty):
            return reply
        found = f"an empty {reply.type}" if reply.is_empty else f"{reply.type} {reply.describe()}"
        text = f"{self.place}: {query_name(prefix, base)} of {reply.device or 'any device'}: found {found}"
        raise Refused(f"{text}, expected {base if prefix == 'GET' else 'an acknowledgement'}")

    def command(
        self,
        name: str,
        text: str,
        device: str,
        metadata: Mapping[str, str] | None,
        timeout_s: float | None,
        to: int | None,
    ) -> Wait[CommandReply]:
        """Send a command; wait for its reply."""
        link = self._the_link(to)
        with self.changed:
            self._command_id = number = self._command_id % _MAX_COMMAND_ID + 1

        def selects(message: ReceivedMessage) -> bool:
            content = message.content
            return message.type == "RTS_COMMAND" and isinstance(content, Command) and content.command_id == number

        items = sorted_items(Item.of(key, value) for key, value in items_of(metadata or {}))
        content = Command.of(number, name, text)
        expected = self._expect(Expected(link, selects))
        try:
            ticks = ns_to_ticks(self._clock.utc_ns())
            self.send(Message("COMMAND", device, content, ticks, 2 if items else _AS_LINK, 0, items), link)
        except BaseException:
            self._forget(expected)
            raise
        return self._reply(expected, timeout_s, f"a reply to the command {name!r}", reply_of)

    def respond_to_command(self, message: ReceivedMessage, result: Any, error: Exception | None) -> None:
        """Send the reply to a command: the text that its handler returned, or a failure."""
        command = message.content
        if not isinstance(command, Command):
            return
        if error is None and not (result is None or isinstance(result, str)):
            raise ConfigError(f"command {message.name!r}: found {type(result).__name__}, expected a string or None")
        text = result or ""
        status = {"Status": "SUCCESS"} if error is None else {"Status": "FAIL", "ErrorMessage": str(error)}
        version = message.header_version
        if error is not None and version == 1:  # it has no metadata
            text = failure_text(message.name, str(error))
        items = sorted_items(Item.of(key, value) for key, value in status.items()) if version == 2 else ()
        content = Command.of(command.command_id, command.name, text)
        ticks = ns_to_ticks(self._clock.utc_ns())
        self.send(Message("RTS_COMMAND", message.wire.device_name, content, ticks, version, 0, items), message.link)

    def respond_to_query(self, message: ReceivedMessage, result: Any, error: Exception | None) -> None:
        """Send the answer to a query: the value that its handler returned, or a refusal."""
        prefix, base = message.query or ("GET", message.type)
        ticks, device = ns_to_ticks(self._clock.utc_ns()), message.wire.device_name
        good = error is None and result is not None
        out: Message
        if isinstance(result, Message) and good:
            out = result
        elif prefix == "GET" and good:
            out = Message(base, device, content_of(base, result), ticks, _AS_LINK)
        elif (name := query_name("RTS", base)) in QUERIES and prefix != "GET":
            out = Message(
                name, device, QueryReply(_OK if error is None and result is not False else 1), ticks, _AS_LINK
            )
        else:
            text = str(error) if error else f"there is no {base} {device}".rstrip()
            out = Message("STATUS", device, Status(4, 0, "NotFound", text), ticks, _AS_LINK)
        self.send(out, message.link)

    # ── what arrives ──────────────────────────────────────────────────────────────────────────────────────────

    def received(self, link: int, data: Buffer) -> None:
        """A link has received a message: for a caller that expects it, for a handler, or for the queue."""
        received_ns = self._clock.utc_ns()
        try:
            wire = decode(data, reading=READING)
        except WireError as error:
            with self.changed:
                self._received += 1
                self._invalid += 1
                self.notes.append(Note(Level.ERROR, error.code, f"{self.place}: invalid message: {error}"))
            return
        message = ReceivedMessage(wire, link, received_ns)
        size = total_size((data,))
        with self.changed:
            self._received += 1
            if wire.header_version > 1 and not wire.deviation:
                self._versions[link] = wire.header_version
            self._remember(message)
            expected = next((one for one in self._expected if one.link == link and one.selects(message)), None)
            if expected:
                self._expected.remove(expected)
                expected.reply = message
            elif any(handler.selects(message) for handler in self.handlers):
                self.to_handle.put(message, size)
            else:
                self.inbox.put(message, size)
            self._changed_now()

    def _remember(self, message: ReceivedMessage) -> None:
        stream = str(message)
        self._latest[stream] = message
        self._latest.move_to_end(stream)
        self._arrived[stream] += 1
        if len(self._latest) > _STREAMS:
            gone, _ = self._latest.popitem(last=False)
            del self._arrived[gone]

    def link_changed(self, link: int, up: bool, note: Note) -> None:
        """A link is up, or has ended."""
        with self.changed:
            self.notes.append(note)
            if up:
                self._up.add(link)
            else:
                self._up.discard(link)
                self._versions.pop(link, None)
                if self._ends:
                    self.ended = note.text
            self._changed_now()


def selector(type_name: str, device: str) -> Callable[[ReceivedMessage], bool]:
    """Return whether a message is of a type and a device (globs; "" selects all)."""
    wanted = ALIASES.get(type_name, type_name)
    return lambda message: (
        (not wanted or matches(wanted, message.type)) and (not device or matches(device, message.device))
    )


def reply_of(message: ReceivedMessage) -> CommandReply:
    """Return the reply to a command."""
    items = tuple(MetadataItem(key, 0, value) for key, value in message.metadata.items())
    status, reason, _ = reply_result(message.text, items)
    return CommandReply(message.name, message.text, status == RosReply.SUCCESS, reason, message)


def is_query(prefix: str, base: str) -> Callable[[ReceivedMessage], bool]:
    """Return whether a message is this query."""
    wanted = ALIASES.get(base, base)
    return lambda message: message.query == (prefix, wanted)


def is_command(name: str) -> Callable[[ReceivedMessage], bool]:
    """Return whether a message is a command whose name matches a glob."""
    return lambda message: (
        message.type == "COMMAND" and isinstance(message.content, Command) and matches(name, message.name)
    )


def start_content(base: str, interval_ms: float, coordinate_name: str, codec: str) -> Body:
    """Return the content of an STT_."""
    match QUERIES.get(query_name("STT", ALIASES.get(base, base)), EmptyQuery):
        case kind if kind is StartTracking:
            return StartTracking(round(interval_ms), coordinate_name)
        case kind if kind is StartVideo:
            return StartVideo(codec, round(interval_ms))
        case kind if kind is StartPolyData:
            return StartPolyData(round(interval_ms * NS_PER_MS))
        case kind if kind is StartBind:
            return StartBind(round(interval_ms * NS_PER_MS))
        case _:
            return EmptyQuery()


def _as_version(message: Message, version: int) -> Message:
    return replace(message, header_version=version, layout=None)
