"""An ordinary node: a timer and a subscription, one thread."""

import rclpy
from rclpy.node import Node
from std_msgs.msg import String


class Counter(Node):
    def __init__(self):
        super().__init__("counter")
        self.count = self.ticks = 0
        self.publisher = self.create_publisher(String, "/out", 10)
        self.create_subscription(String, "/in", self.take, 10)
        self.create_timer(0.1, self.tick)

    def take(self, message):
        self.count += 1
        self.say(f"got {message.data} count={self.count} ticks={self.ticks}")

    def tick(self):
        self.ticks += 1
        if self.ticks % 10 == 0:
            self.say(f"tick {self.ticks} count={self.count}")

    def say(self, text):
        self.publisher.publish(String(data=f"{text} at {self.get_clock().now().nanoseconds}"))


rclpy.init()
try:
    rclpy.spin(Counter())
except KeyboardInterrupt:
    pass
