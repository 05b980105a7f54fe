"""The rule for what a full receive queue drops."""

from __future__ import annotations

import pytest

from igtl_gateway.api.inbox import Inbox
from igtl_gateway.api.received import ReceivedMessage
from igtl_gateway.base.errors import ConfigError
from igtl_gateway.wire import Message, Raw


def message(device: str, number: int) -> ReceivedMessage:
    return ReceivedMessage(Message("RAW", device, Raw(b"")), 1, number)


def taken(inbox: Inbox) -> list[tuple[str, int]]:
    found = []
    while one := inbox.take(lambda _message: True):
        found.append((one.device, one.received_ns))
    return found


def test_the_stream_with_the_most_messages_loses_its_oldest() -> None:
    inbox = Inbox(3, 1000)
    inbox.put(message("rare", 0), 1)
    for number in range(1, 6):
        inbox.put(message("fast", number), 1)
    assert inbox.dropped == {"RAW/fast": 3}
    assert taken(inbox) == [("rare", 0), ("fast", 4), ("fast", 5)]
    assert len(inbox) == 0


def test_the_stream_with_the_most_bytes_loses_its_oldest() -> None:
    inbox = Inbox(100, 10)
    inbox.put(message("large", 0), 6)
    inbox.put(message("small", 1), 1)
    inbox.put(message("large", 2), 6)
    assert taken(inbox) == [("small", 1), ("large", 2)]
    inbox.put(message("huge", 3), 10_000)  # one message of any size
    inbox.put(message("small", 4), 1)
    assert taken(inbox) == [("small", 4)]


def test_what_is_selected_leaves_the_others_in_order() -> None:
    inbox = Inbox(10, 10)
    for number, device in enumerate("abcab"):
        inbox.put(message(device, number), 1)
    found = inbox.take(lambda one: one.device == "b")
    assert found
    assert found.received_ns == 1
    assert inbox.take(lambda one: one.device == "x") is None
    assert taken(inbox) == [("a", 0), ("c", 2), ("a", 3), ("b", 4)]


@pytest.mark.parametrize(("messages", "size"), [(0, 1), (1, 0)])
def test_bounds(messages: int, size: int) -> None:
    with pytest.raises(ConfigError, match="found 0, expected 1 or more"):
        Inbox(messages, size)
