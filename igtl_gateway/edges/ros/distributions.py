"""What differs between the rclpy of Humble, Jazzy, Kilted and Lyrical; no other module of the edge depends on it.

What an rclpy has is looked up, not concluded from its version.  The sources that were read: Humble 3.3.15, Jazzy 7.1.3
and 7.1.6, Lyrical 10.0.10 with its rmw 7.10.1, rcl 10.4.4 and rmw_fastrtps 9.4.7.  Kilted's 9.1.2 was run.

| | Humble | Jazzy, Kilted, Lyrical | here |
|---|---|---|---|
| events | module ``qos_event`` | ``event_handler``; until Kilted ``qos_event`` is its old name | `EVENT_MODULES` |
| event of matches | none, nor in rmw | ``matched`` of publisher and subscription | `CountedMatches` |
| number of matched publishers | in rcl only | ``Subscription.get_publisher_count`` | `_publishers_of` |
| callback with ``raw`` | gets the message | may get its stamps and numbers, too | `_with_info` |
| ``~/set_logger_levels`` | none, nor its types | ``enable_logger_service`` of a node | `node_options` |
| publication numbers | in rmw, not in rclpy | ``publication_sequence_number`` | the native passage reads rmw |
| type hashes, introspection of services, ``~/get_type_description`` | none | there | not used |
| QoS, parameters, lifecycle, guard conditions, wait sets | as later | later ones add to them | what all have |
| GID of an endpoint | 24 bytes | 16 bytes | only its first two are read |
| messages with ``uint8[]`` | as all others | Lyrical: a channel of their own if all subscribers know it | see below |
| buffers outside the CPU, content filters, nodes of asyncio | none | Lyrical: options, off | not used |
| what is called in rcl and rmw, ``rmw_message_info_t`` | equal | equal | ``direct``, ``graph_watch``, native passage |

The channel of Lyrical (rosidl::Buffer) has a writer and a reader beside the usual ones.  What is published serialised
takes the usual ones, as all does that leaves the bridge.  Serialised reading takes the usual reader only, until the
change that ``doctor/middleware.py`` names with the other losses.
"""

from __future__ import annotations

import ctypes
import inspect
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from igtl_gateway.edges.ros.direct import Rcl

#: The modules of rclpy with the callbacks of events, of which the first that is there is used.
EVENT_MODULES = ("event_handler", "qos_event")

#: What a callback gets where rclpy reports nothing of a message.
_UNKNOWN: Mapping[str, Any] = {"source_timestamp": 0}

OnEvent = Callable[[Any], None]


@dataclass(frozen=True, slots=True)
class Matched:
    """How many are matched, and how many more than before: the fields of rmw_matched_status_t that are used."""

    current_count: int
    current_count_change: int


class CountedMatches:
    """Stands in for the event of matches: who polls it has the callback called for a change.

    If one leaves and another one comes between two polls, nothing has changed.

    Args:
        count: returns the number of matches.
        callback: called with a `Matched`.
    """

    def __init__(self, count: Callable[[], int], callback: OnEvent) -> None:
        self._count = count
        self._callback = callback
        self._before = 0

    def poll(self) -> None:
        """Call the callback if the number of matches has changed."""
        count = self._count()
        change, self._before = count - self._before, count
        if change:
            self._callback(Matched(count, change))


def node_options(rclpy: Any) -> dict[str, Any]:
    """Return the arguments of a node that not every rclpy has: the service for the level of its log."""
    name = "enable_logger_service"
    return {name: True} if name in inspect.signature(rclpy.node.Node.__init__).parameters else {}


def create_publisher(
    rclpy: Any,
    node: Any,
    message_class: Any,
    topic: str,
    profile: Any,
    *,
    group: Any,
    incompatible_qos: OnEvent,
) -> Any:
    """Make a publisher whose events call this function.  Its matches are counted, which costs less than an event."""
    make = _event_module(rclpy).PublisherEventCallbacks
    events = make(incompatible_qos=incompatible_qos, use_default_callbacks=False)
    return node.create_publisher(message_class, topic, profile, event_callbacks=events, callback_group=group)


def match_events(rclpy: Any, publisher: Any, group: Any) -> Callable[[], int] | None:
    """Return what counts the matches of a publisher since its last call; None: this rclpy has no such event."""
    module = _event_module(rclpy)
    kinds = getattr(module, "QoSPublisherEventType", None)
    kind = getattr(kinds, "RCL_PUBLISHER_MATCHED", None)
    if kind is None:
        return None
    handler = module.EventHandler(
        callback_group=group, callback=lambda _event: None, event_type=kind, parent_impl=publisher.handle
    )

    def count() -> int:
        handler._ready_to_take_data = True  # as in receiver.EventPolling
        event = handler.take_data()
        return int(event.total_count_change) if event is not None else 0

    return count


def create_subscription(
    rclpy: Any,
    node: Any,
    message_class: Any,
    topic: str,
    callback: Callable[[bytes, Any], None],
    profile: Any,
    *,
    group: Any,
    incompatible_qos: OnEvent,
    message_lost: OnEvent,
    matched: OnEvent,
) -> tuple[Any, CountedMatches | None]:
    """Make a subscription to serialised messages whose events call these functions.

    Returns:
        The subscription, and what has to be polled for its matches; None: the middleware reports them.
    """
    make = _event_module(rclpy).SubscriptionEventCallbacks
    are_reported = "matched" in inspect.signature(make.__init__).parameters
    others = {"matched": matched} if are_reported else {}
    events = make(incompatible_qos=incompatible_qos, message_lost=message_lost, use_default_callbacks=False, **others)
    gets_info = hasattr(rclpy.subscription.Subscription, "CallbackType")
    made = node.create_subscription(
        message_class,
        topic,
        callback if gets_info else _with_info(callback),
        profile,
        callback_group=group,
        event_callbacks=events,
        raw=True,
    )
    return made, None if are_reported else CountedMatches(_publishers_of(made), matched)


def _event_module(rclpy: Any) -> Any:
    """Return the module with the callbacks of events."""
    return next(getattr(rclpy, each) for each in EVENT_MODULES if hasattr(rclpy, each))


def _with_info(callback: Callable[[bytes, Any], None]) -> Callable[..., None]:
    """Return a callback that an executor may call with the message alone."""

    def called(cdr: bytes, info: Any = _UNKNOWN) -> None:
        callback(cdr, info)

    return called


def _publishers_of(subscription: Any) -> Callable[[], int]:
    """Return what counts the matched publishers of a subscription.  Raises OSError or AttributeError without rcl."""
    function, pointer = Rcl().function("rcl_subscription_get_publisher_count"), subscription.handle.pointer
    function.argtypes = (ctypes.c_void_p, ctypes.POINTER(ctypes.c_size_t))

    def count() -> int:
        publishers = ctypes.c_size_t()
        function(pointer, ctypes.byref(publishers))  # refused after the shutdown of the context: then there is none
        return publishers.value

    return count
