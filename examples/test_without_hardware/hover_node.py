"""A ROS 2 node that publishes a pose 50 mm above each target of the navigation.

The function ``hover`` has the logic, from message to message, so tests need no running ROS.
"""

from __future__ import annotations

import copy
from typing import Any

ABOVE_M = 0.05


def hover(target: Any) -> Any:
    """Return the pose of the tool above a target, as geometry_msgs/msg/TransformStamped in the frame of the target."""
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
