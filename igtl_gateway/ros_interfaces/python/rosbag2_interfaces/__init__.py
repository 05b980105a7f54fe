"""Stand-in for the ROS 2 package rosbag2_interfaces, compiled at its first import (igtl_gateway/ros_interfaces)."""

from igtl_gateway.ros_interfaces.cache import package_path

__path__ = package_path(__name__)
