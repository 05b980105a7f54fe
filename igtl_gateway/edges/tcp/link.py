"""One connection: sending in the caller's thread, receiving and the end in the I/O thread."""

from __future__ import annotations

import math
import select
import socket
import threading
from bisect import bisect_right
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from typing import Any

from igtl_gateway.buffers import Buffer
from igtl_gateway.edges.tcp.facts import Limits, LinkCounters, Role
from igtl_gateway.edges.tcp.loop import READ, WRITE, Loop
from igtl_gateway.edges.tcp.outbox import IOV_MAX, Message, Outbox, Part
from igtl_gateway.edges.tcp.refusals import Refusals
from igtl_gateway.edges.tcp.reporter import NOTE_EVERY_S, Reporter, error_note
from igtl_gateway.edges.tcp.sockets import UNANSWERED_S, place_of, unanswered_s, unconfirmed_bytes
from igtl_gateway.edges.tcp.tls import TLS_TO_PLAIN, TlsError, TlsSocket
from igtl_gateway.errors import MessageTooLarge
from igtl_gateway.session.note import Level, Note
from igtl_gateway.stamp import NS_PER_S
from igtl_gateway.wire.framer import HEADER_SIZE, Framer

FLUSH_S = 1.0  # how long what is queued is tried to be sent when we stop, and how long a peer has to say that it closes

_BLOCKED_POLL_MS = 100  # how soon a waiting sender sees that its link was closed
_BODY_SIZE_AT = slice(42, 50)  # in the header, big-endian
_ERRORS_MAX = 3  # unexpected errors of ours in a link's life; this one ends it
#: Notes that end a link.
_FAULTS = frozenset(
    {
        *("too_large", "out_of_memory", "stalled", "unreachable", "idle", "queue_full"),
        *("internal_error", "refused", "tls_failed"),
    }
)
_TLS_HELLO, _TLS_ALERT = b"\x16\x03", b"\x15\x03"  # no header version of OpenIGTLink
_BURST_S = 1.0  # so long may a peer have said nothing and then say it all at once


@dataclass(frozen=True, slots=True)
class Surroundings:
    """What all links of an edge share.

    Attributes:
        bodies: longest bodies of single types, of the limits.
        faults: links that a fault ended, or that ended inside a message, by the code of the note.
        on_frame: the edge's callback.
        drained: told when a queue has run empty.
        closed: told last, with the note for ``on_link``.
    """

    loop: Loop
    reporter: Reporter
    refusals: Refusals
    limits: Limits
    bodies: Sequence[tuple[str, int]]
    faults: Counter[str]
    on_frame: Callable[[int, Buffer], None]
    drained: Callable[[], None]
    closed: Callable[[Link, Note], None]


class Link:
    """One connection.

    ``_lock`` guards ``outbox``, ``_mute``, ``_reason``, ``_flagged``, ``_drops_watched`` and sending.
    """

    def __init__(
        self, number: int, sock: socket.socket | TlsSocket, role: Role, peer: str, around: Surroundings
    ) -> None:
        self.number = number
        self.role: Role = role
        self.peer = peer
        self.local = place_of(sock.getsockname())
        self.announced = False  # by the edge
        self.outbox = Outbox(around.limits)
        self.partner: Link | None = None  # the other end of a relay, where all is sent by the I/O thread
        self._sock = sock
        self._around = around
        self._loop = around.loop
        self._reporter = around.reporter
        self._lock = threading.Lock()
        self._mute = False  # nothing may be sent any more
        self._reason = ""  # why it is about to close
        self._flagged = False  # the I/O thread watches for room in the socket, or was asked to
        self._drops_watched = False  # the I/O thread knows that there are drops to note
        # of the I/O thread alone
        self._framer = Framer(around.limits.max_body, around.bodies)
        self._room = self._framer.buffer()
        self._up_ns = self._heard_ns = self._loop.now()
        self._received_messages = 0
        self._received_bytes = 0
        self._drops_noted = 0
        self._credit = around.limits.messages_per_s * _BURST_S  # messages that may come at once
        self._counted_ns = self._up_ns
        self._resting = False  # it has sent too many messages, and is not read for a moment
        self._rests = 0
        self._rest_noted_ns = 0
        # messages before the one that is on its way (-1: none is), and for how long (ns) it has been
        self._slow = (-1, 0)
        self._moved = (0, 0)  # bytes in and out when they were last seen to change …
        self._moved_ns = self._up_ns  # … and when that was
        self._open = True
        self._reading = True
        self._writing = False
        self._foreign = False  # what came first was no header of OpenIGTLink
        self._ended = False  # the peer sends no more; what is queued for it is still sent
        self._leaving = False  # we send no more than what is queued; what the peer still sends is read
        self._torn = False  # bytes are on their way in or out: an error here loses the place in the stream
        self._errors = 0

    @property
    def facts(self) -> dict[str, str]:
        """What is known of the connection beside its addresses."""
        return {}

    # ── for any thread ────────────────────────────────────────────────────────────────────────────────────────

    def send(self, parts: Sequence[Part], size: int, stream: str, keep: bool, waits: bool) -> bool:
        """Send or queue; False if the link takes nothing any more.  ``waits``: for room in the queue, if need be."""
        while True:
            with self._lock:
                box = self.outbox
                if self._mute:
                    return False
                if box.empty:
                    sent = self._write(parts[:IOV_MAX])
                    if sent == size:
                        box.count_sent(size)
                        return True
                    return self._queue(Message(parts, size, stream, keep), sent)
                if not waits or box.has_room(size):
                    return self._queue(Message(parts, size, stream, keep), 0)
                # Not left to the I/O thread, which may be waiting for a lock that our caller holds.
                box.advance(self._write(box.parts()))
                descriptor = self._sock.fileno()
                full = not box.has_room(size)
            if full:
                if self._loop.stopping:
                    return False
                # If the link is closed meanwhile, this returns at once or late, and the loop finds it mute.
                poll = select.poll()
                poll.register(descriptor, select.POLLOUT)
                poll.poll(_BLOCKED_POLL_MS)

    def send_run(
        self, data: Part, ends: Sequence[int], streams: Sequence[str], waits: bool, hurry: Callable[[], bool]
    ) -> int:
        """Send or queue messages that stand one behind the other, none to be dropped: how many the link took.

        Args:
            data: all of them.
            ends: where each of them ends.
            streams: of each of them.
            waits: until the kernel has taken them, all but perhaps the end of the last one.
            hurry: whether to wait no more: then as many are queued as there is room for.
        """
        view, at, taken = memoryview(data), 0, 0  # bytes and messages that are the link's

        def queue(sent: int) -> bool:
            nonlocal at, taken
            end = ends[taken]
            if not self._queue(Message((view[at:end],), end - at, streams[taken], True), sent):
                return False
            at, taken = end, taken + 1
            return True

        while True:
            with self._lock:
                box = self.outbox
                if not box.empty:
                    box.advance(self._write(box.parts()))
                if box.empty and not self._mute:
                    sent = at + self._write((view[at:],))
                    whole = bisect_right(ends, sent)
                    if whole > taken:
                        box.count_sent(ends[whole - 1] - at, whole - taken)
                        at, taken = ends[whole - 1], whole
                    if sent > at:
                        queue(sent - at)
                hurries = waits and hurry()
                while (
                    (hurries or not waits)
                    and taken < len(ends)
                    and (not waits or box.has_room(ends[taken] - at))
                    and queue(0)
                ):
                    pass
                if self._mute or taken == len(ends) or self._loop.stopping or hurries:
                    return taken
                descriptor = self._sock.fileno()
            self._await_room(descriptor)

    @property
    def all_sent(self) -> bool:
        """Whether the kernel has all that was to be sent."""
        return self.outbox.empty and not self._backlog

    @property
    def _backlog(self) -> int:
        """Bytes that left the queue and are not the kernel's yet."""
        return 0

    def counters(self) -> LinkCounters:
        with self._lock:
            box = self.outbox
            return LinkCounters(
                box.sent_messages,
                box.sent_bytes,
                self._received_messages,
                self._received_bytes,
                box.messages,
                box.bytes,
                dict(box.dropped),
            )

    @staticmethod
    def _await_room(descriptor: int) -> None:
        # If the link is closed meanwhile, this returns at once or late, and the caller finds it mute.
        poll = select.poll()
        poll.register(descriptor, select.POLLOUT)
        poll.poll(_BLOCKED_POLL_MS)

    def _queue(self, message: Message, sent: int) -> bool:
        """Queue what is left of the message; under the lock."""
        if self._mute:
            return False
        box = self.outbox
        drops = box.drops
        if sent:
            box.begin(message, sent)
        elif not box.add(message):
            self._mute = True
            self._reason = "the send queue is full of messages that must not be dropped"
            box.clear()
            self._loop.post(self._overflowed, self.failed)
            return False
        if not self._flagged:
            self._flagged = True
            self._loop.post(self._watch_room, self.failed)
        if box.drops > drops and not self._drops_watched:
            self._drops_watched = True
            self._loop.post(self._note_drops, self.failed)
        return True

    def _write(self, parts: Sequence[Part]) -> int:
        """Bytes that the kernel takes now; under the lock.  A link that fails is muted, and 0 returned."""
        try:
            return self._sock.send(parts[0]) if len(parts) == 1 else self._sock.sendmsg(parts)
        except (BlockingIOError, InterruptedError):
            return 0
        except OSError as exc:
            self._mute = True
            if not self._ended:
                self._reason = f"sending failed: {exc.strerror or exc}"
            self.outbox.clear()
            # what the peer has sent before is still read, then the I/O thread finds the end and closes
            with suppress(OSError):
                self._sock.shutdown(socket.SHUT_RDWR)
            return 0

    # ── for the I/O thread ────────────────────────────────────────────────────────────────────────────────────

    def open(self) -> None:
        """Begin to listen to the peer."""
        self._watch()

    def lasted(self, least_s: float) -> bool:
        """Whether the link was a real one: it brought a byte, or lived that long, and spoke no other protocol."""
        if self._foreign:
            return False
        return self._received_bytes > 0 or self._loop.now() - self._up_ns >= least_s * NS_PER_S

    def sweep(self, step_ns: int) -> None:
        """Close if the peer fell silent inside a message, sends one far too slowly, is silent altogether, or has gone.

        Args:
            step_ns: the time since the last sweep, or less if it comes late.
        """
        limits, now = self._around.limits, self._loop.looked_ns
        pending = self._framer.pending if self._listening else 0
        silent_s = (now - self._heard_ns) / NS_PER_S
        # Looked at here only, so that it costs the messages nothing: a message that is seen at two sweeps began
        # before the first of them.
        message = self._received_messages if pending else -1
        self._slow = message, (self._slow[1] + step_ns if message == self._slow[0] else 0)
        slow_s = self._slow[1] / NS_PER_S
        if pending and silent_s > limits.stall_s:
            self._fault(Level.WARN, "stalled", f"{self.peer} sent half a message, then nothing")
        elif pending and slow_s > limits.stall_s + pending / limits.min_rate:
            text = f"{self.peer} sent {pending:,} bytes of a message in {slow_s:.0f} s: too slow"
            self._fault(Level.WARN, "stalled", text)
        elif (dead_s := unanswered_s(self._sock)) > UNANSWERED_S:
            text = f"{self.peer} cannot be reached: nothing of what it was sent was confirmed for {dead_s:.0f} s"
            self._fault(Level.WARN, "unreachable", text)
        elif limits.idle_s:
            moved = (self._received_bytes, self.outbox.sent_bytes)
            if moved != self._moved:
                self._moved, self._moved_ns = moved, now
            elif (now - self._moved_ns) / NS_PER_S > limits.idle_s and self._listening:
                self._fault(Level.WARN, "idle", f"{self.peer} said nothing and heard nothing for {limits.idle_s:g} s")

    def end_sending(self) -> None:
        """The edge stops: send no more, and let the peer know."""
        with self._lock:
            self._mute = True
            self._reason = self._reason or "stopped"
            with suppress(OSError):
                self._sock.shutdown(socket.SHUT_WR)

    def finish(self, reason: str) -> None:
        """Send what is queued, let the peer know, and close when it does, or soon: the partner has gone, say."""
        if not self._open or self._ended or self._leaving:
            return
        self._leaving = True
        with self._lock:
            self._mute = True
            self._reason = self._reason or reason
        self.resume()
        if not self._half_close():
            self._linger(0)

    def _linger(self, goal: int) -> None:
        """Close if what is queued hardly moves any more; a peer that reads slowly, or is busy for a while, gets all.

        Args:
            goal: bytes that must have been sent by now.
        """
        limits = self._around.limits
        with self._lock:
            sent, done = self.outbox.sent_bytes - self._backlog, self.all_sent
        if not self._open or done:
            return
        if sent >= goal:
            goal = sent + math.ceil(limits.min_rate * limits.stall_s)
            self._loop.later(limits.stall_s, partial(self._linger, goal), self.failed)
        else:
            self.close()

    def _give_up(self) -> None:
        if self._open:
            self.close()

    def resume(self) -> None:
        """Read on, after the partner's queue was in the way."""
        if self._open and not self._reading and not self._ended:
            self._reading = True
            self._be_patient()
            self._watch()

    def _be_patient(self) -> None:
        """It was not read for a while: a message that was on its way begins anew, as far as its time goes."""
        self._heard_ns = self._loop.now()
        self._slow = -1, 0

    @property
    def _listening(self) -> bool:
        """Whether what the peer sends is read now."""
        return self._reading and not self._resting

    def _count(self, messages: int) -> None:
        """Let a peer that sends too many messages wait: what it sends stays in the kernel, and TCP tells it."""
        rate = self._around.limits.messages_per_s
        self._credit = min(rate * _BURST_S, self._credit + (self._heard_ns - self._counted_ns) * rate / NS_PER_S)
        self._credit -= messages
        self._counted_ns = self._heard_ns
        if self._credit >= 0 or not self._open:
            return
        self._resting = True
        self._rests += 1
        self._watch()
        self._loop.later(-self._credit / rate, self._rested, self.failed)
        if self._rests == 1 or self._heard_ns - self._rest_noted_ns >= NOTE_EVERY_S * NS_PER_S:
            self._rest_noted_ns = self._heard_ns
            text = f"{self.peer} sends more than {rate:,} messages a second: it is read no faster"
            data = {"peer": self.peer, "limit": rate, "rests": self._rests}
            self._reporter.note(self.number, Note(Level.WARN, "rate_limited", text, data=data))

    def _rested(self) -> None:
        self._resting = False
        if self._open and not self._ended:
            self._be_patient()
            self._watch()

    def failed(self, exc: Exception) -> None:
        """An unexpected error of ours: noted, and things go on.

        It costs the link where the place in the stream of bytes is lost, and where errors come again and again.
        """
        self._errors += 1
        self._reporter.note(self.number, error_note(exc, peer=self.peer, count=self._errors))
        if self._open and (self._torn or self._errors >= _ERRORS_MAX):
            self.close("internal_error")

    def close(self, reason: str = "") -> None:
        """Close for that reason, or the one known already, and tell."""
        reason = reason or self._reason
        self._open = False
        with self._lock:
            self._mute = True
        self._loop.run(self._note_drops)
        with self._lock:
            self.outbox.clear()
            self._loop.unwatch(self._sock)
            unconfirmed = unconfirmed_bytes(self._sock)
            self._sock.close()
        if reason in _FAULTS:
            self._around.faults[reason] += 1
        else:
            self._loop.run(self._note_truncated)
        counts = self.counters()
        data = {
            "peer": self.peer,
            "local": self.local,
            "role": self.role,
            "reason": reason,
            "sent_messages": counts.sent_messages,
            "sent_bytes": counts.sent_bytes,
            "received_messages": counts.received_messages,
            "received_bytes": counts.received_bytes,
            "dropped": counts.dropped,
            "unsent": self.outbox.unsent,
            "unconfirmed_bytes": unconfirmed,
        }
        text = f"{self.peer} disconnected: {reason}"
        if unconfirmed:
            text += f"; {unconfirmed:,} bytes of what it was sent may not have arrived"
        self._around.closed(self, Note(Level.INFO, "link_down", text, data=data))

    def _ready(self, mask: int) -> None:
        if self._open and mask & WRITE:
            self._drain()
        if self._open and mask & READ:
            self._read()

    def _read(self) -> None:
        try:
            count = self._sock.recv_into(self._room)
        except (BlockingIOError, InterruptedError):
            return
        except TlsError as exc:
            self._fault(Level.WARN, "tls_failed", f"{self.peer} sent what is no TLS any more: {exc}")
            return
        except OSError as exc:
            self.close(self._reason or f"receiving failed: {exc.strerror or exc}")
            return
        if not count:
            self._end()
            return
        self._torn = True
        self._heard_ns = self._loop.looked_ns
        self._received_bytes += count
        try:
            messages = self._framer.received(count)
            for message in messages:
                self._received_messages += 1
                self._reporter.call("on_frame", self._around.on_frame, self.number, message)
            self._room = self._framer.buffer()
            self._count(len(messages))
        except MessageTooLarge as exc:
            self._foreign = not self._received_messages
            if self._framer.pending_head().startswith(_TLS_HELLO) and not self._received_messages:
                self._around.refusals.counts[TLS_TO_PLAIN] += 1
                self._fault(Level.WARN, "refused", f"connection of {self.peer} refused: {TLS_TO_PLAIN}")
            else:
                self._fault(Level.ERROR, "too_large", f"message too large: {exc}")
        except MemoryError:
            self._fault(Level.ERROR, "out_of_memory", "no memory for the message that the peer announces")
        self._torn = False
        if self.partner and self._open:
            self._throttle(self.partner)

    def _throttle(self, partner: Link) -> None:
        """Read on only while the partner takes what comes: then TCP makes the peer wait, and nothing is lost."""
        with partner._lock:
            mute, behind = partner._mute, not partner.outbox.empty
        if mute:
            partner.resume()  # or its end would not be seen
        elif behind:
            self._reading = False
            self._watch()

    def _watch(self) -> None:
        """Wait for what is of interest now."""
        events = (READ if self._listening else 0) | (WRITE if self._writing else 0)
        if events:
            self._loop.watch(self._sock, events, self._ready, self.failed)
        else:
            self._loop.unwatch(self._sock)

    def _half_close(self) -> bool:
        """Tell the peer that no more comes, once it has all, and close soon; whether it has all."""
        with self._lock:
            if not self.all_sent:
                return False
            with suppress(OSError):
                self._sock.shutdown(socket.SHUT_WR)
        self._loop.later(FLUSH_S, self._give_up, self.failed)
        return True

    def _end(self) -> None:
        """The peer sends no more.  It may still read: it gets what is queued for it, as long as that moves."""
        with self._lock:
            self._mute = True
            self._reason = self._reason or "closed by the peer"
            self._ended = not self.all_sent
        if not self._ended:
            self.close()
            return
        self._reading, self._writing = False, True
        self._watch()
        self._linger(0)

    def _drain(self) -> None:
        """There is room in the socket."""
        with self._lock:
            box = self.outbox
            self._torn = True
            if not box.empty:
                box.advance(self._write(box.parts()))
            self._torn = False
            if not (box.empty and self._flushed()):
                return
            if not self._ended:
                self._flagged = self._writing = False
                self._watch()
        if self._ended:
            self.close()
        elif self._leaving:
            self._half_close()
        if self.partner:
            self.partner.resume()
        self._around.drained()

    def _flushed(self) -> bool:
        """Whether there is no backlog any more; under the lock."""
        return True

    def _watch_room(self) -> None:
        if self._open and not self._ended:
            self._writing = True
            self._watch()

    def _overflowed(self) -> None:
        if self._open:
            self._fault(Level.ERROR, "queue_full", f"{self.peer} does not read: {self._reason}")

    def _fault(self, level: Level, code: str, text: str) -> None:
        """Note what is wrong, and close."""
        self._reporter.note(self.number, Note(level, code, text, data=self._unfinished()))
        self.close(code)

    def _note_drops(self) -> None:
        """Note the drops so far, and again in a second if there are more."""
        with self._lock:
            box = self.outbox
            if box.drops == self._drops_noted:
                self._drops_watched = False
                return
            self._drops_noted = drops = box.drops
            data = {"peer": self.peer, "dropped": dict(box.dropped), "messages": box.messages, "bytes": box.bytes}
        text = f"{self.peer} reads too slowly: {drops} messages dropped so far"
        self._reporter.note(self.number, Note(Level.WARN, "queue_drop", text, data=data))
        self._loop.later(NOTE_EVERY_S, self._note_drops, self.failed)

    def _note_truncated(self) -> None:
        if self._framer.pending:
            self._around.faults["truncated"] += 1
            data = self._unfinished()
            text = f"{self.peer} went inside a message: {data['received']} of {data['expected'] or '?'} bytes"
            if self._framer.pending_head().startswith(_TLS_ALERT) and not self._received_messages:
                text += "; it speaks TLS"
            self._reporter.note(self.number, Note(Level.WARN, "truncated", text, data=data))

    def _unfinished(self) -> dict[str, Any]:
        """Facts about the message that the link is inside of."""
        head = self._framer.pending_head()
        expected = HEADER_SIZE + int.from_bytes(head[_BODY_SIZE_AT], "big") if len(head) == HEADER_SIZE else None
        return {"received": self._framer.pending, "expected": expected, "head": head.hex(), "peer": self.peer}


class TlsLink(Link):
    """A connection with TLS: bytes may be between the queue and the kernel, and between the kernel and the framer."""

    def __init__(self, number: int, sock: TlsSocket, role: Role, peer: str, around: Surroundings) -> None:
        super().__init__(number, sock, role, peer, around)
        self._tls = sock

    @property
    def facts(self) -> dict[str, str]:
        return self._tls.facts()

    @property
    def _backlog(self) -> int:
        return self._tls.pending

    def _write(self, parts: Sequence[Part]) -> int:
        sent = super()._write(parts)
        self._flush_soon()
        return sent

    def _flush_soon(self) -> None:
        """Let the I/O thread send what the kernel did not take; under the lock."""
        if self._tls.pending and not self._flagged:
            self._flagged = True
            self._loop.post(self._watch_room, self.failed)

    def _flushed(self) -> bool:
        try:
            return self._tls.flush()
        except OSError:  # the end is found by who receives
            self._mute = True
            return True

    def _read(self) -> None:
        super()._read()
        while self._open and self._listening and self._tls.more:
            super()._read()
        with self._lock:
            self._flush_soon()

    def _watch(self) -> None:
        super()._watch()
        if self._listening and self._tls.more:
            self._loop.post(self._read_on, self.failed)

    def _read_on(self) -> None:
        if self._open and self._listening and self._tls.more:
            self._read()
