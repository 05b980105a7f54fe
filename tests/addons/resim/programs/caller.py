"""A client of services: of another program, and of that program's parameters."""

import rclpy
from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue
from rcl_interfaces.srv import SetParameters
from rclpy.node import Node
from std_msgs.msg import String
from std_srvs.srv import SetBool


class Caller(Node):
    def __init__(self):
        super().__init__("caller")
        self.publisher = self.create_publisher(String, "/answers", 10)
        self.client = self.create_client(SetBool, "/switch")
        self.parameters = self.create_client(SetParameters, "/switch/set_parameters")
        self.create_subscription(String, "/in", self.take, 10)
        self.count = 0
        self.is_there = self.client.wait_for_service(5.0)

    def take(self, message):
        self.count += 1
        future = self.client.call_async(SetBool.Request(data=self.count % 2 == 0))
        future.add_done_callback(lambda done: self.answer(message.data, done.result()))
        if self.count == 5:
            value = ParameterValue(type=ParameterType.PARAMETER_STRING, string_value="changed")
            request = SetParameters.Request(parameters=[Parameter(name="word", value=value)])
            self.parameters.call_async(request)

    def answer(self, name, response):
        text = f"{name}: {response.success} {response.message} {self.is_there}"
        self.publisher.publish(String(data=text))


rclpy.init()
try:
    rclpy.spin(Caller())
except KeyboardInterrupt:
    pass
