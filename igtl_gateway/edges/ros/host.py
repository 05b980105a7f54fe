"""The host: rclpy's context, node and executor, which edges that run one after the other may share.

A bridge is one session and starts once.  Its node is a managed node, which can be cleaned up and configured again, so
the node has to outlive the bridge.
"""

from __future__ import annotations

import atexit
import re
import threading
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Protocol

from igtl_gateway.base.errors import ConfigError, RosError, first_line
from igtl_gateway.base.qos import Qos
from igtl_gateway.base.stamp import NS_PER_S
from igtl_gateway.config.setting import Value
from igtl_gateway.edges.interface import Change
from igtl_gateway.edges.ros.distributions import node_options
from igtl_gateway.edges.ros.middleware import import_lifecycle, import_rclpy, interface_class, profile_of
from igtl_gateway.edges.ros.parameters import changeable, checking_node, declare, overrides, show
from igtl_gateway.gateway.log.note import Level

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
        arguments: what follows on the command line from ``--ros-args`` on: remapping, parameters, log levels.
        starts_active: lead a managed node to the state *active* when it starts, else it is *unconfigured*.

    Attributes:
        changing: a lock that is held while parameters are set; who changes settings otherwise holds it, too, until
            `show` has shown them, so that parameters and settings change in the same order.
        on_change: called with the parameters that are set; a ConfigError refuses them.  None: no bridge runs, and they
            apply to the next one.
        rclpy: the module; None before the start.
        context, node, executor: of rclpy; None before the start and after the stop.
    """

    def __init__(
        self,
        name: str,
        namespace: str = "",
        transitions: Transitions | None = None,
        arguments: Sequence[str] = (),
        *,
        starts_active: bool = False,
    ) -> None:
        self.name = name
        self.namespace = namespace
        self.rclpy: Any = None
        self.context: Any = None
        self.node: Any = None
        self.executor: Any = None
        self.changing = threading.RLock()
        self.on_change: Change | None = None
        self._log: _Rosout | None = None
        self.arguments = tuple(arguments)
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

    def logs(self, level: Level) -> bool:
        """Return whether the node logs this level: by ``--log-level``, or as ``~/set_logger_levels`` has set it."""
        return self._log is None or self._log.is_enabled(level)

    def log(self, level: Level, text: str, stamp_ns: int) -> None:
        """Publish a line on ``/rosout``, unless its level is not logged; nothing before the start and after the stop.

        Args:
            level: its severity.
            text: the line.
            stamp_ns: its time, UTC ns.
        """
        if (log := self._log) and log.is_enabled(level):
            log.publish(level, text, stamp_ns)

    @property
    def full_name(self) -> str:
        """The name of the node with its namespace; arguments may change both.  Only while it is in the graph."""
        return str(self.node.get_fully_qualified_name())

    @property
    def shares_tf(self) -> bool:
        """Whether the node has a namespace, and its /tf is that of all namespaces.  Only while it is in the graph."""
        return str(self.node.get_namespace()) != "/" and str(self.node.resolve_topic_name("/tf")) == "/tf"

    def overrides(self) -> dict[str, Any]:
        """Return name → value of the parameters that the arguments set."""
        return overrides(self.node)

    def declare(self, values: Mapping[str, Value]) -> None:
        """Declare the settings of a bridge as parameters with these values; once."""
        declare(self.rclpy, self.node, values, lambda changes: self.on_change and self.on_change(changes))

    def changed_values(self) -> dict[str, Value]:
        """Return the values of the parameters that may change while a bridge runs; none if they are not declared."""
        return changeable(self.node)

    def show(self, values: Mapping[str, Value]) -> None:
        """Set the declared parameters to settings that have changed, while a bridge runs; other nodes get the event.

        Args:
            values: name → value; names without a parameter are skipped.
        """
        if self.node is not None and self.on_change is not None:
            show(self.rclpy, self.node, values)

    def start(self, on_error: OnError) -> None:
        """Join the graph.

        Raises:
            RosError: in one line, if ROS is missing or refuses.
            ConfigError: for an argument that rcl does not know.
        """
        self.rclpy = rclpy = import_rclpy()
        context = rclpy.context.Context()
        try:
            # Context.init (unlike rclpy.init) leaves the signal handlers alone; a list keeps sys.argv out of ROS.
            context.init(args=list(self.arguments))
            base = rclpy.node.Node if self._transitions is None else _managed_node(self._transitions)
            make = checking_node(rclpy, base, self.changing)
            # rcl's /rosout would have each line on stderr, too, where the terminal shows it already; `log` has our own.
            node = make(
                self.name,
                namespace=self.namespace or None,
                context=context,
                enable_rosout=False,
                **node_options(rclpy),
            )
            self._log = _Rosout(rclpy, node)
        except Exception as error:
            if self.arguments and not context.ok():
                raise ConfigError(f"--ros-args: {_refused(error)}") from None
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
        self._log = None
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


class _Rosout:
    """The log of a node on ``/rosout``, with the QoS that all nodes have there."""

    def __init__(self, rclpy: Any, node: Any) -> None:
        self._message = interface_class("rcl_interfaces/msg/Log")
        self._publisher = node.create_publisher(self._message, "/rosout", profile_of(rclpy, Qos(1000, latched=True)))
        self._logger = node.get_logger()

    def is_enabled(self, level: Level) -> bool:
        return bool(self._logger.is_enabled_for(level))

    def publish(self, level: Level, text: str, stamp_ns: int) -> None:
        line = self._message(level=int(level), name=self._logger.name, msg=text)
        line.stamp.sec, line.stamp.nanosec = divmod(stamp_ns, NS_PER_S)
        self._publisher.publish(line)


def _refused(error: Exception) -> str:
    """Return what rcl does not accept; of a flag that it does not know, rclpy gives the list of flags."""
    flags = ", ".join(re.findall(r"'([^']+)'", first_line(error)))
    if type(error).__name__.startswith("Unknown") and flags:
        return f"found {flags}, expected arguments of ROS 2 such as -p, -r, --params-file and --log-level"
    return first_line(error).removeprefix("failed to initialize rcl: ").partition(" Error: ")[0]


def _managed_node(transitions: Transitions) -> type:
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
