"""Equality of sessions, and the text of a failure."""

from __future__ import annotations

from pathlib import Path

import pytest

from igtl_gateway.convert.rosmsg import Header, TransformStamped
from igtl_gateway.testing.compare import MAX_LISTED, assert_session_equal
from igtl_gateway.testing.gateway import START_NS, ManualGateway
from igtl_gateway.wire import Message
from igtl_gateway.wire.text import Status, String
from tests.places import FIXTURES


def session(x: float = 0.1, text: str = "hello", count: int = 1, stamp_ns: int = START_NS) -> ManualGateway:
    gateway = ManualGateway(start_ns=stamp_ns)
    gateway.connect()
    for _ in range(count):
        gateway.from_ros("/igtl/out/Tool", TransformStamped(Header(7, "base"), "tool", (x, 0, 0), (0, 0, 0, 1)))
    gateway.from_peer(Message("STRING", "Greeting", String.of(text), 7 << 32))
    return gateway


def differences(*sides: ManualGateway, **settings: object) -> str:
    with pytest.raises(AssertionError) as caught:
        assert_session_equal(*sides, **settings)  # type: ignore[arg-type]
    return str(caught.value)


def test_sessions_with_different_gateway_times_are_equal() -> None:
    assert_session_equal(session(), session())
    assert_session_equal(session(), session(stamp_ns=START_NS + 10**12), ignore=("/igtl/links",))
    assert_session_equal(FIXTURES / "star.mcap", str(FIXTURES / "star.mcap"))


def test_a_recording_equals_the_outputs_for_its_inputs(tmp_path: Path) -> None:
    gateway = session()
    gateway.save(tmp_path / "golden.mcap")
    again = ManualGateway()
    again.play(tmp_path / "golden.mcap")
    assert_session_equal(tmp_path / "golden.mcap", again)


def test_the_first_field_that_differs_is_named_with_both_values() -> None:
    text = differences(session(), session(text="help!"))
    assert "OpenIGTLink in STRING/Greeting, message 1 of 1: content.string: 'hello' expected, 'help!' found" in text
    assert "ROS out /igtl/in/Greeting/string, message 1 of 1: data: 'hello' expected, 'help!' found" in text
    assert "Tool" not in text


def test_numbers_within_the_tolerance_are_equal() -> None:
    other = session(x=0.1001)  # 0.1 mm, in millimetres on one side and metres on the other
    assert_session_equal(session(), other, tolerance_mm=0.11)
    text = differences(session(), other, tolerance_mm=0.09)
    assert "OpenIGTLink out TRANSFORM/Tool, message 1 of 1: content.matrix: " in text
    assert "ROS in /igtl/out/Tool, message 1 of 1: transform" in text
    assert text.count(" mm)") == 2


def test_a_stamp_is_a_value() -> None:
    one, other = ManualGateway(), ManualGateway()
    for gateway, seconds in ((one, 7), (other, 9)):
        gateway.from_peer(Message("STATUS", "Robot", Status(1), seconds << 32))
    assert "OpenIGTLink in STATUS/Robot, message 1 of 1: stamp: found 2,000,000,000 ns later" in differences(one, other)
    assert_session_equal(one, other, ignore_fields=("timestamp", "header.stamp"), ignore=("/igtl/**",))


def test_fields_and_streams_can_be_left_out() -> None:
    other = session(text="help!")
    assert_session_equal(session(), other, ignore=("STRING/*", "/igtl/in/**"))
    assert_session_equal(session(), other, ignore_fields=("content.string*", "data"))


def test_missing_messages_and_streams_are_counted() -> None:
    text = differences(session(count=3), session(count=2))
    assert "OpenIGTLink out TRANSFORM/Tool: 3 messages expected, 2 found" in text
    assert "OpenIGTLink out TRANSFORM/Tool: 3 messages expected, 0 found" in differences(
        session(count=3), session(count=0)
    )


def test_different_bytes_with_equal_values_differ() -> None:
    one, other = ManualGateway(), ManualGateway()
    one.from_peer(b"\0\1MYSTERY\0\0\0\0\0" + b"Box" + bytes(17 + 24))
    other.from_peer(b"\0\1MYSTERY\0\0\0\0X" + b"Box" + bytes(17 + 24))
    assert "byte 13: 00 " in differences(one, other)


def test_many_differences_are_counted_and_some_listed() -> None:
    text = differences(session(count=30), session(count=30, x=0.2))
    assert text.count("\n") == MAX_LISTED + 1
    assert "more" in text.splitlines()[-1]
