"""Messages that known programs send wrongly: read if their meaning is certain, refused in the terms of their sender."""

from __future__ import annotations

import struct
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from igtl_gateway.base.buffers import join
from igtl_gateway.base.errors import ChecksumMismatch, WireError
from igtl_gateway.wire import Header, Item, Message, decode, describe, encode
from igtl_gateway.wire.deviations import BARE, DEVIATIONS, READ, VERSION_3
from igtl_gateway.wire.header import READING, crc64
from igtl_gateway.wire.message import metadata_of
from igtl_gateway.wire.text import String
from tests.strategies import messages
from tests.tables import table
from tests.wire.conformance import cases

#: An extended header without metadata.
V2 = b"\0\x0c\0\2" + bytes(8)
IDENTITY = struct.pack(">12f", 1, 0, 0, 0, 1, 0, 0, 0, 1, 0, 0, 0)
TURNED = struct.pack(">12f", 0, 1, 0, 0, 0, 1, 1, 0, 0, 10, 20, 30)
HI = b"\0\3\0\2hi"


def framed(kind: str, body: bytes, version: int = 1) -> bytes:
    return Header(version, kind, "Dev", 0, len(body), crc64(body)).pack() + body


def image(components: int, size: tuple[int, int, int], part: tuple[int, int, int], pixels: int) -> bytes:
    head = struct.pack(">HBBBB3H", 1, components, 3, 2, 1, *size) + IDENTITY + struct.pack(">6H", 0, 0, 0, *part)
    return head + bytes(pixels)


WITH_METADATA = b"\0\x0c\0\x0a\0\0\0\2\0\0\0\7" + IDENTITY + struct.pack(">HHHI", 1, 1, 3, 1) + b"kv"


@table(
    ("data", "kind", "as_sent"),
    [
        (framed("TRANSFORM", IDENTITY, 2), BARE, framed("TRANSFORM", IDENTITY)),
        (framed("TRANSFORM", TURNED, 2), BARE, framed("TRANSFORM", TURNED)),
        (framed("TRANSFORM", IDENTITY, 3), BARE, framed("TRANSFORM", IDENTITY)),
        (framed("STRING", HI, 2), BARE, framed("STRING", HI)),
        (
            framed("IMAGE", image(1, (4, 3, 1), (4, 3, 1), 12), 2),
            BARE,
            framed("IMAGE", image(1, (4, 3, 1), (4, 3, 1), 12)),
        ),
        (framed("GET_TRANS", b"", 2), BARE, framed("GET_TRANS", b"")),
        (framed("STT_TDATA", bytes(4) + b"Tracker".ljust(32, b"\0"), 2), BARE, None),
        (framed("TRANSFORM", V2 + IDENTITY + bytes(2), 3), VERSION_3, framed("TRANSFORM", V2 + IDENTITY + bytes(2), 2)),
        (framed("TRANSFORM", WITH_METADATA, 3), VERSION_3, framed("TRANSFORM", WITH_METADATA, 2)),
    ],
)
def test_what_is_certain_is_read(data: bytes, kind: str, as_sent: bytes | None) -> None:
    with pytest.raises(WireError):
        decode(data)  # by the protocol
    message = decode(data, reading=READING)
    assert message.deviation == kind and join(encode(message)) == data
    shown = describe(data)
    assert shown["deviation"] == READ[kind] and "error" not in shown
    if as_sent:
        right = decode(as_sent)
        assert replace(message, header_version=right.header_version, layout=None) == right
        assert shown["content"] == describe(as_sent)["content"] and metadata_of(data) == right.metadata
    with pytest.raises(ChecksumMismatch):
        decode(data[:57] + bytes([data[57] ^ 1]) + data[58:], reading=READING)


@table(
    ("data", "named"),
    [
        (framed("TRANSFORM", IDENTITY, 4), "found 4, expected 1 or 2"),
        (framed("TRANSFORM", IDENTITY, 0), "found 0, expected 1 or 2"),
        (framed("TRANSFORM", IDENTITY[:-1], 2), "extended header"),
        (framed("TRANSFORM", IDENTITY[:-1], 3), "header version 3 with metadata"),
        # what may be an extended header is one: 36 bytes are left for the pose
        (framed("TRANSFORM", b"\0\x0c" + bytes(46), 2), "36 bytes"),
        (framed("STATUS", struct.pack(">Hq20s", 13, 0, b"Warming") + b"no\0", 2), "expected"),
        (framed("STRING", HI + b"more", 2), "extended header"),
        (framed("TRANSFORM", b"", 2), "extended header"),
        (framed("GET_TRANS", bytes(8), 2), "extended header"),
        (framed("UNKNOWN", IDENTITY, 2), "extended header"),
        (framed("TRANSFORM", WITH_METADATA[:-1], 3), "header version 3 with metadata"),
    ],
)
def test_what_may_mean_something_else_is_refused(data: bytes, named: str) -> None:
    for reading in (0, READING):
        with pytest.raises(WireError) as caught:
            decode(data, reading=reading)
    assert named in str(caught.value) and named in describe(data)["error"]["text"]


@pytest.mark.parametrize(
    ("data", "named"),
    [
        (framed("TRANSFORM", IDENTITY, 2), "openigtlink-rust 0.4.1: header version 2 without an extended header"),
        (framed("STRING", HI, 2), "without an extended header"),
        (framed("TRANSFORM", IDENTITY, 3), "openigtlink-rust"),
        (framed("TRANSFORM", WITH_METADATA, 3), "header version 3 with metadata"),
        (framed("CAPABILITY", b"TRANSFORMSTRING"), "OpenIGTLink-Java (WPI) 94ffbb9: CAPABILITY has names"),
        (framed("CAPABILITY", b"\0\0\0\2TRANSFORM\0STRING\0"), "openigtlink-rust 0.4.1: CAPABILITY has a count"),
        (framed("IMAGE", image(1, (4, 3, 1), (4, 3, 1), 12)[:60] + bytes(12), 2), "no fields of the sub-volume"),
        (framed("IMAGE", image(1, (4, 3, 1), (3, 4, 1), 12)), "columns and rows of the sub-volume exchanged"),
        (framed("IMAGE", image(2, (4, 4, 3), (4, 4, 3), 48)), "pyIGTLink 0.2.1: RGB is declared as 2 components"),
        (framed("IMAGE", V2 + image(2, (4, 4, 3), (4, 4, 3), 48) + b"\0\0", 2), "pyIGTLink 0.2.1"),
        (framed("POSITION", bytes(152)), "POSITION has a layout of its own"),
    ],
)
def test_the_reason_names_the_sender(data: bytes, named: str) -> None:
    with pytest.raises(WireError) as caught:
        decode(data)
    assert named in str(caught.value.expected)


def test_each_row_of_the_table_is_complete() -> None:
    for row in DEVIATIONS:
        assert row.program and row.differs and row.gateway and row.change and "|" not in row.text
        assert bool(row.shows) == ("deviation_read" in row.gateway or row.gateway.startswith("refused; the error"))


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


def test_new_metadata_are_sent_by_the_protocol() -> None:
    message = replace(decode(framed("STRING", HI, 2), reading=READING), metadata=(Item("k", b"v"),))
    again = decode(join(encode(message)))
    assert (again.content, again.metadata, again.deviation) == (String(b"hi"), message.metadata, "")


def test_no_message_of_the_vectors_and_corpora_changes_its_meaning() -> None:
    count = 0
    for case in cases():
        try:
            message = decode(case.data)
        except WireError:
            continue
        count += 1
        assert decode(case.data, reading=READING) == message and not message.deviation
    assert count > 250


@given(messages())
def test_no_valid_message_changes_its_meaning(message: Message) -> None:
    data = join(encode(message))
    read = decode(data)
    assert decode(data, reading=READING) == read and not read.deviation


@given(messages(), st.integers(2, 3))
def test_a_bare_message_means_what_it_means_in_version_1_or_is_refused(message: Message, version: int) -> None:
    plain = join(encode(replace(message, header_version=1, message_id=0, metadata=(), layout=None)))
    bare = struct.pack(">H", version) + plain[2:]
    try:
        read = decode(bare, reading=READING)
    except WireError:
        return
    if read.deviation == BARE:
        assert replace(read, header_version=1, layout=None) == decode(plain)
        assert join(encode(read)) == bare
