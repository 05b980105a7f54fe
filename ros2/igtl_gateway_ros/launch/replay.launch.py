"""A replay to ROS with the recorded time on /clock, and a node with use_sim_time that counts what it receives.

replay.launch.xml is the same in XML.  The launch ends with the replay.
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, GroupAction, Shutdown
from launch.conditions import IfCondition
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node, SetParameter

ARGUMENTS = (
    ("file", None, "recording, or MCAP file of rosbag2"),
    ("to", "ros", "send to ros, or to both: ROS and OpenIGTLink peers"),
    ("rate", "1.0", "recorded seconds per second"),
    ("delay", "2.0", "seconds before the first message, in which subscribers can join"),
    ("namespace", "", "namespace of the nodes, into which the topics below /igtl/ move"),
    ("test_node", "true", "false: without the node that counts messages"),
    ("log_level", "info", "lowest level of the log: debug, info, warn, error or fatal"),
)


def generate_launch_description():
    values = {name: LaunchConfiguration(name) for name, _, _ in ARGUMENTS}
    return LaunchDescription(
        [
            *(
                DeclareLaunchArgument(name, default_value=default, description=text)
                for name, default, text in ARGUMENTS
            ),
            Node(
                package="igtl_gateway",
                executable="replay",
                name="igtl_gateway_replay",
                namespace=values["namespace"],
                output="screen",
                arguments=[
                    values["file"],
                    "--to",
                    values["to"],
                    "--clock",
                    "--rate",
                    values["rate"],
                    "--delay",
                    values["delay"],
                ],
                ros_arguments=["--log-level", values["log_level"]],
                on_exit=Shutdown(),
            ),
            GroupAction(
                [
                    SetParameter("use_sim_time", True),
                    Node(
                        package="igtl_gateway",
                        executable="test_node",
                        name="test_node",
                        namespace=values["namespace"],
                        output="screen",
                        parameters=[{"send": False}],
                        condition=IfCondition(values["test_node"]),
                    ),
                ]
            ),
        ]
    )
