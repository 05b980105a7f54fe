"""A time-stamp authority for the tests: certificates by ``cryptography``, replies by ``openssl ts``."""

from __future__ import annotations

import datetime
import subprocess
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

_DAY = datetime.timedelta(days=1)
_CONFIG = """
[tsa]
default_tsa = here
[here]
serial = {folder}/serial
default_policy = 1.2.3.4
digests = sha256, sha512
signer_digest = sha256
ess_cert_id_chain = no
ess_cert_id_alg = sha256
"""


@dataclass(frozen=True)
class Authority:
    """A root certificate, and a folder with the key and the certificate that sign."""

    folder: Path
    root: Path

    def reply(self, digest: str, *, algorithm: str = "sha256", certificates: bool = True) -> Path:
        """Return the reply about a digest (hexadecimal)."""
        query, reply = self.folder / "query.tsq", self.folder / f"{digest[:8]}-{algorithm}-{certificates}.tsr"
        cert = ["-cert"] if certificates else []
        _openssl("ts", "-query", "-digest", digest, f"-{algorithm}", *cert, "-out", query)
        _openssl("ts", "-reply", "-queryfile", query, "-config", self.folder / "tsa.cnf", "-signer",
                 self.folder / "tsa.pem", "-inkey", self.folder / "tsa.key", "-out", reply)  # fmt: skip
        return reply


def new_authority(folder: Path, name: str, *, days: int = 30, usage: bool = True, inner: bool = False) -> Authority:
    """Make an authority.

    Args:
        folder: for its files.
        name: of its certificates.
        days: until the certificate that signs ends; negative: it has ended.
        usage: whether that may sign time stamps.
        inner: whether another certificate is between it and the root.
    """
    folder.mkdir()
    (folder / "serial").write_text("01\n")
    (folder / "tsa.cnf").write_text(_CONFIG.format(folder=folder))
    root_key = ec.generate_private_key(ec.SECP256R1())
    root = _certificate(f"{name} root", root_key, f"{name} root", root_key, 3650, authority=True)
    issuer, issuer_key = f"{name} root", root_key
    chain = _pem(root)
    if inner:
        issuer_key = ec.generate_private_key(ec.SECP256R1())
        chain += _pem(_certificate(f"{name} inner", issuer_key, issuer, root_key, 3650, authority=True))
        issuer = f"{name} inner"
    key = ec.generate_private_key(ec.SECP256R1())
    leaf = _certificate(name, key, issuer, issuer_key, days, authority=False, usage=usage)
    (folder / "root.pem").write_bytes(chain)
    (folder / "tsa.pem").write_bytes(_pem(leaf))
    (folder / "tsa.key").write_bytes(
        key.private_bytes(serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption())
    )
    return Authority(folder, folder / "root.pem")


def _certificate(
    subject: str, key: Any, issuer: str, issuer_key: Any, days: int, *, authority: bool, usage: bool = True
) -> x509.Certificate:
    now = datetime.datetime.now(datetime.timezone.utc)
    builder = (
        x509.CertificateBuilder()
        .subject_name(x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, subject)]))
        .issuer_name(x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, issuer)]))
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - 60 * _DAY)
        .not_valid_after(now + days * _DAY)
        .add_extension(x509.BasicConstraints(ca=authority, path_length=None), critical=True)
        .add_extension(x509.SubjectKeyIdentifier.from_public_key(key.public_key()), critical=False)
    )
    if not authority:
        purpose = ExtendedKeyUsageOID.TIME_STAMPING if usage else ExtendedKeyUsageOID.CODE_SIGNING
        builder = builder.add_extension(x509.ExtendedKeyUsage([purpose]), critical=True)
    return builder.sign(issuer_key, hashes.SHA256())


def _pem(certificate: x509.Certificate) -> bytes:
    return certificate.public_bytes(serialization.Encoding.PEM)


def _openssl(*words: object) -> None:
    subprocess.run(["openssl", *map(str, words)], check=True, capture_output=True)
