"""Header, extended header and metadata: every byte in its place, every lie found."""

from __future__ import annotations

import math
import struct
from dataclasses import replace
from itertools import cycle
from typing import Any

import fastcrc
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from igtl_gateway.base.buffers import join
from igtl_gateway.base.errors import ChecksumMismatch, MalformedBody, TruncatedMessage, WireError
from igtl_gateway.wire import HEADER_SIZE, Header, Item, Message, Raw, decode, describe, encode
from igtl_gateway.wire.framer import Framer
from igtl_gateway.wire.image import Image
from igtl_gateway.wire.message import MAX_METADATA_ACCEPTED, MAX_METADATA_SENT, sorted_items
from igtl_gateway.wire.text import Status, String
from igtl_gateway.wire.video import Video
from tests import strategies
from tests.tables import table

#: The worked example of the protocol reference, §2.
EXAMPLE = bytes.fromhex(
    "0002 535452494e47000000000000 4465760000000000000000000000000000000000"
    "6553f100 80000000 0000000000000029 15a007a3a439d516"
    "000c 0012 00000005 00000007"
    "0003 0002 6869"
    "0002 0001 0003 00000001 0001 006a 00000002"
    "61 31 62 c3a9"
)
HI = Message(
    "STRING",
    "Dev",
    String(b"hi"),
    0x6553F100_80000000,
    2,
    7,
    (Item("a", b"1", 3), Item("b", "é".encode(), 106)),
)


def framed(body: bytes, version: int = 2, kind: bytes = b"STRING") -> bytes:
    """A message with a right header around any body."""
    crc = fastcrc.crc64.ecma_182(body)
    return struct.pack(">H12s20sQQQ", version, kind, b"d", 0, len(body), crc) + body


def extended(ext: int = 12, head: int = 2, size: int = 0, message_id: int = 9) -> bytes:
    return struct.pack(">HHII", ext, head, size, message_id)


def test_worked_example() -> None:
    assert decode(EXAMPLE) == HI
    assert join(encode(HI)) == EXAMPLE
    assert describe(EXAMPLE)["metadata"][1] == {"key": "b", "encoding": 106, "value": "é"}


@pytest.mark.parametrize(
    ("data", "crc"),
    [
        (b"", 0),
        (b"123456789", 0x6C40DF5F0B497347),
        (b"\x01", 0x42F0E1EBA9EA3693),
        (b"\xff" * 8, 0xFCACBEBD5931A992),
        (bytes(1000), 0),
    ],
)
def test_crc(data: bytes, crc: int) -> None:
    (head, *_) = encode(Message("ANY", "d", Raw(data)))
    assert Header.unpack(head).crc == crc
    assert decode(framed(data, 1, b"ANY")).content == Raw(data)


@pytest.mark.parametrize("size", [0, 1, 57])
def test_too_short_for_a_header(size: int) -> None:
    for function in (decode, describe, Header.unpack):
        with pytest.raises(TruncatedMessage):
            function(EXAMPLE[:size])


def test_every_truncation_is_told_as_one() -> None:
    for size in range(HEADER_SIZE, len(EXAMPLE)):
        with pytest.raises(TruncatedMessage):
            decode(EXAMPLE[:size])
    with pytest.raises(MalformedBody):
        decode(EXAMPLE + b"\x00")


@pytest.mark.parametrize("version", [0, 3, 65535])
def test_unknown_header_versions(version: int) -> None:
    with pytest.raises(MalformedBody, match="version"):
        decode(framed(b"\0\3\0\2hi", version))
    with pytest.raises(MalformedBody, match="version"):
        encode(Message("STRING", "d", String(b"hi"), header_version=version))
    if version != 3:  # which is read, see test_deviations
        assert describe(framed(b"\0\3\0\2hi", version))["error"]["code"] == "malformed"


def test_crc_is_checked_unless_told_not_to() -> None:
    bent = EXAMPLE[:-1] + b"\xaa"
    with pytest.raises(ChecksumMismatch) as caught:
        decode(bent)
    computed = fastcrc.crc64.ecma_182(bent[58:])
    # for the author of the sender: what stands in its header, and what it would have to be
    assert (caught.value.found, caught.value.expected) == ("15a007a3a439d516", f"{computed:016x}")
    assert decode(bent, check_crc=False).metadata[1].value == b"\xc3\xaa"


HI_CONTENT = b"\x00\x03\x00\x02hi"


def test_a_longer_extended_header_is_skipped() -> None:
    body = extended(ext=16) + b"\xde\xad\xbe\xef" + HI_CONTENT + b"\0\0"
    message = decode(framed(body))
    assert (message.content, message.message_id, message.metadata) == (String(b"hi"), 9, ())
    assert join(encode(message)) == framed(body)


ONE_ITEM = b"\0\1" + struct.pack(">HHI", 1, 3, 1)


@pytest.mark.parametrize(
    ("body", "items"),
    [
        (extended(head=0) + HI_CONTENT, ()),  # no metadata header at all
        (extended(head=5) + HI_CONTENT + b"\0\0xyz", ()),  # bytes behind the heads of the items
        (extended(head=10, size=4) + HI_CONTENT + ONE_ITEM + b"k1xy", (Item("k", b"1"),)),  # and behind the items
        (extended(ext=14) + b"xy" + HI_CONTENT + b"\0\0", ()),
    ],
)
def test_odd_layouts_are_written_back(body: bytes, items: tuple[Item, ...]) -> None:
    message = decode(framed(body))
    assert (message.content, message.metadata) == (String(b"hi"), items)
    assert join(encode(message)) == framed(body)
    plain = decode(join(encode(replace(message, layout=None))))
    assert (plain.content, plain.metadata, plain.layout) == (message.content, items, None)
    # new metadata are sent as we send them, not as the others came
    changed = replace(message, metadata=(Item("new", b"value"),))
    assert decode(join(encode(changed))).metadata == changed.metadata


def test_more_metadata_than_we_send() -> None:
    """It is read, and written back; new metadata of that size are refused."""
    value = bytes(MAX_METADATA_SENT)
    head = b"\0\1" + struct.pack(">HHI", 1, 3, len(value))
    data = framed(extended(head=10, size=1 + len(value)) + HI_CONTENT + head + b"k" + value)
    message = decode(data)
    assert join(encode(message)) == data
    with pytest.raises(MalformedBody):
        encode(replace(message, metadata=(Item("K", value),)))


def test_sorted_items() -> None:
    """As a C++ std::map would have them: by bytes, upper case first, the last of equal keys."""
    items = [Item("b", b"1"), Item("é", b"2"), Item("a", b"3"), Item("b", b"4", 106), Item("B", b"5"), Item("", b"6")]
    assert sorted_items(items) == (items[5], items[4], items[2], items[3], items[1])
    assert sorted_items([]) == ()
    # UTF-16 would put these two the other way round
    apart = [Item("\U00010000", b""), Item("\uffff", b"")]
    assert sorted_items(apart) == (apart[1], apart[0])


@table(
    ("body", "error"),
    [
        (b"", TruncatedMessage),
        (extended()[:11], TruncatedMessage),
        (extended(ext=11) + HI_CONTENT + b"\0\0", MalformedBody),
        (extended(ext=0) + HI_CONTENT + b"\0\0", MalformedBody),
        (extended(ext=65535) + HI_CONTENT + b"\0\0", MalformedBody),
        (extended(head=65535) + HI_CONTENT + b"\0\0", MalformedBody),
        (extended(size=2**32 - 1) + HI_CONTENT + b"\0\0", MalformedBody),
        (extended(head=1) + HI_CONTENT + b"\0", TruncatedMessage),
        (extended(head=0, size=2) + HI_CONTENT + b"\0\0", TruncatedMessage),
        (extended() + HI_CONTENT + b"\xff\xff", MalformedBody),  # 65,535 items in two bytes
        (extended(head=10) + HI_CONTENT + b"\0\1" + struct.pack(">HHI", 1, 3, 0), MalformedBody),
        (extended(head=10, size=1) + HI_CONTENT + b"\0\1" + struct.pack(">HHI", 0, 3, 2**32 - 1) + b"x", MalformedBody),
        (extended(size=MAX_METADATA_ACCEPTED + 1) + HI_CONTENT + bytes(MAX_METADATA_ACCEPTED + 3), MalformedBody),
    ],
)
def test_lies_in_version_2(body: bytes, error: type[WireError]) -> None:
    with pytest.raises(error):
        decode(framed(body))
    assert describe(framed(body))["error"]["code"] == error.code


def test_no_metadata_header_at_all_is_tolerated() -> None:
    assert decode(framed(extended(head=0) + HI_CONTENT)).metadata == ()


def test_a_query_without_content() -> None:
    for version, size in ((1, 58), (2, 72)):
        data = join(encode(Message("GET_IMAGE", "", Raw(b""), header_version=version)))
        assert len(data) == size
        assert join(encode(decode(data))) == data
        assert describe(data)["content"] == {}


def test_an_empty_body_of_a_known_type_is_raw() -> None:
    assert decode(framed(b"", 1, b"IMAGE")).content == Raw(b"")
    assert len(decode(framed(b"", 1, b"POINT")).content.elements) == 0  # type: ignore[attr-defined]


@table(
    "message",
    [
        Message("T" * 13, "d", Raw(b"")),
        Message("T", "d" * 21, Raw(b"")),
        Message("T", "é" * 11, Raw(b"")),
        Message("T", "d", Raw(b""), ticks=2**64),
        Message("T", "d", Raw(b""), ticks=-1),
        Message("T", "d", Raw(b""), 0, 2, 2**32),
        Message("T", "d", Raw(b""), 0, 2, 0, (Item("k", b"", 65536),)),
        Message("T", "d", Raw(b""), 0, 2, 0, (Item("k" * 65536, b""),)),
        Message("T", "d", Raw(b""), 0, 2, 0, (Item("k", bytes(MAX_METADATA_SENT)),)),
        Message("T", "d", Raw(b""), 0, 2, 0, (Item("", b""),) * 9000),
        Message("STRING", "d", String(bytes(65536))),
        Message("STRING", "d", String(b"", 65536)),
        Message("STATUS", "d", Status(65536)),
        Message("STATUS", "d", Status(1, 2**63)),
        Message("STATUS", "d", Status(1, 0, "x" * 21)),
    ],
)
def test_what_does_not_fit_is_refused(message: Message) -> None:
    with pytest.raises(MalformedBody):
        encode(message)


def test_full_width_names() -> None:
    message = Message("ABCDEFGHIJKL", "x" * 20, Raw(b"1"))
    assert decode(join(encode(message))) == message


def test_names_with_odd_bytes() -> None:
    """Latin-1 bytes and what follows a NUL survive re-encoding; people see the readable part."""
    data = bytearray(framed(b"x", 1, b"ANY"))
    data[14:34] = b"Caf\xe9\x00rest".ljust(20, b"\0")
    message = decode(bytes(data))
    assert join(encode(message)) == data
    assert describe(bytes(data))["device_name"] == "Caf\ufffd"


def same(one: Any, two: Any) -> bool:
    """Equality of bodies with arrays, NaN equal to NaN; by what they pack to, which is what counts."""
    return type(one) is type(two) and join(one.pack()) == join(two.pack())


@given(strategies.messages(strategies.finite32))
def test_round_trip(message: Message) -> None:
    data = join(encode(message))
    again = decode(data)
    assert same(again.content, message.content) or not join(message.content.pack())
    for name in ("type", "device_name", "ticks", "header_version", "message_id", "metadata"):
        assert getattr(again, name) == getattr(message, name)
    assert join(encode(again)) == data
    assert describe(data)["crc_ok"] is True
    assert "error" not in describe(data)


@given(strategies.messages(strategies.any32))
def test_round_trip_with_nan_and_infinity(message: Message) -> None:
    data = join(encode(message))
    assert join(encode(decode(data))) == data
    describe(data)


@table("word", ["7fa00001", "ffa00001", "7f800001", "7fc00000", "ffffffff", "7f800000", "80000001"])
@table("kind", ["TRANSFORM", "POSITION", "IMAGE", "VIDEO"])
def test_every_bit_of_a_nan_is_kept(kind: str, word: str) -> None:
    """Signalling ones too, which processors make quiet when they convert them."""
    content = {
        "TRANSFORM": b"\x3f\x80\0\0" * 11 + bytes.fromhex(word),
        "POSITION": bytes.fromhex(word) * 7,
        "IMAGE": join(Image((0, 0, 0), 3, b"").pack())[:12] + bytes.fromhex(word) * 12 + bytes(12),
        "VIDEO": join(Video("H264", (0, 0, 0), b"").pack())[:16] + bytes.fromhex(word) * 12 + bytes(12) + b"data",
    }[kind]
    data = framed(content, 1, kind.encode())
    assert join(encode(decode(data))) == data


pieces = st.just([1]) | st.lists(st.sampled_from([1, 2, 57, 58, 59, 1000]), min_size=1, max_size=8)


@given(st.lists(strategies.messages(), min_size=1, max_size=4), pieces)
def test_streams_of_all_types_in_pieces(messages: list[Message], pieces: list[int]) -> None:
    """Byte by byte, or in pieces around the size of a header: the same messages come out, and mean the same."""
    sent = [join(encode(message)) for message in messages]
    stream, framer, got, at = b"".join(sent), Framer(), [], 0
    for size in cycle(pieces):
        got += [bytes(one) for one in framer.feed(stream[at : at + size])]
        at += size
        if at >= len(stream):
            break
    assert got == sent
    assert framer.pending == 0
    assert [join(encode(decode(one))) for one in got] == sent


@given(strategies.damaged_wire_bytes)
def test_garbage_raises_nothing_but_wire_errors(data: bytes) -> None:
    try:
        message = decode(data, check_crc=False)
    except WireError:
        message = None
    if len(data) < HEADER_SIZE:
        with pytest.raises(TruncatedMessage):
            describe(data)
        return
    shown = describe(data)
    assert ("content" in shown) is (message is not None)
    assert ("error" in shown) is (message is None or not shown["crc_ok"])
    if message is not None:
        join(encode(message))


def test_every_bit_of_a_message_may_flip() -> None:
    """Each single-bit error of the body is found by the CRC; without it, it is read or refused, never a crash."""
    for at in range(8 * HEADER_SIZE, 8 * len(EXAMPLE)):
        bent = bytearray(EXAMPLE)
        bent[at // 8] ^= 1 << at % 8
        with pytest.raises(ChecksumMismatch):
            decode(bytes(bent))
        try:
            decode(bytes(bent), check_crc=False)
        except WireError:
            pass


def test_payload_is_not_copied() -> None:
    pixels = np.arange(48, dtype=np.uint8)
    buffers = encode(Message("IMAGE", "d", Image((6, 8, 1), 3, pixels.data), header_version=2))
    assert len(buffers) == 3
    assert np.shares_memory(np.frombuffer(buffers[1], np.uint8), pixels)
    data = join(buffers)
    image = decode(data).content
    assert isinstance(image, Image)
    assert np.shares_memory(image.array, np.frombuffer(data, np.uint8))
    assert math.prod(image.array.shape) == 48


def test_raw_payload_is_a_view_of_what_was_received() -> None:
    data = framed(bytes(1000), 1, b"CUSTOM")
    content = decode(data).content
    assert isinstance(content, Raw)
    received = np.frombuffer(data, np.uint8)
    assert np.shares_memory(np.frombuffer(content.data, np.uint8), received)
    assert any(np.shares_memory(np.frombuffer(part, np.uint8), received) for part in encode(decode(data)))


@pytest.mark.parametrize("text", ["plain", "é", "\udce9 odd"])
def test_item_of(text: str) -> None:
    item = Item.of("key", text)
    assert item.encoding == (3 if text.isascii() else 106)
    assert item.value == text.encode("utf-8", "surrogateescape")
