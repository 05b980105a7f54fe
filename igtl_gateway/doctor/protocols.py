"""Whose language it is, by the first bytes: OpenIGTLink, or one of the protocols that ports are mixed up with."""

from __future__ import annotations

import re
from collections.abc import Callable

from igtl_gateway.wire.header import DEVICE_NAME_AT, TYPE

#: A type name in its 12 bytes: letters, digits and _, up to the first zero if there is one.
_TYPE = re.compile(rb"[A-Za-z][A-Za-z0-9_]*(\x00.*)?", re.ASCII | re.DOTALL)
_PRINTABLE = re.compile(rb"[\t\r\n -~]+")
#: Bytes of text that are no accident.
_TEXT = 8


def _begins(*starts: bytes) -> Callable[[bytes], bool]:
    return lambda head: head.startswith(starts)


def _has(*words: bytes) -> Callable[[bytes], bool]:
    return lambda head: any(word in head for word in words)


def _is_http2(head: bytes) -> bool:
    """A frame of settings: three bytes of length, type 4, stream 0."""
    return len(head) >= 9 and head[:2] == b"\0\0" and head[3] == 4 and head[5:9] == bytes(4)


#: What it is, and how it is known by its first bytes; the first that fits counts.
PROTOCOLS: tuple[tuple[str, Callable[[bytes], bool]], ...] = (
    ("SSH", _begins(b"SSH-")),
    ("HTTP (a web server, a ROS 1 master, rosbridge or Foxglove)", _begins(b"HTTP/", b"<!DOCTYPE", b"<html", b"<?xml")),
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
    """Whether these first bytes of a message (up to 58) may be its header: a type name stands at its place.

    Of less than a type name only the header version can be judged.
    """
    if len(head) < DEVICE_NAME_AT:
        return head[:1] in (b"", b"\0") and head[1:2] in (b"", b"\1", b"\2")
    # a version of two letters is the beginning of a text
    return _TYPE.fullmatch(head[TYPE]) is not None and not _PRINTABLE.fullmatch(head[:DEVICE_NAME_AT])


def protocol_of(head: bytes) -> str:
    """What speaks like this, for people; ``""`` if it is not known."""
    for name, fits in PROTOCOLS:
        if fits(head):
            return name
    return "text" if len(head) >= _TEXT and _PRINTABLE.fullmatch(head) else ""
