"""A node of rclpy that listens to the graph: the messages of a replay as any other program gets them."""

from __future__ import annotations

import importlib
import os
import threading
import time
from collections.abc import Iterator, Mapping
from types import TracebackType
from typing import Any

from tests import domains
from tools.truth.judges.ros import of_message
from tools.truth.judges.samples import Sample

_QUIET_S, _DEADLINE_S = 2.0, 30.0


class Listener:
    """Subscribes to topics; a context manager.

    Args:
        topics: type by name; types that are not installed here are left out of ``topics``.
    """

    def __init__(self, topics: Mapping[str, str]) -> None:
        self.topics: dict[str, Any] = {}
        for topic, name in topics.items():
            try:
                package, _, kind = name.split("/")
                self.topics[topic] = getattr(importlib.import_module(f"{package}.msg"), kind)
            except (ModuleNotFoundError, AttributeError, ValueError):
                continue
        self._found: list[tuple[str, Any]] = []
        self._last = time.monotonic()
        self._stop = threading.Event()

    def __enter__(self) -> Listener:
        import rclpy
        from rclpy.executors import SingleThreadedExecutor
        from rclpy.qos import HistoryPolicy, QoSProfile

        # away from the graph of the user
        os.environ.setdefault("ROS_DOMAIN_ID", str(domains.OWN))
        self._context = rclpy.Context()
        rclpy.init(context=self._context, domain_id=int(os.environ["ROS_DOMAIN_ID"]))
        self._node = rclpy.create_node("truth", context=self._context)
        qos = QoSProfile(depth=1000, history=HistoryPolicy.KEEP_ALL)
        for topic, kind in self.topics.items():
            self._node.create_subscription(kind, topic, self._taker(topic), qos)
        executor = SingleThreadedExecutor(context=self._context)
        executor.add_node(self._node)

        def spin() -> None:
            while not self._stop.is_set():
                executor.spin_once(0.05)

        self._thread = threading.Thread(target=spin)
        self._thread.start()
        return self

    def _taker(self, topic: str) -> Any:
        def take(message: Any) -> None:
            self._found.append((topic, message))
            self._last = time.monotonic()

        return take

    def __exit__(self, kind: type[BaseException] | None, _: BaseException | None, __: TracebackType | None) -> None:
        self._stop.set()
        self._thread.join()
        self._node.destroy_node()
        self._context.shutdown()

    def samples(self) -> Iterator[Sample]:
        """The samples of all that came; waits until nothing more comes."""
        begun = time.monotonic()
        while time.monotonic() - max(self._last, begun) < _QUIET_S and time.monotonic() - begun < _DEADLINE_S:
            time.sleep(0.02)
        for topic, message in list(self._found):
            yield from of_message(message, topic, type(message).__name__)
