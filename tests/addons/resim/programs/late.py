"""Subscribes to a latched topic one second after its start."""

import rclpy
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from std_msgs.msg import String

LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)


class Late(Node):
    def __init__(self):
        super().__init__("late")
        self.publisher = self.create_publisher(String, "/out", 10)
        self.create_subscription(String, "/in", lambda message: self.say(f"in {message.data}"), 10)
        self.timer = self.create_timer(1.0, self.begin)

    def begin(self):
        self.timer.cancel()
        self.create_subscription(String, "/map", lambda message: self.say(f"map {message.data}"), LATCHED)

    def say(self, text):
        self.publisher.publish(String(data=text))


rclpy.init()
try:
    rclpy.spin(Late())
except KeyboardInterrupt:
    pass
