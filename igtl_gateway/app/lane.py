"""The slow lane: large messages on their way to ROS, so that small ones do not wait behind them.

Handing a picture to DDS takes milliseconds, in which a pose would wait for the hub.  So topics that carry large
messages are published by a thread of their own, in order; a topic that once had a large message stays here.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable

from igtl_gateway.session.entry import Entry

#: From here on publishing takes longer than handing over to another thread (0.3 ms against 0.05).
LARGE_BYTES = 256 * 2**10

#: What may wait, ten Full HD pictures.  Beyond it the hub waits, too, as if it published itself.
_WAITING_BYTES = 64 * 2**20


class Lane:
    """Publishes what it is given, one after the other, in a thread of its own.

    Args:
        publish: hands an entry to the ROS edge; must not need any lock that callers of ``put`` hold.
    """

    def __init__(self, publish: Callable[[Entry], None]) -> None:
        self._publish = publish
        self._topics: set[str] = set()
        self._waiting: deque[Entry] = deque()
        self._bytes = 0
        self._changed = threading.Condition()
        self._stopping = False
        self._thread = threading.Thread(target=self._run, name="igtl-ros-lane", daemon=True)

    def is_for(self, entry: Entry) -> bool:
        """Whether a message belongs here: its topic has large ones."""
        if entry.channel in self._topics:
            return True
        if entry.size < LARGE_BYTES:
            return False
        self._topics.add(entry.channel)
        return True

    def put(self, entry: Entry) -> None:
        """Publish this behind all that was put before; waits where too much is waiting already."""
        with self._changed:
            if self._thread.ident is None:
                self._thread.start()
            self._changed.wait_for(lambda: self._stopping or self._bytes < _WAITING_BYTES)
            if not self._stopping:
                self._waiting.append(entry)
                self._bytes += entry.size
                self._changed.notify_all()
                return
        self._publish(entry)  # behind the end of the lane: too late to keep anybody waiting

    def inside(self) -> bool:
        """Whether the caller is the lane's own thread."""
        return threading.get_ident() == self._thread.ident

    def stop(self) -> None:
        """Publish what waits, then end."""
        with self._changed:
            self._stopping = True
            self._changed.notify_all()
        if self._thread.ident is not None:
            self._thread.join()

    def _run(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._stopping or self._waiting)
                if not self._waiting:
                    return
                entry = self._waiting[0]
            self._publish(entry)
            with self._changed:
                self._waiting.popleft()
                self._bytes -= entry.size
                self._changed.notify_all()
