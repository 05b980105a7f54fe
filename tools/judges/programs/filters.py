"""message_filters itself: images with the poses of about their time (``approximate``) or of exactly it (``exact``)."""

import sys

import rclpy
from geometry_msgs.msg import TransformStamped
from message_filters import ApproximateTimeSynchronizer, Subscriber, TimeSynchronizer
from rclpy.executors import ExternalShutdownException
from sensor_msgs.msg import Image
from std_msgs.msg import String

rclpy.init()
node = rclpy.create_node("pairs")
publisher = node.create_publisher(String, "/pairs", 10)
inputs = [Subscriber(node, Image, "/image"), Subscriber(node, TransformStamped, "/pose")]
if sys.argv[1] == "exact":
    pairs = TimeSynchronizer(inputs, 20)
else:
    pairs = ApproximateTimeSynchronizer(inputs, 20, 0.005)
pairs.registerCallback(lambda image, pose: publisher.publish(String(data=f"{image.header.stamp} {pose.header.stamp}")))
try:
    rclpy.spin(node)
except (KeyboardInterrupt, ExternalShutdownException):
    pass
