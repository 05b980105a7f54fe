"""A socket that encrypts, with the interface that a link needs of a socket."""

from __future__ import annotations

import socket
import ssl
import threading
from collections.abc import Sequence
from contextlib import suppress
from typing import Any

from igtl_gateway.edges.tcp.layer import Layer, LayerError
from igtl_gateway.edges.tcp.outbox import Part

_BATCH = 64 * 2**10  # encrypted at once; what the kernel does not take of it waits here
_RECORD = 16 * 2**10  # the most that one TLS record holds
_HANDSHAKE, _ALERT = 0x16, 0x15  # first byte of the records that a conversation may begin with


PLAIN_TO_TLS = "plain text spoken to a TLS port"
TLS_TO_PLAIN = "TLS spoken to a plain port"

#: Why OpenSSL does not trust a certificate, by its code.
_DISTRUST = {
    9: "certificate not yet valid",
    10: "certificate expired",
    23: "certificate revoked",
    62: "certificate of another host",
    64: "certificate of another host",
}
_REASONS = {
    "PEER_DID_NOT_RETURN_A_CERTIFICATE": "no certificate",
    "UNSUPPORTED_PROTOCOL": "TLS version too old",
    "WRONG_VERSION_NUMBER": "TLS version too old",
    "NO_SHARED_CIPHER": "no cipher in common",
}
#: Words in the names of the alerts by which a peer refuses our certificate.
_ALERTS = ("CERTIFICATE", "UNKNOWN_CA", "ACCESS_DENIED")


class TlsError(LayerError):
    """TLS has failed; ``detail`` is the text of OpenSSL."""

    code = "tls_failed"
    what = "invalid TLS records"

    @classmethod
    def of(cls, error: ssl.SSLError) -> TlsError:
        """Return the TlsError that an error of OpenSSL means."""
        if isinstance(error, ssl.SSLCertVerificationError):
            return cls(_DISTRUST.get(error.verify_code, "certificate unknown"), error.verify_message)
        name = error.reason or "unknown error"
        detail = name.lower().replace("_", " ")
        if "ALERT" in name and any(word in name for word in _ALERTS):
            return cls("the other side refuses our certificate", detail)
        return cls(_REASONS.get(name, "TLS failed"), detail)


class TlsSocket(Layer):
    """A connected non-blocking socket with TLS on it."""

    NAME = "TLS"

    def __init__(self, sock: socket.socket, context: ssl.SSLContext, *, server_side: bool, host: str = "") -> None:
        super().__init__(sock)
        self._tcp = sock
        self._server_side = server_side
        self._lock = threading.Lock()  # guards all below; nothing else is taken under it
        self._incoming, self._outgoing = ssl.MemoryBIO(), ssl.MemoryBIO()
        self._tls = context.wrap_bio(self._incoming, self._outgoing, server_side, host or None)
        self._unsent = memoryview(b"")  # encrypted
        self._early = b""  # received with the end of the handshake

    @property
    def pending(self) -> int:
        return len(self._unsent) + self._outgoing.pending

    def facts(self) -> dict[str, str]:
        subject: Any = (self._tls.getpeercert() or {}).get("subject", ())
        name = ", ".join(f"{key}={value}" for part in subject for key, value in part)
        return {"tls": str(self._tls.version()), "certificate": name}

    def do_handshake(self) -> bool:
        """Do as much of the handshake as is possible now; True when it is complete.  Raises OSError.

        With TLS 1.3 a server checks our certificate after our part of the handshake: then its first record (a ticket,
        as a rule, or an alert) completes it.
        """
        with self._lock:
            while True:
                try:
                    self._tls.do_handshake()
                except ssl.SSLWantReadError:
                    if not self._flush() or not self._receive():
                        return False
                except ssl.SSLError as error:
                    self._send_alert()
                    raise TlsError.of(error) from None
                else:
                    self._flush()
                    self.more = self.shaken = True
                    return self._server_side or self._tls.version() != "TLSv1.3" or self._check_verdict()

    def _check_verdict(self) -> bool:
        """Whether the server has sent anything after the handshake; raises TlsError if that is a refusal."""
        received = self._incoming.pending > 0
        while True:
            try:
                self._early += self._tls.read(_RECORD)
                return True
            except ssl.SSLWantReadError:
                if received or not self._receive():
                    return received
                received = True
            except (ssl.SSLZeroReturnError, ssl.SSLEOFError):
                return True  # the link finds the end
            except ssl.SSLError as error:
                raise TlsError.of(error) from None

    def _receive(self) -> bool:
        """Give OpenSSL the received bytes; False if there are none."""
        try:
            data = self._tcp.recv(_BATCH)
        except (BlockingIOError, InterruptedError):
            return False
        if not self.begun and data:
            self.begun = True
            if data[0] not in (_HANDSHAKE, _ALERT):
                raise TlsError(PLAIN_TO_TLS if self._server_side else "the server does not speak TLS")
        if data:
            self._incoming.write(data)
        else:
            self._incoming.write_eof()
        return True

    def sendmsg(self, parts: Sequence[Part]) -> int:
        taken = 0
        with self._lock:
            if not self._flush():
                raise BlockingIOError
            for part in parts:
                view = memoryview(part)
                while view:
                    try:
                        count = self._tls.write(view[:_RECORD])
                    except ssl.SSLError as error:
                        raise TlsError.of(error) from None
                    taken += count
                    view = view[count:]
                    if self._outgoing.pending >= _BATCH and not self._flush():
                        return taken
            self._flush()
        return taken

    def flush(self) -> bool:
        with self._lock:
            return self._flush()

    def _flush(self) -> bool:
        while True:
            if not self._unsent:
                if not self._outgoing.pending:
                    return True
                self._unsent = memoryview(self._outgoing.read())
            try:
                count = self._sock.send(self._unsent)
            except (BlockingIOError, InterruptedError):
                return False
            self._unsent = self._unsent[count:]

    def recv_into(self, room: memoryview) -> int:
        with self._lock:
            if self._early:
                count = min(len(room), len(self._early))
                room[:count] = self._early[:count]
                self._early = self._early[count:]
                return count
            if not self.more and not self._receive():
                raise BlockingIOError
            count = 0
            try:
                while count < len(room):
                    got: Any = self._tls.read(len(room) - count, room[count:])  # a number, with a buffer given
                    if not got:  # the peer has closed the connection in an orderly way
                        break
                    count += got
                self.more = count > 0  # there might be more behind a full room; the next call returns the end
            except ssl.SSLWantReadError:
                self.more = False
                if not count:
                    raise BlockingIOError from None
            except (ssl.SSLZeroReturnError, ssl.SSLEOFError):
                self.more = count > 0  # the next call returns the end
            except ssl.SSLError as error:
                self._send_alert()
                raise TlsError.of(error) from None
            self._send_alert()  # a change of keys needs an answer
            return count

    def ping(self) -> None:
        """TLS has no such question."""

    def farewell(self, reason: str) -> None:
        """TLS has no words for it."""

    def shutdown(self, how: int) -> None:
        """Like a socket's ``shutdown``; a close_notify shows the peer that the end is deliberate."""
        if how == socket.SHUT_WR:
            self._send_close_notify()
        self._sock.shutdown(how)

    def _send_close_notify(self) -> None:
        with self._lock:
            with suppress(OSError):
                self._tls.unwrap()  # never complete at once: the peer has to answer
            self._send_alert()

    def _send_alert(self) -> None:
        """Send the last records of OpenSSL, as far as the kernel takes them."""
        with suppress(OSError):
            self._flush()

    def close(self) -> None:
        """Like a socket's ``close``, behind a close_notify if there was none."""
        self._send_close_notify()
        self._sock.close()
