"""One connection, from its beginning to its end: it joins a sender, a receiver and a check of liveness."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

from igtl_gateway.base.quantities import count_text
from igtl_gateway.edges.tcp.layer import AnySocket
from igtl_gateway.edges.tcp.link_info import LinkCounters, Role
from igtl_gateway.edges.tcp.link_parts import LinkContext, NativeEnds
from igtl_gateway.edges.tcp.liveness import Liveness
from igtl_gateway.edges.tcp.loop import READ, WRITE
from igtl_gateway.edges.tcp.receiver import Receiver
from igtl_gateway.edges.tcp.reporter import error_note
from igtl_gateway.edges.tcp.sender import Sender
from igtl_gateway.edges.tcp.sockets import address_text, unconfirmed_bytes
from igtl_gateway.edges.tcp.turns import Turn
from igtl_gateway.gateway.log.note import STOPPED, Level, Note
from igtl_gateway.native.passage import Link as NativeLink
from igtl_gateway.native.passage import Lock

FLUSH_S = 1.0  # the longest time to send the queue at the end, and to wait until the peer closes

_ERRORS_MAX = 3  # unexpected errors of our own code in a link's life; this one ends it
#: Codes of the notes that end a link.
_FAULTS = frozenset(
    {
        *("too_large", "out_of_memory", "stalled", "unreachable", "idle", "queue_full"),
        *("internal_error", "refused", "tls_failed", "websocket_failed"),
    }
)


class Link:
    """One connection.  ``sender.send`` is for any thread, and so is `counters`; the rest is for the I/O thread alone.

    Args:
        number: counts from 1 and is never used twice.
        sock: connected; the link closes it.
        role: ``"server"`` if the peer connected to us.
        peer: ``host:port``.
        context: what all links share.
        closed: called last, with the note for ``on_link``.

    Attributes:
        announced: the edge has reported the link as up.
        partner: the other link of a relay, whose messages the I/O thread sends.
        native: the link in the native passage; None: all its messages are Python's.
        turn: its turns in the I/O thread.
    """

    def __init__(
        self,
        number: int,
        sock: AnySocket,
        role: Role,
        peer: str,
        context: LinkContext,
        closed: Callable[[Link, Note], None],
    ) -> None:
        self.number = number
        self.role: Role = role
        self.peer = peer
        self.local = address_text(sock.getsockname())
        self.is_open = True
        self.announced = False
        self.partner: Link | None = None
        self._sock = sock
        self._context = context
        self._closed = closed
        self._loop = context.loop
        self.turn = Turn(self._take_turn, self.failed)
        self.native = self._make_native()
        self.sender = self._make_sender()
        self.receiver = self._make_receiver()
        self.liveness = self._make_liveness()
        self._is_finishing = False  # we send no more than the queue; what the peer still sends is read
        self._errors = 0

    def _make_native(self) -> NativeEnds | None:
        if self._context.passage is None:
            return None
        lock = Lock()
        return NativeEnds(NativeLink(self._context.passage, self.number, self._sock.fileno(), lock), lock)

    def _make_sender(self) -> Sender:
        return Sender(self._sock, self, self._context, self.native)

    def _make_receiver(self) -> Receiver:
        return Receiver(self._sock, self, self._context, self.native)

    def _make_liveness(self) -> Liveness:
        return Liveness(self._sock, self, self.sender, self.receiver, self._context)

    @property
    def manner(self) -> str:
        """How the peer is connected, behind the words "connected to PLACE"."""
        return ""

    @property
    def facts(self) -> dict[str, str]:
        """What is known of the connection beside its addresses."""
        return {}

    def counters(self) -> LinkCounters:
        """Counts so far; for any thread."""
        self.sender.take_unsent()
        with self.sender.lock:
            box = self.sender.outbox
            native = self.native.link if self.native else None
            return LinkCounters(
                box.sent_messages + (native.sent_messages if native else 0),
                box.sent_bytes + (native.sent_bytes if native else 0),
                self.receiver.messages,
                self.receiver.bytes,
                box.messages,
                box.bytes,
                dict(box.dropped),
                unconfirmed_bytes=unconfirmed_bytes(self._sock) if self.is_open else 0,
            )

    def watch(self) -> None:
        """Wait for the socket events that the sender and the receiver need."""
        events = (READ if self.receiver.is_reading else 0) | (WRITE if self.sender.awaits_room else 0)
        if events:
            self._loop.watch_in_turn(self._sock, events, self.turn)
        else:
            self._loop.unwatch(self._sock)
        if self.receiver.has_waiting:
            self._loop.ask(self.turn)

    def pair_with(self, partner: Link) -> None:
        """Read from now on no faster than the partner takes what arrives here: then TCP makes the peer wait."""
        self.partner = partner
        self.receiver.after_read = self._apply_backpressure

    def attend(self) -> None:
        """The native passage has left something to Python: the end of a message, or the reading."""
        if self.is_open:
            self.sender.take_unsent()
            self.receiver.note_pauses()
            self.receiver.take_over()

    def read_by_python(self) -> None:
        """The edge stops: the native passage reads no more."""
        self.receiver.take_over(at_end=True)
        self.receiver.handle_all()
        self.watch()

    def finish(self, reason: str) -> None:
        """Send what is queued, then the end of the stream; close when the peer does, or soon after."""
        if not self.is_open or self.sender.peer_ended or self._is_finishing:
            return
        self._is_finishing = True
        self.sender.mute(reason)
        self.receiver.resume()
        if not self._half_close():
            self.liveness.close_when_stalled()

    def end_sending(self) -> None:
        """The edge stops: send the end of the stream, behind what the kernel has."""
        self.sender.end(STOPPED)

    def peer_ended(self) -> None:
        """The peer sends no more.  It may still read: it gets what is queued for it, as long as that moves."""
        if not self.sender.end_by_peer():
            self.close()
            return
        self.sender.awaits_room = True
        self.receiver.stop()
        self.liveness.close_when_stalled()

    def failed(self, exc: Exception) -> None:
        """An unexpected error of our own code: it is noted, and the link goes on.

        It ends the link where the place in the stream of bytes is lost, and where errors repeat.
        """
        self._errors += 1
        self._context.reporter.note(self.number, error_note(exc, peer=self.peer, count=self._errors))
        lost_place = self.sender.is_inside_message or self.receiver.is_inside_message
        if self.is_open and (lost_place or self._errors >= _ERRORS_MAX):
            self.close("internal_error")
        elif self.is_open:
            self.watch()  # what waits has not had its turn

    def broken(self, cause: str) -> None:
        """The connection broke: close for the reason that is already known, or for this one."""
        self.close(self.sender.reason or cause)

    def fault(self, level: Level, code: str, text: str) -> None:
        """Note a fault, and close."""
        self._context.reporter.note(self.number, Note(level, code, text, data=self.receiver.unfinished()))
        self.close(code)

    def close(self, reason: str = "") -> None:
        """Close for this reason, or for the one that is already known, and report it.

        A message that is handled aside comes first.
        """
        sender = self.sender
        reason = reason or sender.reason
        if self.receiver.is_aside and not self._loop.stopping:
            sender.mute(reason)
            self.receiver.then = partial(self.close, reason)
            return
        self.is_open = False
        self._loop.run(partial(self.receiver.take_over, at_end=True))
        self._loop.run(self.receiver.handle_all)
        sender.take_unsent()
        with sender.lock:
            sender.is_muted = True
        self._loop.run(sender.note_drops)
        with sender.lock:
            sender.outbox.clear()
            self._loop.unwatch(self._sock)
            unconfirmed = unconfirmed_bytes(self._sock)
            if self.native:
                self.native.link.close()
            self._sock.close()
        if reason in _FAULTS:
            self._context.faults[reason] += 1
        else:
            self._loop.run(partial(self.receiver.note_truncated, reason))
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
            "unsent": sender.outbox.unsent,
            "unconfirmed_bytes": unconfirmed,
        }
        text = f"{self.peer} disconnected: {reason}"
        if unconfirmed:
            text += f"; {count_text(unconfirmed, 'byte')} of what it was sent may not have arrived"
        self._closed(self, Note(Level.INFO, "link_down", text, data=data))

    def _take_turn(self, mask: int) -> None:
        if self.is_open and mask & WRITE:
            self._drain()
        if self.is_open and (mask & READ or self.receiver.has_waiting):
            self.receiver.read()

    def _drain(self) -> None:
        """The socket has room."""
        if not self.sender.drain():
            return
        if self.sender.peer_ended:
            self.close()
        elif self._is_finishing:
            self._half_close()
        if self.partner:
            self.partner.resume()
        self._context.drained()

    def resume(self) -> None:
        """Read on, after the partner's queue was in the way."""
        if self.is_open and not self.sender.peer_ended:
            self.receiver.resume()

    def _apply_backpressure(self) -> None:
        """Read on only while the partner takes what arrives."""
        if (partner := self.partner) is None:
            return
        with partner.sender.lock:
            muted, behind = partner.sender.is_muted, not partner.sender.outbox.empty
        if muted:
            partner.resume()  # or its end would not be seen
        elif behind:
            self.receiver.stop()

    def _half_close(self) -> bool:
        """Send the end of the stream, once the peer has everything, and close soon; whether it has everything."""
        if not self.sender.shut_down():
            return False
        self._loop.call_later(FLUSH_S, self._give_up, self.failed)
        return True

    def _give_up(self) -> None:
        if self.is_open:
            self.close()
