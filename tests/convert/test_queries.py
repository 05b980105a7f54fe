"""Queries: every name of the protocol, what each carries, what there is not."""

from __future__ import annotations

from typing import Any

import pytest

from igtl_gateway.base.buffers import join
from igtl_gateway.base.errors import ConversionError
from igtl_gateway.convert import queries
from igtl_gateway.convert.context import ToIgtlContext, ToRosContext
from igtl_gateway.convert.igtl_msgs import MetadataItem, Query
from igtl_gateway.convert.rosmsg import Header
from igtl_gateway.wire.body import Body
from igtl_gateway.wire.query import (
    QUERIES,
    QUERY_ALIASES,
    EmptyQuery,
    GetBind,
    QueryReply,
    StartBind,
    StartPolyData,
    StartTracking,
    StartVideo,
)
from tests.tables import table

ITEMS = (MetadataItem("key", 3, "value"),)


def asked(igtl_type: str, content: Body) -> Query:
    to = ToRosContext("Tracker", 7, "base", "", igtl_type=igtl_type, metadata=ITEMS, link=4)
    message = queries.query_to_ros(content, to)
    assert (message.header, message.device_name) == (Header(7, "base"), "Tracker")
    assert (message.metadata, message.link) == (ITEMS, 4)
    return Query.unpack(message.pack())


def sent(message: Query, warnings: list[str] | None = None) -> tuple[str, Body]:
    to = ToIgtlContext()
    outgoing = queries.query_to_igtl(message, to)
    assert [code for code, _ in to.warnings] == (warnings or [])
    assert (outgoing.device_name, outgoing.link) == (message.device_name, message.link)
    assert (outgoing.stamp_ns, outgoing.frame_id) == (message.header.stamp_ns, message.header.frame_id)
    assert outgoing.metadata == message.metadata
    codec = QUERIES[outgoing.igtl_type]
    assert isinstance(outgoing.content, codec)
    return outgoing.igtl_type, codec.unpack(memoryview(join(outgoing.content.pack())))


#: Something of each content that comes back as it was.
CONTENTS: dict[type[Body], Body] = {
    EmptyQuery: EmptyQuery(),
    GetBind: GetBind(),
    StartBind: StartBind(50_000_000),
    StartTracking: StartTracking(50, "Base é"),
    StartVideo: StartVideo("H264", 40),
    StartPolyData: StartPolyData(50_000_000),
    QueryReply: QueryReply(1),
}


@table("igtl_type", QUERIES)
def test_every_query_there_and_back(igtl_type: str) -> None:
    content = CONTENTS[QUERIES[igtl_type]]
    message = asked(igtl_type, content)
    assert sent(message) == (QUERY_ALIASES.get(igtl_type, igtl_type), content)


@pytest.mark.parametrize(
    ("igtl_type", "kind", "base"),
    [
        ("GET_TRANS", Query.GET, "TRANSFORM"),
        ("GET_CAPABIL", Query.GET, "CAPABILITY"),
        ("GET_VMETA", Query.GET, "VIDEOMETA"),
        ("STT_IMAGE", Query.START, "IMAGE"),
        ("STP_TDATA", Query.STOP, "TDATA"),
    ],
)
def test_kinds_and_types(igtl_type: str, kind: int, base: str) -> None:
    message = asked(igtl_type, EmptyQuery())
    assert (message.kind, message.type) == (kind, base)
    assert (message.resolution, message.coordinate_name, message.codec, message.status) == (0, "", "", 0)


@table(
    ("igtl_type", "content", "fields"),
    [
        ("STT_TDATA", StartTracking(50, "Base\x00junk"), (50, "Base", "", 0)),
        ("STT_TDATA", StartTracking(-1), (2**32 - 1, "", "", 0)),
        ("STT_QTDATA", StartTracking(has_body=False), (0, "", "", 0)),
        ("STT_VIDEO", StartVideo("VP90", 2**32 - 1, b"\x00"), (2**32 - 1, "", "VP90", 0)),
        ("STT_POLYDATA", StartPolyData(), (0, "", "", 0)),
        ("STT_POLYDATA", StartPolyData(1), (1, "", "", 0)),
        ("STT_POLYDATA", StartPolyData(2_000_001), (3, "", "", 0)),
        ("STT_BIND", StartBind(2**64 - 1, (("TDATA", "a"),)), (2**32 - 1, "", "", 0)),
        ("RTS_TDATA", QueryReply(255), (0, "", "", 255)),
        ("RTS_BIND", QueryReply(has_body=False), (0, "", "", 0)),
    ],
)
def test_what_a_query_carries(igtl_type: str, content: Body, fields: tuple[object, ...]) -> None:
    message = asked(igtl_type, content)
    assert (message.resolution, message.coordinate_name, message.codec, message.status) == fields


def query(kind: int, base: str, **fields: Any) -> Query:
    return Query(Header(), kind, base, **fields)


def test_intervals_of_every_size_go_out() -> None:
    assert sent(query(Query.START, "TDATA", resolution=2**32 - 1))[1] == StartTracking(-1)
    assert sent(query(Query.START, "BIND", resolution=2**32 - 1))[1] == StartBind((2**32 - 1) * 1_000_000)
    # without an interval it is the query that the library knows
    assert sent(query(Query.START, "POLYDATA"))[1] == StartPolyData(None)


@pytest.mark.parametrize(
    ("message", "warnings"),
    [
        (query(Query.GET, "TDATA", resolution=5), ["field_left_out"]),
        (query(Query.START, "IMAGE", resolution=5, codec="H264"), ["field_left_out"] * 2),
        (query(Query.START, "VIDEO", codec="H264", coordinate_name="Base"), ["field_left_out"]),
        (query(Query.STOP, "TDATA", status=1), ["field_left_out"]),
        (query(Query.START, "TDATA", coordinate_name="x" * 31), []),
        (query(Query.START, "TDATA", coordinate_name="x" * 32), ["text_cut"]),
    ],
)
def test_what_a_query_has_no_place_for_is_told(message: Query, warnings: list[str]) -> None:
    sent(message, warnings)


@pytest.mark.parametrize(
    ("message", "expected"),
    [
        (query(0, "TDATA"), "found kind 0, expected one of"),
        (query(5, "TDATA"), "found kind 5, expected one of"),
        (query(Query.GET, ""), "found type '' for GET_, expected one of .*TRANSFORM"),
        (query(Query.GET, "COMMAND"), "found type 'COMMAND'"),
        (query(Query.REPLY, "COMMAND"), "found type 'COMMAND'"),
        (query(Query.START, "STATUS"), "found type 'STATUS' for STT_, expected one of .*TDATA"),
        (query(Query.START, "VIDEO", codec="H.264"), "found codec 'H.264', expected at most 4 bytes"),
    ],
)
def test_queries_that_do_not_exist_are_refused(message: Query, expected: str) -> None:
    with pytest.raises(ConversionError, match=expected):
        queries.query_to_igtl(message, ToIgtlContext())


def test_only_queries_are_queries() -> None:
    with pytest.raises(ConversionError, match="found type 'RTS_COMMAND', expected GET_"):
        asked("RTS_COMMAND", EmptyQuery())
