"""Time stamps of RFC 3161: the reply of an authority that confirms when the digest of a seal existed.

Nothing here uses a network: the certificates of the authority come from files, and are valid if they were so at the
time of the stamp.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from igtl_gateway.base.errors import ConfigError, Unavailable, UnsupportedRecording
from igtl_gateway.base.extras import missing
from igtl_gateway.base.quantities import count_text
from igtl_gateway.base.stamp import NS_PER_S
from igtl_gateway.base.untrusted.files import read_bytes

#: Maximum size of a reply; authorities send 1 to 8 kB.
MAX_BYTES = 1 << 18

_SHA256 = "2.16.840.1.101.3.4.2.1"


@dataclass(frozen=True, slots=True)
class TimeStamp:
    """What is known about the time stamp of a file.

    Attributes:
        problem: why it is not accepted; "" if it is, or was not checked.
        checked: whether it was compared with certificates.
        time_ns: UTC ns that an accepted one states.
        authority: subject of the certificate that signed an accepted one.
    """

    problem: str = ""
    checked: bool = False
    time_ns: int = 0
    authority: str = ""


def _library() -> Any:
    """Return ``rfc3161_client``.  Raises Unavailable where it is not installed."""
    try:
        import rfc3161_client
    except ImportError as error:
        raise Unavailable(missing("rfc3161_client", error)) from None
    return rfc3161_client


def load_authorities(paths: Iterable[Path]) -> tuple[Any, ...]:
    """Read certificates (PEM, any number in each file).  Raises ConfigError for a file without any; Unavailable."""
    _library()
    from cryptography import x509

    found: list[Any] = []
    for path in paths:
        try:
            found += x509.load_pem_x509_certificates(read_bytes(path))
        except UnsupportedRecording as error:
            raise ConfigError(f"--tsa: {error}") from None
        except ValueError as error:
            reason = str(error).partition("\n")[0][:80]
            raise ConfigError(f"--tsa: {path}: found no certificates in PEM ({reason})") from None
    return tuple(dict.fromkeys(found))


def read_reply(path: Path, digest: bytes) -> bytes:
    """Return the reply of an authority in a file, whose signature is not checked.

    Raises ConfigError if it is not a reply, a refusal, or about something else than ``digest`` (SHA-256); Unavailable.
    """
    try:
        reply = read_bytes(path)
    except UnsupportedRecording as error:
        raise ConfigError(f"--time-stamp: {error}") from None
    if problem := _problem(reply, digest):
        raise ConfigError(f"--time-stamp: {path}: {problem}")
    return reply


def check_reply(reply: bytes, digest: bytes, authorities: tuple[Any, ...]) -> TimeStamp:
    """Check that an authority with these certificates confirms a digest (SHA-256).  Raises Unavailable."""
    if problem := _problem(reply, digest):
        return TimeStamp(problem, checked=True)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter(
                "ignore"
            )  # of cryptography about names of certificates: they would reach the terminal
            return _compared(reply, digest, authorities)
    except Exception:  # of many classes, for damaged certificates and names in the reply
        return TimeStamp("found a damaged certificate or signature in the reply", checked=True)


def _compared(reply: bytes, digest: bytes, authorities: tuple[Any, ...]) -> TimeStamp:
    """Return the time stamp in a reply about a digest, compared with the certificates."""
    library = _library()
    response = library.decode_timestamp_response(reply)
    signer = _signer(response, authorities)
    if signer is None:
        return TimeStamp("found no certificate of its signer, expected it in the reply or in --tsa", checked=True)
    embedded = response.signed_data.certificates
    verifier = library.VerifierBuilder(roots=list(authorities), tsa_certificate=None if embedded else signer).build()
    stated = response.tst_info.gen_time
    name = signer.subject.rfc4514_string()
    try:
        verifier.verify(response, digest)
    except library.VerificationError:
        first, last = signer.not_valid_before_utc, signer.not_valid_after_utc
        if not first <= stated <= last:
            valid = f"from {first:%F} to {last:%F}, when {name} was valid"
            problem = f"found a time stamp of {stated:%F}, expected one {valid}"
        elif not _may_sign(signer):
            problem = f"found the signer {name}, expected one whose certificate is for time stamps only"
        else:
            problem = f"found a signature of {name}, which the given certificates do not confirm"
        return TimeStamp(problem, checked=True)
    return TimeStamp("", True, int(stated.timestamp()) * NS_PER_S + stated.microsecond * 1000, name)


def _problem(reply: bytes, digest: bytes) -> str:
    """Return why a reply does not confirm a digest; "" if it may."""
    if len(reply) > MAX_BYTES:
        return f"found {count_text(len(reply), 'byte')}, expected at most {MAX_BYTES:,}"
    library = _library()
    try:
        response = library.decode_timestamp_response(reply)
        status = int(response.status)
        if status:
            return f"found a reply of status {status}, expected 0: granted"
        imprint = response.tst_info.message_imprint
        algorithm, stamped = imprint.hash_algorithm.dotted_string, bytes(imprint.message)
    except Exception:  # the library has no class of its own for all of them
        return "found no reply of a time-stamp authority (RFC 3161, DER)"
    if algorithm != _SHA256:
        return f"found the hash algorithm {algorithm}, expected {_SHA256}: SHA-256"
    if stamped != digest:
        return f"found a time stamp of {stamped.hex()[:64]}, expected one of {digest.hex()}"
    return ""


def _may_sign(signer: Any) -> bool:
    """Return whether a certificate is for time stamps."""
    from cryptography import x509

    try:
        usage = signer.extensions.get_extension_for_class(x509.ExtendedKeyUsage)
    except (x509.ExtensionNotFound, ValueError):
        return False
    return usage.critical and x509.oid.ExtendedKeyUsageOID.TIME_STAMPING in usage.value


def _signer(response: Any, authorities: tuple[Any, ...]) -> Any:
    """Return the certificate of the signer, from the reply or from those that are given; None if it is in neither."""
    from cryptography import x509

    infos = list(response.signed_data.signer_infos)
    embedded: list[Any] = []
    for data in response.signed_data.certificates:
        try:
            embedded.append(x509.load_der_x509_certificate(data))
        except ValueError:
            continue
    return next(
        (
            each
            for each in (*embedded, *authorities)
            if any((each.issuer, each.serial_number) == (info.issuer, info.serial_number) for info in infos)
        ),
        None,
    )
