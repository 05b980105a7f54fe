"""Integers in float fields, as the real rclpy sends them, and numbers that are small but measured."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from igtl_gateway.config.configuration import Config
from igtl_gateway.convert.rosmsg import Header, TransformStamped
from igtl_gateway.doctor import Observer
from igtl_gateway.doctor.denormals import LEAST_FLOAT64, denormal_in_ros
from igtl_gateway.doctor.observer import MAX_LOOKED_AT
from igtl_gateway.doctor.rules import judge
from igtl_gateway.gateway.log.entry import Entry, Kind

KIND = "geometry_msgs/msg/TransformStamped"


def observed(cdr: bytes, times: int = 1, kind: str = KIND) -> Observer:
    seen = Observer(Config())
    for number in range(1, times + 1):
        seen.add(Entry(number, number, Kind.ROS_IN, "/arm/pose", kind, (cdr,)))
    return seen


@pytest.mark.parametrize("value", [1, True, np.bool_(True), np.int64(7), np.float32(2.5)], ids=repr)
def test_what_rclpy_sends_of_another_type_is_found(value: Any) -> None:
    serialization = pytest.importorskip("rclpy.serialization")
    messages = pytest.importorskip("geometry_msgs.msg")
    message = messages.TransformStamped()
    message.transform.translation.y = value
    (finding,) = [one for one in judge(observed(serialization.serialize_message(message))) if one.rule.id[5] != "I"]
    assert finding.rule.id == "IGTL-W510" and finding.match.where == "/arm/pose"
    assert finding.match.text.startswith("translation is ") and "1 of 1 message of " + KIND in finding.match.text


def test_a_list_of_integers_becomes_numbers_in_rclpy() -> None:
    """Arrays are converted there: nothing to find."""
    serialization = pytest.importorskip("rclpy.serialization")
    messages = pytest.importorskip("sensor_msgs.msg")
    message = messages.JointState(position=[1, 2, 3])
    assert denormal_in_ros("sensor_msgs/msg/JointState", serialization.serialize_message(message)) is None


@pytest.mark.parametrize(
    ("number", "found"),
    [(0.0, None), (-0.0, None), (LEAST_FLOAT64, None), (1e-30, None), (5e-324, 5e-324), (-1e-310, -1e-310)],
)
def test_only_denormal_numbers(number: float, found: float | None) -> None:
    cdr = TransformStamped(Header(5, "a"), "b", (0.0, number, 0.0), (0.0, 0.0, 0.0, 1.0)).pack()
    assert denormal_in_ros(KIND, cdr) == (None if found is None else ("translation", found))


def test_what_cannot_be_read_is_not_looked_at() -> None:
    assert denormal_in_ros("foreign_msgs/msg/Type", b"\0\1\0\0") is None
    assert denormal_in_ros(KIND, b"\0\1\0\0") is None
    assert denormal_in_ros(KIND, bytes(100_000)) is None


def test_a_long_topic_costs_its_first_messages_only() -> None:
    cdr = TransformStamped(Header(5, "a"), "b", (5e-324, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0)).pack()
    topic = observed(cdr, MAX_LOOKED_AT + 10).topics["/arm/pose"]
    assert (topic.messages, topic.denormal) == (MAX_LOOKED_AT + 10, MAX_LOOKED_AT)
