"""Moves the set point of a robot towards a tracked target, at most at 50 mm/s."""

import math

import rclpy
from geometry_msgs.msg import PoseStamped, TransformStamped
from rclpy.node import Node

SPEED = 0.05  # m/s
PERIOD = 0.05  # s


class Planner(Node):
    def __init__(self):
        super().__init__("planner")
        self.target = None
        self.at = (0.0, 0.0, 0.3)
        self.publisher = self.create_publisher(PoseStamped, "/servo_cp", 10)
        self.create_subscription(TransformStamped, "/igtl/in/TargetToBase/transform", self.take, 10)
        self.create_timer(PERIOD, self.step)

    def take(self, message):
        found = message.transform.translation
        self.target = (found.x, found.y, found.z + 0.1)  # stay above it

    def step(self):
        if self.target is None:
            return
        way = math.dist(self.at, self.target)
        part = min(1.0, SPEED * PERIOD / way) if way else 0.0
        self.at = tuple(a + part * (b - a) for a, b in zip(self.at, self.target, strict=True))
        pose = PoseStamped()
        pose.header.stamp = self.get_clock().now().to_msg()
        pose.header.frame_id = "Base"
        pose.pose.position.x, pose.pose.position.y, pose.pose.position.z = self.at
        self.publisher.publish(pose)


def main():
    rclpy.init()
    try:
        rclpy.spin(Planner())
    except KeyboardInterrupt:
        pass


if __name__ == "__main__":
    main()
