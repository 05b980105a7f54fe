"""Stand-in for the ROS 2 package foxglove_msgs, compiled at its first import (igtl_gateway.edges.ros_interfaces)."""

from igtl_gateway.edges.ros_interfaces.cache import package_path

__path__ = package_path(__name__)
