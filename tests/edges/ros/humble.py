"""An imitation of Humble's rclpy (3.3.15): takes from the installed one what that does not have; runs a program.

    python tests/edges/ros/humble.py PYTHON -m MODULE ARGUMENT …

Written after the sources of Humble.  The libraries below, rcl and the middleware, are the installed ones, as messages
are, whose bytes are equal.  Of the executor only what a callback gets is imitated.
"""

from __future__ import annotations

import importlib
import runpy
import sys
from functools import wraps
from importlib.machinery import ModuleSpec
from importlib.util import module_from_spec
from typing import Any

#: Modules of rclpy that Humble does not have.
ABSENT = (
    "rclpy.clock_type",
    "rclpy.event_handler",
    "rclpy.logging_service",
    "rclpy.parameter_client",
    "rclpy.parameter_event_handler",
    "rclpy.service_introspection",
    "rclpy.type_description_service",
    "rclpy.type_hash",
)
#: Services of rcl_interfaces that it does not have.
ABSENT_SERVICES = ("GetLoggerLevels", "SetLoggerLevels")
#: What a callback gets to know of a message: stamps, but no numbers.
INFO = ("source_timestamp", "received_timestamp")
GID_BYTES = 24


def imitate() -> None:
    """Make the installed rclpy one of Humble, for this process."""
    if "rclpy" in sys.modules:
        raise RuntimeError("rclpy was imported before")
    for name in ("node", "lifecycle", "executors", "subscription", "event_handler", "parameter_client"):
        importlib.import_module(f"rclpy.{name}")
    rclpy = importlib.import_module("rclpy")
    _no_new_events(rclpy)
    _no_new_arguments(rclpy)
    _no_numbers(rclpy)
    _long_identifiers(rclpy)
    for name in ABSENT:
        package, _, module = name.rpartition(".")
        if package and hasattr(sys.modules[package], module):
            delattr(sys.modules[package], module)
        sys.modules[name] = None  # type: ignore[assignment]  # an import of it fails
    services = importlib.import_module("rcl_interfaces.srv")
    for name in ABSENT_SERVICES:
        delattr(services, name)


def _no_new_events(rclpy: Any) -> None:
    """The module of events has another name, and knows neither matches nor types."""
    from rclpy import event_handler as events

    class PublisherEventCallbacks(events.PublisherEventCallbacks):  # type: ignore[misc]  # rclpy is untyped
        def __init__(
            self,
            *,
            deadline: Any = None,
            liveliness: Any = None,
            incompatible_qos: Any = None,
            use_default_callbacks: bool = True,
        ) -> None:
            given = {"deadline": deadline, "liveliness": liveliness, "incompatible_qos": incompatible_qos}
            super().__init__(**given, use_default_callbacks=use_default_callbacks)

    class SubscriptionEventCallbacks(events.SubscriptionEventCallbacks):  # type: ignore[misc]
        def __init__(
            self,
            *,
            deadline: Any = None,
            incompatible_qos: Any = None,
            liveliness: Any = None,
            message_lost: Any = None,
            use_default_callbacks: bool = True,
        ) -> None:
            given = {"deadline": deadline, "liveliness": liveliness, "incompatible_qos": incompatible_qos}
            super().__init__(**given, message_lost=message_lost, use_default_callbacks=use_default_callbacks)

    module: Any = module_from_spec(ModuleSpec("rclpy.qos_event", None))
    module.PublisherEventCallbacks = rclpy.node.PublisherEventCallbacks = PublisherEventCallbacks
    module.SubscriptionEventCallbacks = rclpy.node.SubscriptionEventCallbacks = SubscriptionEventCallbacks
    module.QoSEventHandler = events.EventHandler
    sys.modules["rclpy.qos_event"] = rclpy.qos_event = module


def _no_new_arguments(rclpy: Any) -> None:
    """A node has no services for the levels of its log and for its types, and no others have introspection."""
    node, make = rclpy.node, rclpy.node.Node.__init__

    class NoService:
        def __init__(self, _node: Any) -> None:
            pass

        def destroy(self) -> None:
            pass

    @wraps(make)
    def begin(
        self: Any,
        node_name: str,
        *,
        context: Any = None,
        cli_args: Any = None,
        namespace: Any = None,
        use_global_arguments: bool = True,
        enable_rosout: bool = True,
        start_parameter_services: bool = True,
        parameter_overrides: Any = None,
        allow_undeclared_parameters: bool = False,
        automatically_declare_parameters_from_overrides: bool = False,
    ) -> None:
        given = {name: value for name, value in locals().items() if name not in ("self", "node_name", "make")}
        make(self, node_name, **given)

    del begin.__wrapped__  # its signature is what is asked for
    node.Node.__init__ = begin
    node.TypeDescriptionService = NoService
    for kind in (rclpy.service.Service, rclpy.client.Client):
        del kind.configure_introspection


def _no_numbers(rclpy: Any) -> None:
    """A callback gets the message alone; what it reports of one has no numbers; a subscription counts no publishers."""
    subscription = rclpy.subscription.Subscription
    kinds = subscription.CallbackType
    compiled = rclpy.impl.implementation_singleton.rclpy_implementation.Subscription
    take = compiled.take_message

    def take_message(self: Any, message_type: Any, raw: bool) -> Any:
        taken = take(self, message_type, raw)
        return taken and (taken[0], {name: taken[1][name] for name in INFO})

    compiled.take_message = take_message
    subscription._callback_type = kinds.MessageOnly
    del subscription.CallbackType, subscription.callback, subscription.get_publisher_count
    subscription.CallbackType = _Hidden(kinds)


class _Hidden:
    """An attribute of a class that only the modules of rclpy see."""

    def __init__(self, value: Any) -> None:
        self._value = value

    def __get__(self, _instance: Any, _owner: Any) -> Any:
        if not sys._getframe(1).f_globals.get("__name__", "").startswith("rclpy."):
            raise AttributeError("CallbackType")
        return self._value


def _long_identifiers(rclpy: Any) -> None:
    """The GID of an endpoint is longer, and there is no hash of its type."""

    from rclpy.topic_endpoint_info import TopicEndpointInfo as Known

    class TopicEndpointInfo(Known):  # type: ignore[misc]
        def __init__(self, **given: Any) -> None:
            super().__init__(**given)
            gid = given["endpoint_gid"]
            self.endpoint_gid = [*gid, *bytes(GID_BYTES - len(gid))]

        @property
        def topic_type_hash(self) -> Any:
            raise AttributeError("topic_type_hash")

        @topic_type_hash.setter
        def topic_type_hash(self, _value: Any) -> None:
            pass

    rclpy.node.TopicEndpointInfo = TopicEndpointInfo


if __name__ == "__main__":
    imitate()
    sys.argv[:] = sys.argv[3:]
    sys.path[0] = ""
    runpy.run_module(sys.argv[0], run_name="__main__", alter_sys=True)
