"""The host: rclpy's context, node and executor, which edges that run one after the other may share.

A bridge is one session and starts once.  Its node is a managed node, which can be cleaned up and configured again, so
the node has to outlive the bridge.
"""

from __future__ import annotations

import atexit
import threading
from collections.abc import Callable
from typing import Any, Protocol

from igtl_gateway.edges.ros.middleware import first_line, import_lifecycle, import_rclpy
from igtl_gateway.errors import RosError

_CALLS_AT_ONCE = 8  # of services; a call may wait for a peer

#: Called with an exception of a callback of the node.
OnError = Callable[[Exception], None]


class Transitions(Protocol):
    """What the transitions of a managed node do.  Each returns whether it succeeded; if not, the state stays.

    An exception leads to ``error``, and from there to the state *unconfigured*, or, if that fails, to *finalized*.
    """

    def configure(self) -> bool: ...
    def activate(self) -> bool: ...
    def deactivate(self) -> bool: ...
    def cleanup(self) -> bool: ...
    def shutdown(self) -> bool: ...
    def error(self) -> bool: ...


class NodeHost:
    """A node in the graph, from start to stop.

    Args:
        name, namespace: of the node.
        transitions: what the transitions of a managed node do; None: the node is not a managed one.
        starts_active: lead a managed node to the state *active* when it starts, else it is *unconfigured*.

    Attributes:
        rclpy: the module; None before the start.
        context, node, executor: of rclpy; None before the start and after the stop.
    """

    def __init__(
        self, name: str, namespace: str = "", transitions: Transitions | None = None, *, starts_active: bool = False
    ) -> None:
        self.name = name
        self.namespace = namespace
        self.rclpy: Any = None
        self.context: Any = None
        self.node: Any = None
        self.executor: Any = None
        self._transitions = transitions
        self._starts_active = starts_active
        self._stopping = threading.Event()
        self._spinner: threading.Thread | None = None

    @property
    def is_managed(self) -> bool:
        """Whether the node is a managed one: then its owner stops it, not the edge that has started it."""
        return self._transitions is not None

    @property
    def is_running(self) -> bool:
        return self.node is not None

    def start(self, on_error: OnError) -> None:
        """Join the graph.  Raises RosError, in one line, if ROS is missing or refuses."""
        self.rclpy = rclpy = import_rclpy()
        context = rclpy.context.Context()
        try:
            # Context.init (unlike rclpy.init) leaves the signal handlers alone; [] keeps sys.argv out of ROS.
            context.init(args=[])
            make = rclpy.node.Node if self._transitions is None else _managed_node(self._transitions)
            # No /rosout: our own log must not come back as a publication of another node.
            node = make(self.name, namespace=self.namespace or None, context=context, enable_rosout=False)
        except Exception as error:
            context.try_shutdown()
            raise RosError(f"node {self.name!r} in {self.namespace!r}: {first_line(error)}") from error
        atexit.register(self.stop)  # the threads wait inside the middleware: it must not be torn down under them
        if self._starts_active:  # before a service can be called
            node.trigger_configure()
            node.trigger_activate()
        executor = rclpy.executors.MultiThreadedExecutor(_CALLS_AT_ONCE, context=context)
        executor.add_node(node)
        self.context, self.node, self.executor = context, node, executor
        spinner = threading.Thread(target=self._spin, args=(on_error,), name="igtl-ros-executor", daemon=True)
        self._spinner = spinner
        spinner.start()

    def end_calls(self) -> None:
        """End the executor: no callback begins after this.  Not from a callback."""
        if self._spinner:
            self._stopping.set()
            self.executor.create_task(lambda: None)  # wakes spin_once and makes it return
            self._spinner.join()
            self._spinner = None

    def stop(self) -> None:
        """Leave the graph.  Further calls do nothing."""
        if self.node is None:
            return
        atexit.unregister(self.stop)
        self.end_calls()
        self.executor.shutdown()
        if pool := getattr(self.executor, "_executor", None):  # rclpy leaves its threads to the interpreter's end
            pool.shutdown(wait=True)
        self.node.destroy_node()
        self.context.try_shutdown()
        self.context.destroy()
        self.context = self.node = self.executor = None

    def entities(self) -> set[Any]:
        """Return the publishers, subscriptions and services that exist now."""
        return {*self.node.publishers, *self.node.subscriptions, *self.node.services}

    def destroy_all_but(self, kept: set[Any]) -> None:
        """Destroy all publishers, subscriptions and services except those in ``kept``."""
        node = self.node
        for entities, destroy in (
            (node.publishers, node.destroy_publisher),
            (node.subscriptions, node.destroy_subscription),
            (node.services, node.destroy_service),
        ):
            for entity in list(entities):
                if entity not in kept:
                    destroy(entity)

    def _spin(self, on_error: OnError) -> None:
        # Not spin() and shutdown(): they race for the executor's guard condition.
        context, executor = self.context, self.executor
        while not self._stopping.is_set() and context.ok():
            try:
                executor.spin_once()
            except Exception as error:  # of one callback
                on_error(error)


def _managed_node(transitions: Transitions) -> Callable[..., Any]:
    """Return the class of a managed node whose callbacks are these transitions."""
    lifecycle = import_lifecycle()
    returned = lifecycle.TransitionCallbackReturn

    def callback(run: Callable[[], bool]) -> Callable[[Any, Any], Any]:
        def called(_node: Any, _before: Any) -> Any:
            return returned.SUCCESS if run() else returned.FAILURE

        return called

    names = ("configure", "activate", "deactivate", "cleanup", "shutdown", "error")
    callbacks = {f"on_{name}": callback(getattr(transitions, name)) for name in names}
    return type("ManagedNode", (lifecycle.LifecycleNode,), callbacks)
