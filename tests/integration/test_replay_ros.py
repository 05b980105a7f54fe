"""``replay --to ros``: a typed rclpy node hears what was said that day."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from tests.integration.bridge import RosClient, gateway

pytestmark = pytest.mark.ros

TYPES = Path(__file__).parents[2] / "fixtures" / "paper-types.mcap"
HEARD = {
    "/igtl/in/ProbeToTracker/transform": "geometry_msgs/msg/TransformStamped",
    "/igtl/in/Greeting/string": "std_msgs/msg/String",
    "/igtl/in/Colour/image": "sensor_msgs/msg/Image",
    "/igtl/in/Surface/mesh": "shape_msgs/msg/Mesh",
    "/igtl/out/Greeting": "std_msgs/msg/String",
}


def test_a_ros_node_hears_what_was_published_that_day() -> None:
    with RosClient("listener", subscribe=HEARD) as node:
        streams = [word for topic in HEARD for word in ("--streams", topic)]
        options = ("--as-fast-as-possible", "--wait-peers", "1", *streams)
        program = gateway("replay", str(TYPES), "--to", "ros", "--json", *options)
        try:
            pose = node.receive("/igtl/in/ProbeToTracker/transform")
            assert (pose["header"]["frame_id"], pose["child_frame_id"]) == ("Tracker", "Probe")
            assert pose["transform"]["translation"] == {"x": 0.1, "y": -0.2, "z": 0.3005}
            assert node.receive("/igtl/in/Greeting/string")["data"] == "hello from OpenIGTLink"
            assert node.receive("/igtl/in/Greeting/string")["data"] == "Grüße, 你好"
            image = node.receive("/igtl/in/Colour/image")
            assert (image["encoding"], image["width"], image["height"]) == ("rgb8", 8, 6)
            assert image["data"]["hex"] == bytes(range(144)).hex()
            assert len(node.receive("/igtl/in/Surface/mesh")["triangles"]) == 4
            assert node.receive("/igtl/out/Greeting")["data"] == "hello from ROS 2"
            program.wait_until(lambda: '"complete"' in program.said(), "the outcome")
            told = json.loads(next(line for line in program.said().splitlines() if '"complete"' in line))
            assert told["complete"] and told["messages"] == sum(told["streams"].values())
        finally:
            program.close()
