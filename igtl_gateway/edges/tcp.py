"""The OpenIGTLink edge: servers and clients over TCP, any number of peers at once.

Strategy: one I/O thread around one selector accepts, connects, receives, frames and calls back.  Sending does
not pass through it: ``send`` writes to the socket in the caller's own thread as long as the peer keeps up, which
saves a thread hop per message.  Only what the kernel does not take at once is queued, and the I/O thread sends it
as the peer reads on.

Locks: each link has one, held for one non-blocking system call at most.  ``_changed`` (table of links, totals) may
be held while taking a link's lock, never the other way round.  No callback is ever made under either, and callbacks
are made by the I/O thread only; so a callback may take the caller's lock and ``send``, while another thread sends
under that same lock.

At the bound of a link's queue, see ``_Outbox``.
"""

from __future__ import annotations

import errno
import heapq
import ipaddress
import logging
import os
import select
import selectors
import socket
import threading
from collections import Counter, OrderedDict, deque
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import partial
from itertools import islice
from typing import Any, Literal

from igtl_gateway.buffers import Buffer
from igtl_gateway.clock import Clock
from igtl_gateway.errors import ConfigError, MessageTooLarge
from igtl_gateway.session.note import Level, Note
from igtl_gateway.stamp import NS_PER_S
from igtl_gateway.wire.framer import DEFAULT_MAX_BODY, HEADER_SIZE, Framer

_log = logging.getLogger(__name__)

_BACKLOG = 64  # connections that may wait while one callback runs
_IOV_MAX = 1024  # buffers that one sendmsg takes (IOV_MAX of Linux and macOS)
_CONNECT_TIMEOUT_S = 5.0  # the kernel's own would be two minutes
_RETRY_FIRST_S = 0.1  # as fast as 3D Slicer retries: a server that restarts is back at once
_RETRY_LAST_S = 5.0  # the longest that a user waits after switching the server on
_LIVED_S = 1.0  # a link that lasted this long, or brought a byte, was a real one: retry fast again
_DRAIN_S = 0.25  # how long stop() waits for peers to close their side
_NOTE_EVERY_S = 1.0  # repeated facts are noted at most this often
_BLOCKED_POLL_MS = 100  # how soon a waiting sender sees that its link was closed
_KEEPALIVE = (  # a peer that lost power is found after 10 + 3 x 5 s; silent ones that live are kept
    (socket.SOL_SOCKET, "SO_KEEPALIVE", 1),
    (socket.IPPROTO_TCP, "TCP_KEEPIDLE", 10),
    (socket.IPPROTO_TCP, "TCP_KEEPINTVL", 5),
    (socket.IPPROTO_TCP, "TCP_KEEPCNT", 3),
)

_PORT_MAX = 65535
_BODY_SIZE_AT = slice(42, 50)  # in the header, big-endian
_FAULTS = frozenset({"too_large", "out_of_memory", "stalled", "queue_full"})  # notes that end a link

_JOINED = 4096  # bytes of a message up to which one copied buffer is sent faster than several (3.5 µs against 5.5)

Role = Literal["server", "client"]
_Part = bytes | memoryview


@dataclass(frozen=True, slots=True)
class Limits:
    """What a peer can cost.  Raises ConfigError for a limit that is not positive.

    Attributes:
        max_clients: links at once that peers opened; the paper's setups have a handful, 32 shows a runaway.
        queue_bytes: what waits for one link; ten images in full HD, a second or two at a frame rate.
        queue_messages: the same in messages; four seconds of transforms at 1 kHz.
        stall_s: longest silence inside a message; TCP itself recovers from a lost packet well within it.
        max_body: longest body of a message received, in bytes; see ``DEFAULT_MAX_BODY``.
    """

    max_clients: int = 32
    queue_bytes: int = 64 * 2**20
    queue_messages: int = 4096
    stall_s: float = 10.0
    max_body: int = DEFAULT_MAX_BODY

    def __post_init__(self) -> None:
        for name in self.__slots__:
            if not getattr(self, name) > 0:
                raise ConfigError(f"limit {name}: found {getattr(self, name)}, expected more than 0")


@dataclass(frozen=True, slots=True)
class LinkInfo:
    """One peer, or one that ``connect`` is trying to reach (number 0, not connected)."""

    number: int
    peer: str
    role: Role
    connected: bool


@dataclass(frozen=True, slots=True)
class LinkCounters:
    """What went over one link so far.

    ``sent`` means handed to the kernel.  ``dropped`` counts per stream the messages that were taken and could not
    be sent: pushed out of the full queue, or left in it when the link closed.  ``ignored`` counts per stream the
    messages that were not taken: for links that were gone already, or that this very message made close.
    """

    sent_messages: int = 0
    sent_bytes: int = 0
    received_messages: int = 0
    received_bytes: int = 0
    queued_messages: int = 0
    queued_bytes: int = 0
    dropped: dict[str, int] = field(default_factory=dict)
    ignored: dict[str, int] = field(default_factory=dict)


class _Message:
    """One message on its way out: the buffers still to be sent."""

    __slots__ = ("keep", "left", "parts", "stream")

    def __init__(self, parts: Sequence[_Part], left: int, stream: str, keep: bool) -> None:
        self.parts = parts
        self.left = left
        self.stream = stream
        self.keep = keep

    def advance(self, count: int) -> None:
        """``count`` more bytes are sent (less than what is left)."""
        self.left -= count
        for index, part in enumerate(self.parts):
            if count < len(part):
                self.parts = [part[count:], *self.parts[index + 1 :]]
                return
            count -= len(part)


class _Outbox:
    """Messages waiting for one link, in order, within bounds.  Not locked: the link's lock guards it.

    A message that has begun to be sent is always finished; it stands apart and the bounds are for those behind
    it.  One message of any size may wait there.  When there is no room for a new message:

    1. the oldest waiting message of the same stream with ``keep=False`` is dropped: the newer one replaces it;
    2. else the oldest with ``keep=False`` of the stream that holds most of what has run out (bytes or messages);
    3. where dropping all of them would not do, nothing is dropped for it: the new message itself is, or, if it
       has ``keep=True`` as well, it is refused, and the link must be closed.
    """

    def __init__(self, limits: Limits) -> None:
        self.sent_messages = 0
        self.sent_bytes = 0
        self.dropped: Counter[str] = Counter()
        self.drops = 0  # pushed out
        self.unsent = 0  # left over at the end
        self.waiting_bytes = 0
        self._limits = limits
        self._begun: _Message | None = None
        self._waiting: OrderedDict[int, _Message] = OrderedDict()
        self._serial = 0
        # per stream the waiting messages that may be dropped, oldest first, and their bytes
        self._droppable: dict[str, deque[int]] = {}
        self._droppable_bytes: Counter[str] = Counter()
        self._kept_messages = 0
        self._kept_bytes = 0

    @property
    def empty(self) -> bool:
        return self._begun is None and not self._waiting

    @property
    def messages(self) -> int:
        return len(self._waiting) + (self._begun is not None)

    @property
    def bytes(self) -> int:
        return self.waiting_bytes + (self._begun.left if self._begun else 0)

    def has_room(self, size: int) -> bool:
        """Whether a message of ``size`` bytes can be added without dropping any."""
        return self._fits(len(self._waiting), self.waiting_bytes, size)

    def add(self, message: _Message) -> bool:
        """Add it, making room if need be; False if it is refused (case 3 above)."""
        if not self.has_room(message.left):
            if not self._fits(self._kept_messages, self._kept_bytes, message.left):
                if not message.keep:
                    self._count_drop(message)
                return not message.keep
            while not self.has_room(message.left):
                self._drop_one(message.stream)
        self._serial += 1
        self._waiting[self._serial] = message
        self.waiting_bytes += message.left
        if message.keep:
            self._kept_messages += 1
            self._kept_bytes += message.left
        else:
            self._droppable.setdefault(message.stream, deque()).append(self._serial)
            self._droppable_bytes[message.stream] += message.left
        return True

    def begin(self, message: _Message, sent: int) -> None:
        """To an empty box: a message of which the first ``sent`` bytes are sent."""
        message.advance(sent)
        self.sent_bytes += sent
        self._begun = message

    def count_sent(self, size: int) -> None:
        """A whole message of ``size`` bytes went past the empty box."""
        self.sent_messages += 1
        self.sent_bytes += size

    def parts(self) -> list[_Part]:
        """The next buffers to be sent, as many as one system call takes."""
        parts = list(self._begun.parts[:_IOV_MAX]) if self._begun else []
        for message in islice(self._waiting.values(), _IOV_MAX - len(parts)):
            parts += message.parts
            if len(parts) >= _IOV_MAX:
                return parts[:_IOV_MAX]
        return parts

    def advance(self, count: int) -> None:
        """The first ``count`` bytes of ``parts()`` are sent."""
        self.sent_bytes += count
        while count:
            message = self._begun or self._pop_first()
            if count < message.left:
                message.advance(count)
                self._begun = message
                return
            count -= message.left
            self._begun = None
            self.sent_messages += 1

    def clear(self) -> None:
        """Count everything that is left as dropped."""
        left = [self._begun] if self._begun else []
        self._begun = None
        while self._waiting:
            left.append(self._pop_first())
        self.unsent += len(left)
        self.dropped.update(message.stream for message in left)

    def _fits(self, messages: int, size: int, new: int) -> bool:
        limits = self._limits
        return not messages or (messages < limits.queue_messages and size + new <= limits.queue_bytes)

    def _pop_first(self) -> _Message:
        _, message = self._waiting.popitem(last=False)
        if message.keep:
            self._kept_messages -= 1
            self._kept_bytes -= message.left
        else:
            self._forget(message)  # the first of all is the first of its stream
        self.waiting_bytes -= message.left
        return message

    def _drop_one(self, stream: str) -> None:
        if stream not in self._droppable:
            if len(self._waiting) >= self._limits.queue_messages:
                stream = max(self._droppable, key=lambda name: len(self._droppable[name]))
            else:
                stream = max(self._droppable, key=self._droppable_bytes.__getitem__)
        message = self._waiting.pop(self._droppable[stream][0])
        self._forget(message)
        self.waiting_bytes -= message.left
        self._count_drop(message)

    def _forget(self, message: _Message) -> None:
        """Take the oldest of its stream off the books of what may be dropped."""
        self._droppable_bytes[message.stream] -= message.left
        self._droppable[message.stream].popleft()
        if not self._droppable[message.stream]:
            del self._droppable[message.stream], self._droppable_bytes[message.stream]

    def _count_drop(self, message: _Message) -> None:
        self.dropped[message.stream] += 1
        self.drops += 1


class _Link:
    """One connection.  ``lock`` guards ``outbox``, ``mute``, ``reason``, ``flagged``, ``drops_watched`` and sending."""

    def __init__(self, number: int, sock: socket.socket, role: Role, peer: str, limits: Limits) -> None:
        self.number = number
        self.sock = sock
        self.role: Role = role
        self.peer = peer
        self.local = _address(sock.getsockname())
        self.lock = threading.Lock()
        self.outbox = _Outbox(limits)
        self.mute = False  # nothing may be sent any more
        self.reason = ""  # why it is about to close
        self.flagged = False  # the I/O thread watches for room in the socket, or was asked to
        self.drops_watched = False  # the I/O thread knows that there are drops to note
        # of the I/O thread alone
        self.framer = Framer(limits.max_body)
        self.room = self.framer.buffer()
        self.up_ns = self.heard_ns = 0
        self.received_messages = 0
        self.received_bytes = 0
        self.drops_noted = 0
        self.open = True
        self.announced = False

    def counters(self) -> LinkCounters:
        with self.lock:
            box = self.outbox
            return LinkCounters(
                box.sent_messages,
                box.sent_bytes,
                self.received_messages,
                self.received_bytes,
                box.messages,
                box.bytes,
                dict(box.dropped),
            )


class _Dialer:
    """A server that ``connect`` was asked to reach; of the I/O thread alone."""

    def __init__(self, host: str, port: int) -> None:
        self.host = host
        self.port = port
        self.target = _address((host, port))
        self.delay_s = _RETRY_FIRST_S
        self.causes: set[str] = set()  # noted already in this outage
        self.addresses: list[tuple[int, Any]] = []  # family and address, still to be tried in this attempt
        self.sock: socket.socket | None = None
        self.link: _Link | None = None


class _Repeated:
    """A fact that may repeat quickly, noted at most once a second."""

    def __init__(self, make: Callable[[int], Note]) -> None:
        self.make = make
        self.count = 0
        self.noted = 0


class TcpEdge:
    """Frames in by callback, frames out by ``send``.  Link numbers count from 1 and are never used twice.

    Callbacks come from the I/O thread, one at a time: for each link first ``on_link(number, True, note)``, then
    its frames, then ``on_link(number, False, note)``.  One that raises is noted, and things go on.

    The clock paces retries, stalls and notes; it must run by itself.

    Args:
        on_frame: link number and one whole message, unchecked; the buffer is the receiver's to keep.
        on_link: a peer came (True) or went; the note's data has ``peer``, ``local``, ``role``, and, when it went,
            ``reason`` and the counts.
        on_note: link number (0 if none) and a fact: ``truncated``, ``too_large``, ``stalled``, ``out_of_memory``,
            ``queue_drop``, ``queue_full``, ``refused``, ``accept_failed``, ``connect_failed``, ``callback_failed``.
        clock: see above.
        limits: what a peer can cost.
        allow: networks (CIDR) whose peers may connect beside this host's own, or ``"any"``.
        when_full: ``"drop"``: ``send`` never waits, see ``_Outbox``; ``"block"``: ``send`` waits for room and
            nothing is lost while the link lives (except in callbacks, which must not wait for themselves).

    Raises ConfigError for a network that is none.
    """

    def __init__(
        self,
        *,
        on_frame: Callable[[int, Buffer], None],
        on_link: Callable[[int, bool, Note], None],
        on_note: Callable[[int, Note], None],
        clock: Clock,
        limits: Limits = Limits(),
        allow: Sequence[str] = (),
        when_full: Literal["drop", "block"] = "drop",
    ) -> None:
        self._on_frame = on_frame
        self._on_link = on_link
        self._on_note = on_note
        self._clock = clock
        self._limits = limits
        self._allow_any = "any" in allow
        self._networks = [_network(text) for text in allow if text != "any"]
        self._blocking = when_full == "block"

        self._changed = threading.Condition()  # guards _links, _ignored, _gone; told when a waiter should look again
        self._links: dict[int, _Link] = {}
        self._ignored: Counter[str] = Counter()
        self._gone = LinkCounters()

        self._thread = threading.Thread(target=self._run, name="igtl-tcp", daemon=True)
        self._stopping = False
        self._closing = False  # the last phase of stopping: every link is being shut down
        self._finished = False
        self._flush_s = 0.0

        self._selector = selectors.DefaultSelector()
        self._wake_in, self._wake_out = socket.socketpair()
        self._wake_in.setblocking(False)
        self._wake_out.setblocking(False)
        self._selector.register(self._wake_in, selectors.EVENT_READ, lambda _: self._woken())
        self._todo: deque[Callable[[], None]] = deque()
        self._timers: list[tuple[int, int, Callable[[], None]]] = []
        self._serial = 0
        self._last_number = 0
        self._listeners: list[socket.socket] = []
        self._dialers: list[_Dialer] = []
        self._repeated: dict[str, _Repeated] = {}

    # ── for any thread ────────────────────────────────────────────────────────────────────────────────────────

    def listen(self, host: str, port: int) -> tuple[str, int]:
        """Serve peers at this address; port 0 chooses a free one.  Returns the address and port bound.

        Raises ConfigError if the address is invalid or taken, or open to other hosts without an allow-list.
        """
        guarded = self._allow_any or bool(self._networks)
        listener = _listening_socket(host, port, guarded)
        self._listeners.append(listener)
        self._post(partial(self._watch_listener, listener))
        bound: tuple[str, int] = listener.getsockname()[:2]
        return bound

    def connect(self, host: str, port: int) -> None:
        """Stay connected to this server: try until it is there, and again whenever it goes.

        Raises ConfigError for a port out of range.  Anything else may mend itself, and is noted.
        """
        if not 1 <= port <= _PORT_MAX:
            raise ConfigError(f"connect {host}: found port {port}, expected 1 to {_PORT_MAX}")
        dialer = _Dialer(host, port)
        self._dialers.append(dialer)
        self._post(partial(self._dial, dialer))

    def start(self) -> None:
        """Start the I/O thread; once."""
        self._thread.start()

    def send(self, links: Sequence[int], buffers: Sequence[Buffer], stream: str, keep: bool) -> None:
        """Send one message, as buffers one after the other, to each of these links.

        The buffers must not change afterwards: what the kernel does not take at once is queued as it is.
        Messages leave a link in the order of the calls.  Links that are gone are ignored and counted.
        Raises TypeError or BufferError, with nothing sent, for a buffer that is not contiguous.
        """
        size = sum([memoryview(buffer).nbytes for buffer in buffers])
        parts: Sequence[_Part]
        if size <= _JOINED:
            parts = (b"".join(buffers),)
        else:
            # cast() refuses arrays with a zero in their shape
            parts = [memoryview(buffer).cast("B") for buffer in buffers if memoryview(buffer).nbytes]
        for number in links:
            link = self._links.get(number)
            if link is None or not self._send_on(link, parts, size, stream, keep):
                with self._changed:
                    self._ignored[stream] += 1

    def counters(self) -> dict[int, LinkCounters]:
        """Counts per link that is up; under 0 those of all links that are gone, taken together."""
        with self._changed:
            counts = {number: link.counters() for number, link in self._links.items()}
            return {0: _sum(self._gone, LinkCounters(ignored=dict(self._ignored)))} | counts

    def flush(self, timeout_s: float) -> bool:
        """Wait until nothing is queued for any link; False if that took too long."""
        return self._wait(lambda: all(link.outbox.empty for link in self._links.values()), timeout_s)

    def links(self) -> list[LinkInfo]:
        """The peers, and the servers that are not there yet."""
        with self._changed:
            live = [LinkInfo(link.number, link.peer, link.role, True) for link in self._live()]
        return live + [LinkInfo(0, dialer.target, "client", False) for dialer in self._dialers if not dialer.link]

    def wait_links(self, count: int, timeout_s: float | None) -> bool:
        """Wait until at least ``count`` links are up; False if that took too long or the edge was stopped."""
        return self._wait(lambda: len(self._live()) >= count, timeout_s)

    def stop(self, flush_s: float = 1.0) -> None:
        """Accept no more, send what is queued (for ``flush_s`` seconds at most), close all links, end the thread.

        Frames that arrive meanwhile are still delivered: do not call it under a lock that callbacks take.
        Further calls do nothing; from a callback it only asks, and returns at once.
        """
        with self._changed:
            if not self._stopping:
                self._flush_s = flush_s
                self._stopping = True
            self._changed.notify_all()
        self._wake()
        if self._thread.ident is None:
            self._finish()
        elif not self._in_io_thread():
            self._thread.join()

    # ── sending, in the caller's thread ───────────────────────────────────────────────────────────────────────

    def _send_on(self, link: _Link, parts: Sequence[_Part], size: int, stream: str, keep: bool) -> bool:
        """Send or queue; False if the link takes nothing any more."""
        while True:
            with link.lock:
                box = link.outbox
                if link.mute:
                    return False
                if box.empty:
                    sent = self._write(link, parts[:_IOV_MAX])
                    if sent == size:
                        box.count_sent(size)
                        return True
                    return self._queue(link, _Message(parts, size, stream, keep), sent)
                waits = self._blocking and not self._in_io_thread()
                if not waits or box.has_room(size):
                    return self._queue(link, _Message(parts, size, stream, keep), 0)
                # Not left to the I/O thread, which may be waiting for a lock that our caller holds.
                box.advance(self._write(link, box.parts()))
                descriptor = link.sock.fileno()
                full = not box.has_room(size)
            if full:
                if self._stopping:
                    return False
                # If the link is closed meanwhile, this returns at once or late, and the loop finds it mute.
                poll = select.poll()
                poll.register(descriptor, select.POLLOUT)
                poll.poll(_BLOCKED_POLL_MS)

    def _queue(self, link: _Link, message: _Message, sent: int) -> bool:
        """Queue what is left of the message; under the link's lock."""
        if link.mute:
            return False
        box = link.outbox
        drops = box.drops
        if sent:
            box.begin(message, sent)
        elif not box.add(message):
            link.mute = True
            link.reason = "the send queue is full of messages that must not be dropped"
            box.clear()
            self._post(partial(self._overflowed, link))
            return False
        if not link.flagged:
            link.flagged = True
            self._post(partial(self._watch_room, link))
        if box.drops > drops and not link.drops_watched:
            link.drops_watched = True
            self._post(partial(self._note_drops, link))
        return True

    def _write(self, link: _Link, parts: Sequence[_Part]) -> int:
        """Bytes that the kernel takes now; under the link's lock.  A link that fails is muted, and 0 returned."""
        try:
            return link.sock.send(parts[0]) if len(parts) == 1 else link.sock.sendmsg(parts)
        except (BlockingIOError, InterruptedError):
            return 0
        except OSError as exc:
            link.mute = True
            link.reason = f"sending failed: {exc.strerror or exc}"
            link.outbox.clear()
            # what the peer has sent before is still read, then the I/O thread finds the end and closes
            with suppress(OSError):
                link.sock.shutdown(socket.SHUT_RDWR)
            return 0

    # ── the I/O thread: turns ─────────────────────────────────────────────────────────────────────────────────

    def _in_io_thread(self) -> bool:
        return threading.get_ident() == self._thread.ident

    def _post(self, action: Callable[[], None]) -> None:
        """Let the I/O thread do this soon."""
        self._todo.append(action)
        if not self._in_io_thread():
            self._wake()

    def _wake(self) -> None:
        with suppress(OSError):  # full: it is awake already; closed: it has ended
            self._wake_out.send(b"\0")

    def _woken(self) -> None:
        with suppress(BlockingIOError):
            self._wake_in.recv(4096)

    def _later(self, delay_s: float, action: Callable[[], None]) -> None:
        self._serial += 1
        heapq.heappush(self._timers, (self._now() + round(delay_s * NS_PER_S), self._serial, action))

    def _now(self) -> int:
        return self._clock.monotonic_ns()

    def _run(self) -> None:
        self._sweep()
        while not self._stopping:
            self._turn(None)
        self._finish()

    def _turn(self, deadline_ns: int | None) -> None:
        """Wait for something to do, not beyond the deadline, and do it."""
        if self._timers and (deadline_ns is None or self._timers[0][0] < deadline_ns):
            deadline_ns = self._timers[0][0]
        timeout = None
        if self._todo:
            timeout = 0.0
        elif deadline_ns is not None:
            timeout = max(0, deadline_ns - self._now()) / NS_PER_S
        for key, mask in self._selector.select(timeout):
            key.data(mask)
        while self._todo:
            self._todo.popleft()()
        # after the sockets, so that a peer is not called silent for what was waiting in the kernel
        while self._timers and self._timers[0][0] <= self._now():
            heapq.heappop(self._timers)[2]()

    def _finish(self) -> None:
        """The orderly end: flush, half-close, read out, close."""
        if self._finished:
            return
        for listener in self._listeners:
            self._unwatch(listener)
            listener.close()
        for dialer in self._dialers:
            self._hang_up(dialer)
        deadline_ns = self._now() + round(self._flush_s * NS_PER_S)
        while any(not link.outbox.empty for link in self._links.values()) and self._now() < deadline_ns:
            self._turn(deadline_ns)
        for link in self._links.values():
            with link.lock:
                link.mute = True
                link.reason = link.reason or "stopped"
                with suppress(OSError):
                    link.sock.shutdown(socket.SHUT_WR)
        # Closing with unread bytes resets the connection, and the peer could lose the last that we sent.
        deadline_ns = self._now() + round(_DRAIN_S * NS_PER_S)
        while self._links and self._now() < deadline_ns:
            self._turn(deadline_ns)
        for link in list(self._links.values()):
            self._close(link, link.reason)
        self._selector.close()
        self._wake_in.close()
        self._wake_out.close()
        self._finished = True

    # ── the I/O thread: links ─────────────────────────────────────────────────────────────────────────────────

    def _up(self, sock: socket.socket, peer: str, dialer: _Dialer | None = None) -> None:
        sock.setblocking(False)
        sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        for level, option, value in _KEEPALIVE:
            if hasattr(socket, option):
                sock.setsockopt(level, getattr(socket, option), value)
        self._last_number += 1
        role: Role = "client" if dialer else "server"
        link = _Link(self._last_number, sock, role, peer, self._limits)
        if dialer:
            dialer.link = link
        link.up_ns = link.heard_ns = self._now()
        with self._changed:
            self._links[link.number] = link
        self._selector.register(sock, selectors.EVENT_READ, partial(self._ready, link))
        data = {"peer": peer, "local": link.local, "role": role}
        text = f"{peer} connected to {link.local}" if role == "server" else f"connected to {peer}"
        self._call("on_link", self._on_link, link.number, True, Note(Level.INFO, "link_up", text, data=data))
        with self._changed:
            link.announced = True
            self._changed.notify_all()

    def _live(self) -> list[_Link]:
        return [link for link in self._links.values() if link.announced]

    def _ready(self, link: _Link, mask: int) -> None:
        if link.open and mask & selectors.EVENT_WRITE:
            self._drain(link)
        if link.open and mask & selectors.EVENT_READ:
            self._read(link)

    def _read(self, link: _Link) -> None:
        try:
            count = link.sock.recv_into(link.room)
        except (BlockingIOError, InterruptedError):
            return
        except OSError as exc:
            self._close(link, link.reason or f"receiving failed: {exc.strerror or exc}")
            return
        if not count:
            self._close(link, link.reason or "closed by the peer")
            return
        link.heard_ns = self._now()
        link.received_bytes += count
        try:
            for message in link.framer.received(count):
                link.received_messages += 1
                self._call("on_frame", self._on_frame, link.number, message)
            link.room = link.framer.buffer()
        except MessageTooLarge as exc:
            self._fault(link, Level.ERROR, "too_large", f"message too large: {exc}")
        except MemoryError:
            self._fault(link, Level.ERROR, "out_of_memory", "no memory for the message that the peer announces")

    def _drain(self, link: _Link) -> None:
        """There is room in the socket."""
        with link.lock:
            box = link.outbox
            if not box.empty:
                box.advance(self._write(link, box.parts()))
            if not box.empty:
                return
            link.flagged = False
            self._selector.modify(link.sock, selectors.EVENT_READ, partial(self._ready, link))
        with self._changed:
            self._changed.notify_all()

    def _watch_room(self, link: _Link) -> None:
        if link.open:
            both = selectors.EVENT_READ | selectors.EVENT_WRITE
            self._selector.modify(link.sock, both, partial(self._ready, link))

    def _overflowed(self, link: _Link) -> None:
        if link.open:
            self._fault(link, Level.ERROR, "queue_full", f"{link.peer} does not read: {link.reason}")

    def _sweep(self) -> None:
        """Close the links that fell silent inside a message."""
        for link in list(self._links.values()):
            silent_s = (self._now() - link.heard_ns) / NS_PER_S
            if link.framer.pending and silent_s > self._limits.stall_s:
                self._fault(link, Level.WARN, "stalled", f"{link.peer} sent half a message, then nothing")
        self._later(min(self._limits.stall_s / 4, 1.0), self._sweep)

    def _fault(self, link: _Link, level: Level, code: str, text: str) -> None:
        """Note what is wrong with the link, and close it."""
        self._note(link.number, Note(level, code, text, data=_unfinished(link) | {"peer": link.peer}))
        self._close(link, code)

    def _close(self, link: _Link, reason: str) -> None:
        link.open = False
        with link.lock:
            link.mute = True
        self._note_drops(link)
        with link.lock:
            link.outbox.clear()
            self._selector.unregister(link.sock)
            link.sock.close()
        counts = link.counters()
        if link.framer.pending and reason not in _FAULTS:
            data = _unfinished(link) | {"peer": link.peer}
            text = f"{link.peer} went inside a message: {data['received']} of {data['expected'] or '?'} bytes"
            self._note(link.number, Note(Level.WARN, "truncated", text, data=data))
        with self._changed:
            del self._links[link.number]
            self._gone = _sum(self._gone, counts)
        data = {
            "peer": link.peer,
            "local": link.local,
            "role": link.role,
            "reason": reason,
            "sent_messages": counts.sent_messages,
            "sent_bytes": counts.sent_bytes,
            "received_messages": counts.received_messages,
            "received_bytes": counts.received_bytes,
            "dropped": counts.dropped,
            "unsent": link.outbox.unsent,
        }
        note = Note(Level.INFO, "link_down", f"{link.peer} disconnected: {reason}", data=data)
        self._call("on_link", self._on_link, link.number, False, note)
        with self._changed:
            self._changed.notify_all()
        for dialer in self._dialers:
            if dialer.link is link:
                self._redial(dialer)

    # ── the I/O thread: servers ───────────────────────────────────────────────────────────────────────────────

    def _watch_listener(self, listener: socket.socket) -> None:
        if not self._stopping:
            self._selector.register(listener, selectors.EVENT_READ, lambda _: self._accept(listener))

    def _accept(self, listener: socket.socket) -> None:
        try:
            sock, address = listener.accept()
        except (BlockingIOError, InterruptedError, ConnectionAbortedError):
            return
        except OSError as exc:
            # out of descriptors, mostly: the listener would stay ready and the loop spin
            text = f"cannot accept connections at {_address(listener.getsockname())}: {exc.strerror}"
            self._note(0, Note(Level.ERROR, "accept_failed", text))
            self._unwatch(listener)
            self._later(_NOTE_EVERY_S, partial(self._watch_listener, listener))
            return
        peer = _address(address)
        if not self._allowed(address[0]):
            self._refuse(sock, peer, "not in the allow-list")
        elif sum(link.role == "server" for link in self._links.values()) >= self._limits.max_clients:
            self._refuse(sock, peer, f"{self._limits.max_clients} clients are connected already")
        else:
            self._up(sock, peer)

    def _allowed(self, host: str) -> bool:
        ip = _ip(host)
        return ip.is_loopback or self._allow_any or any(ip in network for network in self._networks)

    def _refuse(self, sock: socket.socket, peer: str, reason: str) -> None:
        sock.close()

        def make(count: int) -> Note:
            data = {"peer": peer, "reason": reason, "count": count}
            return Note(Level.WARN, "refused", f"connection of {peer} refused: {reason}", data=data)

        self._note_slowly(f"refused: {reason}", make)

    def _unwatch(self, sock: socket.socket) -> None:
        with suppress(KeyError):
            self._selector.unregister(sock)

    # ── the I/O thread: clients ───────────────────────────────────────────────────────────────────────────────

    def _dial(self, dialer: _Dialer) -> None:
        """Begin an attempt: find the addresses of the server."""
        if self._stopping:
            return
        try:
            self._found(dialer, _resolve(dialer.host, dialer.port, numeric=True), "")
        except OSError:
            # a name server can take seconds: not in this thread
            threading.Thread(target=self._look_up, args=(dialer,), name="igtl-resolve", daemon=True).start()

    def _look_up(self, dialer: _Dialer) -> None:
        try:
            found, cause = _resolve(dialer.host, dialer.port, numeric=False), ""
        except OSError as exc:
            found, cause = [], f"{exc.strerror or exc}"
        self._post(partial(self._found, dialer, found, cause))

    def _found(self, dialer: _Dialer, addresses: list[tuple[int, Any]], cause: str) -> None:
        dialer.addresses = addresses
        self._dial_next(dialer, cause)

    def _dial_next(self, dialer: _Dialer, cause: str) -> None:
        """Try the next address, or give up this attempt for the cause."""
        if self._stopping:
            return
        if not dialer.addresses:
            self._dial_failed(dialer, cause)
            return
        family, address = dialer.addresses.pop(0)
        try:
            dialer.sock = sock = socket.socket(family, socket.SOCK_STREAM)
        except OSError as exc:
            self._dial_next(dialer, f"{exc.strerror}")
            return
        sock.setblocking(False)
        code = sock.connect_ex(address)
        if code not in (0, errno.EINPROGRESS):
            sock.close()
            self._dial_next(dialer, os.strerror(code))
            return
        self._selector.register(sock, selectors.EVENT_WRITE, lambda _: self._dialled(dialer, sock, address))
        self._later(_CONNECT_TIMEOUT_S, partial(self._dial_timed_out, dialer, sock))

    def _dialled(self, dialer: _Dialer, sock: socket.socket, address: Any) -> None:
        self._selector.unregister(sock)
        dialer.sock = None
        code = sock.getsockopt(socket.SOL_SOCKET, socket.SO_ERROR)
        # A free port of the ephemeral range can be connected to itself; nobody is there.
        if not code and sock.getsockname()[:2] == address[:2]:
            code = errno.ECONNREFUSED
        if code:
            sock.close()
            self._dial_next(dialer, os.strerror(code))
            return
        self._up(sock, _address(address), dialer)

    def _dial_timed_out(self, dialer: _Dialer, sock: socket.socket) -> None:
        if dialer.sock is sock:
            self._hang_up(dialer)
            self._dial_next(dialer, os.strerror(errno.ETIMEDOUT))

    def _hang_up(self, dialer: _Dialer) -> None:
        if dialer.sock:
            self._selector.unregister(dialer.sock)
            dialer.sock.close()
            dialer.sock = None

    def _dial_failed(self, dialer: _Dialer, cause: str) -> None:
        if cause not in dialer.causes:
            dialer.causes.add(cause)
            text = f"cannot connect to {dialer.target}: {cause}; trying on"
            self._note(0, Note(Level.WARN, "connect_failed", text, data={"peer": dialer.target, "reason": cause}))
        self._retry(dialer)

    def _redial(self, dialer: _Dialer) -> None:
        """Its link has gone."""
        link, dialer.link = dialer.link, None
        if link and (link.received_bytes or self._now() - link.up_ns >= _LIVED_S * NS_PER_S):
            dialer.delay_s = _RETRY_FIRST_S
            dialer.causes.clear()
        self._retry(dialer)

    def _retry(self, dialer: _Dialer) -> None:
        self._later(dialer.delay_s, partial(self._dial, dialer))
        dialer.delay_s = min(2 * dialer.delay_s, _RETRY_LAST_S)

    # ── the I/O thread: callbacks ─────────────────────────────────────────────────────────────────────────────

    def _call(self, name: str, callback: Callable[..., None], *args: object) -> None:
        try:
            callback(*args)
        except Exception as exc:
            cause = f"{type(exc).__name__}: {exc}"
            _log.debug("%s raised", name, exc_info=exc)

            def make(count: int) -> Note:
                data = {"callback": name, "error": cause, "count": count}
                return Note(Level.ERROR, "callback_failed", f"{name} raised {cause}", data=data)

            self._note_slowly(f"{name} raised {type(exc).__name__}", make)

    def _note(self, number: int, note: Note) -> None:
        try:
            self._on_note(number, note)
        except Exception:  # the last resort: there is nobody left to tell
            _log.exception("on_note raised at: %s", note.text)

    def _note_slowly(self, fact: str, make: Callable[[int], Note]) -> None:
        """Note a fact now, and while it repeats once a second with the count."""
        repeated = self._repeated.get(fact)
        if repeated is None:
            repeated = self._repeated[fact] = _Repeated(make)
            self._post(partial(self._note_repeated, fact, repeated))
        repeated.make = make
        repeated.count += 1

    def _note_repeated(self, fact: str, repeated: _Repeated) -> None:
        if repeated.count == repeated.noted:
            del self._repeated[fact]
            return
        repeated.noted = repeated.count
        self._note(0, repeated.make(repeated.count))
        self._later(_NOTE_EVERY_S, partial(self._note_repeated, fact, repeated))

    def _note_drops(self, link: _Link) -> None:
        """Note the drops so far, and again in a second if there are more."""
        with link.lock:
            box = link.outbox
            if box.drops == link.drops_noted:
                link.drops_watched = False
                return
            link.drops_noted = box.drops
            data = {"peer": link.peer, "dropped": dict(box.dropped), "messages": box.messages, "bytes": box.bytes}
            drops = box.drops
        text = f"{link.peer} reads too slowly: {drops} messages dropped so far"
        self._note(link.number, Note(Level.WARN, "queue_drop", text, data=data))
        self._later(_NOTE_EVERY_S, partial(self._note_drops, link))

    def _wait(self, condition: Callable[[], bool], timeout_s: float | None) -> bool:
        if self._in_io_thread():  # it would wait for itself
            timeout_s = 0.0
        with self._changed:
            self._changed.wait_for(lambda: self._stopping or condition(), timeout_s)
            return condition()


def _unfinished(link: _Link) -> dict[str, Any]:
    """Facts about the message that the link is inside of."""
    head = link.framer.pending_head()
    expected = HEADER_SIZE + int.from_bytes(head[_BODY_SIZE_AT], "big") if len(head) == HEADER_SIZE else None
    return {"received": link.framer.pending, "expected": expected, "head": head.hex()}


def _sum(one: LinkCounters, other: LinkCounters) -> LinkCounters:
    return LinkCounters(
        one.sent_messages + other.sent_messages,
        one.sent_bytes + other.sent_bytes,
        one.received_messages + other.received_messages,
        one.received_bytes + other.received_bytes,
        one.queued_messages + other.queued_messages,
        one.queued_bytes + other.queued_bytes,
        dict(Counter(one.dropped) + Counter(other.dropped)),
        dict(Counter(one.ignored) + Counter(other.ignored)),
    )


def _address(address: Any) -> str:
    """``host:port`` of a socket address, ``[host]:port`` for IPv6."""
    host, port = address[:2]
    return f"[{host}]:{port}" if ":" in host else f"{host}:{port}"


def _ip(host: str) -> ipaddress.IPv4Address | ipaddress.IPv6Address:
    """The address without its scope, and without the IPv6 form of an IPv4 address."""
    ip = ipaddress.ip_address(host.partition("%")[0])
    return getattr(ip, "ipv4_mapped", None) or ip


def _network(text: str) -> ipaddress.IPv4Network | ipaddress.IPv6Network:
    try:
        return ipaddress.ip_network(text)
    except ValueError as exc:
        raise ConfigError(
            f'allow: found {text!r} ({exc}), expected "any" or a network such as 192.168.1.0/24'
        ) from None


def _resolve(host: str, port: int, *, numeric: bool) -> list[tuple[int, Any]]:
    """Family and address of a host, IPv4 first: that is where the peers listen.  Raises OSError."""
    flags = socket.AI_NUMERICHOST if numeric else 0
    found = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM, flags=flags)
    return sorted(((family, address) for family, _, _, _, address in found), key=lambda one: one[0] != socket.AF_INET)


def _listening_socket(host: str, port: int, guarded: bool) -> socket.socket:
    """A listening socket; see ``TcpEdge.listen``.  ``guarded``: there is an allow-list."""
    place = f"listen {_address((host, port))}"
    if not 0 <= port <= _PORT_MAX:
        raise ConfigError(f"{place}: found port {port}, expected 0 (any) to {_PORT_MAX}")
    try:
        family, address = _resolve(host, port, numeric=False)[0]
    except (OSError, UnicodeError) as exc:
        raise ConfigError(f"{place}: found host {host!r} ({exc}), expected an address of this machine") from None
    if not (guarded or _ip(address[0]).is_loopback):
        raise ConfigError(
            f"{place}: open to other hosts, but nobody is allowed to connect; "
            'allow networks such as 192.168.1.0/24, or "any" for everybody'
        )
    listener = socket.socket(family, socket.SOCK_STREAM)
    try:
        # a restart must not wait for the connections of the run before to time out
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listener.bind(address)
        listener.listen(_BACKLOG)
        listener.setblocking(False)
    except OSError as exc:
        listener.close()
        if exc.errno == errno.EADDRINUSE:
            raise ConfigError(f"{place}: the port is in use by another program; stop it or choose another") from None
        raise ConfigError(f"{place}: {exc.strerror or exc}") from None
    return listener
