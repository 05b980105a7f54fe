"""A foreign ROS 2 node: typed rclpy in a process of its own.  Nothing of igtl_gateway is imported here.

Types are named ``pkg/msg/Name``, any that can be imported.  Their own descriptions of their fields decide how values
become JSON and back.  Sequences of bytes are ``{"hex": …}``, all other sequences and arrays are lists.

usage: ros_client.py NODE_NAME

One JSON object per line.  On stdin commands, each answered by ``{"done": …}`` or ``{"failed": text}`` on stdout:

* ``{"do": "subscribe", "topic", "type", "depth", "latched"}``
* ``{"do": "advertise", "topic", "type", "depth", "latched"}``
* ``{"do": "readers", "topic", "count"}``: wait until the publisher has as many readers
* ``{"do": "publish", "topic", "fields"}``: one message; fields that are left out keep their default
* ``{"do": "again", "topic", "sec"}``: the message before once more, with another ``header.stamp.sec``
* ``{"do": "call", "topic", "type", "fields"}``: a request to a service, once it is there

On stdout also what is received: ``{"topic", "message"}``; for a call its response.
"""

from __future__ import annotations

import array
import json
import sys
import threading
import time
from importlib import import_module
from typing import Any

import rclpy
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rosidl_parser.definition import AbstractNestedType, BasicType, NamespacedType

TIMEOUT_S = 60.0

_printing = threading.Lock()


def say(value: dict[str, Any]) -> None:
    with _printing:
        print(json.dumps(value), flush=True)  # noqa: T201 (the protocol)


def interface(name: str) -> Any:
    """The class of ``pkg/msg/Name`` or ``pkg/srv/Name``."""
    package, kind, name = name.split("/")
    return getattr(import_module(f"{package}.{kind}"), name)


def filled(message: Any, fields: dict[str, Any]) -> Any:
    """``message`` with these fields; what is not named keeps its default."""
    types = dict(zip(message.get_fields_and_field_types(), message.SLOT_TYPES, strict=True))
    for name, value in fields.items():
        setattr(message, name, ros_value(types[name], getattr(message, name), value))
    return message


def ros_value(kind: Any, present: Any, value: Any) -> Any:
    """``value`` for a field of that type, which has the value ``present`` now."""
    if isinstance(kind, NamespacedType):
        return filled(present, value)
    if isinstance(value, dict):
        data = bytes.fromhex(value["hex"])
        return array.array("B", data) if isinstance(present, array.array) else data
    if isinstance(kind, AbstractNestedType):
        element = kind.value_type
        if isinstance(element, NamespacedType):
            make = interface("/".join(element.namespaced_name()))
            return [filled(make(), item) for item in value]
        return [ros_value(element, None, item) for item in value]
    if isinstance(kind, BasicType) and kind.typename in ("float", "double"):
        return float(value)  # rclpy takes no 1 for 1.0
    return value


def plain(value: Any) -> Any:
    """A message as JSON values."""
    if hasattr(value, "get_fields_and_field_types"):
        return {name: plain(getattr(value, name)) for name in value.get_fields_and_field_types()}
    if isinstance(value, bytes):
        return {"hex": value.hex()}
    if isinstance(value, array.array) and value.typecode == "B":
        return {"hex": value.tobytes().hex()}
    if isinstance(value, str | int | float):
        return value
    # sequences of numbers are array.array, fixed ones numpy arrays
    return value.tolist() if hasattr(value, "tolist") else [plain(item) for item in value]


def profile(command: dict[str, Any]) -> Any:
    latched = command.get("latched", False)
    return QoSProfile(
        depth=command.get("depth", 100),
        reliability=ReliabilityPolicy.RELIABLE,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE,
    )


class Client:
    """The node and its commands."""

    def __init__(self, node: Any) -> None:
        self._node = node
        self._publishers: dict[str, Any] = {}
        self._last: dict[str, Any] = {}
        self._callers: dict[str, Any] = {}

    def subscribe(self, command: dict[str, Any]) -> None:
        topic = command["topic"]
        self._node.create_subscription(
            interface(command["type"]),
            topic,
            lambda message: say({"topic": topic, "message": plain(message)}),
            profile(command),
        )

    def advertise(self, command: dict[str, Any]) -> None:
        topic, kind = command["topic"], interface(command["type"])
        self._publishers[topic] = self._node.create_publisher(kind, topic, profile(command))

    def readers(self, command: dict[str, Any]) -> None:
        publisher, deadline = self._publishers[command["topic"]], time.monotonic() + TIMEOUT_S
        while (found := publisher.get_subscription_count()) < command["count"]:
            if time.monotonic() > deadline:
                raise TimeoutError(f"{command['topic']}: {found} readers, expected {command['count']}")
            time.sleep(0.005)

    def publish(self, command: dict[str, Any]) -> None:
        topic = command["topic"]
        self._last[topic] = filled(self._publishers[topic].msg_type(), command["fields"])
        self._publishers[topic].publish(self._last[topic])

    def again(self, command: dict[str, Any]) -> None:
        message = self._last[command["topic"]]
        message.header.stamp.sec = command["sec"]
        self._publishers[command["topic"]].publish(message)

    def call(self, command: dict[str, Any]) -> None:
        name, kind = command["topic"], interface(command["type"])
        if name not in self._callers:
            self._callers[name] = self._node.create_client(kind, name)
        if not self._callers[name].wait_for_service(TIMEOUT_S):
            raise TimeoutError(f"{name}: no such service")
        future = self._callers[name].call_async(filled(kind.Request(), command["fields"]))
        future.add_done_callback(lambda done: say({"topic": name, "message": plain(done.result())}))

    def obey(self, command: dict[str, Any]) -> None:
        {
            "subscribe": self.subscribe,
            "advertise": self.advertise,
            "readers": self.readers,
            "publish": self.publish,
            "again": self.again,
            "call": self.call,
        }[command["do"]](command)


def main() -> None:
    rclpy.init(args=[])
    node = Node(sys.argv[1])
    client = Client(node)
    executor = rclpy.executors.SingleThreadedExecutor()
    executor.add_node(node)
    stopping = threading.Event()

    def spin() -> None:
        while not stopping.is_set():
            executor.spin_once(timeout_sec=0.1)

    spinner = threading.Thread(target=spin)
    spinner.start()
    for line in sys.stdin:
        command = json.loads(line)
        try:
            client.obey(command)
            say({"done": command["do"]})
        except Exception as error:  # reported to the test that gave the command
            say({"failed": f"{command['do']} {command['topic']}: {type(error).__name__}: {error}"})
    stopping.set()
    spinner.join()
    node.destroy_node()
    rclpy.shutdown()


if __name__ == "__main__":
    main()
