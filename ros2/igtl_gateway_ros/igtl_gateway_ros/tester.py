"""``ros2 run igtl_gateway test_node``: a node that sends one message of each kind, and counts what it receives.

It sends what the test node of the ROS-IGTL-Bridge paper sends: a random transform, a point, a cloud of 20 points, a
string and a model.  Their names are those of the scenario ``test-node`` of the laboratory.  It needs only ROS.

Topics are relative, so the node works in the namespace of the bridge that it belongs to:

* publishes ``igtl/out/NodeTransform/transform``, ``NodePoint/point``, ``NodeCloud/points``, ``NodeString/string`` and
  ``NodeModel/mesh``;
* subscribes to every topic below ``igtl/in/``.
"""

from __future__ import annotations

import importlib
import math
import random
import struct
from collections import Counter
from typing import Any

import rclpy
from geometry_msgs.msg import Point, PointStamped, TransformStamped
from rcl_interfaces.msg import FloatingPointRange, ParameterDescriptor
from rclpy.clock import Clock, ClockType
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import PointCloud2, PointField
from shape_msgs.msg import Mesh, MeshTriangle
from std_msgs.msg import Header, String

FRAME = "base"
CLOUD_POINTS = 20
REPORT_S = 2.0
#: The corners of the model, in units of its size, and its faces: an octahedron.
_CORNERS = ((1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0), (0, 0, 1), (0, 0, -1))
_FACES = ((0, 2, 4), (2, 1, 4), (1, 3, 4), (3, 0, 4), (2, 0, 5), (1, 2, 5), (3, 1, 5), (0, 3, 5))
_REACH_M = 0.3


class TestNode(Node):  # type: ignore[misc]  # rclpy is untyped
    """Sends a round of messages at the rate of the parameter ``rate``, and logs the number of received messages.

    Parameters: ``send`` (bool), ``rate`` (rounds per second, above 0 up to 1000) and ``seed`` (of the random values).
    """

    def __init__(self) -> None:
        super().__init__("test_node")
        steady = Clock(clock_type=ClockType.STEADY_TIME)  # with use_sim_time, the clock of the node might not advance
        text = ParameterDescriptor
        rate_range = [FloatingPointRange(from_value=0.001, to_value=1000.0)]
        self.declare_parameter("send", True, text(description="send messages; false: receive only", read_only=True))
        self.declare_parameter(
            "rate", 1.0, text(description="rounds per second", floating_point_range=rate_range, read_only=True)
        )
        self.declare_parameter("seed", 0, text(description="seed of the random values", read_only=True))
        self._random = random.Random(self.get_parameter("seed").value)
        self._rounds = 0
        self._received: Counter[str] = Counter()
        self._reported = 0
        self._subscribed: dict[str, Any] = {}
        self._prefix = self.resolve_topic_name("igtl/in") + "/"
        if self.get_parameter("send").value:
            self._out = {
                topic: self.create_publisher(kind, f"igtl/out/{topic}", 10)
                for topic, kind in (
                    ("NodeTransform/transform", TransformStamped),
                    ("NodePoint/point", PointStamped),
                    ("NodeCloud/points", PointCloud2),
                    ("NodeString/string", String),
                    ("NodeModel/mesh", Mesh),
                )
            }
            rate = self.get_parameter("rate").value
            self.create_timer(1.0 / rate, self._send_round, clock=steady)
            topics = ", ".join(publisher.topic_name for publisher in self._out.values())
            self.get_logger().info(f"sends {rate:g} rounds per second on {topics}")
        self.get_logger().info(f"counts the messages of all topics below {self._prefix}")
        self.create_timer(0.2, self._subscribe, clock=steady)
        self.create_timer(REPORT_S, self.report, clock=steady)

    def report(self) -> None:
        """Log what was received, if there is news, and the time of the node's clock."""
        total = self._received.total()
        if total == self._reported:
            return
        self._reported = total
        time_s = self.get_clock().now().nanoseconds / 1e9
        counts = ", ".join(f"{topic} {count}" for topic, count in sorted(self._received.items()))
        self.get_logger().info(f"sent {self._rounds} rounds, received {total} messages at {time_s:.1f} s: {counts}")

    def _subscribe(self) -> None:
        """Subscribe to the topics that have appeared below ``igtl/in/``."""
        for topic, types in self.get_topic_names_and_types():
            if not topic.startswith(self._prefix) or topic in self._subscribed:
                continue
            package, _, name = types[0].partition("/msg/")
            try:
                kind = getattr(importlib.import_module(f"{package}.msg"), name)
            except (ImportError, AttributeError):
                self.get_logger().warning(f"{topic}: found no package {package} here, expected it for this type")
                self._subscribed[topic] = None
                continue
            # best effort is compatible with every publisher
            qos = QoSProfile(depth=100, reliability=ReliabilityPolicy.BEST_EFFORT)
            self._subscribed[topic] = self.create_subscription(
                kind, topic, lambda _, topic=topic: self._received.update((topic,)), qos, raw=True
            )

    def _send_round(self) -> None:
        self._rounds += 1
        header = Header(stamp=self.get_clock().now().to_msg(), frame_id=FRAME)
        pose = TransformStamped(header=header, child_frame_id="node_transform")
        pose.transform.translation.x, pose.transform.translation.y, pose.transform.translation.z = self._place()
        rotation = [self._random.gauss(0.0, 1.0) for _ in range(4)]
        length = math.hypot(*rotation) or 1.0
        quaternion = pose.transform.rotation
        quaternion.x, quaternion.y, quaternion.z, quaternion.w = (value / length for value in rotation)
        self._out["NodeTransform/transform"].publish(pose)
        self._out["NodePoint/point"].publish(PointStamped(header=header, point=self._point()))
        self._out["NodeCloud/points"].publish(self._cloud(header))
        self._out["NodeString/string"].publish(String(data=f"round {self._rounds} of the node: Grüße"))
        size = self._random.uniform(0.02, 0.05)
        self._out["NodeModel/mesh"].publish(
            Mesh(
                triangles=[MeshTriangle(vertex_indices=face) for face in _FACES],
                vertices=[Point(x=size * x, y=size * y, z=size * z) for x, y, z in _CORNERS],
            )
        )

    def _place(self) -> tuple[float, float, float]:
        """A random place, in metres."""
        x, y, z = (self._random.uniform(-_REACH_M, _REACH_M) for _ in range(3))
        return x, y, z

    def _point(self) -> Point:
        x, y, z = self._place()
        return Point(x=x, y=y, z=z)

    def _cloud(self, header: Header) -> PointCloud2:
        return PointCloud2(
            header=header,
            height=1,
            width=CLOUD_POINTS,
            fields=[
                PointField(name=name, offset=4 * at, datatype=PointField.FLOAT32, count=1)
                for at, name in enumerate("xyz")
            ],
            is_bigendian=False,
            point_step=12,
            row_step=12 * CLOUD_POINTS,
            data=b"".join(struct.pack("<3f", *self._place()) for _ in range(CLOUD_POINTS)),
            is_dense=True,
        )


def main() -> None:
    """Run the node until Ctrl-C."""
    rclpy.init()
    node = TestNode()
    try:
        rclpy.spin(node)
    except (KeyboardInterrupt, ExternalShutdownException):
        node.report()
    finally:
        node.destroy_node()
        rclpy.try_shutdown()
