"""TLS for both roles: certificates, handshakes, and a socket that encrypts.

Strategy: OpenSSL never sees the socket.  It works on two buffers in memory, and what it makes is sent, what came is
given to it, by plain non-blocking system calls.  So nothing of it waits; a sender in any thread and the I/O thread as
receiver take turns at one lock, held for one batch of at most 64 KiB (tens of µs); and bytes that it has taken are
sent, whatever becomes of the messages behind them (OpenSSL on a socket wants the very same bytes again after each
"not now", which a queue that drops old messages cannot promise).

A server with a CA asks every client for a certificate of it; a client checks the server's certificate and its name.
Nothing below TLS 1.2 is spoken.
"""

from __future__ import annotations

import socket
import ssl
import threading
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from igtl_gateway.edges.tcp.loop import READ, WRITE, Loop
from igtl_gateway.edges.tcp.outbox import Part
from igtl_gateway.errors import ConfigError

Context = ssl.SSLContext

PLAIN_TO_TLS = "plain text spoken to a TLS port"
TLS_TO_PLAIN = "TLS spoken to a plain port"

_BATCH = 64 * 2**10  # encrypted at once; what the kernel does not take of it waits here
_VERDICT_S = 0.25  # how long a server without tickets may take to refuse us; several times across a continent
_RECORD = 16 * 2**10  # the most that one TLS record holds
_HANDSHAKE, _ALERT = 0x16, 0x15  # first byte of the records that a conversation may begin with

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
#: What the other side says of our certificate, in the names of alerts.
_ALERTS = ("CERTIFICATE", "UNKNOWN_CA", "ACCESS_DENIED")


class TlsError(OSError):
    """TLS that fails: ``reason`` is one of few, ``detail`` what OpenSSL says."""

    def __init__(self, reason: str, detail: str = "") -> None:
        super().__init__(f"{reason} ({detail})" if detail else reason)
        self.reason = reason
        self.detail = detail

    @classmethod
    def of(cls, error: ssl.SSLError) -> TlsError:
        """What an error of OpenSSL means."""
        if isinstance(error, ssl.SSLCertVerificationError):
            return cls(_DISTRUST.get(error.verify_code, "certificate unknown"), error.verify_message)
        name = error.reason or "unknown error"
        detail = name.lower().replace("_", " ")
        if "ALERT" in name and any(word in name for word in _ALERTS):
            return cls("the other side refuses our certificate", detail)
        return cls(_REASONS.get(name, "TLS failed"), detail)


@dataclass(frozen=True, slots=True)
class TlsFiles:
    """PEM files: our certificate (and what stands between it and the CA), its key, and the CA that peers need."""

    cert: Path | None = None
    key: Path | None = None
    ca: Path | None = None

    def server(self) -> ssl.SSLContext:
        """What a server needs.  Raises ConfigError."""
        if self.cert is None:
            raise ConfigError("TLS: found no certificate, expected --tls-cert FILE (and --tls-key) for a server")
        context = self._own(ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER))
        if self.ca:
            context.verify_mode = ssl.CERT_REQUIRED
            self._trust(context, self.ca)
        return context

    def client(self) -> ssl.SSLContext:
        """What a client needs: without a CA of its own it trusts those of the system.  Raises ConfigError."""
        context = self._own(ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT))
        if self.ca:
            self._trust(context, self.ca)
        else:
            context.load_default_certs()
        return context

    def _own(self, context: ssl.SSLContext) -> ssl.SSLContext:
        context.minimum_version = ssl.TLSVersion.TLSv1_2
        context.options |= ssl.OP_NO_RENEGOTIATION
        if self.key and not self.cert:
            raise ConfigError(f"--tls-key {self.key}: found no --tls-cert, expected the certificate that it is for")
        if self.cert:
            _readable("--tls-cert", self.cert)
            if self.key:
                _readable("--tls-key", self.key)
            try:
                # a password is never asked for: nobody may be there to type it
                context.load_cert_chain(self.cert, self.key, password="")
            except ssl.SSLError as error:
                found = f"--tls-cert {self.cert}, --tls-key {self.key or self.cert}: {error.reason or error}"
                expected = "expected a certificate and its own key as PEM, without a password"
                raise ConfigError(f"{found}; {expected}") from None
        return context

    @staticmethod
    def _trust(context: ssl.SSLContext, ca: Path) -> None:
        _readable("--tls-ca", ca)
        try:
            context.load_verify_locations(ca)
        except ssl.SSLError as error:
            raise ConfigError(f"--tls-ca {ca}: {error.reason or error}; expected certificates as PEM") from None


def _readable(option: str, path: Path) -> None:
    try:
        path.read_bytes()
    except OSError as error:
        raise ConfigError(f"{option} {path}: cannot be read: {error.strerror}") from None


class TlsSocket:
    """A connected non-blocking socket with TLS on it; what a link needs of a socket is here under the same names.

    ``more``: there may be received bytes that no system call will tell of; only ``recv_into`` does.
    ``begun``: anything was received.  ``shaken``: the handshake is over as far as we are concerned.
    """

    def __init__(self, sock: socket.socket, context: ssl.SSLContext, *, server_side: bool, host: str = "") -> None:
        self.more = False
        self.begun = False
        self._sock = sock
        self._server_side = server_side
        self._lock = threading.Lock()  # guards all below; nothing else is taken under it
        self._incoming, self._outgoing = ssl.MemoryBIO(), ssl.MemoryBIO()
        self._tls = context.wrap_bio(self._incoming, self._outgoing, server_side, host or None)
        self._unsent = memoryview(b"")  # encrypted
        self._early = b""  # received with the server's verdict
        self.shaken = False

    @property
    def pending(self) -> int:
        """Encrypted bytes that the kernel has not taken yet."""
        return len(self._unsent) + self._outgoing.pending

    def facts(self) -> dict[str, str]:
        """What is known of the other side."""
        subject: Any = (self._tls.getpeercert() or {}).get("subject", ())
        name = ", ".join(f"{key}={value}" for part in subject for key, value in part)
        return {"tls": str(self._tls.version()), "certificate": name}

    def shake(self) -> bool:
        """As much of the handshake as can be done now; True when it is over.  Raises OSError.

        With TLS 1.3 a server looks at our certificate when we are through: its first word (a ticket, as a rule, or an
        alert) is waited for.
        """
        with self._lock:
            while True:
                try:
                    self._tls.do_handshake()
                except ssl.SSLWantReadError:
                    if not self._flush() or not self._receive():
                        return False
                except ssl.SSLError as error:
                    self._tell()
                    raise TlsError.of(error) from None
                else:
                    self._flush()
                    self.more = self.shaken = True
                    return self._server_side or self._tls.version() != "TLSv1.3" or self._judged()

    def _judged(self) -> bool:
        """Whether the server has said anything; raises TlsError if that is no."""
        heard = self._incoming.pending > 0
        while True:
            try:
                self._early += self._tls.read(_RECORD)
                return True
            except ssl.SSLWantReadError:
                if heard or not self._receive():
                    return heard
                heard = True
            except (ssl.SSLZeroReturnError, ssl.SSLEOFError):
                return True  # the link finds the end
            except ssl.SSLError as error:
                raise TlsError.of(error) from None

    def _receive(self) -> bool:
        """Give OpenSSL what has come; False if that is nothing."""
        try:
            data = self._sock.recv(_BATCH)
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

    def send(self, part: Part) -> int:
        """As of a socket."""
        return self.sendmsg((part,))

    def sendmsg(self, parts: Sequence[Part]) -> int:
        """As of a socket; bytes that are counted as sent may wait here, see ``pending`` and ``flush``."""
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
        """Send what is left; whether nothing is.  Raises OSError."""
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
        """As of a socket: at most one reception from the kernel, and none while there is ``more``."""
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
                    if not got:  # the other side has said goodbye
                        break
                    count += got
                self.more = count > 0  # there may be more behind a full room; a goodbye is told at the next call
            except ssl.SSLWantReadError:
                self.more = False
                if not count:
                    raise BlockingIOError from None
            except (ssl.SSLZeroReturnError, ssl.SSLEOFError):
                self.more = count > 0  # the end is told at the next call
            except ssl.SSLError as error:
                self._tell()
                raise TlsError.of(error) from None
            self._tell()  # keys that change want an answer
            return count

    def shutdown(self, how: int) -> None:
        """As of a socket; the other side is told that this end is no accident."""
        if how == socket.SHUT_WR:
            self._say_farewell()
        self._sock.shutdown(how)

    def _say_farewell(self) -> None:
        with self._lock:
            with suppress(OSError):
                self._tls.unwrap()  # never done at once: the other side has to say the same
            self._tell()

    def _tell(self) -> None:
        """Send what OpenSSL has to say last."""
        with suppress(OSError):
            self._flush()

    def getsockname(self) -> Any:
        return self._sock.getsockname()

    def getsockopt(self, level: int, option: int, size: int) -> bytes:
        return self._sock.getsockopt(level, option, size)

    def fileno(self) -> int:
        return self._sock.fileno()

    def close(self) -> None:
        """As of a socket; the other side is told, if it is not yet."""
        self._say_farewell()
        self._sock.close()


class Handshake:
    """The beginning of one conversation, within a time; of the I/O thread alone.

    Ends with one call: ``done``, or ``refused`` with reason and detail (the socket is theirs to close).
    """

    def __init__(
        self,
        sock: TlsSocket,
        loop: Loop,
        done: Callable[[], None],
        refused: Callable[[str, str], None],
        failed: Callable[[Exception], None],
    ) -> None:
        self.sock = sock
        self._loop = loop
        self._done = done
        self._refused = refused
        self._failed = failed
        self._over = False
        self._waiting = False  # for the server's verdict

    def begin(self, timeout_s: float) -> None:
        self._loop.later(timeout_s, self._timed_out, self._failed)
        self._step(0)

    def give_way(self) -> None:
        """To one that came later."""
        self._finish()
        self._refused("no TLS handshake before others came", "")

    def cancel(self) -> None:
        """Let it be, and close."""
        self._finish()
        self.sock.close()

    def _finish(self) -> None:
        self._over = True
        self._loop.unwatch(self.sock)

    def _step(self, _mask: int) -> None:
        if self._over:  # by something else in the same turn
            return
        try:
            done = self.sock.shake()
        except TlsError as error:
            self._finish()
            self._refused(error.reason, error.detail)
        except OSError as error:
            self._finish()
            self._refused("connection lost in the TLS handshake", f"{error.strerror or error}")
        else:
            if done:
                self._finish()
                self._done()
            else:
                if self.sock.shaken and not self._waiting:
                    self._waiting = True
                    self._loop.later(_VERDICT_S, self._no_verdict, self._failed)
                events = READ | (WRITE if self.sock.pending else 0)
                self._loop.watch(self.sock, events, self._step, self._failed)

    def _no_verdict(self) -> None:
        """The server has nothing against us so far."""
        if not self._over:
            self._finish()
            self._done()

    def _timed_out(self) -> None:
        if not self._over:
            self._finish()
            self._refused("no TLS handshake in time", "")
