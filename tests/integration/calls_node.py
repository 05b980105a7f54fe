"""A server of a service and of an action, or their client: rclpy in a process of its own.

usage: calls_node.py server|client|echo|resimulated|aborts|orders

The server is of rclpy's services alone, so that introspection shows the action's, too: Jazzy's ActionServer has none.
A goal of order 1 succeeds, 2 is aborted, 3 is canceled by the client, 4 is rejected.  The client publishes what it gets
on /out, which a recorder has to receive ("client"), then "end".  "aborts" is rclpy's own server, which aborts goals of
an odd order; "orders" asks it for 20.
"""

from __future__ import annotations

import sys
import threading
import time
from typing import Any

import rclpy
from action_msgs.msg import GoalStatus, GoalStatusArray
from action_msgs.srv import CancelGoal
from rclpy.action import ActionClient, ActionServer
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.executors import MultiThreadedExecutor
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, qos_profile_system_default
from rclpy.service_introspection import ServiceIntrospectionState
from std_msgs.msg import String
from std_srvs.srv import SetBool
from test_msgs.action import Fibonacci

IMPL = Fibonacci.Impl


class Server(Node):  # type: ignore[misc]
    def __init__(self) -> None:
        super().__init__("calls_server")
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self.states = self.create_publisher(GoalStatusArray, "/fib/_action/status", latched)
        self.feedback = self.create_publisher(IMPL.FeedbackMessage, "/fib/_action/feedback", 10)
        self.goals: dict[bytes, int] = {}  # id → order
        self.ended: dict[bytes, threading.Event] = {}
        self.offer(SetBool, "/enable", self.enable)
        self.offer(IMPL.SendGoalService, "/fib/_action/send_goal", self.send_goal)
        self.offer(IMPL.GetResultService, "/fib/_action/get_result", self.get_result)
        self.offer(CancelGoal, "/fib/_action/cancel_goal", self.cancel_goal)

    def offer(self, type_: Any, name: str, answer: Any) -> None:
        service = self.create_service(type_, name, answer, callback_group=ReentrantCallbackGroup())
        introspection = qos_profile_system_default, ServiceIntrospectionState.CONTENTS
        service.configure_introspection(self.get_clock(), *introspection)

    def enable(self, request: Any, response: Any) -> Any:
        response.success, response.message = request.data, "on" if request.data else "off"
        return response

    def state(self, id_: bytes, status: int) -> None:
        one = GoalStatus(status=status)
        one.goal_info.goal_id.uuid = list(id_)
        self.states.publish(GoalStatusArray(status_list=[one]))

    def send_goal(self, request: Any, response: Any) -> Any:
        id_ = request.goal_id.uuid.tobytes()
        response.accepted = request.goal.order != 4
        if response.accepted:
            self.goals[id_], self.ended[id_] = request.goal.order, threading.Event()
            self.state(id_, GoalStatus.STATUS_EXECUTING)
            threading.Thread(target=self.work, args=(id_, request.goal.order), daemon=True).start()
        return response

    def work(self, id_: bytes, order: int) -> None:
        for length in (1, 2):
            time.sleep(0.05)
            message = IMPL.FeedbackMessage()
            message.goal_id.uuid, message.feedback.sequence = list(id_), list(range(length))
            self.feedback.publish(message)
        if order == 3:
            self.ended[id_].wait()
        time.sleep(0.05)
        self.state(id_, {1: GoalStatus.STATUS_SUCCEEDED, 2: GoalStatus.STATUS_ABORTED}.get(order, 5))
        self.ended[id_].set()

    def get_result(self, request: Any, response: Any) -> Any:
        order = self.goals[request.goal_id.uuid.tobytes()]
        self.ended[request.goal_id.uuid.tobytes()].wait()
        response.status = {1: GoalStatus.STATUS_SUCCEEDED, 2: GoalStatus.STATUS_ABORTED}.get(order, 5)
        response.result.sequence = [order, 10 * order]
        return response

    def cancel_goal(self, request: Any, response: Any) -> Any:
        self.state(request.goal_info.goal_id.uuid.tobytes(), GoalStatus.STATUS_CANCELING)
        response.goals_canceling = [request.goal_info]
        self.ended[request.goal_info.goal_id.uuid.tobytes()].set()
        return response


class Client(Node):  # type: ignore[misc]
    def __init__(self) -> None:
        super().__init__("calls_client")
        self.out = self.create_publisher(String, "/out", 100)
        self.service = self.create_client(SetBool, "/enable")
        self.action = ActionClient(self, Fibonacci, "/fib")

    def say(self, text: str) -> None:
        self.out.publish(String(data=text))
        print(text, flush=True)  # noqa: T201 (the protocol)

    def wait(self, future: Any) -> Any:
        rclpy.spin_until_future_complete(self, future, timeout_sec=20)
        return future.result()

    def run(self, recorders: int) -> None:
        assert self.service.wait_for_service(30) and self.action.wait_for_server(30)
        recorded = ("/out", "/enable/_service_event", "/fib/_action/send_goal/_service_event")
        while recorders and not all(map(self.count_subscribers, recorded)):
            time.sleep(0.05)
        time.sleep(recorders)  # the server may have to discover them, too
        for value in (True, False):
            answer = self.wait(self.service.call_async(SetBool.Request(data=value)))
            self.say(f"{value}: {answer.success} {answer.message}")
        for order in (1, 2, 3, 4):
            self.goal(order)
        self.say("end")

    def order(self) -> None:
        assert self.action.wait_for_server(30)
        time.sleep(2)  # a recorder may still discover the server
        for number in range(20):
            goal = self.wait(self.action.send_goal_async(Fibonacci.Goal(order=number)))
            self.wait(goal.get_result_async())
            time.sleep(0.5)
        time.sleep(2)  # its window ends, though nothing else comes
        print("end", flush=True)  # noqa: T201 (the protocol)

    def goal(self, order: int) -> None:
        seen: list[int] = []
        goal = self.wait(
            self.action.send_goal_async(
                Fibonacci.Goal(order=order), lambda each: seen.append(len(each.feedback.sequence))
            )
        )
        if not goal.accepted:
            self.say(f"{order}: rejected")
            return
        result = goal.get_result_async()
        while order == 3 and len(seen) < 2:
            rclpy.spin_once(self, timeout_sec=1)
        code = self.wait(goal.cancel_goal_async()).return_code if order == 3 else "-"
        found = self.wait(result)
        self.say(f"{order}: {found.status} {list(found.result.sequence)} feedback {seen} cancel {code}")


def end(goal: Any) -> Any:
    """Abort goals of an odd order."""
    (goal.abort if goal.request.order % 2 else goal.succeed)()
    return Fibonacci.Result()


sys.excepthook = lambda kind, *rest: None if kind is KeyboardInterrupt else sys.__excepthook__(kind, *rest)
rclpy.init()
if sys.argv[1] == "server":
    executor = MultiThreadedExecutor(8)
    executor.add_node(Server())
    executor.spin()
elif sys.argv[1] == "aborts":
    own = Node("aborting")
    server = ActionServer(own, Fibonacci, "/fib", end)
    rclpy.spin(own)
elif sys.argv[1] == "orders":
    Client().order()
else:
    Client().run(recorders=int(sys.argv[1] == "client"))
    if sys.argv[1] == "resimulated":
        rclpy.spin(Node("rest"))
