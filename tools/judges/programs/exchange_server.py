"""A service and an action without clients of their own: prints each request, and of a goal that is canceled, that."""

import sys
import time
from typing import Any

import rclpy
from rclpy.action import ActionServer, CancelResponse
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.executors import ExternalShutdownException, MultiThreadedExecutor
from std_srvs.srv import SetBool
from test_msgs.action import Fibonacci

#: The goal that ends by a request, as in ``tests/integration/services_world.py``.
CANCELED = 5

rclpy.init()
node, group = rclpy.create_node("server"), ReentrantCallbackGroup()


def tell(line: str) -> None:
    sys.stdout.write(f"{line}\n")  # at once: threads do


def enable(request: Any, response: Any) -> Any:
    tell(f"call {request.data}")
    return response


def work(goal: Any) -> Any:
    tell(f"goal {goal.request.order}")
    while goal.request.order == CANCELED and not goal.is_cancel_requested:
        time.sleep(0.01)
    if goal.is_cancel_requested:
        tell(f"cancel {goal.request.order}")
        goal.canceled()
    else:
        goal.succeed()
    return Fibonacci.Result()


def accept(_: Any) -> Any:
    return CancelResponse.ACCEPT


service = node.create_service(SetBool, "/arm/enable", enable, callback_group=group)
server = ActionServer(node, Fibonacci, "/fib", work, cancel_callback=accept, callback_group=group)
executor = MultiThreadedExecutor(4)
executor.add_node(node)
try:
    executor.spin()
except (KeyboardInterrupt, ExternalShutdownException):
    pass
