"""A service server, and beside it a parameter that decides what it answers."""

import rclpy
from rclpy.node import Node
from std_srvs.srv import SetBool


class Switch(Node):
    def __init__(self):
        super().__init__("switch")
        self.count = 0
        self.declare_parameter("word", "on")
        self.create_service(SetBool, "/switch", self.switch)

    def switch(self, request, response):
        self.count += 1
        response.success = request.data
        response.message = f"{self.get_parameter('word').value} {self.count} at {self.get_clock().now().nanoseconds}"
        return response


rclpy.init()
try:
    rclpy.spin(Switch())
except KeyboardInterrupt:
    pass
