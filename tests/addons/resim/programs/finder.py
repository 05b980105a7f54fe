"""A node that looks at the graph every 100 ms, and subscribes to the topics of others whose name ends with "in".

It publishes on /own_in, too, and reports how many publishers each topic has.
"""

import rclpy
from rclpy.node import Node
from std_msgs.msg import String


class Finder(Node):  # type: ignore[misc]
    def __init__(self) -> None:
        super().__init__("finder")
        self.publisher = self.create_publisher(String, "/out", 10)
        self.own = self.create_publisher(String, "/own_in", 10)
        self.found: set[str] = set()
        self.create_timer(0.1, self.look)

    def look(self) -> None:
        for topic, types in self.get_topic_names_and_types():
            if topic.endswith("in") and topic not in self.found:
                self.found.add(topic)
                self.publisher.publish(String(data=f"{topic} {types} {self.count_publishers(topic)}"))
                if topic != "/own_in":
                    self.create_subscription(String, topic, self.publisher.publish, 10)


rclpy.init()
rclpy.spin(Finder())
