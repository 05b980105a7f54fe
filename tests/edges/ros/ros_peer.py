"""A foreign ROS 2 node for the tests: typed rclpy in a process of its own, controlled by JSON lines.

Each line on stdin is ``[command, arguments…]`` and is answered by one JSON line on stdout.  Nothing of the
gateway is imported here, and no executor runs: messages stay in the reader's queue until they are taken.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable
from importlib import import_module
from typing import Any

from rclpy.context import Context
from rclpy.duration import Duration
from rclpy.executors import SingleThreadedExecutor
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.serialization import deserialize_message, serialize_message

TIMEOUT_S = 60


def message_class(name: str) -> Any:
    package, _, kind = name.split("/")
    return getattr(import_module(f"{package}.msg"), kind)


def set_message_fields(message: Any, fields: dict[str, Any]) -> None:
    for name, value in fields.items():
        if isinstance(value, dict):
            set_message_fields(getattr(message, name), value)
        else:
            setattr(message, name, value)


def as_dict(value: Any) -> Any:
    if not hasattr(value, "get_fields_and_field_types"):
        value = value.tolist() if hasattr(value, "tolist") else value  # sequences of numbers
        return list(map(as_dict, value)) if isinstance(value, list) else value
    return {name: as_dict(getattr(value, name)) for name in value.get_fields_and_field_types()}


def profile(depth: int = 10, reliable: bool = True, latched: bool = False) -> Any:
    return QoSProfile(
        depth=depth,
        reliability=ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE,
    )


class Peer:
    def __init__(self) -> None:
        self.context = Context()
        self.context.init(args=[])
        self.node = Node("peer", context=self.context)
        self.publishers: dict[str, Any] = {}
        self.subscriptions: dict[str, Any] = {}

    def call(self, service: str, kind: str, number: int) -> int:
        """Make this number of calls at once; return the number of answers."""
        package, _, name = kind.split("/")
        service_class = getattr(import_module(f"{package}.srv"), name)
        client = self.node.create_client(service_class, service, qos_profile=profile(depth=number))
        executor = SingleThreadedExecutor(context=self.context)
        executor.add_node(self.node)
        try:
            if not client.wait_for_service(TIMEOUT_S):
                return 0
            futures = [client.call_async(service_class.Request()) for _ in range(number)]
            deadline = time.monotonic() + TIMEOUT_S
            while not all(future.done() for future in futures) and time.monotonic() < deadline:
                executor.spin_once(0.1)
            return sum(future.done() for future in futures)
        finally:
            executor.remove_node(self.node)
            self.node.destroy_client(client)

    def publisher(self, topic: str, kind: str, qos: dict[str, Any]) -> None:
        self.publishers[topic] = self.node.create_publisher(message_class(kind), topic, profile(**qos))

    def subscribe(self, topic: str, kind: str, qos: dict[str, Any]) -> None:
        self.subscriptions[topic] = self.node.create_subscription(
            message_class(kind), topic, lambda _: None, profile(**qos), raw=True
        )

    def drop(self, topic: str) -> None:
        """Remove publisher and subscription of the topic."""
        if topic in self.publishers:
            self.node.destroy_publisher(self.publishers.pop(topic))
        if topic in self.subscriptions:
            self.node.destroy_subscription(self.subscriptions.pop(topic))

    def readers(self, topic: str, count: int) -> bool:
        """Wait until the publisher has that many readers."""
        return self._until(lambda: self.publishers[topic].get_subscription_count() == count)

    def writers(self, topic: str, count: int) -> bool:
        """Wait until the subscription has that many writers."""
        return self._until(lambda: self.subscriptions[topic].get_publisher_count() == count)

    def publish(self, topic: str, fields: dict[str, Any]) -> str:
        """Send one message; returns its bytes."""
        message = self.publishers[topic].msg_type()
        set_message_fields(message, fields)
        self.publishers[topic].publish(message)
        data: bytes = serialize_message(message)
        return data.hex()

    def publish_hex(self, topic: str, cdr: str) -> None:
        self.publishers[topic].publish(bytes.fromhex(cdr))

    def publish_many(self, topic: str, fields: dict[str, Any], counted: str, count: int) -> None:
        """Send ``count`` messages as fast as possible, the string field ``counted`` numbered."""
        message = self.publishers[topic].msg_type()
        set_message_fields(message, fields)
        for number in range(count):
            setattr(message, counted, str(number))
            self.publishers[topic].publish(message)

    def publish_times(self, topic: str, fields: dict[str, Any], counted: str, period_s: float, count: int) -> None:
        """Send at a steady rate, the string field ``counted`` holding the clock (for measurements)."""
        message = self.publishers[topic].msg_type()
        set_message_fields(message, fields)
        for _ in range(count):
            time.sleep(period_s)
            setattr(message, counted, str(time.monotonic_ns()))
            self.publishers[topic].publish(message)

    def acked(self, topic: str) -> bool:
        """Wait until all readers of the publisher have its messages."""
        done: bool = self.publishers[topic].wait_for_all_acked(Duration(seconds=TIMEOUT_S))
        return done

    def ready(self, topic: str) -> bool:
        """Wait once for messages of the subscription, and take none."""
        wait_set = rclpy_implementation.WaitSet(1, 0, 0, 0, 0, 0, self.context.handle)
        wait_set.clear_entities()
        wait_set.add_subscription(self.subscriptions[topic].handle)
        wait_set.wait(TIMEOUT_S * 10**9)
        return bool(wait_set.get_ready_entities("subscription"))

    def take(self, topic: str, count: int) -> list[list[Any]]:
        """Wait for this number of messages: ``[[bytes, fields]…]``; fewer if they do not arrive in time."""
        subscription = self.subscriptions[topic]
        taken: list[bytes] = []

        def enough() -> bool:
            while len(taken) < count and (message := subscription.handle.take_message(subscription.msg_type, True)):
                taken.append(message[0])
            return len(taken) == count

        self._until(enough)
        return [[m.hex(), as_dict(deserialize_message(m, subscription.msg_type))] for m in taken]

    def _until(self, condition: Callable[[], bool]) -> bool:
        deadline = time.monotonic() + TIMEOUT_S
        while not condition():
            if time.monotonic() > deadline:
                return False
            time.sleep(0.001)
        return True


def main() -> None:
    peer = Peer()
    for line in sys.stdin:
        command, *arguments = json.loads(line)
        print(json.dumps(getattr(peer, command)(*arguments)), flush=True)  # noqa: T201 (the protocol)
    peer.node.destroy_node()
    peer.context.try_shutdown()


if __name__ == "__main__":
    main()
