"""What TLS reports when it fails, in a small set of reasons."""

from __future__ import annotations

import ssl

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


class TlsError(OSError):
    """TLS has failed: ``reason`` comes from a small fixed set, ``detail`` is the text of OpenSSL."""

    def __init__(self, reason: str, detail: str = "") -> None:
        super().__init__(f"{reason} ({detail})" if detail else reason)
        self.reason = reason
        self.detail = detail

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
