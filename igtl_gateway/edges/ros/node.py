"""The node as an edge has it: from the start of the edge to its stop."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any

from igtl_gateway.base.clock import SystemClock
from igtl_gateway.base.errors import RosError
from igtl_gateway.edges.interface import Reports
from igtl_gateway.edges.ros.graph_watch import BlindWatch, GraphWatch, watch_graph
from igtl_gateway.edges.ros.host import NodeHost
from igtl_gateway.edges.ros.middleware import interface_class
from igtl_gateway.edges.ros.names import GraphNames

_CALLS_WAITING = 100  # of each service; one that is pushed out of the queue of DDS never gets an answer


class RosNode:
    """A node that starts once.

    Attributes:
        lock: guards the making of entities and the tables of topics; no message on its way takes it.
        stopping: set as soon as the stop has begun.
        changed: notified when subscribers are matched, when held messages are sent, and at stop.
        host: where the node is.
        graph: where the edge's own thread waits for changes of the graph; made by the start.
        clock: the system's; DDS stamps are compared with it.
        started_ns: when the node joined the graph (monotonic).
        rclpy: the module; None before the start.
        names: of topics; only after the start.
    """

    names: GraphNames

    def __init__(self, host: NodeHost, reports: Reports) -> None:
        self.lock = threading.RLock()
        self.stopping = threading.Event()
        self.changed = threading.Condition()
        self.graph: GraphWatch = BlindWatch()
        self.clock = SystemClock()
        self.started_ns = 0
        self.rclpy: Any = None
        self.host = host
        self._owns_host = False
        self._kept: set[Any] = set()  # entities that are not of this edge
        self._reports = reports
        self._is_running = False

    @property
    def is_running(self) -> bool:
        return self._is_running

    @property
    def handle(self) -> Any:
        """The rclpy node.  Raises RosError before start and after stop."""
        if not self._is_running:
            raise RosError("the node is not running")
        return self.host.node

    @property
    def executor(self) -> Any:
        """The rclpy executor.  Raises RosError before start and after stop."""
        if not self._is_running:
            raise RosError("the node is not running")
        return self.host.executor

    def start(self) -> Any:
        """Join the graph; returns rclpy's context.  Raises what ``NodeHost.start`` raises."""
        host = self.host
        if self._is_running or self.stopping.is_set():
            raise RosError(f"node {host.name!r}: started before, an edge starts once")
        if not host.is_running:
            host.start(lambda error: self._reports.callback_failed("callback", error))
            self._owns_host = not host.is_managed
        self._kept = host.entities()
        self.rclpy = host.rclpy
        self.names = GraphNames(host.node, host.arguments)
        self.graph = watch_graph(host.rclpy, host.context, host.node)
        self._is_running = True
        self.started_ns = self.clock.monotonic_ns()
        return host.context

    def begin_stop(self) -> Callable[[], None] | None:
        """End the executor, if the node is of this edge only; from here on no entity is made.

        Returns:
            What leaves the graph, to be called once nothing uses the node any more; None if it did not run.
        """
        was_running, self._is_running = self._is_running, False
        self.stopping.set()
        if not was_running:
            return None
        self.graph.wake()
        if self._owns_host:
            self.host.end_calls()
        return self._leave

    def _leave(self) -> None:
        with self.lock:
            if self._owns_host:
                self.host.stop()
            else:
                self.host.destroy_all_but(self._kept)
        self.notify()

    def serve(self, name: str, type_name: str, answer: Callable[[Any, Any], Any]) -> bool:
        """Offer a service; see ``RosEdge.serve``."""
        try:
            with self.lock:
                node = self.handle
                group = self.rclpy.callback_groups.ReentrantCallbackGroup()
                qos = self.rclpy.qos.QoSProfile(depth=_CALLS_WAITING)
                node.create_service(interface_class(type_name), name, answer, qos_profile=qos, callback_group=group)
        except Exception as error:  # rclpy raises a dozen unrelated classes here
            self._reports.refuse("serve", name, type_name, error)
            return False
        return True

    def notify(self) -> None:
        """Have waiting threads check their conditions."""
        with self.changed:
            self.changed.notify_all()

    def wait(self, condition: Callable[[], bool], timeout_s: float) -> bool:
        """Wait for a condition; False if that took longer than ``timeout_s``, True at stop."""
        with self.changed:
            return self.changed.wait_for(lambda: self.stopping.is_set() or condition(), timeout_s)
