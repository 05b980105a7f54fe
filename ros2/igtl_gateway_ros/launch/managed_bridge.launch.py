"""A bridge as a managed node that this launch file configures and activates; other nodes start once it is active.

An operator may deactivate the bridge: it stays inactive until another node activates it.  The notation XML has no
events of managed nodes.  Arguments are those of bridge.launch.py.
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, EmitEvent, GroupAction, RegisterEventHandler
from launch.conditions import IfCondition
from launch.events import matches_action
from launch.substitutions import LaunchConfiguration, NotEqualsSubstitution
from launch_ros.actions import LifecycleNode, Node, SetParameter, SetParametersFromFile
from launch_ros.event_handlers import OnStateTransition
from launch_ros.events.lifecycle import ChangeState
from lifecycle_msgs.msg import Transition

ARGUMENTS = (
    ("namespace", "", "namespace of the nodes"),
    ("node_name", "igtl_gateway", "name of the bridge"),
    ("params_file", "", "file of parameters of the bridge; arguments override it"),
    ("listen", "", "listen on this address, HOST:PORT; several: in params_file"),
    ("record", "", "record all messages to this MCAP file"),
    ("test_node", "false", "true: start a node that sends and counts messages, once the bridge is active"),
    ("log_level", "info", "lowest level of the log: debug, info, warn, error or fatal"),
)


def given(value):
    return IfCondition(NotEqualsSubstitution(value, ""))


def generate_launch_description():
    values = {name: LaunchConfiguration(name) for name, _, _ in ARGUMENTS}
    bridge = LifecycleNode(
        package="igtl_gateway",
        executable="bridge",
        name=values["node_name"],
        namespace=values["namespace"],
        output="screen",
        arguments=["--no-autostart"],
        ros_arguments=["--log-level", values["log_level"]],
    )

    def transition(number):
        event = ChangeState(lifecycle_node_matcher=matches_action(bridge), transition_id=number)
        return EmitEvent(event=event)

    test_node = Node(
        package="igtl_gateway",
        executable="test_node",
        name="test_node",
        namespace=values["namespace"],
        output="screen",
        condition=IfCondition(values["test_node"]),
    )
    on_configured = OnStateTransition(
        target_lifecycle_node=bridge,
        start_state="configuring",
        goal_state="inactive",
        entities=[transition(Transition.TRANSITION_ACTIVATE)],
    )
    on_active = OnStateTransition(
        target_lifecycle_node=bridge,
        start_state="activating",
        goal_state="active",
        entities=[test_node],
        handle_once=True,
    )
    listen = ["'[\"", values["listen"], "\"]'"]  # a list in the notation of ROS
    return LaunchDescription(
        [
            *(
                DeclareLaunchArgument(name, default_value=default, description=text)
                for name, default, text in ARGUMENTS
            ),
            RegisterEventHandler(on_configured),
            RegisterEventHandler(on_active),
            GroupAction(
                [
                    SetParametersFromFile(values["params_file"], condition=given(values["params_file"])),
                    SetParameter("record", [values["record"]], condition=given(values["record"])),
                    SetParameter("listen", listen, condition=given(values["listen"])),
                    bridge,
                ]
            ),
            transition(Transition.TRANSITION_CONFIGURE),
        ]
    )
