"""Services and actions as topics: their names, and the bytes of events and of the states of goals."""

from __future__ import annotations

import struct
from contextlib import suppress

import pytest
from hypothesis import given
from hypothesis import strategies as st

from igtl_gateway.base.errors import ConversionError
from igtl_gateway.convert.exchanges import (
    REQUEST_SENT,
    RESPONSE_RECEIVED,
    ServiceEvent,
    action_of,
    feedback_goal,
    goal_states,
    service_of,
)
from tests import exchanges
from tests.tables import table

NAMES = {
    "/arm/enable/_service_event": ("/arm/enable", None),
    "/fib/_action/status": ("", ("/fib", "status")),
    "/a/fib/_action/get_result/_service_event": ("/a/fib/_action/get_result", ("/a/fib", "get_result")),
    "/fib/_action/other": ("", None),
    "/fib/_action/status/_service_event": ("/fib/_action/status", None),
    "/fib/_action/send_goal": ("", None),
    "/_action/status": ("", None),
    "/fib": ("", None),
}


@table(("topic", "names"), NAMES.items(), ids=NAMES)
def test_names(topic: str, names: tuple[str, tuple[str, str] | None]) -> None:
    assert (service_of(topic), action_of(topic)) == names


def test_an_event_in_both_byte_orders() -> None:
    asked = exchanges.event(REQUEST_SENT, 5, 7, request=b"\1", client=b"c" * 16)
    assert ServiceEvent.unpack(asked) == ServiceEvent(
        0, exchanges.START_NS + 5, b"c" * 16, 7, True, b"\1" + bytes(7), None
    )
    big = b"\0\0\0\0" + struct.pack(">B3xiI16s4xqIIb", 3, 2, 9, b"c" * 16, 7, 0, 1, 4)
    assert ServiceEvent.unpack(big) == ServiceEvent(3, 2_000_000_009, b"c" * 16, 7, False, b"", b"\0\0\0\0\4")
    without = ServiceEvent.unpack(exchanges.event(RESPONSE_RECEIVED, 0, 1))
    assert (without.has_request, without.response) == (False, None)  # introspection of metadata only


BAD_EVENTS = {
    "empty": b"",
    "cut off": exchanges.event(REQUEST_SENT, 0, 1)[:-1],
    "not CDR": b"\1" + exchanges.event(REQUEST_SENT, 0, 1)[1:],
    "of no kind": exchanges.event(4, 0, 1),
    "two requests": exchanges.event(REQUEST_SENT, 0, 1)[:44] + struct.pack("<I", 2) + bytes(8),
    "many responses": exchanges.event(REQUEST_SENT, 0, 1)[:48] + b"\xff" * 4,
}


@table("data", BAD_EVENTS.values(), ids=BAD_EVENTS)
def test_bytes_that_are_no_event(data: bytes) -> None:
    with pytest.raises(ConversionError, match=r"found .*, expected"):
        ServiceEvent.unpack(data)


def test_the_states_of_goals() -> None:
    given = {3: 4, 9: 6, 5: 2}
    assert goal_states(exchanges.states(given)) == [(exchanges.goal_id(order), each) for order, each in given.items()]
    assert goal_states(exchanges.states({})) == []
    for cut in (exchanges.states(given)[:-1], exchanges.HEAD, b"\0\1\0\0\xff\xff\xff\xff", b""):
        with pytest.raises(ConversionError, match=r"found .*, expected"):
            goal_states(cut)


@given(st.binary(max_size=120), st.sampled_from([b"", exchanges.HEAD, b"\0\0\0\0"]))
def test_any_bytes_are_read_or_refused(data: bytes, head: bytes) -> None:
    for read in (ServiceEvent.unpack, goal_states, feedback_goal):
        with suppress(ConversionError):
            read(head + data)
