"""The node: rclpy's context, node and executor, from start to stop."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from igtl_gateway.clock import SystemClock
from igtl_gateway.edges.ros.graph_watch import BlindWatch, GraphWatch, watch_graph
from igtl_gateway.edges.ros.middleware import first_line, import_rclpy, interface_class
from igtl_gateway.edges.ros.reports import Reports
from igtl_gateway.errors import RosError

_CALLS_AT_ONCE = 8  # of services; a call may wait for a peer
_CALLS_WAITING = 100  # of each service; one that is pushed out of the queue of DDS never gets an answer


@dataclass(frozen=True, slots=True)
class _RunningNode:
    """What exists between start and stop."""

    context: Any
    node: Any
    executor: Any
    spinner: threading.Thread


class RosNode:
    """A node that starts once.

    Attributes:
        lock: guards the making of entities and the tables of topics; no message on its way takes it.
        stopping: set as soon as the stop has begun.
        changed: notified when subscribers are matched, when held messages are sent, and at stop.
        graph: where the edge's own thread waits for changes of the graph; made by the start.
        clock: the system's; DDS stamps are compared with it.
        started_ns: when the node joined the graph (monotonic).
        rclpy: the module; None before the start.
    """

    def __init__(self, name: str, namespace: str, reports: Reports) -> None:
        self.lock = threading.RLock()
        self.stopping = threading.Event()
        self.changed = threading.Condition()
        self.graph: GraphWatch = BlindWatch()
        self.clock = SystemClock()
        self.started_ns = 0
        self.rclpy: Any = None
        self._name = name
        self._namespace = namespace
        self._reports = reports
        self._running: _RunningNode | None = None

    @property
    def is_running(self) -> bool:
        return self._running is not None

    @property
    def handle(self) -> Any:
        """The rclpy node.  Raises RosError before start and after stop."""
        if self._running is None:
            raise RosError("the node is not running")
        return self._running.node

    @property
    def executor(self) -> Any:
        """The rclpy executor.  Raises RosError before start and after stop."""
        if self._running is None:
            raise RosError("the node is not running")
        return self._running.executor

    def start(self) -> Any:
        """Join the graph; returns rclpy's context.  Raises RosError, in one line, if ROS is missing or refuses."""
        if self._running is not None or self.stopping.is_set():
            raise RosError(f"node {self._name!r}: started before, an edge starts once")
        self.rclpy = rclpy = import_rclpy()
        context = rclpy.context.Context()
        try:
            # Context.init (unlike rclpy.init) leaves the signal handlers alone; [] keeps sys.argv out of ROS.
            context.init(args=[])
            # No /rosout: our own log must not come back as a publication of another node.
            node = rclpy.node.Node(self._name, namespace=self._namespace or None, context=context, enable_rosout=False)
        except Exception as error:
            context.try_shutdown()
            raise RosError(f"node {self._name!r} in {self._namespace!r}: {first_line(error)}") from error
        executor = rclpy.executors.MultiThreadedExecutor(_CALLS_AT_ONCE, context=context)
        executor.add_node(node)
        spinner = threading.Thread(target=self._spin, args=(context, executor), name="igtl-ros-executor", daemon=True)
        self.graph = watch_graph(rclpy, context, node)
        self._running = _RunningNode(context, node, executor, spinner)
        self.started_ns = self.clock.monotonic_ns()
        spinner.start()
        return context

    def begin_stop(self) -> Callable[[], None] | None:
        """End the executor; from here on no entity is made.

        Returns:
            What leaves the graph, to be called once nothing uses the node any more; None if it did not run.
        """
        running, self._running = self._running, None
        self.stopping.set()
        if running is None:
            return None
        self.graph.wake()
        running.executor.create_task(lambda: None)  # wakes spin_once and makes it return
        running.spinner.join()
        return lambda: self._leave(running)

    def _leave(self, running: _RunningNode) -> None:
        running.executor.shutdown()
        if pool := getattr(running.executor, "_executor", None):  # rclpy leaves its threads to the interpreter's end
            pool.shutdown(wait=True)
        with self.lock:
            running.node.destroy_node()
        running.context.try_shutdown()
        running.context.destroy()
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

    def _spin(self, context: Any, executor: Any) -> None:
        # Not spin() and shutdown(): they race for the executor's guard condition.
        while not self.stopping.is_set() and context.ok():
            try:
                executor.spin_once()
            except Exception as error:  # of one callback
                self._reports.callback_failed("callback", error)
