"""A lifecycle node, which publishes while it is active."""

import rclpy
from rclpy.lifecycle import LifecycleNode, TransitionCallbackReturn
from std_msgs.msg import String


class Managed(LifecycleNode):
    def __init__(self):
        super().__init__("managed")
        self.count = 0

    def on_configure(self, state):
        self.publisher = self.create_lifecycle_publisher(String, "/out", 10)
        self.create_subscription(String, "/in", self.take, 10)
        return TransitionCallbackReturn.SUCCESS

    def take(self, message):
        self.count += 1
        self.publisher.publish(String(data=f"{message.data} {self.count}"))


rclpy.init()
try:
    rclpy.spin(Managed())
except KeyboardInterrupt:
    pass
