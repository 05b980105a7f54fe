"""A bridge that records, and a node that sends one message of each kind and counts what it receives.

recorded_test.launch.xml is the same in XML.
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, IncludeLaunchDescription
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch.substitutions import LaunchConfiguration, ThisLaunchFileDir
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue

ARGUMENTS = (
    ("namespace", "", "namespace of both nodes"),
    ("listen", "127.0.0.1:18944", "listen on this address, HOST:PORT"),
    ("record", "session.mcap", "record all messages to this MCAP file"),
    ("overwrite", "", "true: overwrite an existing recording"),
    ("params_file", "", "file of parameters of the bridge"),
    ("rate", "1.0", "rounds of messages per second of the test node"),
    ("log_level", "info", "lowest level of the log: debug, info, warn, error or fatal"),
)
OF_THE_BRIDGE = ("namespace", "listen", "record", "overwrite", "params_file", "log_level")


def generate_launch_description():
    values = {name: LaunchConfiguration(name) for name, _, _ in ARGUMENTS}
    return LaunchDescription(
        [
            *(
                DeclareLaunchArgument(name, default_value=default, description=text)
                for name, default, text in ARGUMENTS
            ),
            IncludeLaunchDescription(
                PythonLaunchDescriptionSource([ThisLaunchFileDir(), "/bridge.launch.py"]),
                launch_arguments=[(name, values[name]) for name in OF_THE_BRIDGE],
            ),
            Node(
                package="igtl_gateway",
                executable="test_node",
                name="test_node",
                namespace=values["namespace"],
                output="screen",
                parameters=[{"rate": ParameterValue(values["rate"], value_type=float)}],
            ),
        ]
    )
