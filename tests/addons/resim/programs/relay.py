"""Publishes what it receives; the arguments are both topics."""

import sys

import rclpy
from std_msgs.msg import String

rclpy.init()
node = rclpy.create_node("relay_to" + sys.argv[2].replace("/", "_"))
publisher = node.create_publisher(String, sys.argv[2], 10)
node.create_subscription(String, sys.argv[1], publisher.publish, 10)
try:
    rclpy.spin(node)
except KeyboardInterrupt:
    pass
