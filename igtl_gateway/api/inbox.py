"""The receive queue of a peer: bounded, with a rule for what to drop when it is full."""

from __future__ import annotations

from collections import Counter, OrderedDict, deque
from collections.abc import Callable

from igtl_gateway.api.received import ReceivedMessage
from igtl_gateway.base.errors import ConfigError


class Inbox:
    """Received messages in order of arrival, within two bounds.  Not locked: its owner has a lock.

    If a message finds no room, the oldest message of the stream that has the most of what is exhausted (messages or
    bytes) is dropped.  So a fast stream of images does not displace the only string.  One message of any size may wait.

    Attributes:
        dropped: number of dropped messages by stream, ``TYPE/device``.

    Args:
        max_messages: bound of the number of messages.
        max_bytes: bound of their bytes.

    Raises ConfigError for a bound below 1.
    """

    def __init__(self, max_messages: int, max_bytes: int) -> None:
        for name, bound in (("queue_messages", max_messages), ("queue_bytes", max_bytes)):
            if bound < 1:
                raise ConfigError(f"{name}: found {bound}, expected 1 or more")
        self.dropped: Counter[str] = Counter()
        self._max_messages, self._max_bytes = max_messages, max_bytes
        self._waiting: OrderedDict[int, tuple[ReceivedMessage, int]] = OrderedDict()
        self._streams: dict[str, deque[int]] = {}
        self._bytes: Counter[str] = Counter()
        self._total = 0
        self._serial = 0

    def __len__(self) -> int:
        return len(self._waiting)

    def put(self, message: ReceivedMessage, size: int) -> None:
        """Add a message of ``size`` bytes; drop others if there is no room."""
        while self._waiting and len(self._waiting) >= self._max_messages:
            self._drop(max(self._streams, key=lambda name: len(self._streams[name])))
        while self._waiting and self._total + size > self._max_bytes:
            self._drop(max(self._bytes, key=self._bytes.__getitem__))
        self._serial += 1
        stream = str(message)
        self._waiting[self._serial] = message, size
        self._streams.setdefault(stream, deque()).append(self._serial)
        self._bytes[stream] += size
        self._total += size

    def take(self, selects: Callable[[ReceivedMessage], bool]) -> ReceivedMessage | None:
        """Remove and return the first message that is selected; None if there is none."""
        serial = next((number for number, (message, _) in self._waiting.items() if selects(message)), None)
        return None if serial is None else self._remove(serial)

    def clear(self) -> None:
        """Remove all messages, which do not count as dropped."""
        for serial in list(self._waiting):
            self._remove(serial)

    def _drop(self, stream: str) -> None:
        self.dropped[stream] += 1
        self._remove(self._streams[stream][0])

    def _remove(self, serial: int) -> ReceivedMessage:
        message, size = self._waiting.pop(serial)
        stream = str(message)
        self._streams[stream].remove(serial)
        self._bytes[stream] -= size
        self._total -= size
        if not self._streams[stream]:
            del self._streams[stream], self._bytes[stream]
        return message
