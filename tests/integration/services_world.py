"""A service with introspection, an action and their clients in one foreign node: four calls, and three goals.

They begin when all of their topics have as many readers as the argument states (default: 1).  The events of the
services of the action are those of its client.  rclpy of Jazzy has no introspection of actions: there, they are sent by
hand.  Printed: order and status of each goal.
"""

import sys
import threading
import time
from typing import Any

import rclpy
from rclpy.action import ActionClient, ActionServer, CancelResponse
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.executors import MultiThreadedExecutor
from rclpy.qos import qos_profile_system_default
from rclpy.service_introspection import ServiceIntrospectionState
from std_srvs.srv import SetBool
from test_msgs.action import Fibonacci

#: Each with the readers that are the client's own.
TOPICS = {
    "/arm/enable/_service_event": 0,
    "/fib/_action/send_goal/_service_event": 0,
    "/fib/_action/get_result/_service_event": 0,
    "/fib/_action/feedback": 1,
    "/fib/_action/status": 1,
}
ABORTED, CANCELED = 9, 5

rclpy.init()
node, group = rclpy.create_node("arm"), ReentrantCallbackGroup()


def enable(request: Any, response: Any) -> Any:
    response.success, response.message = request.data, "on" if request.data else "off"
    return response


def work(goal: Any) -> Any:
    found = [0, 1]
    while len(found) < 4 or (goal.request.order == CANCELED and not goal.is_cancel_requested):
        found.append(found[-1] + found[-2])
        goal.publish_feedback(Fibonacci.Feedback(sequence=found[:8]))
        time.sleep(0.01)
    {ABORTED: goal.abort, CANCELED: goal.canceled}.get(goal.request.order, goal.succeed)()
    return Fibonacci.Result(sequence=found[:8])


def done(future: Any) -> Any:
    while not future.done():
        time.sleep(0.002)
    return future.result()


service = node.create_service(SetBool, "/arm/enable", enable, callback_group=group)
caller = node.create_client(SetBool, "/arm/enable", callback_group=group)
for each in (service, caller):
    each.configure_introspection(node.get_clock(), qos_profile_system_default, ServiceIntrospectionState.CONTENTS)
accept = lambda _: CancelResponse.ACCEPT  # noqa: E731
server = ActionServer(node, Fibonacci, "/fib", work, cancel_callback=accept, callback_group=group)
client = ActionClient(node, Fibonacci, "/fib", callback_group=group)
introspection = getattr(client, "configure_introspection", None)
if introspection:
    introspection(node.get_clock(), qos_profile_system_default, ServiceIntrospectionState.CONTENTS)
kinds = {"send_goal": Fibonacci.Impl.SendGoalService.Event, "get_result": Fibonacci.Impl.GetResultService.Event}
events = {
    each: node.create_publisher(kind, f"/fib/_action/{each}/_service_event", 10)
    for each, kind in kinds.items()
    if not introspection
}


def tell(each: str, number: int, request: Any, response: Any) -> None:
    """The two events of the client."""
    for sent, content in ((0, {"request": [request]}), (3, {"response": [response]})):
        event = kinds[each](**content)
        event.info.event_type, event.info.sequence_number = sent, number
        if each in events:
            events[each].publish(event)


executor = MultiThreadedExecutor(4)
executor.add_node(node)
threading.Thread(target=executor.spin, daemon=True).start()
readers = int(sys.argv[1]) if len(sys.argv) > 1 else 1
while not all(node.count_subscribers(topic) >= readers + own for topic, own in TOPICS.items()):
    time.sleep(0.01)
caller.wait_for_service()
client.wait_for_server()
for number in range(4):
    done(caller.call_async(SetBool.Request(data=bool(number % 2))))
for order in (3, ABORTED, CANCELED):
    goal = done(client.send_goal_async(Fibonacci.Goal(order=order)))
    result = goal.get_result_async()
    if order == CANCELED:
        done(goal.cancel_goal_async())
    ended = done(result)
    print(order, ended.status, flush=True)  # noqa: T201 (the protocol)
    services = Fibonacci.Impl.SendGoalService, Fibonacci.Impl.GetResultService
    asked = services[0].Request(goal_id=goal.goal_id, goal=Fibonacci.Goal(order=order))
    tell("send_goal", order, asked, services[0].Response(accepted=True))
    tell("get_result", order, services[1].Request(goal_id=goal.goal_id), ended)
print("end", flush=True)  # noqa: T201
threading.Event().wait()
