"""Queries: names in every spelling, contents that may be missing, layouts that peers get wrong."""

from __future__ import annotations

import struct
from dataclasses import replace

import pytest

from igtl_gateway.base.buffers import join
from igtl_gateway.base.errors import MalformedBody, TruncatedMessage, WireError
from igtl_gateway.wire import Message, decode, encode
from igtl_gateway.wire.body import Body
from igtl_gateway.wire.query import (
    PREFIXES,
    QUERIES,
    EmptyQuery,
    GetBind,
    QueryReply,
    StartBind,
    StartPolyData,
    StartTracking,
    StartVideo,
    query_name,
    split_query,
)
from igtl_gateway.wire.registry import BODIES
from tests.tables import table


def read(kind: str, content: bytes, version: int = 1) -> Body:
    """The content as it comes out of a whole message, which must be written back as it was."""
    data = join(encode(Message(kind, "", EmptyQuery(content), header_version=version)))
    message = decode(data)
    assert join(encode(message)) == data
    return message.content


TWO = b"\0\2" + b"IMAGE".ljust(12, b"\0") + b"POINT".ljust(12, b"\0")
NAMES = (("IMAGE", "CT"), ("POINT", "b"))

CASES: list[tuple[str, bytes, Body]] = [
    ("GET_TRANS", b"", EmptyQuery()),
    ("GET_TRANSFOR", b"", EmptyQuery()),  # what the documents call it
    ("GET_CAPABIL", b"", EmptyQuery()),
    ("STP_VIDEO", b"", EmptyQuery()),
    ("STT_IMAGE", b"", EmptyQuery()),
    ("STP_TDATA", b"?", EmptyQuery(b"?")),  # unexpected, kept
    ("STT_TDATA", b"\0\0\0\x32" + b"RAS".ljust(32, b"\0"), StartTracking(50, "RAS")),
    ("STT_TDATA", b"\xff" * 4 + bytes(32), StartTracking(-1, "")),
    ("STT_QTDATA", b"", StartTracking(has_body=False)),
    ("STT_VIDEO", b"H264" + b"\0\0\0\x28", StartVideo("H264", 40)),
    ("STT_VIDEO", b"VP90" + b"\0\0\0\x28" + b"\0", StartVideo("VP90", 40, b"\0")),  # as the library sends it
    ("STT_POLYDATA", b"", StartPolyData()),
    ("STT_POLYDATA", struct.pack(">Q", 10**9), StartPolyData(10**9)),
    ("RTS_TDATA", b"\0", QueryReply(0)),
    ("RTS_POLYDATA", b"\1", QueryReply(1)),
    ("RTS_QTRANS", b"\1", QueryReply(1)),
    ("RTS_BIND", b"\0", QueryReply(0)),
    ("RTS_BIND", b"", QueryReply(has_body=False)),  # as the document has it
    ("GET_BIND", b"", GetBind()),
    ("GET_BIND", TWO + b"\0\6" + b"CT\0b\0\0", GetBind(NAMES)),
    ("STT_BIND", struct.pack(">Q", 7), StartBind(7)),
    ("STT_BIND", struct.pack(">Q", 7) + TWO + b"\0\6" + b"CT\0b\0\0", StartBind(7, NAMES)),
]


@table(("kind", "content", "body"), CASES)
@table("version", [1, 2])
def test_golden_bytes(kind: str, content: bytes, body: Body, version: int) -> None:
    assert read(kind, content, version) == body
    assert join(body.pack()) == content


@pytest.mark.parametrize(
    "names",
    [
        b"\0\5" + b"CT\0b\0",  # the library forgets the padding
        b"\0\4" + b"CT\0b",
        b"\0\5" + b"CT\0b\0" + b"\0",  # padding that the size does not count
        b"\0\6" + b"CT\0b\0\xee",
    ],
)
def test_odd_lists_of_children(names: bytes) -> None:
    query = read("GET_BIND", TWO + names)
    assert isinstance(query, GetBind)
    assert query == GetBind(NAMES, TWO + names)
    assert replace(query, kept=None) == GetBind(NAMES)
    start = read("STT_BIND", bytes(8) + TWO + names)
    assert start == StartBind(0, NAMES, bytes(8) + TWO + names)


def test_everything_in_other_words() -> None:
    assert read("GET_BIND", bytes(4)) == GetBind((), bytes(4))


@pytest.mark.parametrize("version", [1, 2])
@pytest.mark.parametrize("stray", [b"\x5c\x9f\x00\x7f", b"\x00\x01\x00\x00", b"\xff\xff\xff\xff"])
def test_all_as_the_reference_library_asks_for_it(stray: bytes, version: int) -> None:
    """Four bytes that it never fills, behind an interval that it never fills either."""
    assert read("GET_BIND", stray, version) == GetBind((), stray)
    interval = b"\xb0\x10\x00\x00\x00\x7f\x00\x00"
    query = read("STT_BIND", interval + stray, version)
    assert isinstance(query, StartBind) and query.children == ()
    assert read("STT_BIND", b"") == StartBind(0, (), b"")
    assert read("STT_BIND", bytes(12)) == StartBind(0, (), bytes(12))


@table(
    ("kind", "content"),
    [
        ("STT_TDATA", bytes(35)),
        ("STT_TDATA", bytes(37)),
        ("STT_VIDEO", bytes(7)),
        ("STT_VIDEO", bytes(10)),
        ("STT_POLYDATA", bytes(7)),
        ("RTS_IMAGE", bytes(2)),
        ("GET_BIND", b"\0"),
        ("GET_BIND", TWO),
        ("GET_BIND", TWO + b"\0\2a\0"),
        ("GET_BIND", TWO + b"\0\6CT\0b\0\0??"),
        ("STT_BIND", bytes(7)),
    ],
)
def test_contents_of_no_known_layout(kind: str, content: bytes) -> None:
    with pytest.raises(WireError):
        read(kind, content)


@table(
    "body",
    [
        StartTracking(2**31),
        StartTracking(0, "c" * 33),
        StartVideo("H.264"),
        StartVideo("H264", -1),
        StartPolyData(-1),
        QueryReply(256),
        GetBind((("T" * 13, ""),)),
        StartBind(-1),
        GetBind((("IMAGE", "a\0b"),)),
    ],
)
def test_what_does_not_fit(body: Body) -> None:
    with pytest.raises(MalformedBody):
        encode(Message("ANY", "", body))


def test_an_empty_start_of_video_is_no_start() -> None:
    """Without a codec nothing can be started; it is carried all the same."""
    assert not isinstance(read("STT_VIDEO", b""), StartVideo)
    with pytest.raises(MalformedBody):
        StartVideo.unpack(memoryview(b""))
    with pytest.raises(TruncatedMessage):
        StartBind.unpack(memoryview(b"\0"))


@table(
    ("name", "parts"),
    [
        ("GET_TRANS", ("GET", "TRANSFORM")),
        ("GET_TRANSFOR", ("GET", "TRANSFORM")),
        ("STT_QTRANS", ("STT", "POSITION")),
        ("STT_TDATA", ("STT", "TDATA")),
        ("GET_CAPABIL", ("GET", "CAPABILITY")),
        ("GET_VMETA", ("GET", "VIDEOMETA")),
        ("GET_COLORT", ("GET", "COLORT")),
        ("RTS_POLYDATA", ("RTS", "POLYDATA")),
        ("GET_FOO_BAR", ("GET", "FOO_BAR")),
        ("GET_IMAGE\0junk", ("GET", "IMAGE")),
        ("RTS_COMMAND", None),
        ("COMMAND", None),
        ("GET", None),
        ("GET_", None),
        ("get_IMAGE", None),
        ("FORGET_IMAGE", None),
        ("", None),
    ],
)
def test_split_query(name: str, parts: tuple[str, str] | None) -> None:
    assert split_query(name) == parts


def test_every_query_is_of_a_type_that_exists() -> None:
    for name in QUERIES:
        prefix, base = split_query(name) or ("", "")
        assert prefix in PREFIXES
        assert base in BODIES
        assert len(name) <= 12
        assert query_name(prefix, base) in QUERIES
        assert BODIES[name] is QUERIES[name] is QUERIES[query_name(prefix, base)]


def test_the_names_of_the_documents() -> None:
    assert [query_name("GET", base) for base in ("TRANSFORM", "CAPABILITY", "VIDEOMETA", "COLORTABLE", "IMAGE")] == [
        "GET_TRANS", "GET_CAPABIL", "GET_VMETA", "GET_COLORT", "GET_IMAGE",
    ]  # fmt: skip


@pytest.mark.parametrize("kind", ["STT_TDATA", "STT_QTDATA", "STT_IMAGE", "STT_SENSOR"])
def test_the_interval_of_openigtlink4j_is_a_long(kind: str) -> None:
    for interval in (0, 50, 2**40):
        data = struct.pack(">q", interval)
        query = BODIES[kind].unpack(memoryview(data))
        assert query.resolution == interval and join(query.pack()) == data  # type: ignore[attr-defined]
