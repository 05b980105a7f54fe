"""Taking the messages of our subscriptions from the middleware: two ways behind one interface.

Measured with TransformStamped at full speed on two busy cores: rclpy's executor, which builds a new wait set for
every message, took 2,400 a second at 370 µs of CPU each (333 a second in an earlier trial elsewhere); one wait
set kept by a thread of our own took 11,300 at 56 µs.  At 1 kHz and at 30 Hz the median latency was about equal.
rclpy is handed in, not imported (`igtl_gateway.edges.ros.middleware` alone imports it).
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any, Protocol

from igtl_gateway.base.errors import RosError
from igtl_gateway.native.passage import Passage
from igtl_gateway.native.passage import Subscription as NativeSubscription

#: Fields of the events of rclpy with the number of changes; an event without any has zeros.
_CHANGES = ("total_count_change", "current_count_change")
# Bounds for the messages of one topic before the next one has its turn; one as large as a picture reaches the second.
_TAKE_AT_MOST = 32
_TAKE_BYTES = 256 * 2**10

OnError = Callable[[Exception], None]


class Receiver(Protocol):
    """Takes the messages of subscriptions and calls their callbacks with ``(bytes, info)``."""

    #: The rclpy callback group that the subscriptions are to be created with; None for the node's own.
    group: Any

    def start(self) -> None: ...

    def add(self, subscription: Any) -> NativeSubscription | None:
        """Take from this subscription too; callable at any time from any thread.

        Returns:
            The subscription in the native passage; None without one.
        """
        ...

    def poll_events(self) -> None:
        """Call the event callbacks (lost messages, matched …) of what happened since the last poll."""
        ...

    def stop(self) -> None:
        """No callback runs after this."""
        ...


class ExecutorReceiver:
    """The executor of the node takes: slow, but only public interfaces."""

    group = None

    def start(self) -> None:
        """The executor thread is the edge's."""

    def add(self, subscription: Any) -> None:
        """The node has added it to its executor already."""

    def poll_events(self) -> None:
        """The executor does it."""

    def stop(self) -> None:
        """The executor thread is the edge's."""


class EventPolling:
    """Events of publishers or subscriptions, which no executor waits for."""

    def __init__(self) -> None:
        self.events: list[Any] = []

    def poll_events(self) -> None:
        for handler in list(self.events):
            # EventHandler.is_ready sets it when a wait set reports an event; we take it without waiting
            handler._ready_to_take_data = True
            event = handler.take_data()
            if event is not None and any(getattr(event, name, 0) for name in _CHANGES):
                handler.callback(event)


class UnmanagedCallbackGroup:
    """A callback group (duck-typed, see `rclpy.callback_groups`) whose entities no executor waits for.

    Subscriptions and their events: waiting for an event wakes the executor at every message too (Fast DDS has one
    condition for both), which cost more than all the rest of the bridge: 0.9 ms of CPU a message at 1 kHz.  Events of
    publishers: for each new one the executor asks all others, which takes 9 ms with the GIL where there are 500.
    """

    def add_entity(self, _entity: Any) -> None:
        """Nothing to keep: the node keeps its entities."""

    def can_execute(self, _entity: Any) -> bool:
        return False

    def beginning_execution(self, _entity: Any) -> bool:
        return True

    def ending_execution(self, _entity: Any) -> None:
        """Nothing begins, so nothing ends."""


class Addresses(Protocol):
    """Finds functions of rcl."""

    def address(self, name: str) -> int: ...


class NativeReceiver(EventPolling):
    """The native passage takes, in the threads of the middleware; what it does not pass on, our own thread takes.

    Args:
        passage: the native passage.
        rcl: see ``Addresses``.
        on_error: called with what a callback or rcl raises.
    """

    def __init__(self, passage: Passage, rcl: Addresses, on_error: OnError) -> None:
        super().__init__()
        self.group = UnmanagedCallbackGroup()
        self._passage = passage
        self._set_callback = rcl.address("rcl_subscription_set_on_new_message_callback")
        passage.use_rcl(
            rcl.address("rcl_take_serialized_message"),
            rcl.address("rcl_publish_serialized_message"),
            rcl.address("rcl_publisher_get_subscription_count"),
        )
        self._on_error = on_error
        self._callbacks: dict[NativeSubscription, Callable[..., None]] = {}
        self._stopping = False
        self._thread = threading.Thread(target=self._run, name="igtl-ros-receiver", daemon=True)

    def start(self) -> None:
        self._thread.start()

    def add(self, subscription: Any) -> NativeSubscription:
        native = NativeSubscription(self._passage, subscription.handle.pointer)
        self.events += subscription.event_handlers
        self._callbacks = {**self._callbacks, native: subscription.callback}
        # it is Python's as long as it has no stream, so this cannot wait for the sequence lock
        if code := self._passage.set_callback(self._set_callback, native, True):
            raise RosError(f"rcl does not report new messages (code {code})")
        return native

    def stop(self) -> None:
        for native in self._callbacks:
            self._passage.set_callback(self._set_callback, native, False)
        self._stopping = True
        self._passage.wake()
        self._thread.join()
        self._passage.fill()

    def _run(self) -> None:
        while not self._stopping:
            for native in self._passage.wait_subscriptions():
                self._take(native)

    def _take(self, native: NativeSubscription) -> None:
        callback, size = self._callbacks[native], 0
        for _ in range(_TAKE_AT_MOST):
            try:
                taken = native.take()
            except RuntimeError as error:  # the middleware refuses one topic: the others go on
                self._on_error(error)
                return
            if taken is None or self._stopping:
                return
            if isinstance(taken, int):  # it has passed natively
                size += taken
            else:
                cdr, source_ns, number = taken
                try:
                    callback(cdr, {"source_timestamp": source_ns, "publication_sequence_number": number})
                except Exception as error:  # a defect of our own costs this message
                    self._on_error(error)
                size += len(cdr)
            if size > _TAKE_BYTES:
                break
        native.again()


class DirectReceiver(EventPolling):
    """A thread around one wait set of our own.

    It uses internals of rclpy: `available` checks for them.
    """

    def __init__(self, rclpy: Any, context: Any, on_error: OnError) -> None:
        super().__init__()
        self.group = UnmanagedCallbackGroup()
        self._implementation = rclpy.impl.implementation_singleton.rclpy_implementation
        self._context = context
        self._on_error = on_error
        self._wake = rclpy.guard_condition.GuardCondition(None, None, context=context)
        self._sources: list[tuple[Any, Any, Callable[..., None]]] = []
        self._stopping = False
        self._thread = threading.Thread(target=self._run, name="igtl-ros-receiver", daemon=True)

    @staticmethod
    def available(rclpy: Any) -> bool:
        """Whether this rclpy has the internals that the class needs."""
        implementation = rclpy.impl.implementation_singleton.rclpy_implementation
        needed = {
            "WaitSet": ("clear_entities", "add_subscription", "add_guard_condition", "wait", "get_ready_entities"),
            "Subscription": ("take_message", "pointer"),
        }
        return all(
            hasattr(getattr(implementation, name, None), method)
            for name, methods in needed.items()
            for method in methods
        )

    def start(self) -> None:
        self._thread.start()

    def add(self, subscription: Any) -> None:
        self.events += subscription.event_handlers
        # a new list each time: the thread may be walking the old one
        self._sources = [*self._sources, (subscription.handle, subscription.msg_type, subscription.callback)]
        self._wake.trigger()

    def stop(self) -> None:
        self._stopping = True
        self._wake.trigger()
        self._thread.join()
        self._wake.destroy()

    def _run(self) -> None:
        sources: list[tuple[Any, Any, Callable[..., None]]] = []
        by_pointer: dict[int, tuple[Any, Any, Callable[..., None]]] = {}
        wait_set = None
        while not self._stopping:
            if wait_set is None or sources is not self._sources:
                sources = self._sources
                wait_set = self._implementation.WaitSet(len(sources), 1, 0, 0, 0, 0, self._context.handle)
                by_pointer = {source[0].pointer: source for source in sources}
            wait_set.clear_entities()
            wait_set.add_guard_condition(self._wake.handle)
            for handle, _, _ in sources:
                wait_set.add_subscription(handle)
            wait_set.wait(-1)  # releases the GIL
            for pointer in wait_set.get_ready_entities("subscription"):
                try:
                    self._take(*by_pointer[pointer])
                except Exception as error:  # the middleware refuses one topic: the others go on
                    self._on_error(error)

    def _take(self, handle: Any, message_type: Any, callback: Callable[..., None]) -> None:
        # Messages left after a turn make the next wait return at once, so every topic has its turn.
        size = 0
        for _ in range(_TAKE_AT_MOST):
            taken = handle.take_message(message_type, True)
            if taken is None or self._stopping:
                return
            callback(*taken)
            size += len(taken[0])
            if size > _TAKE_BYTES:
                return
