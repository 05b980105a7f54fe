"""A light ROS 2 node for ``resim``: it passes each pose on, and does nothing else.  ``python light_node.py``.

Most of the CPU of a re-simulation of it is that of rclpy's executor (measured: 130 of 200 µs an input).
"""

from __future__ import annotations

from typing import Any

TOPIC_IN, TOPIC_OUT = "/igtl/in/Tracker/transform", "/light_node/transform"


def main() -> None:
    """The process."""
    import rclpy
    from geometry_msgs.msg import TransformStamped
    from rclpy.executors import ExternalShutdownException

    rclpy.init()
    node = rclpy.create_node("light_node")
    out = node.create_publisher(TransformStamped, TOPIC_OUT, 10)

    def passed_on(message: Any) -> None:
        out.publish(message)

    node.create_subscription(TransformStamped, TOPIC_IN, passed_on, 10)
    try:
        rclpy.spin(node)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass


if __name__ == "__main__":
    main()
