"""One bridge; bridge.launch.xml is the same in XML.

An argument that is empty sets no parameter: the value is that of params_file, else of config, else the default.
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, GroupAction
from launch.conditions import IfCondition
from launch.substitutions import LaunchConfiguration, NotEqualsSubstitution, NotSubstitution
from launch_ros.actions import Node, SetParameter, SetParametersFromFile

ARGUMENTS = (
    ("namespace", "", "namespace of the node"),
    ("node_name", "igtl_gateway", "name of the node"),
    ("params_file", "", "file of parameters; arguments override it"),
    ("config", "", "configuration file of igtl-gateway (TOML); parameters override it"),
    ("listen", "", "listen on this address, HOST:PORT; several: in params_file"),
    ("connect", "", "connect to this server, HOST:PORT; several: in params_file"),
    ("allow", "", "accept clients of this network only: CIDR, or any"),
    ("record", "", "record all messages to this MCAP file"),
    ("overwrite", "", "true: overwrite an existing recording"),
    ("autostart", "true", "false: wait until other nodes configure and activate the bridge"),
    ("log_level", "info", "lowest level of the log: debug, info, warn, error or fatal"),
)
TEXTS = ("config", "record", "overwrite")
LISTS = ("listen", "connect", "allow")


def given(value):
    return IfCondition(NotEqualsSubstitution(value, ""))


def generate_launch_description():
    values = {name: LaunchConfiguration(name) for name, _, _ in ARGUMENTS}
    parameters = {name: [values[name]] for name in TEXTS}
    parameters |= {name: ["'[\"", values[name], "\"]'"] for name in LISTS}  # a list in the notation of ROS
    node = {
        "package": "igtl_gateway",
        "executable": "bridge",
        "name": values["node_name"],
        "namespace": values["namespace"],
        "output": "screen",
        "ros_arguments": ["--log-level", values["log_level"]],
    }
    return LaunchDescription(
        [
            *(
                DeclareLaunchArgument(name, default_value=default, description=text)
                for name, default, text in ARGUMENTS
            ),
            GroupAction(
                [
                    SetParametersFromFile(values["params_file"], condition=given(values["params_file"])),
                    *(SetParameter(name, value, condition=given(values[name])) for name, value in parameters.items()),
                    Node(**node, condition=IfCondition(values["autostart"])),
                    Node(
                        **node,
                        arguments=["--no-autostart"],
                        condition=IfCondition(NotSubstitution(values["autostart"])),
                    ),
                ]
            ),
        ]
    )
