"""A MultiThreadedExecutor with reentrant callbacks: a timer, a subscription, and one that takes its time."""

import time

import rclpy
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.executors import MultiThreadedExecutor
from rclpy.node import Node
from std_msgs.msg import String


class Counter(Node):
    def __init__(self):
        super().__init__("counter")
        self.count = self.ticks = 0
        group = ReentrantCallbackGroup()
        self.publisher = self.create_publisher(String, "/out", 10)
        self.create_subscription(String, "/in", self.take, 10, callback_group=group)
        self.create_subscription(String, "/in", self.take_slowly, 10, callback_group=group)
        self.create_timer(0.1, self.tick, callback_group=group)
        self.create_timer(0.05, self.tock, callback_group=group)

    def take(self, message):
        self.count += 1
        self.say(f"got {message.data} count={self.count} ticks={self.ticks}")

    def take_slowly(self, message):
        time.sleep(0.03)
        self.say(f"later {message.data} count={self.count} ticks={self.ticks}")

    def tick(self):
        self.ticks += 1
        if self.ticks % 10 == 0:
            self.say(f"tick {self.ticks} count={self.count}")

    def tock(self):
        self.ticks += 1
        if self.ticks % 10 == 0:
            self.say(f"tock {self.ticks} count={self.count}")

    def say(self, text):
        self.publisher.publish(String(data=f"{text} at {self.get_clock().now().nanoseconds}"))


rclpy.init()
executor = MultiThreadedExecutor(4)
executor.add_node(Counter())
try:
    executor.spin()
except KeyboardInterrupt:
    pass
