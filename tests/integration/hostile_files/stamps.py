"""Hostile replies of time-stamp authorities, and certificates."""

from __future__ import annotations

import base64
from collections.abc import Callable, Sequence

from tests.integration.hostile_files.case import MIB, NAUGHTY, Danger, Hostile, file


def der(tag: int, content: bytes, length: int | None = None) -> bytes:
    """One value in DER; it may claim another length."""
    size = len(content) if length is None else length
    if size < 0x80:
        return bytes([tag, size]) + content
    octets = size.to_bytes((size.bit_length() + 7) // 8, "big")
    return bytes([tag, 0x80 | len(octets)]) + octets + content


def _nested(depth: int, tag: int = 0x30) -> bytes:
    content = b""
    for _ in range(depth):
        content = der(tag, content)
    return content


def _status(number: bytes, text: bytes = b"", token: bytes = b"") -> bytes:
    texts = der(0x30, der(0x0C, text)) if text else b""
    return der(0x30, der(0x30, der(0x02, number) + texts) + token)


_SIGNED = bytes.fromhex("06092a864886f70d010702")


def _token(content: bytes) -> bytes:
    return _status(b"\0", token=der(0x30, _SIGNED + der(0xA0, content)))


_REPLIES: Sequence[tuple[str, Danger, str, Callable[[], bytes]]] = (
    ("empty", Danger.LIE, "nothing", lambda: b""),
    ("zeros", Danger.BOMB, "64 MiB of zeros", lambda: bytes(64 * MIB)),
    ("large", Danger.BOMB, "262,144 bytes", lambda: der(0x30, bytes(262_139))),
    ("deep", Danger.BOMB, "DER that is nested 10,000 deep", lambda: _nested(10_000)),
    ("deep-signed", Danger.BOMB, "signed data that are nested 20,000 deep", lambda: _token(_nested(20_000))),
    ("deep-sets", Danger.BOMB, "sets that are nested 20,000 deep", lambda: _token(_nested(20_000, 0x31))),
    ("length", Danger.LIE, "a length of 2^63", lambda: der(0x30, b"", 1 << 63)),
    ("indefinite", Danger.LIE, "a length that is not stated", lambda: b"\x30\x80" * 1000),
    ("status", Danger.LIE, "a status of 100,000 digits", lambda: _status(b"\x7f" * 100_000)),
    ("refused", Danger.TERMINAL, "a refusal with hostile text", lambda: _status(b"\2", NAUGHTY.encode())),
    ("bytes", Danger.SHAPE, "a refusal with invalid UTF-8", lambda: _status(b"\2", b"\xff\xfe\xc0")),
    ("granted", Danger.LIE, "a grant without a time stamp", lambda: _status(b"\0")),
    ("signed-empty", Danger.SHAPE, "signed data of nothing", lambda: _token(b"")),
    ("signed-null", Danger.SHAPE, "signed data that are null", lambda: _token(der(0x05, b""))),
    ("signed-numbers", Danger.SHAPE, "signed data of numbers", lambda: _token(der(0x30, der(0x02, b"\3") * 6))),
    ("pem", Danger.SHAPE, "PEM", lambda: b"-----BEGIN PKCS7-----\nAAAA\n-----END PKCS7-----\n"),
    ("random", Danger.SHAPE, "all bytes", lambda: bytes(range(256)) * 20),
    ("text", Danger.TERMINAL, "escape sequences", NAUGHTY.encode),
)


def _pem(data: bytes, name: str = "CERTIFICATE") -> bytes:
    return f"-----BEGIN {name}-----\n".encode() + base64.encodebytes(data) + f"-----END {name}-----\n".encode()


_CERTIFICATES: Sequence[tuple[str, Danger, str, Callable[[], bytes]]] = (
    ("empty", Danger.LIE, "nothing", lambda: b""),
    ("zeros", Danger.BOMB, "64 MiB of zeros", lambda: bytes(64 * MIB)),
    ("deep", Danger.BOMB, "DER that is nested 10,000 deep", lambda: _pem(_nested(10_000))),
    ("blocks", Danger.BOMB, "20,000 blocks", lambda: _pem(der(0x30, b"\5\0")) * 20_000),
    ("opened", Danger.BOMB, "100,000 blocks that do not end", lambda: b"-----BEGIN CERTIFICATE-----\n" * 100_000),
    ("length", Danger.LIE, "a length of 2^63", lambda: _pem(der(0x30, b"", 1 << 63))),
    ("key", Danger.SHAPE, "a block of another name", lambda: _pem(der(0x30, b"\5\0"), "PRIVATE KEY")),
    ("numbers", Danger.SHAPE, "a certificate of numbers", lambda: _pem(der(0x30, der(0x02, b"\3") * 3))),
    ("base64", Danger.SHAPE, "no base64", lambda: b"-----BEGIN CERTIFICATE-----\n????\n-----END CERTIFICATE-----\n"),
    ("text", Danger.TERMINAL, "escape sequences", lambda: _pem(NAUGHTY.encode()) + NAUGHTY.encode()),
    ("label", Danger.TERMINAL, "escape sequences in a label", lambda: _pem(b"\x30\0", NAUGHTY)),
)

CASES = (
    *(
        Hostile(f"tsr-{name}", "time stamp", danger, f"a reply: {what}", file("reply.tsr", data))
        for name, danger, what, data in _REPLIES
    ),
    *(
        Hostile(f"tsa-{name}", "certificate", danger, f"certificates: {what}", file("tsa.pem", data))
        for name, danger, what, data in _CERTIFICATES
    ),
)
