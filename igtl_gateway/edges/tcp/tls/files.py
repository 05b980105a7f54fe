"""Certificates and keys as files, and the contexts of OpenSSL that follow from them."""

from __future__ import annotations

import ssl
from dataclasses import dataclass
from pathlib import Path

from igtl_gateway.base.errors import ConfigError, RecordingError
from igtl_gateway.base.untrusted.files import open_file

Context = ssl.SSLContext


@dataclass(frozen=True, slots=True)
class TlsFiles:
    """PEM files: our certificate (with the intermediate ones), its key, and the CA of the peers."""

    cert: Path | None = None
    key: Path | None = None
    ca: Path | None = None

    def server(self) -> ssl.SSLContext:
        """Return the context of a server.  Raises ConfigError."""
        if self.cert is None:
            raise ConfigError("TLS: found no certificate, expected --tls-cert FILE (and --tls-key) for a server")
        context = self._own(ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER))
        if self.ca:
            context.verify_mode = ssl.CERT_REQUIRED
            self._trust(context, self.ca)
        return context

    def client(self) -> ssl.SSLContext:
        """Return the context of a client, which without a CA here trusts those of the system.  Raises ConfigError."""
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
                # a password is never asked for: a service has no terminal
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
    """Raise ConfigError if this is not a regular file: OpenSSL would block on a FIFO, and never finish a device."""
    try:
        open_file(path).close()
    except RecordingError as error:
        raise ConfigError(f"{option} {error}") from None
