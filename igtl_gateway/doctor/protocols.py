"""Detection of the protocol by its first bytes: OpenIGTLink, or one whose port is often confused with it."""

from __future__ import annotations

import re
from collections.abc import Callable

from igtl_gateway.wire.header import DEVICE_NAME_AT, TYPE

#: A type name in its 12 bytes: letters, digits and _, up to the first zero or the end.
_TYPE = re.compile(rb"[A-Za-z][A-Za-z0-9_]*(\x00.*)?", re.ASCII | re.DOTALL)
_PRINTABLE = re.compile(rb"[\t\r\n -~]+")
#: Number of printable bytes that are text and not a coincidence.
_TEXT = 8


def _begins(*starts: bytes) -> Callable[[bytes], bool]:
    return lambda head: head.startswith(starts)


def _has(*words: bytes) -> Callable[[bytes], bool]:
    return lambda head: any(word in head for word in words)


def _is_http2(head: bytes) -> bool:
    """Return whether it begins with a SETTINGS frame: three bytes of length, type 4, stream 0."""
    return len(head) >= 9 and head[:2] == b"\0\0" and head[3] == 4 and head[5:9] == bytes(4)


#: Name of a protocol, and the test of its first bytes; the first match counts.
PROTOCOLS: tuple[tuple[str, Callable[[bytes], bool]], ...] = (
    ("SSH", _begins(b"SSH-")),
    (
        "HTTP (a web server, a WebSocket, a ROS 1 master, rosbridge or Foxglove)",
        _begins(b"HTTP/", b"<!DOCTYPE", b"<html", b"<?xml"),
    ),
    (
        "an HTTP client (a browser, a WebSocket)",
        _begins(b"GET /", b"POST /", b"HEAD /", b"PUT /", b"OPTIONS ", b"CONNECT ", b"PRI * "),
    ),
    ("HTTP/2 (gRPC, such as rerun)", _is_http2),
    ("TLS (encrypted)", _begins(b"\x16\x03", b"\x15\x03")),
    ("ROS 1 (TCPROS)", _has(b"callerid=", b"md5sum=", b"message_definition=")),
    ("DDS (RTPS over TCP)", _begins(b"RTPS", b"RTPX", b"RTCP")),
    ("VNC", _begins(b"RFB ")),
    ("FTP or mail", _begins(b"220 ", b"220-")),
    ("JSON (rosbridge over TCP?)", _begins(b"{", b"[")),
)


def is_openigtlink(head: bytes) -> bool:
    """Return whether these first bytes (up to 58) can be a message header: they have a type name at its offset.

    If they end before the type name does, only the header version is checked.
    """
    if len(head) < DEVICE_NAME_AT:
        return head[:1] in (b"", b"\0") and head[1:2] in (b"", b"\1", b"\2")
    # a printable version means text
    return _TYPE.fullmatch(head[TYPE]) is not None and not _PRINTABLE.fullmatch(head[:DEVICE_NAME_AT])


def protocol_of(head: bytes) -> str:
    """Return the name of the protocol with these first bytes; ``""`` if it is unknown."""
    for name, fits in PROTOCOLS:
        if fits(head):
            return name
    return "text" if len(head) >= _TEXT and _PRINTABLE.fullmatch(head) else ""
