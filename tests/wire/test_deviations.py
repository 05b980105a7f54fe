"""Messages that known programs send wrongly: refused with the reason in the terms of their sender."""

from __future__ import annotations

import struct

import pytest

from igtl_gateway.base.errors import WireError
from igtl_gateway.wire import Header, decode, describe
from igtl_gateway.wire.header import crc64

#: An extended header without metadata.
V2 = b"\0\x0c\0\2" + bytes(8)
IDENTITY = struct.pack(">12f", 1, 0, 0, 0, 1, 0, 0, 0, 1, 0, 0, 0)


def framed(kind: str, body: bytes, version: int = 1) -> bytes:
    return Header(version, kind, "Dev", 0, len(body), crc64(body)).pack() + body


def image(components: int, size: tuple[int, int, int], part: tuple[int, int, int], pixels: int) -> bytes:
    head = struct.pack(">HBBBB3H", 1, components, 3, 2, 1, *size) + IDENTITY + struct.pack(">6H", 0, 0, 0, *part)
    return head + bytes(pixels)


@pytest.mark.parametrize(
    ("data", "named"),
    [
        (framed("TRANSFORM", IDENTITY, 2), "openigtlink-rust 0.4.1 writes this unless its version is set to 1"),
        (framed("STRING", b"\0\3\0\2hi", 2), "without an extended header"),
        (framed("TRANSFORM", IDENTITY, 3), "openigtlink-rust"),
        (
            framed("TRANSFORM", b"\0\x0c\0\x0a\0\0\0\2\0\0\0\0" + IDENTITY + bytes(12), 3),
            "writes version 3 with metadata",
        ),
        (framed("CAPABILITY", b"TRANSFORMSTRING"), "OpenIGTLink-Java (WPI) does not pad the type names"),
        (framed("IMAGE", image(1, (4, 3, 1), (3, 4, 1), 12)), "columns and rows of the sub-volume are exchanged"),
        (framed("IMAGE", image(2, (4, 3, 1), (4, 3, 1), 36)), "RGB is declared as 2 components, as pyIGTLink"),
        (
            framed("IMAGE", b"\0\x0c\0\2\0\0\0\0\0\0\0\0" + image(2, (4, 3, 1), (4, 3, 1), 36) + b"\0\0", 2),
            "pyIGTLink 0.2.1",
        ),
        (framed("POSITION", bytes(152)), "pyigtl writes a layout of its own"),
    ],
)
def test_the_reason_names_the_sender(data: bytes, named: str) -> None:
    with pytest.raises(WireError) as caught:
        decode(data)
    assert named in str(caught.value.expected)
    assert named in describe(data)["error"]["text"]


@pytest.mark.parametrize(
    "data",
    [
        framed("TRANSFORM", IDENTITY[:-1]),
        framed("TRANSFORM", IDENTITY[:-1], 2),
        framed("IMAGE", image(1, (4, 3, 1), (4, 3, 1), 11)),
        framed("IMAGE", bytes(20)),
        framed("POSITION", bytes(30)),
    ],
)
def test_other_faults_name_nobody(data: bytes) -> None:
    with pytest.raises(WireError) as caught:
        decode(data)
    assert "(" not in str(caught.value.expected).replace("(4, 3, 1)", "")
