"""The outgoing half of a link: the caller's thread writes to the socket, the I/O thread sends what is queued."""

from __future__ import annotations

import select
import socket
import sys
import threading
from bisect import bisect_right
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, suppress

from igtl_gateway.base.quantities import count_text
from igtl_gateway.edges.tcp.layer import AnySocket, send_parts
from igtl_gateway.edges.tcp.link_parts import LinkContext, LinkLife, NativeEnds
from igtl_gateway.edges.tcp.outbox import IOV_MAX, Outbox, Part, QueuedMessage
from igtl_gateway.edges.tcp.reporter import NOTE_EVERY_S
from igtl_gateway.gateway.log.note import Level, Note

_BLOCKED_POLL_MS = 100  # the longest time after which a waiting sender notices that its link was closed


class Sender:
    """Sends messages, or queues them.

    ``lock`` guards all attributes but ``awaits_room`` and ``is_inside_message``, which belong to the I/O thread.

    Attributes:
        outbox: the send queue.
        is_muted: nothing may be sent any more.
        reason: why the link is about to close, ``""`` if it is not.
        peer_ended: the peer sends no more; what is queued for it is still sent.
        awaits_room: the I/O thread waits until the socket takes more.
        is_inside_message: bytes are on their way to the socket: an error here loses the place in the stream.
    """

    def __init__(
        self,
        sock: AnySocket,
        link: LinkLife,
        context: LinkContext,
        native: NativeEnds | None = None,
    ) -> None:
        self.outbox = Outbox(context.limits)
        self.lock: AbstractContextManager[object] = native.lock if native else threading.Lock()
        self._native = native.link if native else None
        self._muted = False
        self.reason = ""
        self.peer_ended = False
        self.awaits_room = False
        self.is_inside_message = False
        self._sock = sock
        self._link = link
        self._loop = context.loop
        self._reporter = context.reporter
        self._room_requested = False  # the I/O thread waits for room in the socket, or was asked to
        self._drops_watched = False  # the I/O thread has been informed of drops that are not noted yet
        self._drops_noted = 0

    # ── for any thread ────────────────────────────────────────────────────────────────────────────────────────

    @property
    def is_muted(self) -> bool:
        """Nothing may be sent any more."""
        return self._muted

    @is_muted.setter
    def is_muted(self, muted: bool) -> None:
        self._muted = muted
        self._settle()

    @property
    def sent_bytes(self) -> int:
        """Bytes that the kernel has taken so far."""
        return self.outbox.sent_bytes + (self._native.sent_bytes if self._native else 0)

    def take_unsent(self) -> None:
        """Queue what the native passage could not send."""
        with self.lock:
            self._take_unsent()

    def send(self, parts: Sequence[Part], size: int, stream: str, keep: bool, waits: bool) -> bool:
        """Send or queue a message; False if the link takes nothing any more.

        ``waits``: wait for room in the queue, if it is full.
        """
        while True:
            with self.lock:
                box = self.outbox
                self._take_unsent()
                if self._muted:
                    return False
                if box.empty:
                    sent = self._write(parts[:IOV_MAX])
                    if sent == size:
                        box.count_sent(size)
                        return True
                    return self._queue(QueuedMessage(parts, size, stream, keep), sent)
                if not waits or box.has_room(size):
                    # who waits for room wants the order, too: a replay
                    return self._queue(QueuedMessage(parts, size, stream, keep or waits), 0)
                # Not left to the I/O thread, which may be waiting for a lock that our caller holds.
                box.advance(self._write(box.parts()))
                self._settle()
                descriptor = self._sock.fileno()
                full = not box.has_room(size)
            if full:
                if self._loop.stopping:
                    return False
                _await_room(descriptor)

    def send_batch(
        self, data: Part, ends: Sequence[int], streams: Sequence[str], waits: bool, is_urgent: Callable[[], bool]
    ) -> int:
        """Send or queue messages that follow each other in one buffer, none to be dropped.

        Args:
            data: all messages.
            ends: the end of each message in ``data``.
            streams: the stream of each message.
            waits: until the kernel has taken them, except perhaps the end of the last one.
            is_urgent: returns whether to stop waiting: then as many messages are queued as there is room for.

        Returns:
            The number of messages that the link took.
        """
        view, at, taken = memoryview(data), 0, 0  # bytes and messages that are the link's

        def queue(sent: int) -> bool:
            nonlocal at, taken
            end = ends[taken]
            if not self._queue(QueuedMessage((view[at:end],), end - at, streams[taken], True), sent):
                return False
            at, taken = end, taken + 1
            return True

        while True:
            with self.lock:
                box = self.outbox
                self._take_unsent()
                if not box.empty:
                    box.advance(self._write(box.parts()))
                    self._settle()
                if box.empty and not self.is_muted:
                    sent = at + self._write((view[at:],))
                    whole = bisect_right(ends, sent)
                    if whole > taken:
                        box.count_sent(ends[whole - 1] - at, whole - taken)
                        at, taken = ends[whole - 1], whole
                    if sent > at:
                        queue(sent - at)
                urgent = waits and is_urgent()
                while (
                    (urgent or not waits)
                    and taken < len(ends)
                    and (not waits or box.has_room(ends[taken] - at))
                    and queue(0)
                ):
                    pass
                if self.is_muted or taken == len(ends) or self._loop.stopping or urgent:
                    return taken
                descriptor = self._sock.fileno()
            _await_room(descriptor)

    @property
    def all_sent(self) -> bool:
        """Whether the kernel has everything that was to be sent."""
        return self.outbox.empty and not self.backlog and not (self._native and self._native.unsent_bytes)

    @property
    def backlog(self) -> int:
        """Bytes that left the queue and are not yet the kernel's."""
        return 0

    def _take_unsent(self) -> None:
        """``take_unsent`` under the lock."""
        while self._native and not self._native.clear and (unsent := self._native.take_unsent()):
            data, sent, stream, keep = unsent
            if not data:
                self._lose(stream, sent)
            elif not self._queue(QueuedMessage((data,), len(data), stream, keep), self._begun(data, sent)):
                self.outbox.dropped[stream] += 1

    def _begun(self, message: bytes, sent: int) -> int:
        """The native passage has sent bytes for this message: return how many of the message; under the lock."""
        return sent

    def _lose(self, stream: str, sent: int) -> None:
        """There was no memory for the rest of a message, of which ``sent`` bytes are sent; under the lock."""
        self.outbox.dropped[stream] += 1
        if sent:  # the peer takes what would follow for the rest
            self._fail("there was no memory for the rest of a message")
        else:
            self._settle()

    def _settle(self) -> None:
        """Let the native passage send, or no more; under the lock."""
        if self._native:
            self._native.muted = self._muted
            self._native.clear = self.outbox.empty and not self._muted

    def _queue(self, message: QueuedMessage, sent: int) -> bool:
        """Queue the rest of the message; under the lock."""
        if self.is_muted:
            return False
        if self._native:
            self._native.clear = False
        box = self.outbox
        drops = box.drops
        if sent:
            box.begin(message, sent)
        elif not box.add(message):
            self.is_muted = True
            self.reason = "the send queue is full of messages that must not be dropped"
            box.clear()
            self._loop.call_soon(self._overflowed, self._link.failed)
            return False
        self._request_room()
        if box.drops > drops and not self._drops_watched:
            self._drops_watched = True
            self._loop.call_soon(self.note_drops, self._link.failed)
        return True

    def _request_room(self) -> None:
        """Have the I/O thread send the rest; under the lock."""
        if not self._room_requested:
            self._room_requested = True
            self._loop.call_soon(self._await_room_in_loop, self._link.failed)

    def _write(self, parts: Sequence[Part]) -> int:
        """Bytes that the kernel takes now; under the lock.  A link that fails is muted, and 0 returned."""
        try:
            return self._sock.send(parts[0]) if len(parts) == 1 else send_parts(self._sock, parts)
        except (BlockingIOError, InterruptedError):
            return 0
        except OSError as exc:
            self._fail(f"sending failed: {exc.strerror or exc}")
            return 0

    def _fail(self, reason: str) -> None:
        """Take no more messages, and close; under the lock."""
        self.is_muted = True
        if not self.peer_ended:
            self.reason = reason
        self.outbox.clear()
        # what the peer has sent before is still read, then the I/O thread finds the end and closes
        with suppress(OSError):
            self._sock.shutdown(socket.SHUT_RDWR)

    # ── for the I/O thread ────────────────────────────────────────────────────────────────────────────────────

    def mute(self, reason: str) -> None:
        """Take no more messages, for this reason if there is no other yet."""
        with self.lock:
            self.is_muted = True
            self.reason = self.reason or reason

    def end(self, reason: str) -> None:
        """Take no more messages, and send the end of the stream behind what the kernel has."""
        with self.lock:
            self.is_muted = True
            self.reason = self.reason or reason
            with suppress(OSError):
                self._sock.shutdown(socket.SHUT_WR)

    def end_by_peer(self) -> bool:
        """The peer sends no more: take no more messages; whether there is still something to be sent to it."""
        with self.lock:
            self.is_muted = True
            self.reason = self.reason or "closed by the peer"
            self.peer_ended = not self.all_sent
            return self.peer_ended

    def drain(self) -> bool:
        """Send from the queue, now that the socket has room; whether nothing is left."""
        with self.lock:
            box = self.outbox
            self._take_unsent()
            self.is_inside_message = True
            if not box.empty:
                box.advance(self._write(box.parts()))
            self.is_inside_message = False
            if not (box.empty and self._flushed()):
                return False
            if not self.peer_ended:
                self._room_requested = self.awaits_room = False
                self._link.watch()
            self._settle()
        return True

    def shut_down(self) -> bool:
        """Send the end of the stream, if the peer has everything before it; whether it has."""
        with self.lock:
            if not self.all_sent:
                return False
            with suppress(OSError):
                self._sock.shutdown(socket.SHUT_WR)
        return True

    def note_drops(self) -> None:
        """Note the drops so far, and again after a second if there are more."""
        with self.lock:
            box = self.outbox
            if box.drops == self._drops_noted:
                self._drops_watched = False
                return
            self._drops_noted = drops = box.drops
            peer, dropped = self._link.peer, dict(box.dropped)
            data = {"peer": peer, "dropped": dropped, "messages": box.messages, "bytes": box.bytes}
        text = f"{peer} reads too slowly: {count_text(drops, 'message')} dropped so far"
        self._reporter.note(self._link.number, Note(Level.WARN, "queue_drop", text, data=data))
        self._loop.call_later(NOTE_EVERY_S, self.note_drops, self._link.failed)

    def _flushed(self) -> bool:
        """Whether there is no backlog any more; under the lock."""
        return True

    def _await_room_in_loop(self) -> None:
        if self._link.is_open and not self.peer_ended:
            self.awaits_room = True
            self._link.watch()

    def _overflowed(self) -> None:
        if self._link.is_open:
            self._link.fault(Level.ERROR, "queue_full", f"{self._link.peer} does not read: {self.reason}")


if sys.platform == "win32":

    def _await_room(descriptor: int) -> None:
        # If the link is closed meanwhile, this returns at once or late, and the caller finds it muted.
        with suppress(OSError, ValueError):
            select.select((), (descriptor,), (descriptor,), _BLOCKED_POLL_MS / 1000)

else:

    def _await_room(descriptor: int) -> None:
        # If the link is closed meanwhile, this returns at once or late, and the caller finds it muted.
        poll = select.poll()
        poll.register(descriptor, select.POLLOUT)
        poll.poll(_BLOCKED_POLL_MS)
