"""The incoming half of a link: the I/O thread reads from the socket, frames, and calls back.

It reads once in a turn, and calls back until the turn is over (``turns``).  While messages wait for the next turn, the
socket is not read, and TCP makes the peer wait.
"""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

from igtl_gateway.base.errors import MessageTooLarge
from igtl_gateway.base.quantities import count_text
from igtl_gateway.base.stamp import NS_PER_S
from igtl_gateway.edges.tcp.aside import Job
from igtl_gateway.edges.tcp.layer import AnySocket, LayerError
from igtl_gateway.edges.tcp.link_parts import LinkContext, LinkLife, NativeEnds
from igtl_gateway.edges.tcp.outbox import Part
from igtl_gateway.edges.tcp.reporter import NOTE_EVERY_S
from igtl_gateway.edges.tcp.tls import TLS_TO_PLAIN
from igtl_gateway.edges.tcp.turns import LARGE_BYTES, QUANTUM_NS
from igtl_gateway.gateway.log.note import Level, Note
from igtl_gateway.wire.framer import Framer
from igtl_gateway.wire.header import BODY_SIZE, HEADER_SIZE

_TLS_HELLO, _TLS_ALERT = b"\x16\x03", b"\x15\x03"  # not a header version of OpenIGTLink


_MOST_AT_ONCE = 512 << 10  # bytes of a turn, for which all others wait
_LOOK_S = 0.005  # until the next look whether a large message is admitted
_BURST_S = 1.0  # a peer that was silent for this long may send the messages of this time at once


class RateLimit:
    """A token bucket for the messages of one link; of the I/O thread alone.

    What a peer sends while it ``is_pausing`` stays in the kernel, and TCP makes the peer wait.
    """

    def __init__(self, link: LinkLife, context: LinkContext, now_ns: int) -> None:
        self.is_pausing = False
        self._link = link
        self._context = context
        self._tokens = context.limits.messages_per_s * _BURST_S  # messages that may arrive at once
        self._counted_ns = now_ns
        self._pauses = 0
        self._noted_ns = 0

    def room(self, now_ns: int) -> int:
        """Return the number of messages that may arrive at once: at least one."""
        self._refill(now_ns)
        return max(1, int(self._tokens))

    def take_over(self, room: float, now_ns: int) -> None:
        """The native passage has read, by the same rule, and leaves room for this number of messages."""
        self._tokens, self._counted_ns = room, now_ns

    def pause_s(self, messages: int, now_ns: int) -> float:
        """Count messages; how long (s) to read no more from the link, 0.0 for no pause.  A pause is noted."""
        rate = self._context.limits.messages_per_s
        self._refill(now_ns)
        self._tokens -= messages
        if self._tokens >= 0 or not self._link.is_open:
            return 0.0
        self.is_pausing = True
        self.count(1, now_ns)
        return -self._tokens / rate

    def count(self, pauses: int, now_ns: int) -> None:
        """Count pauses, and note them: now, and while they repeat once a second."""
        rate = self._context.limits.messages_per_s
        is_first = not self._pauses
        self._pauses += pauses
        if is_first or now_ns - self._noted_ns >= NOTE_EVERY_S * NS_PER_S:
            self._noted_ns = now_ns
            text = (
                f"{self._link.peer} sends more than {count_text(rate, 'message')} per second and is read at this rate"
            )
            data = {"peer": self._link.peer, "limit": rate, "rests": self._pauses}
            self._context.reporter.note(self._link.number, Note(Level.WARN, "rate_limited", text, data=data))

    def _refill(self, now_ns: int) -> None:
        rate = self._context.limits.messages_per_s
        self._tokens = min(rate * _BURST_S, self._tokens + (now_ns - self._counted_ns) * rate / NS_PER_S)
        self._counted_ns = now_ns


class Receiver:
    """Reads whole messages and hands them on; of the I/O thread alone, except the two counts.

    Attributes:
        is_foreign: the first bytes were not a header of OpenIGTLink.
        is_inside_message: bytes are between socket and framer: an error here loses the place in the stream.
        after_read: called after each reading, None for nothing; the link of a relay sets it.
        then: called when the message that is handled aside is done; None for nothing.
    """

    def __init__(
        self,
        sock: AnySocket,
        link: LinkLife,
        context: LinkContext,
        native: NativeEnds | None = None,
    ) -> None:
        self._messages = 0
        self._bytes = 0
        self._heard_ns = context.loop.now()
        self._native = native.link if native else None
        self._is_native = False  # the native passage reads
        self._waiting: deque[Part] = deque()  # whole messages that wait for a turn
        self._was_full = False  # the socket may have more than was received at once
        self.is_foreign = False
        self.is_inside_message = False
        self.after_read: Callable[[], None] | None = None
        self.then: Callable[[], None] | None = None
        self._aside: Job | None = None
        self._sock = sock
        self._link = link
        self._context = context
        self._loop = context.loop
        self._reporter = context.reporter
        self._on_frame = context.on_frame
        self._framer = Framer(context.limits.max_body, context.bodies)
        self._room = self._framer.buffer()
        self._rate = RateLimit(link, context, self._heard_ns)
        self._is_held = False  # a large message waits until it is admitted
        self._is_stopped = False  # the partner's queue is in the way, or the peer has ended
        self._message_since: tuple[int, int] = (-1, 0)  # see `message_ns`

    @property
    def messages(self) -> int:
        """Messages received so far."""
        return self._messages + (self._native.received_messages if self._native else 0)

    @property
    def bytes(self) -> int:
        """Bytes received so far."""
        return self._bytes + (self._native.received_bytes if self._native else 0)

    @property
    def heard_ns(self) -> int:
        """When the last bytes came (monotonic)."""
        return max(self._heard_ns, self._native.heard_ns if self._native else 0)

    @property
    def has_waiting(self) -> bool:
        """Whether messages, or something else that was received, wait for a turn."""
        return bool(self._waiting) and not (self._is_stopped or self._is_held or self._aside)

    @property
    def is_aside(self) -> bool:
        """Whether a message of the link is handled aside; the link is not read meanwhile."""
        return self._aside is not None

    @property
    def is_reading(self) -> bool:
        """Whether the I/O thread reads the link now."""
        held = self._is_stopped or self._is_held or self._aside is not None
        return not (held or self._rate.is_pausing or self._is_native)

    @property
    def is_read(self) -> bool:
        """Whether the link is read now, by the I/O thread or by the native passage, and does not wait for a turn."""
        if self._native and self._is_native:
            return self._native.is_native and not self._native.waits
        return self.is_reading and not (self._waiting or self._link.turn.waits)

    @property
    def pending(self) -> int:
        """Bytes of the message that is not complete yet."""
        return self._native.pending if self._is_native and self._native else self._framer.pending

    def read(self) -> None:
        """Take a turn: handle messages that wait, or what the socket has, once."""
        if self._waiting or self._receive():
            self._handle(self._loop.now() + QUANTUM_NS)
            self._link.turn.has_more = bool(self._waiting) or (self._was_full and self.is_reading)
            if self.after_read and self._link.is_open:
                self.after_read()

    def _receive(self) -> bool:
        """Take what the socket has, once; whether there is something to be handled."""
        try:
            count = self._sock.recv_into(self._room)
        except (BlockingIOError, InterruptedError):
            return False
        except LayerError as exc:
            self._link.fault(Level.WARN, exc.code, f"{self._link.peer} sent {exc.what}: {exc}")
            return False
        except OSError as exc:
            self._link.broken(f"receiving failed: {exc.strerror or exc}")
            return False
        if not count:
            self._link.peer_ended()
            return False
        self._was_full = count == len(self._room)
        self._heard_ns = self._loop.looked_ns
        self._bytes += count
        self._frame(partial(self._framer.received, count))
        return True

    def note_pauses(self) -> None:
        """Note that the native passage did not read the link for a while."""
        if self._native and (pauses := self._native.take_pauses()):
            self._rate.count(pauses, self._loop.now())

    def take_over(self, *, at_end: bool = False) -> None:
        """Read in the I/O thread, where the native passage has stopped.

        ``at_end``: the link closes: in any case, and without looking at the socket.
        """
        if self._native is None or not self._is_native or (self._native.is_native and not at_end):
            return
        if at_end:
            self._context.wait_large(self._native)
        elif self._native.large_waiting:  # what Python handles next came after them: this is called again
            return
        rest, failure = self._native.read_by_python()
        self._rate.take_over(self._native.room, self._loop.now())
        self._is_native = False
        if rest:  # else the peer has ended, which the next reading finds
            self._frame(partial(self._framer.feed, rest))
            if not self._waiting:
                self._prepare()
        if not at_end:
            self._link.watch()
        if failure and not at_end and self._link.is_open:
            self._link.broken(f"receiving failed: {os.strerror(failure)}")

    def handle_all(self) -> None:
        """The link closes: handle all messages that were received whole."""
        if self._aside:
            self._aside.wait()
        self._handle(0)

    def _frame(self, received: Callable[[], Sequence[Part]]) -> None:
        """Let messages that are whole now wait for their turn."""
        self.is_inside_message = True
        try:
            messages = received()
            self._waiting.extend(messages)
            if pause_s := self._rate.pause_s(len(messages), self._loop.now()):
                self._link.watch()
                self._loop.call_later(pause_s, self._end_rate_pause, self._link.failed)
        except MessageTooLarge as exc:
            self._refuse(exc)
        except MemoryError:
            self._out_of_memory()
        self.is_inside_message = False

    def _handle(self, until_ns: int) -> None:
        """Call back with messages that wait, until the turn is over (monotonic); 0: with all of them."""
        waiting, call, number = self._waiting, self._reporter.call, self._link.number
        while waiting and not (self._is_stopped and until_ns):
            size = len(waiting[0])
            if size >= LARGE_BYTES and not self._admit(size, bool(until_ns)):
                return
            self._messages += 1
            if until_ns and self.after_read is None and self._context.aside.takes(waiting[0]):
                self._put_aside(partial(call, "on_frame", self._on_frame, number, waiting.popleft()), size)
                return
            if call("on_frame", self._on_frame, number, waiting.popleft()) is True:
                self._rest_after_invalid(size)
            if size >= LARGE_BYTES:
                self._context.admission.leave(size)
            if until_ns and waiting and self._loop.now() >= until_ns:
                break
        if not self._link.is_open:
            return
        if waiting:
            self._loop.ask(self._link.turn)
        elif self._prepare():
            self._let_passage_read()

    def _put_aside(self, work: Callable[[], object], size: int) -> None:
        """Have a message handled aside; the link is read on when that is done."""
        self._aside = Job(work, partial(self._end_aside, size))
        self._link.watch()
        self._context.aside.put(self._aside, self._link.failed)

    def _end_aside(self, size: int, result: object, used_ns: int) -> None:
        self._aside = None
        self._link.turn.charge(used_ns)
        if size >= LARGE_BYTES:
            self._context.admission.leave(size)
        if result is True:
            self._rest_after_invalid(size)
        then, self.then = self.then, None
        if then:
            then()
        elif self._link.is_open:
            if not self._waiting and self._prepare():
                self._let_passage_read()
            self._read_on()

    def _admit(self, size: int, waits: bool) -> bool:
        """Whether a large message passes now; else the link is not read until the next look."""
        if not waits:
            self._context.admission.enter(size)
        elif not self._context.admission.admit(size):
            self._is_held = True
            self._link.watch()
            self._loop.call_later(_LOOK_S, self._end_hold, self._link.failed)
            return False
        return True

    def _end_hold(self) -> None:
        self._is_held = False
        self._read_on()

    def _rest_after_invalid(self, size: int) -> None:
        rest_s = self._context.invalid.rest_s(size, self._loop.now())
        if rest_s and self._link.is_open:
            self._rate.is_pausing = True
            self._link.watch()
            self._loop.call_later(rest_s, self._end_rate_pause, self._link.failed)

    def _prepare(self) -> bool:
        """Make room for what comes next; False if nothing may come any more."""
        try:
            self._room = self._framer.buffer()[:_MOST_AT_ONCE]
        except MessageTooLarge as exc:
            self._refuse(exc)
        except MemoryError:
            self._out_of_memory()
        return self._link.is_open

    def _let_passage_read(self) -> None:
        """Leave the reading to the native passage, if it has a stream of the link, and between two messages."""
        native = self._native
        if native is None or not native.stream_count or self._framer.pending or self._waiting:
            return
        if self.is_reading and self._link.is_open and not self._loop.stopping:
            self._is_native = True
            self._link.watch()
            native.read_natively(self._rate.room(self._loop.now()), self._context.limits.messages_per_s)

    def stop(self) -> None:
        """Read no more, until `resume`."""
        self._is_stopped = True
        self._link.watch()

    def resume(self) -> None:
        """Read on."""
        if self._is_stopped:
            self._is_stopped = False
            self._restart_body_timer()
            self._link.watch()

    def message_ns(self, step_ns: int) -> int:
        """How long (ns) the incomplete message has been on its way, to be asked at each check of the link.

        It is measured here alone, so that it costs the messages nothing: a message that is seen at two checks began
        before the first of them.

        Args:
            step_ns: the time since the last check.
        """
        message = self.messages if self.is_read and self.pending else -1
        since, passed_ns = self._message_since
        self._message_since = message, (passed_ns + step_ns if message == since else 0)
        return self._message_since[1]

    def unfinished(self) -> dict[str, Any]:
        """Facts about the message that is not complete, for the data of a note."""
        head = self._framer.pending_head()
        expected = HEADER_SIZE + int.from_bytes(head[BODY_SIZE], "big") if len(head) == HEADER_SIZE else None
        return {"received": self.pending, "expected": expected, "head": head.hex(), "peer": self._link.peer}

    def note_truncated(self, reason: str) -> None:
        """Note that the link ends inside a message, if it does, for this reason."""
        if not self.pending:
            return
        self._context.faults["truncated"] += 1
        data = self.unfinished() | {"reason": reason}
        text = f"{self._link.peer} went inside a message: {data['received']} of {data['expected'] or '?'} bytes"
        if self._framer.pending_head().startswith(_TLS_ALERT) and not self.messages:
            text += "; it speaks TLS"
        self._reporter.note(self._link.number, Note(Level.WARN, "truncated", text, data=data))

    def _refuse(self, exc: MessageTooLarge) -> None:
        self.is_foreign = not self.messages
        if self._framer.pending_head().startswith(_TLS_HELLO) and not self.messages:
            self._context.refusals.counts[TLS_TO_PLAIN] += 1
            self._link.fault(Level.WARN, "refused", f"connection of {self._link.peer} refused: {TLS_TO_PLAIN}")
        else:
            http = "; it speaks HTTP, expected at ws://HOST:PORT" if self._is_http() else ""
            self._link.fault(Level.ERROR, "too_large", f"message too large: {exc}{http}")

    def _is_http(self) -> bool:
        return not self.messages and self._framer.pending_head().startswith(b"GET /")

    def _out_of_memory(self) -> None:
        self._link.fault(Level.ERROR, "out_of_memory", "not enough memory for the announced message")

    def _restart_body_timer(self) -> None:
        """The link was not read for a while: that does not count for the message on its way."""
        self._heard_ns = self._loop.now()
        self._message_since = -1, 0

    def _end_rate_pause(self) -> None:
        self._rate.is_pausing = False
        self._read_on()

    def _read_on(self) -> None:
        if self._link.is_open and not self._is_stopped:
            self._restart_body_timer()
            self._link.watch()
