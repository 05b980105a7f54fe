"""What a STT_ asks for: the interval of each type in its own unit, and how many streams a peer may have."""

from __future__ import annotations

import struct

import pytest

from igtl_gateway.base.stamp import NS_PER_MS, NS_PER_S
from igtl_gateway.convert.profiles import UNRECOGNISED
from igtl_gateway.gateway.dialogue.answers import ERROR, MAX_TRACKED, OK, start_stream
from igtl_gateway.gateway.peers import MAX_STREAM_REQUESTS, Peer
from igtl_gateway.wire import Message
from igtl_gateway.wire.body import Body
from igtl_gateway.wire.query import EmptyQuery, StartBind, StartPolyData, StartTracking, StartVideo
from tests.tables import table

#: The longest interval that can be meant where a program may leave the field undefined: an hour.
LONGEST_NS = 3_600 * NS_PER_S


def peer() -> Peer:
    return Peer(1, "127.0.0.1:1", "server", UNRECOGNISED, chosen=False)


def interval_of(igtl_type: str, content: Body) -> int:
    one = peer()
    assert start_stream(Message(f"STT_{igtl_type}", "D", content), igtl_type, one, lambda _: True).status == OK
    return one.stream_requests[igtl_type, "D"].interval_ns


@table(
    ("igtl_type", "content", "interval_ns"),
    [
        ("TDATA", StartTracking(50, ""), 50 * NS_PER_MS),
        ("QTDATA", StartTracking(1, ""), NS_PER_MS),
        ("TDATA", StartTracking(0, ""), 0),
        ("VIDEO", StartVideo("H264", 40), 40 * NS_PER_MS),
        ("POLYDATA", StartPolyData(7_000_001), 7_000_001),
        ("POLYDATA", StartPolyData(1), 1),
        ("POLYDATA", StartPolyData(0), 0),
        ("POLYDATA", StartPolyData(None), 0),
        ("BIND", StartBind(3_000_000, ()), 3_000_000),
        ("BIND", StartBind(LONGEST_NS, ()), LONGEST_NS),
        ("BIND", StartBind(LONGEST_NS + 1, ()), 0),
        ("IMAGE", EmptyQuery(), 0),
        ("IMAGE", EmptyQuery(struct.pack(">q", 20)), 20 * NS_PER_MS),
        ("IMAGE", EmptyQuery(struct.pack(">q", LONGEST_NS // NS_PER_MS)), LONGEST_NS),
        ("IMAGE", EmptyQuery(struct.pack(">q", LONGEST_NS // NS_PER_MS + 1)), 0),
    ],
)
def test_the_interval_has_the_unit_of_its_type(igtl_type: str, content: Body, interval_ns: int) -> None:
    found = interval_of(igtl_type, content)
    assert type(found) is int and found == interval_ns


@pytest.mark.parametrize(
    ("igtl_type", "most"), [("IMAGE", MAX_STREAM_REQUESTS), ("TDATA", MAX_TRACKED), ("QTDATA", MAX_TRACKED)]
)
def test_a_peer_has_so_many_streams_and_no_more(igtl_type: str, most: int) -> None:
    one = peer()
    content: Body = EmptyQuery() if igtl_type == "IMAGE" else StartTracking(20, "")

    def status(device: str) -> int:
        return start_stream(Message(f"STT_{igtl_type}", device, content), igtl_type, one, lambda _: True).status

    assert [status(f"D{number}") for number in range(most)] == [OK] * most
    assert status("one more") == ERROR
    assert status("D0") == OK, "it has this one"
