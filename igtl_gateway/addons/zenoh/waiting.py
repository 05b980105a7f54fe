"""The thread that sends what Zenoh must not drop.

Zenoh keeps the caller of a message with BLOCK while its line carries nothing, for up to 5 s.  So such messages
(commands) are sent by a thread of their own, in their order, and their publishers never wait.
"""

from __future__ import annotations

import threading
from collections import Counter, deque
from collections.abc import Callable

from igtl_gateway.addon import NS_PER_S, Clock
from igtl_gateway.addon.reading import Level
from igtl_gateway.addon.ros_side import Reports, TopicCounts
from igtl_gateway.addon.terminal import counted

#: A command that has waited longer is not sent: what it asks for may be wrong by then.
LATE_NS = 2 * NS_PER_S
#: Commands that wait.
MOST = 256
#: The stop waits this long for the commands that wait.
_STOP_S = 2.0


class Commands:
    """Messages that wait for the line: a bounded queue and its thread, which the first message starts.

    Args:
        reports: takes the notes.
        clock: source of the monotonic time.
    """

    def __init__(self, reports: Reports, clock: Clock) -> None:
        self._reports = reports
        self._clock = clock
        self._changed = threading.Condition()
        self._waiting: deque[tuple[int, str, TopicCounts, Callable[[], str]]] = deque()
        self._dropped: Counter[str] = Counter()
        self._stopping = False
        self._thread: threading.Thread | None = None

    def put(self, topic: str, counts: TopicCounts, send: Callable[[], str]) -> None:
        """Take a message; ``send`` sends it, counts it and returns why that failed, or ``""``.

        A message is ``held`` while it waits, and ``failed`` if it cannot be sent in time.
        """
        with self._changed:
            if self._stopping or len(self._waiting) >= MOST:
                self._drop(topic, counts)
                return
            if self._thread is None:
                self._thread = threading.Thread(target=self._run, name="igtl-zenoh-commands", daemon=True)
                self._thread.start()
            counts.held += 1
            self._waiting.append((self._clock.monotonic_ns(), topic, counts, send))
            self._changed.notify()

    def note_dropped(self) -> None:
        """Note the messages that were not sent in time since the last call."""
        with self._changed:
            dropped, self._dropped = self._dropped, Counter()
        for topic, count in dropped.items():
            text = (
                f"{topic}: {counted(count, 'message')} not sent, because the line took none for "
                f"{LATE_NS / NS_PER_S:g} s"
            )
            self._reports.note(Level.ERROR, "site_command_late", text, topic, {"dropped": count})

    def stop(self) -> None:
        """Send what waits, for 2 s at most; drop the rest."""
        with self._changed:
            self._stopping = True
            self._changed.notify()
        if self._thread is not None:
            self._thread.join(_STOP_S)
        with self._changed:
            while self._waiting:
                _, topic, counts, _send = self._waiting.popleft()
                counts.held -= 1
                self._drop(topic, counts)
        self.note_dropped()

    def _drop(self, topic: str, counts: TopicCounts) -> None:
        counts.failed += 1
        self._dropped[topic] += 1

    def _run(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._waiting or self._stopping)
                if not self._waiting:
                    return
                since_ns, topic, counts, send = self._waiting.popleft()
                counts.held -= 1
                if self._clock.monotonic_ns() - since_ns > LATE_NS:
                    self._drop(topic, counts)
                    continue
            self._reports.publish_failed(topic, send())
