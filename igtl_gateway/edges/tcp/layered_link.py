"""A link over layers (TLS, WebSocket): bytes may wait between queue and kernel, and between kernel and framer."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from igtl_gateway.base.quantities import duration_text
from igtl_gateway.base.stamp import NS_PER_S
from igtl_gateway.edges.tcp.layer import Layer
from igtl_gateway.edges.tcp.link import Link
from igtl_gateway.edges.tcp.link_info import Role
from igtl_gateway.edges.tcp.link_parts import LinkContext, LinkLife, NativeEnds
from igtl_gateway.edges.tcp.liveness import Liveness
from igtl_gateway.edges.tcp.outbox import Part
from igtl_gateway.edges.tcp.receiver import Receiver
from igtl_gateway.edges.tcp.sender import Sender
from igtl_gateway.edges.tcp.sockets import UNANSWERED_S
from igtl_gateway.gateway.log.note import STOPPED, Level, Note
from igtl_gateway.native.passage import Link as NativeLink
from igtl_gateway.native.passage import Lock

#: A peer that is silent for this long (s) is asked whether it is there.
PING_S = 10.0


class LayeredSender(Sender):
    """A sender some of whose bytes the I/O thread flushes."""

    def __init__(self, sock: Layer, link: LinkLife, context: LinkContext, native: NativeEnds | None) -> None:
        self._layer = sock
        super().__init__(sock, link, context, native)

    @property
    def backlog(self) -> int:
        return self._layer.pending

    def flush_now(self) -> None:
        """Send what the layer has of its own, such as the answer to a ping; in the I/O thread."""
        if self._layer.pending:
            with self.lock:
                self._take_unsent()  # inside of whose frame nothing may be sent
                self._flushed()
                self._flush_soon()

    def _flush_soon(self) -> None:
        """Have the I/O thread send what the kernel did not take; under the lock."""
        if self._layer.pending:
            self._settle()
            self._request_room()

    def _settle(self) -> None:
        super()._settle()
        if self._native and self._layer.pending:
            self._native.clear = False

    def _begun(self, message: bytes, sent: int) -> int:
        return self._layer.take_over(message, sent) if sent else 0

    def _write(self, parts: Sequence[Part]) -> int:
        sent = super()._write(parts)
        self._flush_soon()
        return sent

    def _flushed(self) -> bool:
        try:
            return self._layer.flush()
        except OSError:  # the receiver finds the end
            self.is_muted = True
            return True


class LayeredReceiver(Receiver):
    """A receiver that also reads what the layer has already, of which no system call reports anything."""

    def __init__(self, sock: Layer, link: LinkLife, context: LinkContext, sender: LayeredSender) -> None:
        super().__init__(sock, link, context)
        self._layer = sock
        self._sender = sender

    @property
    def has_more(self) -> bool:
        """Whether the link is read, and bytes in the layer wait for that."""
        return self._link.is_open and self.is_reading and self._layer.more

    @property
    def has_waiting(self) -> bool:
        return super().has_waiting or self.has_more

    def read(self) -> None:
        super().read()
        if self.has_more:
            self._loop.ask(self._link.turn)
        if self._link.is_open and not self._layer.is_ending:  # which would count as not arrived
            self._sender.flush_now()


class LayeredLiveness(Liveness):
    """A check that also asks a silent peer for a sign of life: a proxy may hold the connection of one that is gone."""

    def __init__(
        self, sock: Layer, link: LinkLife, sender: LayeredSender, receiver: LayeredReceiver, context: LinkContext
    ) -> None:
        super().__init__(sock, link, sender, receiver, context)
        self._layer = sock
        self._layered_sender = sender
        self._received = 0
        self._silent_ns = 0
        self._is_asked = False

    def check(self, step_ns: int) -> None:
        super().check(step_ns)
        if not (self._layer.PINGS and self._link.is_open):
            return
        if self._layer.received_bytes != self._received or not self._receiver.is_read:
            self._received, self._silent_ns, self._is_asked = self._layer.received_bytes, 0, False
            return
        self._silent_ns += step_ns
        if not self._is_asked:
            # behind what is queued, a peer that reads slowly would not get it in time
            if self._silent_ns > PING_S * NS_PER_S and self._sender.all_sent:
                self._is_asked, self._silent_ns = True, 0
                self._layer.ping()
                self._layered_sender.flush_now()
        elif self._silent_ns > UNANSWERED_S * NS_PER_S:
            silence = duration_text(self._silent_ns)
            text = f"{self._link.peer} is unreachable: it has not answered a ping for {silence}"
            self._link.fault(Level.WARN, "unreachable", text)


class LayeredLink(Link):
    """One connection over a layer; see ``Link``."""

    def __init__(
        self,
        number: int,
        sock: Layer,
        role: Role,
        peer: str,
        context: LinkContext,
        closed: Callable[[Link, Note], None],
    ) -> None:
        self._layer = sock
        super().__init__(number, sock, role, peer, context, closed)

    def _make_native(self) -> NativeEnds | None:
        """The native passage sends frames.  It reads none, and does not encrypt."""
        if self._context.passage is None or not self._layer.is_framed:
            return None
        lock = Lock()
        return NativeEnds(NativeLink(self._context.passage, self.number, self._layer.fileno(), lock, True), lock)

    def _make_sender(self) -> Sender:
        self._layered_sender = LayeredSender(self._layer, self, self._context, self.native)
        return self._layered_sender

    def _make_receiver(self) -> Receiver:
        self._layered_receiver = LayeredReceiver(self._layer, self, self._context, self._layered_sender)
        return self._layered_receiver

    def _make_liveness(self) -> Liveness:
        return LayeredLiveness(self._layer, self, self._layered_sender, self._layered_receiver, self._context)

    @property
    def manner(self) -> str:
        return self._layer.manner

    @property
    def facts(self) -> dict[str, str]:
        return self._layer.facts()

    def peer_ended(self) -> None:
        """The peer sends no more.  One that has announced its end reads no more, either."""
        if self._layer.has_left:
            self.close(self.sender.reason or "closed by the peer")
        else:
            super().peer_ended()

    def finish(self, reason: str) -> None:
        self._layer.farewell(reason)
        super().finish(reason)

    def end_sending(self) -> None:
        self._layer.farewell(STOPPED)
        self.sender.take_unsent()
        super().end_sending()

    def close(self, reason: str = "") -> None:
        self._layer.farewell(reason or self.sender.reason)
        super().close(reason)
