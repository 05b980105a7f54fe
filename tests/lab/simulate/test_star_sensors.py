"""The sensors alone: a machine that is too slow loses measurements, and no measurement is sent twice."""

from __future__ import annotations

from igtl_gateway.base.stamp import NS_PER_S
from igtl_gateway.convert.common_msgs import CameraInfo
from igtl_gateway.convert.rosmsg import Image, PointCloud2
from igtl_gateway_lab.simulate import star_topics as topics
from igtl_gateway_lab.simulate.actor import RosSent
from igtl_gateway_lab.simulate.star_sensors import Sensors

START_NS = 10**18


def stamps_s(said: list[RosSent], topic: str) -> list[float]:
    found = []
    for one in said:
        if one.topic == topic:
            assert isinstance(one.message, PointCloud2 | Image | CameraInfo)
            found.append((one.message.header.stamp_ns - START_NS) / NS_PER_S)
    return found


def test_looks_that_a_slow_machine_missed_are_not_made_up_for() -> None:
    sensors = Sensors(20 * NS_PER_S)
    sensors.begin(START_NS)
    said = [one for one in sensors.act(START_NS + 4 * NS_PER_S) if isinstance(one, RosSent)]
    assert stamps_s(said, topics.CLOUD) == stamps_s(said, topics.IMAGE) == stamps_s(said, topics.CAMERA_INFO) == [3.1]
    assert stamps_s(said, topics.MARKERS) == [3.85]
    said = [one for one in sensors.act(START_NS + 5 * NS_PER_S) if isinstance(one, RosSent)]
    assert stamps_s(said, topics.CLOUD) == [4.1]


def test_the_end_comes_with_the_duration() -> None:
    sensors = Sensors(NS_PER_S // 2)
    sensors.begin(START_NS)
    said: list[RosSent] = []
    while sensors.due_ns is not None:
        said += [one for one in sensors.act(sensors.due_ns) if isinstance(one, RosSent)]
    assert sensors.done and sensors.report().good
    assert stamps_s(said, topics.CLOUD) == [0.1]
    assert {one.topic for one in said} == set(sensors.publishes)
