"""Turns and faults of the direct receiver, on a stand-in for rclpy's wait set (`test_ros.py` has the real one)."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

from igtl_gateway.edges.ros.receiver import DirectReceiver

TIMEOUT_S = 10.0


class Subscription:
    """A queue of messages; also its own handle."""

    pointer = 0

    def __init__(self, queued: list[str], callback: Callable[..., None], fails: bool = False) -> None:
        self.queue = deque(queued)
        self.callback = callback
        self.msg_type = str
        self.handle = self
        self.fails = fails
        self.event_handlers: list[Event] = []
        self.pointer = id(self)

    def take_message(self, _message_type: Any, _raw: bool) -> tuple[str, None] | None:
        if self.fails:
            self.queue.clear()
            raise RuntimeError("the middleware refuses")
        return (self.queue.popleft(), None) if self.queue else None


class Event:
    """A QoS event with its callback, as rclpy's EventHandler: gives its state only after it is marked as ready."""

    def __init__(self, total_count_change: int) -> None:
        self._ready_to_take_data = False
        self.state = SimpleNamespace(total_count_change=total_count_change)
        self.called: list[Any] = []
        self.callback = self.called.append

    def take_data(self) -> Any:
        ready, self._ready_to_take_data = self._ready_to_take_data, False
        return self.state if ready else None


class Context(threading.Event):
    """The event is what the guard condition triggers."""

    handle = None


class Guard:
    def __init__(self, *_: Any, context: Any) -> None:
        self.handle = context
        self.event = context

    def trigger(self) -> None:
        self.event.set()

    def destroy(self) -> None:
        self.event.clear()


class WaitSet:
    """Level-triggered as the real one: returns at once while there are messages, else at the guard condition."""

    def __init__(self, *sizes: Any) -> None:
        self.room = sizes[0]
        self.entries: list[Subscription] = []
        self.ready: list[int] = []

    def clear_entities(self) -> None:
        self.entries = []

    def add_guard_condition(self, handle: threading.Event) -> None:
        self.guard = handle

    def add_subscription(self, handle: Subscription) -> None:
        self.entries.append(handle)
        assert len(self.entries) <= self.room

    def wait(self, _timeout_ns: int) -> None:
        if not any(entry.queue for entry in self.entries):
            assert self.guard.wait(TIMEOUT_S)
        self.guard.clear()
        self.ready = [entry.pointer for entry in self.entries if entry.queue]

    def get_ready_entities(self, _kind: str) -> list[int]:
        return self.ready


def stand_in(wait_set: type = WaitSet) -> Any:
    implementation = SimpleNamespace(WaitSet=wait_set, Subscription=Subscription)
    return SimpleNamespace(
        guard_condition=SimpleNamespace(GuardCondition=Guard),
        impl=SimpleNamespace(implementation_singleton=SimpleNamespace(rclpy_implementation=implementation)),
    )


class Log:
    def __init__(self, last: str) -> None:
        self.lines: list[str] = []
        self.errors: list[str] = []
        self.last = last
        self.done = threading.Event()

    def __call__(self, message: str, _info: None) -> None:
        self.lines.append(message)
        if message == self.last:
            self.done.set()

    def receiver(self) -> DirectReceiver:
        return DirectReceiver(stand_in(), Context(), lambda error: self.errors.append(str(error)))


def test_every_topic_comes_to_its_turn_and_keeps_its_order() -> None:
    log = Log(last="a499")
    busy = [f"a{number}" for number in range(500)]
    receiver = log.receiver()
    receiver.add(Subscription(busy, log))
    receiver.add(Subscription(["b0", "b1"], log))
    receiver.start()
    assert log.done.wait(TIMEOUT_S)
    receiver.stop()
    assert [line for line in log.lines if line[0] == "a"] == busy
    assert log.lines.index("b1") < 100


def test_subscription_may_be_added_while_it_waits() -> None:
    log = Log(last="late")
    receiver = log.receiver()
    receiver.start()
    receiver.add(Subscription(["late"], log))
    assert log.done.wait(TIMEOUT_S)
    receiver.stop()


def test_refusal_of_one_topic_is_reported_and_the_others_go_on() -> None:
    log = Log(last="good")
    receiver = log.receiver()
    receiver.add(Subscription(["x"], log, fails=True))
    receiver.add(Subscription(["good"], log))
    receiver.start()
    assert log.done.wait(TIMEOUT_S)
    receiver.stop()
    assert (log.lines, log.errors) == (["good"], ["the middleware refuses"])


def test_events_are_polled_and_only_news_are_told() -> None:
    receiver = Log(last="").receiver()
    subscription = Subscription([], print)
    news, none = Event(2), Event(0)
    subscription.event_handlers = [news, none]
    receiver.add(subscription)
    receiver.poll_events()
    assert (news.called, none.called) == ([news.state], [])


def test_no_executor_waits_for_subscriptions_or_their_events() -> None:
    group = Log(last="").receiver().group
    assert not group.can_execute(Subscription([], print)) and not group.can_execute(Event(1))


def test_missing_internals_are_seen() -> None:
    assert DirectReceiver.available(stand_in())
    assert not DirectReceiver.available(stand_in(wait_set=type("WaitSet", (), {})))
