"""Ed25519 keys of seals: private keys that only their owner can read, sets of trusted public keys, and rotation.

A private key is PKCS#8 in PEM, a public key SubjectPublicKeyInfo in PEM, as ``openssl pkey`` writes them.  A new key
may have *introductions* behind its PEM block, one a line: envelopes in which the key before it states its identifier.
They are part of every seal, so that a reader who trusts an old key also trusts the new one.
"""

from __future__ import annotations

import hashlib
import json
import stat
import sys
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from igtl_gateway.base.errors import ConfigError, DamagedRecording, Unavailable, UnsupportedRecording
from igtl_gateway.base.extras import missing
from igtl_gateway.base.untrusted.files import read_bytes
from igtl_gateway.base.untrusted.shape import fields, text
from igtl_gateway.base.untrusted.text import parse_json
from igtl_gateway.record.seal import envelope
from igtl_gateway.record.seal.envelope import Envelope

if TYPE_CHECKING:
    from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

#: Bytes of a public key and of a signature.
PUBLIC_BYTES, SIGNATURE_BYTES = 32, 64
#: Maximum number of introductions that trust follows.
MAX_INTRODUCTIONS = 100

_STATEMENT = "https://in-toto.io/Statement/v1"
_INTRODUCTION = "urn:igtl-gateway:introduction:v1"
_BEGIN, _END = b"-----BEGIN PUBLIC KEY-----", b"-----END PUBLIC KEY-----"
_GROUP_AND_OTHERS = stat.S_IRWXG | stat.S_IRWXO


def _library() -> Any:
    """Return the modules of ``cryptography``.  Raises Unavailable where it is not installed."""
    try:
        from cryptography.hazmat.primitives import serialization
        from cryptography.hazmat.primitives.asymmetric import ed25519
    except ImportError as error:
        raise Unavailable(missing("cryptography", error)) from None
    return ed25519, serialization


def key_id(public: bytes) -> str:
    """Return the identifier of a public key: the first 16 hexadecimal digits of its SHA-256."""
    return hashlib.sha256(public).hexdigest()[:16]


@dataclass(frozen=True, slots=True)
class SigningKey:
    """A private key.

    Attributes:
        public: its public key, 32 bytes.
        introductions: envelopes as JSON, oldest first.
    """

    _private: Ed25519PrivateKey
    public: bytes
    introductions: tuple[str, ...] = ()

    @classmethod
    def generate(cls) -> SigningKey:
        """Return a new key.  Raises Unavailable."""
        ed25519, _ = _library()
        private = ed25519.Ed25519PrivateKey.generate()
        return cls(private, private.public_key().public_bytes_raw())

    def successor(self) -> SigningKey:
        """Return a new key that this one introduces."""
        new = SigningKey.generate()
        return SigningKey(new._private, new.public, (*self.introductions, self.introduce(new)))

    @classmethod
    def load(cls, path: Path) -> SigningKey:
        """Read a key.  Raises ConfigError if it is another file or others than its owner may read it; Unavailable."""
        ed25519, serialization = _library()
        try:
            data = read_bytes(path)
        except UnsupportedRecording as error:
            raise ConfigError(f"key {error}") from None
        mode = stat.S_IMODE(path.stat().st_mode)
        if mode & _GROUP_AND_OTHERS and sys.platform != "win32":  # there the folder decides who may read it
            raise ConfigError(f"key {path}: found mode {mode:04o}, expected 0600: others may read it")
        try:
            private = serialization.load_pem_private_key(data, None)
        except TypeError:
            raise ConfigError(f"key {path}: found an encrypted key, expected one without a password") from None
        except Exception as error:  # the library has no class of its own for them
            reason = str(error).partition("\n")[0] or type(error).__name__
            raise ConfigError(f"key {path}: found no private key in PEM ({reason[:80]})") from None
        if not isinstance(private, ed25519.Ed25519PrivateKey):
            raise ConfigError(f"key {path}: found a key of another kind, expected Ed25519")
        return cls(private, private.public_key().public_bytes_raw(), _lines_of(data))

    @property
    def id(self) -> str:
        return key_id(self.public)

    def sign(self, payload: bytes) -> Envelope:
        """Return the signed envelope of a payload."""
        return Envelope(payload, self.id, self._private.sign(envelope.signed_bytes(payload)))

    def introduce(self, successor: SigningKey) -> str:
        """Return the envelope that states that ``successor`` continues this key."""
        statement = {
            "_type": _STATEMENT,
            "subject": [{"name": f"key {successor.id}", "digest": {"sha256": _digest(successor.public)}}],
            "predicateType": _INTRODUCTION,
            "predicate": {"by": _text(self.public), "key": _text(successor.public)},
        }
        return envelope.pack(self.sign(json.dumps(statement, sort_keys=True).encode()))

    def private_pem(self) -> bytes:
        """Return the content of the file of the private key, with its introductions."""
        _, serialization = _library()
        pem: bytes = self._private.private_bytes(
            serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
        )
        return pem + "".join(f"{line}\n" for line in self.introductions).encode()

    def public_pem(self) -> bytes:
        """Return the content of the file of the public key."""
        _, serialization = _library()
        pem: bytes = self._private.public_key().public_bytes(
            serialization.Encoding.PEM, serialization.PublicFormat.SubjectPublicKeyInfo
        )
        return pem


def verifies(found: Envelope, public: bytes) -> bool:
    """Return whether the signature of an envelope is that of a key.  Raises Unavailable."""
    ed25519, _ = _library()
    if found.key_id != key_id(public):
        return False
    try:
        ed25519.Ed25519PublicKey.from_public_bytes(public).verify(found.signature, envelope.signed_bytes(found.payload))
    except Exception:  # InvalidSignature, or bytes that are not a key
        return False
    return True


def load_trusted(paths: Iterable[Path]) -> frozenset[bytes]:
    """Read the public keys (PEM, any number in each file).  Raises ConfigError for a file without any; Unavailable."""
    ed25519, serialization = _library()
    found = set()
    for path in paths:
        try:
            blocks = _public_blocks(read_bytes(path))
        except UnsupportedRecording as error:
            raise ConfigError(f"trusted keys {error}") from None
        if not blocks:
            raise ConfigError(f"trusted keys {path}: found no public key, expected PEM blocks 'PUBLIC KEY'")
        for block in blocks:
            try:
                public = serialization.load_pem_public_key(block)
            except Exception:
                raise ConfigError(f"trusted keys {path}: found a damaged public key") from None
            if not isinstance(public, ed25519.Ed25519PublicKey):
                raise ConfigError(f"trusted keys {path}: found a key of another kind, expected Ed25519")
            found.add(public.public_bytes_raw())
    return frozenset(found)


def _public_blocks(data: bytes) -> list[bytes]:
    """Return the PEM blocks of public keys in a file, in one pass over it."""
    pieces = (piece.partition(_END) for piece in data.split(_BEGIN)[1:])
    return [_BEGIN + body + end for body, end, _ in pieces if end]


def trusted_with(trusted: frozenset[bytes], introductions: Sequence[str]) -> frozenset[bytes]:
    """Return the trusted keys and those that they introduce, directly or through others."""
    known = set(trusted)
    for written in introductions[:MAX_INTRODUCTIONS]:
        try:
            found = envelope.parse(written, "introduction")
            by, key = _introduction(found.payload)
        except DamagedRecording:
            continue
        if by in known and verifies(found, by):
            known.add(key)
    return frozenset(known)


_SHAPE = fields(
    {"predicateType": text, "predicate": fields({"by": text, "key": text}, needed=("by", "key"))},
    needed=("predicateType", "predicate"),
    other=lambda _value, _place: None,
)


def _introduction(payload: bytes) -> tuple[bytes, bytes]:
    """Return the key that introduces, and the one that it introduces.  Raises DamagedRecording."""
    statement = parse_json(payload.decode("utf-8", "replace"), "introduction")
    _SHAPE(statement, "introduction")
    if statement["predicateType"] != _INTRODUCTION:
        raise DamagedRecording("introduction: found another statement")
    return public_of(statement["predicate"]["by"]), public_of(statement["predicate"]["key"])


def public_of(written: str) -> bytes:
    """Return a public key written in hexadecimal digits.  Raises DamagedRecording."""
    try:
        public = bytes.fromhex(written)
    except ValueError:
        public = b""
    if len(public) != PUBLIC_BYTES or written != public.hex():
        raise DamagedRecording("key: found other text, expected 64 hexadecimal digits")
    return public


def _text(public: bytes) -> str:
    return public.hex()


def _digest(public: bytes) -> str:
    return hashlib.sha256(public).hexdigest()


def _lines_of(data: bytes) -> tuple[str, ...]:
    """Return the introductions in the file of a private key."""
    lines = data.decode("utf-8", "replace").splitlines()
    return tuple(line for line in lines if line.startswith("{"))
