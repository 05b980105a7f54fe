"""Two bridges, each in a namespace and with a port of its own; two_bridges.launch.xml is the same in XML.

Each has the /tf of its namespace: the frames of two trackers with the same device names would mix.
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, GroupAction, IncludeLaunchDescription
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch.substitutions import LaunchConfiguration, ThisLaunchFileDir
from launch_ros.actions import SetRemap

ARGUMENTS = (
    ("namespace_1", "or1", "namespace of the first bridge"),
    ("listen_1", "127.0.0.1:18944", "address of the first bridge"),
    ("namespace_2", "or2", "namespace of the second bridge"),
    ("listen_2", "127.0.0.1:18945", "address of the second bridge"),
    ("params_file", "", "file of parameters of both bridges"),
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
            *(
                GroupAction(
                    [
                        SetRemap("/tf", "tf"),
                        SetRemap("/tf_static", "tf_static"),
                        IncludeLaunchDescription(
                            PythonLaunchDescriptionSource([ThisLaunchFileDir(), "/bridge.launch.py"]),
                            launch_arguments={
                                "namespace": values[f"namespace_{number}"],
                                "listen": values[f"listen_{number}"],
                                "params_file": values["params_file"],
                                "log_level": values["log_level"],
                            }.items(),
                        ),
                    ]
                )
                for number in (1, 2)
            ),
        ]
    )
