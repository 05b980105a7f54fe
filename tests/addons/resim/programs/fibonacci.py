"""Client and server of an action, with goals that are cancelled and rejected, in several threads; "single": in one.

The arguments state which of them; "wrong" has a fault in the feedback of the sixth goal.
"""

import sys
import time
from typing import Any

import rclpy
from rclpy.action import ActionClient, ActionServer, CancelResponse, GoalResponse
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.executors import MultiThreadedExecutor, SingleThreadedExecutor
from rclpy.node import Node
from std_msgs.msg import String
from test_msgs.action import Fibonacci


class Server(Node):  # type: ignore[misc]
    def __init__(self) -> None:
        super().__init__("server")
        self.action = ActionServer(
            self, Fibonacci, "/drive", self.work,
            goal_callback=lambda goal: GoalResponse.ACCEPT if goal.order % 4 else GoalResponse.REJECT,
            cancel_callback=lambda _: CancelResponse.ACCEPT, callback_group=ReentrantCallbackGroup(),
        )  # fmt: skip

    def work(self, goal: Any) -> Fibonacci.Result:
        found = [0, 1]
        for _ in range(4):
            if goal.is_cancel_requested:
                goal.canceled()
                return Fibonacci.Result(sequence=found)
            found.append(found[-1] + found[-2] + ("wrong" in sys.argv and goal.request.order == 6))
            goal.publish_feedback(Fibonacci.Feedback(sequence=found))
            time.sleep(0.005)
        goal.succeed()
        return Fibonacci.Result(sequence=found)


class Client(Node):  # type: ignore[misc]
    def __init__(self) -> None:
        super().__init__("client")
        self.publisher = self.create_publisher(String, "/out", 10)
        self.count = 0
        self.action = ActionClient(self, Fibonacci, "/drive")
        self.create_subscription(String, "/in", self.take, 10)

    def take(self, message: String) -> None:
        self.count += 1
        number, name = self.count, message.data
        sent = self.action.send_goal_async(
            Fibonacci.Goal(order=number),
            feedback_callback=lambda each: self.say(f"{name} goes on {len(each.feedback.sequence)}"),
        )
        sent.add_done_callback(lambda future: self.accepted(future.result(), name, number))

    def accepted(self, goal: Any, name: str, number: int) -> None:
        self.say(f"{name} accepted={goal.accepted}")
        if not goal.accepted:
            return
        goal.get_result_async().add_done_callback(
            lambda future: self.say(f"{name} {future.result().status} {list(future.result().result.sequence)}")
        )
        if number % 5 == 0:
            goal.cancel_goal_async()

    def say(self, text: str) -> None:
        self.publisher.publish(String(data=f"{text} at {self.get_clock().now().nanoseconds}"))


rclpy.init()
executor = SingleThreadedExecutor() if "single" in sys.argv else MultiThreadedExecutor(3)
nodes = [{"server": Server, "client": Client}[name]() for name in sys.argv[1:] if name in ("server", "client")]
for node in nodes:
    executor.add_node(node)
executor.spin()
