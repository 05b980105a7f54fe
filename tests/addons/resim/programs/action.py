"""Imitates the client or the server of an action, with types that are there; the argument states which.

The client asks the server by services with a new random goal id for each message; the server publishes status and
feedback with these ids, as rcl_action does.  "server wrong" has a fault in the feedback of the fifth goal.
"""

import sys
import uuid

import rclpy
from action_msgs.msg import GoalInfo, GoalStatus, GoalStatusArray
from action_msgs.srv import CancelGoal
from rclpy.node import Node
from std_msgs.msg import String


class Server(Node):  # type: ignore[misc]
    def __init__(self, is_wrong: bool) -> None:
        super().__init__("server")
        self.is_wrong = is_wrong
        self.goals: list[GoalStatus] = []
        self.status = self.create_publisher(GoalStatusArray, "/drive/_action/status", 10)
        self.feedback = self.create_publisher(GoalInfo, "/drive/_action/feedback", 10)
        self.create_service(CancelGoal, "/drive/_action/send_goal", self.accept)

    def accept(self, request: CancelGoal.Request, response: CancelGoal.Response) -> CancelGoal.Response:
        goal = request.goal_info
        self.goals.append(GoalStatus(goal_info=goal, status=GoalStatus.STATUS_EXECUTING))
        self.status.publish(GoalStatusArray(status_list=self.goals))
        for step in range(2):
            info = GoalInfo(goal_id=goal.goal_id)
            info.stamp.sec = len(self.goals) + 10 * step + (100 if self.is_wrong and len(self.goals) == 5 else 0)
            self.feedback.publish(info)
        self.goals[-1].status = GoalStatus.STATUS_SUCCEEDED
        self.status.publish(GoalStatusArray(status_list=self.goals))
        response.goals_canceling = [goal]
        return response


class Client(Node):  # type: ignore[misc]
    def __init__(self) -> None:
        super().__init__("client")
        self.publisher = self.create_publisher(String, "/out", 10)
        self.action = self.create_client(CancelGoal, "/drive/_action/send_goal")
        self.own: set[bytes] = set()
        self.create_subscription(GoalInfo, "/drive/_action/feedback", self.goes_on, 10)
        self.create_subscription(String, "/in", self.take, 10)

    def take(self, message: String) -> None:
        request = CancelGoal.Request()
        request.goal_info.goal_id.uuid = list(uuid.uuid4().bytes)
        self.own.add(bytes(request.goal_info.goal_id.uuid))
        self.action.call_async(request)

    def goes_on(self, info: GoalInfo) -> None:
        """Only the ids that were sent come back."""
        self.publisher.publish(String(data=f"{info.stamp.sec} {bytes(info.goal_id.uuid) in self.own}"))


rclpy.init()
rclpy.spin(Client() if sys.argv[1] == "client" else Server("wrong" in sys.argv))
