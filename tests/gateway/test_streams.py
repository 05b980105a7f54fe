"""Which rows a stream goes by, and names that stand for others."""

from __future__ import annotations

import pytest

from igtl_gateway.config.configuration import Config, ToRosRow
from igtl_gateway.convert.names import short_device_name
from igtl_gateway.convert.rosmsg import String as RosString
from igtl_gateway.gateway.streams import Streams


def topics(config: Config, igtl_type: str = "IMAGE") -> list[str]:
    stream = Streams(config).to_ros(igtl_type, "A")
    assert stream
    return [topic for _, topic in stream.outputs]


def test_a_topic_of_one_name_is_of_one_type_the_standard_one() -> None:
    assert topics(Config()) == ["/igtl/in/A/image", "/igtl/in/A/volume"]
    assert topics(Config(to_ros=(ToRosRow(topic="/picture"),))) == ["/picture"]


def test_without_a_standard_type_it_is_of_the_first() -> None:
    assert topics(Config(to_ros=(ToRosRow(topic="/info"),)), "CAPABILITY") == ["/info"]


@pytest.mark.parametrize("publish_tf", [True, False])
def test_tf_can_be_switched_off(publish_tf: bool) -> None:
    assert ("/tf" in topics(Config(publish_tf=publish_tf), "TRANSFORM")) is publish_tf


def test_a_device_that_has_the_short_name_of_another_gets_one_of_its_own() -> None:
    long = "a device whose name is longer than twenty bytes"
    streams = Streams(Config())
    short = streams.device(long)
    assert (short, len(short.encode())) == (short_device_name(long), 20)
    assert streams.device(long) == short
    other = streams.device(short)
    assert other not in (short, long) and len(other.encode()) <= 20
    assert streams.device(short) == other, "from then on"


def test_topics_beyond_the_limit_are_told_from_those_that_are_not_bridged() -> None:
    streams = Streams(Config(max_streams=1))
    assert streams.to_igtl("/igtl/out/A", RosString.TYPE)
    assert streams.to_igtl("/igtl/out/B", RosString.TYPE) is None
    assert streams.is_over_limit("/igtl/out/B", RosString.TYPE)
    assert not streams.is_over_limit("/igtl/out/A", RosString.TYPE)
    assert not streams.is_over_limit("/elsewhere", RosString.TYPE)


@pytest.mark.parametrize(
    ("igtl_type", "frame_id"),
    [("TRANSFORM", "Base"), ("POSITION", "Base"), ("IMAGE", "patient"), ("STRING", "patient"), ("STATUS", "patient")],
)
def test_the_parent_in_a_name_is_the_frame_of_poses_only(igtl_type: str, frame_id: str) -> None:
    """``ToolToBase`` of 3D Slicer is a pose in Base; a picture of that name is in the frame of the configuration."""
    stream = Streams(Config(base_frame="patient")).to_ros(igtl_type, "ToolToBase")
    assert stream and stream.frame_id == frame_id
