"""Another program, which uses the message types like any user of rclpy: by their classes.

    typed_node.py TYPE ...

Takes each TYPE (``igtl_msgs/msg/Name``) on ``NAME/there``, prints its values as one line of JSON and publishes the
message on ``NAME/back``.  Answers the service ``send_command`` with what it was asked.  Ends with its standard input.
"""

from __future__ import annotations

import importlib
import json
import sys
import threading
from typing import Any

import rclpy
from igtl_msgs.srv import SendCommand
from rclpy.executors import ExternalShutdownException
from rclpy.qos import QoSProfile

QOS = QoSProfile(depth=10)


def plain(value: Any) -> Any:
    """A message as dicts, lists, strings and numbers."""
    if hasattr(value, "get_fields_and_field_types"):
        return {name: plain(getattr(value, name)) for name in value.get_fields_and_field_types()}
    if isinstance(value, str | int | float):
        return value
    return [plain(item) for item in (value.tolist() if hasattr(value, "tolist") else value)]


def topic(type_name: str) -> str:
    return "/" + type_name.replace("/", "_")


def answer(request: Any, response: Any) -> Any:
    response.status = 1
    response.content = json.dumps(plain(request))
    response.metadata = request.metadata
    response.link = request.link
    return response


def main() -> None:
    rclpy.init()
    node = rclpy.create_node("typed_node")
    for type_name in sys.argv[1:]:
        package, _, name = type_name.split("/")
        message_class = getattr(importlib.import_module(f"{package}.msg"), name)
        publisher = node.create_publisher(message_class, topic(type_name) + "/back", QOS)

        def callback(message: Any, type_name: str = type_name, publisher: Any = publisher) -> None:
            sys.stdout.write(json.dumps([type_name, plain(message)]) + "\n")
            sys.stdout.flush()
            publisher.publish(message)

        node.create_subscription(message_class, topic(type_name) + "/there", callback, QOS)
    node.create_service(SendCommand, "send_command", answer)
    threading.Thread(target=lambda: (sys.stdin.read(), rclpy.try_shutdown()), daemon=True).start()
    try:
        rclpy.spin(node)
    except ExternalShutdownException:
        pass


if __name__ == "__main__":
    main()
