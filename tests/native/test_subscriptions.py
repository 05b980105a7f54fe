"""Subscriptions of the native passage, step by step in one thread."""

from __future__ import annotations

import threading

import pytest

from igtl_gateway.native.passage import Passage, Subscription, is_compiled
from tests.native.middleware import Middleware
from tests.timing import WAIT_S

pytestmark = pytest.mark.skipif(not is_compiled(), reason="without the native passage")


def test_what_comes_while_python_has_a_failure_is_taken_without_a_further_message() -> None:
    middleware, passage = Middleware(), Passage()
    passage.use_rcl(
        middleware.address("rcl_take_serialized_message"),
        middleware.address("rcl_publish_serialized_message"),
        middleware.address("rcl_publisher_get_subscription_count"),
    )
    one = Subscription(passage, middleware.pointer("/topic"))
    assert not passage.set_callback(middleware.address("rcl_subscription_set_on_new_message_callback"), one, True)
    middleware.failing = 7
    middleware.deliver("/topic", b"\0\1\0\0first", 1)
    assert passage.wait_subscriptions() == [one]
    middleware.failing = 0
    middleware.deliver("/topic", b"\0\1\0\0second", 2)  # Python has the subscription: only noted
    with pytest.raises(RuntimeError, match="code 7"):
        one.take()
    found: list[list[Subscription]] = []
    thread = threading.Thread(target=lambda: found.append(passage.wait_subscriptions()), daemon=True)
    thread.start()
    thread.join(WAIT_S)
    passage.wake()
    thread.join()
    assert found == [[one]]
    assert [one.take(), one.take(), one.take()] == [(b"\0\1\0\0first", 1, 1), (b"\0\1\0\0second", 2, 2), None]
    assert not passage.set_callback(middleware.address("rcl_subscription_set_on_new_message_callback"), one, False)
