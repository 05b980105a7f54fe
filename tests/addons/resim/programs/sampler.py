"""Publishes the last pose by a timer of 20 Hz, as a controller samples its input; "echo" publishes each pose, too."""

import sys

import rclpy
from geometry_msgs.msg import TransformStamped
from rclpy.node import Node


class Sampler(Node):
    def __init__(self):
        super().__init__("sampler")
        self.pose = None
        self.publisher = self.create_publisher(TransformStamped, "/sample", 100)
        self.echo = self.create_publisher(TransformStamped, "/plan", 100) if "echo" in sys.argv else None
        self.create_subscription(TransformStamped, "/pose", self.take, 100)
        self.create_timer(0.05, self.step)

    def take(self, pose):
        self.pose = pose
        if self.echo:
            pose.transform.translation.z += 0.1 if "higher" in sys.argv else 0.0
            self.echo.publish(pose)

    def step(self):
        if self.pose:
            self.publisher.publish(self.pose)


rclpy.init()
try:
    rclpy.spin(Sampler())
except KeyboardInterrupt:
    pass
