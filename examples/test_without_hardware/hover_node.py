"""A ROS 2 node: for each target that the navigation names, the pose five centimetres above it.

The thinking is in ``hover``, which takes and gives messages, so that it can be tested without a running ROS.
"""

from __future__ import annotations

import copy
from typing import Any

ABOVE_M = 0.05


def hover(target: Any) -> Any:
    """The pose above a target (geometry_msgs/msg/TransformStamped), in the same frame, for the tool."""
    pose = copy.deepcopy(target)
    pose.child_frame_id = "tool"
    pose.transform.translation.z += ABOVE_M
    return pose


def main() -> None:
    import rclpy
    from geometry_msgs.msg import TransformStamped

    rclpy.init()
    node = rclpy.create_node("hover")
    publisher = node.create_publisher(TransformStamped, "/igtl/out/HoverToBase", 10)
    node.create_subscription(
        TransformStamped, "/igtl/in/TargetToBase/transform", lambda target: publisher.publish(hover(target)), 10
    )
    rclpy.spin(node)


if __name__ == "__main__":
    main()
