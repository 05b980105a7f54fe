"""A link with TLS: bytes may wait between the queue and the kernel, and between the kernel and the framer."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from igtl_gateway.edges.tcp.link import Link
from igtl_gateway.edges.tcp.link_info import Role
from igtl_gateway.edges.tcp.link_parts import LinkContext, LinkLife
from igtl_gateway.edges.tcp.outbox import Part
from igtl_gateway.edges.tcp.receiver import Receiver
from igtl_gateway.edges.tcp.sender import Sender
from igtl_gateway.edges.tcp.tls import TlsSocket
from igtl_gateway.gateway.log.note import Note


class TlsSender(Sender):
    """A sender whose encrypted bytes the I/O thread flushes."""

    def __init__(self, sock: TlsSocket, link: LinkLife, context: LinkContext) -> None:
        super().__init__(sock, link, context)
        self._tls = sock

    @property
    def backlog(self) -> int:
        return self._tls.pending

    def flush_soon(self) -> None:
        """Have the I/O thread send what the kernel did not take; under the lock."""
        if self._tls.pending:
            self._request_room()

    def _write(self, parts: Sequence[Part]) -> int:
        sent = super()._write(parts)
        self.flush_soon()
        return sent

    def _flushed(self) -> bool:
        try:
            return self._tls.flush()
        except OSError:  # the receiver finds the end
            self.is_muted = True
            return True


class TlsReceiver(Receiver):
    """A receiver that also reads what is decrypted already, of which no system call reports anything."""

    def __init__(self, sock: TlsSocket, link: LinkLife, context: LinkContext, sender: TlsSender) -> None:
        super().__init__(sock, link, context)
        self._tls = sock
        self._sender = sender

    @property
    def has_decrypted(self) -> bool:
        """Whether the link is read, and decrypted bytes wait for that."""
        return self._link.is_open and self.is_reading and self._tls.more

    @property
    def has_waiting(self) -> bool:
        return super().has_waiting or self.has_decrypted

    def read(self) -> None:
        super().read()
        if self.has_decrypted:
            self._loop.ask(self._link.turn)
        with self._sender.lock:
            self._sender.flush_soon()


class TlsLink(Link):
    """One connection with TLS; see ``Link``."""

    def __init__(
        self,
        number: int,
        sock: TlsSocket,
        role: Role,
        peer: str,
        context: LinkContext,
        closed: Callable[[Link, Note], None],
    ) -> None:
        self._tls = sock
        super().__init__(number, sock, role, peer, context, closed)

    def _make_native(self) -> None:
        """The native passage does not decrypt."""

    def _make_sender(self) -> Sender:
        self._tls_sender = TlsSender(self._tls, self, self._context)
        return self._tls_sender

    def _make_receiver(self) -> Receiver:
        self._tls_receiver = TlsReceiver(self._tls, self, self._context, self._tls_sender)
        return self._tls_receiver

    @property
    def facts(self) -> dict[str, str]:
        return self._tls.facts()
