"""A middleware without ROS: rcl's functions as callbacks of ctypes, on queues, and the ROS edge of a bridge on them."""

from __future__ import annotations

import ctypes
from collections import deque
from collections.abc import Callable
from contextlib import nullcontext
from types import SimpleNamespace
from typing import Any

from igtl_gateway.base.clock import SystemClock
from igtl_gateway.base.errors import RosError
from igtl_gateway.base.qos import Endpoint, Qos
from igtl_gateway.edges.interface import Publication, TopicCounts
from igtl_gateway.edges.ros.receiver import NativeReceiver
from igtl_gateway.edges.ros.subscribing import message_callback
from igtl_gateway.edges.ros.topics import TopicSubscription
from igtl_gateway.gateway.log.note import Level, Note
from igtl_gateway.gateway.orders import Heard, Order, Unwritten, unwritten
from igtl_gateway.native.passage import Passage, Publisher, Subscription

_OK, _NOTHING = 0, 401
_libc = ctypes.CDLL(None)
_libc.realloc.argtypes = (ctypes.c_void_p, ctypes.c_size_t)
_libc.realloc.restype = ctypes.c_void_p


class _Serialized(ctypes.Structure):
    """rcl_serialized_message_t, without its allocator."""

    _fields_ = (("buffer", ctypes.c_void_p), ("length", ctypes.c_size_t), ("capacity", ctypes.c_size_t))


class _Info(ctypes.Structure):
    _fields_ = (("source_ns", ctypes.c_int64), ("received_ns", ctypes.c_int64), ("number", ctypes.c_uint64))


_OnMessage = ctypes.CFUNCTYPE(None, ctypes.c_void_p, ctypes.c_size_t)
_Take = ctypes.CFUNCTYPE(
    ctypes.c_int32, ctypes.c_size_t, ctypes.POINTER(_Serialized), ctypes.POINTER(_Info), ctypes.c_void_p
)
_Publish = ctypes.CFUNCTYPE(ctypes.c_int32, ctypes.c_size_t, ctypes.POINTER(_Serialized), ctypes.c_void_p)
_Count = ctypes.CFUNCTYPE(ctypes.c_int32, ctypes.c_size_t, ctypes.POINTER(ctypes.c_size_t))
_SetCallback = ctypes.CFUNCTYPE(ctypes.c_int32, ctypes.c_size_t, ctypes.c_void_p, ctypes.c_void_p)


class Middleware:
    """Queues of messages by address, which are also the addresses of subscriptions and publishers.

    Attributes:
        published: topic, CDR of every message that was published, in order.
        subscribers: topic → number of subscribers; 1 for topics that it does not have.
        failing: take and publish fail with this code; 0: they do not.
    """

    def __init__(self) -> None:
        self.published: list[tuple[str, bytes]] = []
        self.subscribers: dict[str, int] = {}
        self.failing = 0
        self._topics: list[str] = [""]  # the address of a topic is its index
        self._queues: dict[int, deque[tuple[bytes, int, int]]] = {}
        self._callbacks: dict[int, tuple[Any, int]] = {}
        self._numbers: dict[int, int] = {}
        self._functions = {
            "rcl_take_serialized_message": _Take(self._take),
            "rcl_publish_serialized_message": _Publish(self._publish),
            "rcl_publisher_get_subscription_count": _Count(self._count),
            "rcl_subscription_set_on_new_message_callback": _SetCallback(self._set_callback),
        }

    def address(self, name: str) -> int:
        """Return the address of a function, as ``Rcl`` does."""
        return ctypes.cast(self._functions[name], ctypes.c_void_p).value or 0

    def pointer(self, topic: str) -> int:
        """Return the address of the subscription or publisher of a topic."""
        if topic not in self._topics:
            self._topics.append(topic)
        return self._topics.index(topic)

    def deliver(self, topic: str, cdr: bytes, source_ns: int, *, lost: int = 0) -> None:
        """Deliver a message in this thread, as a thread of the middleware does, after ``lost`` others."""
        pointer = self.pointer(topic)
        number = self._numbers[pointer] = self._numbers.get(pointer, 0) + 1 + lost
        self._queues.setdefault(pointer, deque()).append((cdr, source_ns, number))
        if registered := self._callbacks.get(pointer):
            callback, user_data = registered
            callback(user_data, 1)

    def waiting(self) -> int:
        """Return the number of messages that were not taken."""
        return sum(map(len, self._queues.values()))

    def _take(self, pointer: int, message: Any, info: Any, _allocation: int | None) -> int:
        if self.failing:
            return self.failing
        queue = self._queues.get(pointer)
        if not queue:
            return _NOTHING
        cdr, info[0].source_ns, info[0].number = queue.popleft()
        if message[0].capacity < len(cdr):
            message[0].buffer = _libc.realloc(message[0].buffer, len(cdr))
            message[0].capacity = len(cdr)
        ctypes.memmove(message[0].buffer, cdr, len(cdr))
        message[0].length = len(cdr)
        return _OK

    def _publish(self, pointer: int, message: Any, _allocation: int | None) -> int:
        if self.failing:
            return self.failing
        cdr = ctypes.string_at(message[0].buffer, message[0].length)
        self.published.append((self._topics[pointer], cdr))
        return _OK

    def _count(self, pointer: int, count: Any) -> int:
        count[0] = self.subscribers.get(self._topics[pointer], 1)
        return _OK

    def _set_callback(self, pointer: int, callback: int | None, user_data: int | None) -> int:
        if callback is None:
            self._callbacks.pop(pointer, None)
            return _OK
        self._callbacks[pointer] = _OnMessage(callback), user_data or 0
        return _OK


class RosEdge:
    """The ROS edge of a bridge on a ``Middleware``; what rclpy would do is left out."""

    def __init__(
        self,
        middleware: Middleware,
        *,
        on_message: Callable[[str, str, bytes, int], None],
        on_note: Callable[[Note], None],
        passage: Passage | None = None,
        **_: Any,
    ) -> None:
        self.middleware = middleware
        self.errors: list[str] = []
        self._passage = passage
        self._on_message = on_message
        self._receiver: Any = None
        self._subscriptions: dict[str, TopicSubscription] = {}
        self._native: dict[str, Publisher] = {}
        self._latched: set[str] = set()
        self._counts: dict[str, TopicCounts] = {}
        self._clock = SystemClock()
        self._written_ns: dict[str, int] = {}  # topic of a robot → end of the last write, monotonic
        self._reports: Any = SimpleNamespace(
            callback_failed=lambda what, error, *_: self.errors.append(f"{what}: {error}")
        )

    def start(self) -> None:
        if self._passage:
            self._receiver = NativeReceiver(
                self._passage,
                self.middleware,
                lambda error: self.errors.append(str(error)),
            )
            self._receiver.start()

    changing = nullcontext()
    full_name = "/igtl_gateway"

    def show(self, _values: object) -> None:
        """No parameters."""

    def follow(self, _owner: object) -> None:
        """There is no managed node."""

    def log(self, _level: Level, _text: str, _stamp_ns: int) -> None:
        """There is no /rosout."""

    def stop(self) -> None:
        if self._receiver:
            self._receiver.stop()
            self._receiver = None

    def subscribe(self, topic: str, type_name: str, *_: object) -> None:
        counts = self._counts.setdefault(topic, TopicCounts())
        subscription = self._subscriptions[topic] = TopicSubscription(topic, type_name, counts, None)
        subscription.matched(1)
        if self._receiver:
            source = SimpleNamespace(
                handle=SimpleNamespace(pointer=self.middleware.pointer(topic)),
                event_handlers=[],
                callback=message_callback(subscription, self._on_message, self._reports),
            )
            subscription.native = self._receiver.add(source)

    def deliver(self, topic: str, type_name: str, cdr: bytes, source_ns: int, *, lost: int = 0) -> None:
        """Deliver a message to the bridge: natively, or where there is no passage by Python."""
        if topic not in self._subscriptions:
            self.subscribe(topic, type_name)
        if self._receiver:
            self.middleware.deliver(topic, cdr, source_ns, lost=lost)
        else:
            self._on_message(topic, type_name, cdr, source_ns)

    def native_subscription(self, topic: str, type_name: str) -> Subscription | None:
        subscription = self._subscriptions.get(topic)
        return subscription.native if subscription and subscription.type_name == type_name else None

    def native_publisher(self, topic: str, type_name: str) -> Publisher | None:
        if topic not in self._native:
            self._native[topic] = Publisher(self.middleware.pointer(topic), topic in self._latched)
        return self._native[topic]

    def publish(self, topic: str, type_name: str, cdr: bytes, qos: Qos, until_ns: int = 0) -> str:
        """Publish a message at once: nothing is held, so ``until_ns`` is never over."""
        self._counts.setdefault(topic, TopicCounts()).published += 1
        if qos.latched:
            self._latched.add(topic)
        self.middleware.published.append((topic, cdr))
        return ""

    def expect_orders(self, topic: str, type_name: str, qos: Qos, lifespan_ns: int) -> None:
        """Every topic has a publisher already."""

    def write(self, order: Order) -> Unwritten | None:
        """Write a command to a robot now, or never, by the rule of the edges."""
        clock, written_ns = self._clock, self._written_ns.get(order.topic)
        passed_ns = None if written_ns is None else clock.monotonic_ns() - written_ns
        heard = Heard(self.middleware.subscribers.get(order.topic, 1))
        refused = unwritten(order, heard, clock.utc_ns(), passed_ns)
        if refused:
            self._counts.setdefault(order.topic, TopicCounts()).unwritten += 1
            return refused
        self.publish(order.topic, order.type, order.cdr, order.qos)
        self._written_ns[order.topic] = clock.monotonic_ns()
        return None

    def publications(self) -> list[Publication]:
        """There is no graph."""
        return []

    def endpoints(self) -> list[Endpoint]:
        """There is no graph."""
        return []

    def failing(self) -> dict[str, str]:
        """Nothing fails."""
        return {}

    def has_subscriber(self, topic: str) -> bool:
        return self.middleware.subscribers.get(topic, 1) > 0

    def count_if_unsubscribed(self, topic: str) -> bool:
        if self.has_subscriber(topic):
            return False
        self._counts.setdefault(topic, TopicCounts()).unheard += 1
        return True

    def sync(self) -> None:
        for subscription in self._subscriptions.values():
            subscription.sync()
        for topic, native in self._native.items():
            published, unheard, failed = native.collect()
            counts = self._counts.setdefault(topic, TopicCounts())
            counts.published += published
            counts.unheard += unheard
            counts.failed += failed

    def counters(self) -> dict[str, dict[str, int]]:
        return {
            topic: {
                "received": one.received,
                "published": one.published,
                "unheard": one.unheard,
                "lost": one.lost,
                "failed": one.failed,
                "held": one.held,
                "unwritten": one.unwritten,
            }
            for topic, one in self._counts.copy().items()  # a thread of the bridge may add a topic
        }

    def message_class(self, type_name: str) -> Any:
        raise RosError("there is no ROS here")

    def advertise(self, *_: Any) -> None:
        """Every topic has a publisher already."""

    def serve(self, *_: Any) -> bool:
        return False
