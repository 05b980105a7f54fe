"""The buffer between Zenoh's threads and the hub: bounded, and the oldest message of a topic gives way.

Zenoh calls with each message in threads of its own, which must return soon: they serve all keys of the session.  One
own thread passes the messages on in the order in which they came.  The policy is that of a KEEP_LAST reader: each
topic keeps as many messages as its subscription is deep, and a newer one displaces the oldest.  Together they have at
most ``BYTES``; then the topic that receives loses its oldest, too.  What is displaced counts as lost.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

#: Of all waiting messages together.
BYTES = 256 << 20


@dataclass(slots=True)
class Waiting:
    """The messages of one topic that wait.

    Attributes:
        deliver: called with payload and source stamp, in our thread.
        depth: most messages that wait.
        displaced: messages that gave way so far.
        gone: places in the order whose message gave way and that no newer one has taken.
    """

    deliver: Callable[[Any, int], None]
    depth: int
    displaced: int = 0
    gone: int = 0
    messages: deque[tuple[Any, int, int]] = field(default_factory=deque)


class Inbox:
    """Passes messages from any threads to one.

    Args:
        most_bytes: of all waiting messages; a single message may be larger, if nothing else waits.
    """

    def __init__(self, most_bytes: int = BYTES) -> None:
        self._most_bytes = most_bytes
        self._bytes = 0
        self._order: deque[Waiting] = deque()  # one for each message that waits
        self._changed = threading.Condition()
        self._stopped = False
        self._thread = threading.Thread(target=self._run, name="igtl-ros-receiver", daemon=True)

    def start(self) -> None:
        self._thread.start()

    def stop(self) -> None:
        """No message is delivered after this; those that wait count as displaced."""
        with self._changed:
            self._stopped = True
            self._changed.notify_all()
        if self._thread.ident:
            self._thread.join()

    def put(self, topic: Waiting, payload: Any, size: int, stamp_ns: int) -> None:
        """Add a message: payload as Zenoh has it, its bytes, its source stamp (UTC ns)."""
        with self._changed:
            if self._stopped:
                topic.displaced += 1
                return
            while topic.messages and (len(topic.messages) >= topic.depth or self._bytes + size > self._most_bytes):
                self._bytes -= topic.messages.popleft()[1]
                topic.displaced += 1
                topic.gone += 1
            if self._bytes and self._bytes + size > self._most_bytes:
                topic.displaced += 1
                return
            topic.messages.append((payload, size, stamp_ns))
            self._bytes += size
            if topic.gone:
                topic.gone -= 1  # it takes the place of the one that gave way
            else:
                self._order.append(topic)
            self._changed.notify()

    def _run(self) -> None:
        while True:
            with self._changed:
                while not self._order and not self._stopped:
                    self._changed.wait()
                if self._stopped:
                    for topic in self._order:
                        topic.displaced += 1
                    return
                topic = self._order.popleft()
                if not topic.messages:
                    topic.gone -= 1
                    continue
                payload, size, stamp_ns = topic.messages.popleft()
                self._bytes -= size
            topic.deliver(payload, stamp_ns)
