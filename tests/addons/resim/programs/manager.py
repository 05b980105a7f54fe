"""Configures and activates the lifecycle node, and deactivates it after two seconds of session."""

import rclpy
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState

rclpy.init()
node = rclpy.create_node("manager")
client = node.create_client(ChangeState, "/managed/change_state")
client.wait_for_service()


def change(transition):
    request = ChangeState.Request(transition=Transition(id=transition))
    future = client.call_async(request)
    rclpy.spin_until_future_complete(node, future)
    return future.result().success


try:
    change(Transition.TRANSITION_CONFIGURE)
    change(Transition.TRANSITION_ACTIVATE)
    node.get_clock().sleep_for(rclpy.duration.Duration(seconds=2))
    change(Transition.TRANSITION_DEACTIVATE)
    rclpy.spin(node)
except KeyboardInterrupt:
    pass
