"""A node that is slower than its input; arguments: the depth of its queue ("all": keep all), and what takes long.

"spin": a callback of 100 ms; "threads": the same in an executor with several threads; "timer": a timer's callback;
"serve" and "ask": a service that works on its first request for a second, and a client with 25 requests at once.
"""

import sys
import time
from typing import Any

import rclpy
from rclpy.executors import MultiThreadedExecutor, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import HistoryPolicy, QoSProfile, ReliabilityPolicy
from std_msgs.msg import String
from std_srvs.srv import SetBool

depth, what = sys.argv[1:]
KEPT = (
    QoSProfile(history=HistoryPolicy.KEEP_ALL, reliability=ReliabilityPolicy.BEST_EFFORT)
    if depth == "all"
    else QoSProfile(depth=int(depth))
)


class Slow(Node):  # type: ignore[misc]
    def __init__(self) -> None:
        super().__init__(what)
        self.publisher = self.create_publisher(String, "/out", 10)
        self.asked = self.served = 0
        if what == "ask":
            self.client = self.create_client(SetBool, "/work")
            self.timer = self.create_timer(0.01, self.ask)
        elif what == "serve":
            self.create_service(SetBool, "/work", self.serve)
        else:
            self.create_subscription(String, "/in", self.take, KEPT)
            if what == "timer":
                self.timer = self.create_timer(0.2, lambda: time.sleep(0.19))

    def take(self, message: String) -> None:
        self.publisher.publish(message)
        if what != "timer":
            time.sleep(0.1)

    def ask(self) -> None:
        while self.client.service_is_ready() and self.asked < 25:
            future = self.client.call_async(SetBool.Request())
            future.add_done_callback(lambda _, number=self.asked: self.publisher.publish(String(data=str(number))))
            self.asked += 1

    def serve(self, _request: Any, response: Any) -> Any:
        time.sleep(0 if self.served else 1)
        self.served += 1
        return response


rclpy.init()
executor = MultiThreadedExecutor(3) if what == "threads" else SingleThreadedExecutor()
executor.add_node(Slow())
executor.spin()
