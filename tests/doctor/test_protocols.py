"""Protocols and their first bytes."""

from __future__ import annotations

from igtl_gateway.doctor.protocols import is_openigtlink, protocol_of
from igtl_gateway.wire import Header
from tests.tables import table


@table(
    ("head", "name"),
    [
        (b"SSH-2.0-OpenSSH_9.2p1\r\n", "SSH"),
        (b"HTTP/1.1 400 Bad Request\r\n", "HTTP"),
        (b"<!DOCTYPE HTML>\n<html>", "HTTP"),
        (b"GET / HTTP/1.1\r\nUpgrade: websocket", "HTTP client"),
        (b"\0\0\x12\4\0\0\0\0\0\0\3\0\0\0\x80", "HTTP/2"),
        (b"\x16\3\1\2\0\1\0\1\xfc\3\3", "TLS"),
        (b"\x15\3\1\0\2\2\x46", "TLS"),
        (b"\xb0\0\0\0\x12\0\0\0callerid=/node", "ROS 1"),
        (b"RTPS\2\3\1\x0f", "DDS"),
        (b"RFB 003.008\n", "VNC"),
        (b"220 mail.example.org ESMTP", "mail"),
        (b'{"op": "subscribe"}', "JSON"),
        (b"hello, who is there?\n", "text"),
        (bytes(range(100, 158)), ""),
    ],
)
def test_other_protocols(head: bytes, name: str) -> None:
    assert not is_openigtlink(head)
    assert name in protocol_of(head) and bool(name) == bool(protocol_of(head))


def test_headers_are_recognised() -> None:
    for version, kind in ((1, "TRANSFORM"), (2, "RTS_COMMAND"), (65535, "A"), (0, "lower")):
        head = Header(version, kind, "any device", 0, 1 << 40, 0).pack()
        assert is_openigtlink(head) and is_openigtlink(head[:14])
    assert is_openigtlink(b"\0\1") and is_openigtlink(b"") and not is_openigtlink(b"\0\3")
