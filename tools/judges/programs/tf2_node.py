"""tf2_ros itself: a buffer, its listener, look-ups that wait, and both broadcasters.

``timer``: the node's executor runs the listener, and a timer looks up.  ``thread``: the listener has a thread,
and the main one looks up and sleeps.
"""

import sys
from typing import Any

import rclpy
from geometry_msgs.msg import TransformStamped
from rclpy.duration import Duration
from rclpy.executors import ExternalShutdownException
from rclpy.time import Time
from tf2_ros import Buffer, StaticTransformBroadcaster, TransformBroadcaster, TransformException, TransformListener

rclpy.init()
node = rclpy.create_node("needle")
buffer = Buffer()
listener = TransformListener(buffer, node, spin_thread=sys.argv[1] == "thread")
broadcaster = TransformBroadcaster(node)
fixed = TransformStamped(child_frame_id="tip")
fixed.header.frame_id, fixed.transform.translation.z = "tool", 0.2
static = StaticTransformBroadcaster(node)
static.sendTransform(fixed)


def send(**wait: Any) -> None:
    """Broadcast the tip again under another name."""
    try:
        found = buffer.lookup_transform("base", "tip", Time(), **wait)
    except TransformException as error:
        node.get_logger().info(str(error))
        return
    found.child_frame_id = "needle"
    broadcaster.sendTransform(found)


try:
    if sys.argv[1] == "timer":
        node.create_timer(0.033, send)
        rclpy.spin(node)
    while rclpy.ok():
        send(timeout=Duration(seconds=0.5))
        node.get_clock().sleep_for(Duration(seconds=0.05))
except (KeyboardInterrupt, ExternalShutdownException):
    pass
