"""What the application needs of the ROS side, whichever middleware carries it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass
from typing import Any, Protocol

from igtl_gateway.base.qos import Endpoint, Qos
from igtl_gateway.config.setting import Value
from igtl_gateway.gateway.log.note import Level
from igtl_gateway.gateway.orders import Order, Unwritten
from igtl_gateway.native.passage import Publisher, Subscription

#: Called with topic, type, CDR bytes and source stamp of a message.
OnMessage = Callable[[str, str, bytes, int], None]
#: Returns the QoS to subscribe to a topic and type with, or None.
Wants = Callable[[str, str], Qos | None]
#: Changes settings while the bridge runs.  Raises ConfigError.
Change = Callable[[Mapping[str, object]], object]


class Publish(Protocol):
    """Sends a message; see ``Publishers.publish``."""

    def __call__(self, topic: str, type_name: str, cdr: bytes, qos: Qos, until_ns: int = 0, /) -> str: ...


@dataclass(frozen=True, slots=True)
class Publication:
    """A topic that other nodes publish.

    Attributes:
        topic: full name in the gateway.
        type: ``"pkg/msg/Name"``.
        publishers: the number of publishers beside our own.
    """

    topic: str
    type: str
    publishers: int


class RosSide(Protocol):
    """The interface of ``edges.ros.edge.RosEdge``, which describes it, and of a side over another middleware."""

    @property
    def publish(self) -> Publish: ...

    @property
    def count_if_unsubscribed(self) -> Callable[[str], bool]: ...

    @property
    def has_subscriber(self) -> Callable[[str], bool]: ...

    @property
    def full_name(self) -> str: ...

    @property
    def changing(self) -> AbstractContextManager[object]: ...

    def message_class(self, type_name: str, /) -> Any: ...

    def start(self) -> None: ...

    def stop(self) -> None: ...

    def follow(self, change: Change | None, /) -> None: ...

    def show(self, values: Mapping[str, Value], /) -> None: ...

    def log(self, level: Level, text: str, stamp_ns: int, /) -> None: ...

    def serve(self, name: str, type_name: str, answer: Callable[[Any, Any], Any], /) -> bool: ...

    def advertise(self, topic: str, type_name: str, qos: Qos, /) -> None: ...

    def expect_orders(self, topic: str, type_name: str, qos: Qos, lifespan_ns: int, /) -> object: ...

    @property
    def write(self) -> Callable[[Order], Unwritten | None]: ...

    def subscribe(self, topic: str, type_name: str, qos: Qos, /) -> bool: ...

    def publications(self) -> list[Publication]: ...

    def endpoints(self) -> list[Endpoint]: ...

    def failing(self) -> Mapping[str, str]: ...

    def native_subscription(self, topic: str, type_name: str, /) -> Subscription | None: ...

    def native_publisher(self, topic: str, type_name: str, /) -> Publisher | None: ...

    def sync(self) -> None: ...

    def counters(self) -> dict[str, dict[str, int]]: ...


class PlainSide:
    """What a side without parameters and without the native passage answers."""

    def follow(self, change: Change | None) -> None:
        """There are no parameters that could change."""

    def show(self, values: Mapping[str, Value]) -> None:
        """There are no parameters that could show the values."""

    def native_subscription(self, topic: str, type_name: str) -> Subscription | None:
        """None: all messages are Python's."""
        return None

    def native_publisher(self, topic: str, type_name: str) -> Publisher | None:
        """None: Python publishes."""
        return None
