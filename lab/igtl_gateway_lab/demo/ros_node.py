"""An ordinary ROS 2 node: typed publishers and subscribers, without igtl_gateway.

It publishes until its standard input ends.

usage: python -m igtl_gateway_lab.demo.ros_node
"""

from __future__ import annotations

import json
import math
import sys
import threading
from array import array
from typing import Any

import rclpy
from geometry_msgs.msg import Point, PointStamped, TransformStamped
from rclpy.node import Node
from sensor_msgs.msg import Image, PointCloud2, PointField
from shape_msgs.msg import Mesh, MeshTriangle
from std_msgs.msg import String

WIDTH, HEIGHT = 64, 48
_RATE_HZ = 20.0


class DemoNode(Node):  # type: ignore[misc]  # rclpy is untyped
    """Publishes a robot's state, a camera and a cloud; listens to what comes from OpenIGTLink."""

    def __init__(self) -> None:
        super().__init__("demo_robot")
        self.sent: dict[str, int] = {}
        self.heard: dict[str, dict[str, Any]] = {}
        self.ticks = 0
        self._out = {
            name: self.create_publisher(kind, f"/igtl/out/{name}", 10)
            for name, kind in (
                ("ToolToBase", TransformStamped),
                ("Robot", String),
                ("Camera", Image),
                ("Target", PointStamped),
                ("Cloud", PointCloud2),
                ("Model", Mesh),
            )
        }
        for name, topic, kind in (
            ("ProbeToTracker", "transform", TransformStamped),
            ("Operator", "string", String),
            ("Ultrasound", "image", Image),
            ("Landmarks", "points", PointCloud2),
        ):
            path = f"/igtl/in/{name}/{topic}"
            self.create_subscription(kind, path, lambda message, path=path: self._hear(path, message), 100)
        self.create_timer(1.0 / _RATE_HZ, self._tick)

    def _hear(self, topic: str, message: Any) -> None:
        entry = self.heard.setdefault(topic, {"messages": 0, "last": ""})
        entry["messages"] += 1
        entry["last"] = _shown(message)

    def _publish(self, name: str, message: Any) -> None:
        self._out[name].publish(message)
        self.sent[name] = self.sent.get(name, 0) + 1

    def _tick(self) -> None:
        self.ticks += 1
        now = self.get_clock().now().to_msg()
        angle = self.ticks / _RATE_HZ
        pose = TransformStamped()
        pose.header.stamp, pose.header.frame_id, pose.child_frame_id = now, "Base", "Tool"
        pose.transform.translation.x = 0.4 + 0.05 * math.cos(angle)
        pose.transform.translation.y = 0.05 * math.sin(angle)
        pose.transform.translation.z = 0.25
        pose.transform.rotation.z, pose.transform.rotation.w = math.sin(angle / 2), math.cos(angle / 2)
        self._publish("ToolToBase", pose)
        if self.ticks % 4 == 0:
            self._publish("Camera", self._image(now))
        if self.ticks % 10 == 0:
            self._publish("Cloud", self._cloud(now))
            self._publish("Target", PointStamped(header=pose.header, point=Point(x=0.01, y=-0.02, z=0.03)))
        if self.ticks % 20 == 0:
            self._publish("Robot", String(data=f"moving, tick {self.ticks}"))
            corners = [Point(x=0.0, y=0.0, z=0.0), Point(x=0.1, y=0.0, z=0.0), Point(x=0.0, y=0.1, z=0.0)]
            self._publish("Model", Mesh(triangles=[MeshTriangle(vertex_indices=[0, 1, 2])], vertices=corners))

    def _image(self, stamp: Any) -> Any:
        image = Image(height=HEIGHT, width=WIDTH, encoding="rgb8", step=3 * WIDTH)
        image.header.stamp, image.header.frame_id = stamp, "camera"
        image.data = array("B", bytes((self.ticks + 4 * (index // 3)) % 256 for index in range(3 * WIDTH * HEIGHT)))
        return image

    def _cloud(self, stamp: Any) -> Any:
        cloud = PointCloud2(height=1, width=1000, point_step=12, row_step=12_000, is_dense=True)
        cloud.header.stamp, cloud.header.frame_id = stamp, "camera"
        cloud.fields = [PointField(name=name, offset=4 * at, datatype=7, count=1) for at, name in enumerate("xyz")]
        turn = 2 * math.pi / 100
        points = array("f")
        for index in range(1000):
            points.extend((0.03 * math.cos(turn * index), 0.03 * math.sin(turn * index), index / 20_000))
        cloud.data = array("B", points.tobytes())
        return cloud


def _shown(message: Any) -> str:
    """The message in a few words."""
    if isinstance(message, TransformStamped):
        t = message.transform.translation
        return f"{message.child_frame_id} in {message.header.frame_id} at ({t.x:.4f}, {t.y:.4f}, {t.z:.4f}) m"
    if isinstance(message, Image):
        return f"{message.width} x {message.height} {message.encoding}, {len(message.data)} bytes"
    if isinstance(message, PointCloud2):
        return f"{message.width * message.height} points, fields {', '.join(field.name for field in message.fields)}"
    return repr(message.data)


def _wait_for_end(ended: threading.Event) -> None:
    sys.stdin.read()
    ended.set()


def main() -> None:
    ended = threading.Event()
    threading.Thread(target=_wait_for_end, args=(ended,), daemon=True).start()
    rclpy.init()
    node = DemoNode()
    print(json.dumps({"event": "ready"}), flush=True)
    while not ended.is_set():
        rclpy.spin_once(node, timeout_sec=0.1)
    print(json.dumps({"event": "summary", "sent": node.sent, "received": node.heard}), flush=True)
    node.destroy_node()
    rclpy.shutdown()


if __name__ == "__main__":
    main()
