"""Stand-in for the ROS 2 package igtl_msgs, compiled when it is first imported (igtl_gateway.edges.ros_interfaces)."""

from igtl_gateway.edges.ros_interfaces.cache import package_path

__path__ = package_path(__name__)
