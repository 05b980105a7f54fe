"""A planner: a target above each pose, with a regression that the first argument names, from message 500 on."""

import math
import sys

import rclpy
from geometry_msgs.msg import TransformStamped
from rclpy.node import Node

FAULT = sys.argv[1]


class Planner(Node):
    def __init__(self):
        super().__init__("planner")
        self.count = 0
        self.late = None
        self.publisher = self.create_publisher(TransformStamped, "/plan", 100)
        self.create_subscription(TransformStamped, "/pose", self.take, 100)

    def take(self, pose):
        self.count += 1
        pose.transform.translation.z += 0.1
        if FAULT == "mm" and self.count >= 500:
            pose.transform.translation.x += 0.001
        if FAULT == "deg" and self.count >= 500:
            turn(pose.transform.rotation, math.radians(1))
        if FAULT == "frame" and self.count >= 500:
            pose.header.frame_id, pose.child_frame_id = pose.child_frame_id, pose.header.frame_id
        if FAULT == "nan" and self.count == 500:
            pose.transform.translation.y = math.nan
        if FAULT == "lost" and self.count == 500:
            return
        if FAULT == "late" and self.count == 500:
            self.late = pose
            return
        if self.late:
            self.publisher.publish(self.late)
            self.late = None
        self.publisher.publish(pose)


def turn(q, angle):
    """Rotate a quaternion about z."""
    s, c = math.sin(angle / 2), math.cos(angle / 2)
    q.x, q.y, q.z, q.w = q.x * c + q.y * s, q.y * c - q.x * s, q.z * c + q.w * s, q.w * c - q.z * s


rclpy.init()
try:
    rclpy.spin(Planner())
except KeyboardInterrupt:
    pass
