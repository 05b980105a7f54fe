"""An approximate time synchroniser of image and pose, as message_filters has it (which has no wheels)."""

import rclpy
from geometry_msgs.msg import TransformStamped
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import Image
from std_msgs.msg import String


class Pairs(Node):
    def __init__(self):
        super().__init__("pairs")
        self.images, self.poses = [], []
        self.publisher = self.create_publisher(String, "/pairs", 10)
        self.create_subscription(Image, "/image", lambda m: self.take(self.images, m), qos_profile_sensor_data)
        self.create_subscription(TransformStamped, "/pose", lambda m: self.take(self.poses, m), 10)

    def take(self, queue, message):
        queue.append(message)
        del queue[:-20]
        while self.images and self.poses:
            image = self.images[0]
            pose = min(self.poses, key=lambda each: abs(ns(each) - ns(image)))
            if ns(self.poses[-1]) < ns(image):
                return
            self.images.pop(0)
            if abs(ns(pose) - ns(image)) <= 5_000_000:
                x = pose.transform.translation.x
                self.publisher.publish(String(data=f"{ns(image)} {ns(pose)} {x:.6f} {sum(image.data)}"))


def ns(message):
    return message.header.stamp.sec * 10**9 + message.header.stamp.nanosec


rclpy.init()
try:
    rclpy.spin(Pairs())
except KeyboardInterrupt:
    pass
