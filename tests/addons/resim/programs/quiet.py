"""A node with two outputs, /out and /state, that does less than it did; the argument states what."""

import sys
import threading
import time

import rclpy
from rclpy.executors import MultiThreadedExecutor
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from std_msgs.msg import String

QOS = {
    "best_effort": QoSProfile(depth=10, reliability=ReliabilityPolicy.BEST_EFFORT),
    "latched": QoSProfile(depth=10, durability=DurabilityPolicy.TRANSIENT_LOCAL),
    "deep": QoSProfile(depth=50),
}


class Quiet(Node):  # type: ignore[misc]
    def __init__(self, what: str) -> None:
        super().__init__("quiet")
        self.what, self.count = what, 0
        self.out = self.create_publisher(String, "/out", QOS.get(what, 10))
        if what != "without":
            self.state = self.create_publisher(String, "/state", 10)
        self.create_subscription(String, "/in", self.take, 10)

    def take(self, message: String) -> None:
        self.count += 1
        self.out.publish(message)
        if self.what not in ("silent", "without"):
            self.state.publish(String(data=str(self.count)))
        if self.count == 40:  # the last one
            self.end()

    def end(self) -> None:
        if self.what in ("sleeps", "pools"):
            time.sleep(1e8)
        if self.what == "awaits":
            threading.Event().wait(1e6)
        if self.what == "rests":
            time.sleep(5)


def main() -> None:
    rclpy.init()
    what = sys.argv[1]
    node = Quiet(what)
    if what == "pools":
        executor = MultiThreadedExecutor(3)
        executor.add_node(node)
        executor.spin()
    elif what == "apart":  # the main thread keeps the program, and another one spins
        threading.Thread(target=rclpy.spin, args=(node,), daemon=True).start()
        time.sleep(1e8)
    else:
        rclpy.spin(node)


main()
