"""Channels: their kinds, the reasons for skipping them, and the numbers of their entries."""

from __future__ import annotations

import pytest
from mcap.records import Channel, Schema

from igtl_gateway.base.qos import Qos
from igtl_gateway.gateway.log.entry import Kind
from igtl_gateway.record.sessionfile import layout
from igtl_gateway.record.sessionfile.channels import ChannelSummary, is_marked, kind_of, next_seq
from tests.tables import table

STRING = Schema(id=1, data=b"string data", encoding="ros2msg", name="std_msgs/msg/String")
RAW = Schema(id=2, data=b"", encoding="ros2msg", name=layout.RAW_MESSAGE_TYPE)


def channel(kind: str = "", encoding: str = "cdr", **facts: str) -> Channel:
    metadata = {**({layout.KIND_KEY: kind} if kind else {}), **facts}
    return Channel(id=1, topic="/a", message_encoding=encoding, metadata=metadata, schema_id=1)


@table(
    ("given", "schema", "foreign", "expected"),
    [
        (channel("ros_in"), STRING, False, Kind.ROS_IN),
        (channel(), STRING, True, Kind.ROS_IN),
        (channel("igtl_out"), RAW, False, Kind.IGTL_OUT),
        (channel("igtl_out"), STRING, False, "expected 'igtl_msgs/msg/RawMessage'"),
        (channel(), STRING, False, "not written by the gateway"),
        (channel("ros_in", "json"), STRING, False, "found encoding 'json'"),
        (channel("ros_in"), None, False, "found type ''"),
        (channel("ros_in"), Schema(1, b"a\n---\nb", "ros2msg", "a/msg/B"), False, "a service"),
        (channel("ros_in"), Schema(1, b"", "ros2msg", "B"), False, "expected package/msg/Name"),
        (channel("ros_in"), Schema(1, b"", "", "a/srv/B_Event"), False, Kind.ROS_IN),
        (channel(), Schema(1, b"a\n---\nb", "unknown", "a/srv/B_Event"), True, Kind.ROS_IN),
        (channel(), Schema(1, b"", "", "a/action/B_FeedbackMessage"), True, Kind.ROS_IN),
        (channel(), Schema(1, b"", "", "a/action/B_Goal"), True, "expected package/msg/Name"),
    ],
)
def test_kinds(given: Channel, schema: Schema | None, foreign: bool, expected: Kind | str) -> None:
    kind, why = kind_of(given, schema, foreign)
    if isinstance(expected, Kind):
        assert (kind, why) == (expected, "")
    else:
        assert kind is None and expected in why


def test_a_summary_has_the_stream_of_the_entries() -> None:
    qos = Qos(depth=3, latched=True)
    facts = {layout.STREAM_KEY: r"STRING/a\\b", layout.QOS_KEY: layout.qos_yaml(qos)}
    raw = ChannelSummary.of(channel("igtl_in", **facts), RAW, Kind.IGTL_IN, 5)
    assert (raw.stream, raw.entry_type, raw.qos, raw.count) == ("STRING/a\\b", "STRING", qos, 5)
    ros = ChannelSummary.of(channel("ros_in"), STRING, Kind.ROS_IN, 0)
    assert (ros.stream, ros.entry_type, ros.qos) == ("/a", STRING.name, None)


def test_the_gateway_marks_its_channels() -> None:
    assert is_marked(channel("note")) and not is_marked(channel())


@pytest.mark.parametrize(
    ("seq", "sequence", "expected"),
    [(0, 1, 1), (5, 9, 9), (5, 5, 5), ((1 << 32) - 1, 0, 1 << 32), ((1 << 40) + 3, 7, (1 << 40) + 7)],
)
def test_numbers_go_on_beyond_32_bits(seq: int, sequence: int, expected: int) -> None:
    assert next_seq(seq, sequence) == expected
