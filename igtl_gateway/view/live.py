"""A live view: a sink of the hub's entries that never makes the hub wait.

The sink puts entries into a bounded queue; a thread of its own draws them and sends what it has several times a
second.  What the queue cannot hold is dropped, counted, and told in the picture's own log as a gap.
"""

from __future__ import annotations

import threading
from collections import deque

import rerun as rr

from igtl_gateway.session.entry import Entry
from igtl_gateway.view.canvas import Options
from igtl_gateway.view.session import SessionView
from igtl_gateway.view.stream import arrange

MAX_ENTRIES, MAX_BYTES = 20_000, 256 << 20
_FLUSH_S = 0.1
_BLUEPRINT_S = 2.0


class LiveView:
    """Call it with every entry; ``close`` it at the end.

    Args:
        recording: the stream to draw into; its sink is the caller's.
        base_frame: of the session.
        options: how to draw.
        name: of the blueprint; "" = chosen by what is there, anew as more appears.
        max_entries, max_bytes: bounds of the queue.

    Attributes:
        dropped: entries that were not drawn.
        failure: why nothing is drawn any more; "" while all is well.
    """

    def __init__(
        self,
        recording: rr.RecordingStream,
        base_frame: str,
        options: Options | None = None,
        name: str = "",
        *,
        max_entries: int = MAX_ENTRIES,
        max_bytes: int = MAX_BYTES,
    ) -> None:
        self.dropped = 0
        self.failure = ""
        self._recording = recording
        self._view = SessionView(recording, base_frame, options)
        self._name = name
        self._max_entries, self._max_bytes = max_entries, max_bytes
        self._queue: deque[Entry] = deque()
        self._bytes = 0
        self._shedding = False  # the queue was full: nothing is taken until it is empty, so that a flood is one gap
        self._arranged = 0  # topics when the blueprint was sent last
        self._wake = threading.Condition()
        self._stopping = False
        self._thread = threading.Thread(target=self._run, name="igtl-view", daemon=True)
        self._thread.start()

    def __call__(self, entry: Entry) -> None:
        """Take an entry, or drop it; returns at once."""
        with self._wake:
            full = len(self._queue) >= self._max_entries or self._bytes + entry.size > self._max_bytes
            self._shedding = self._shedding or full
            if self._shedding or self.failure:
                self.dropped += 1
                return
            self._queue.append(entry)
            self._bytes += entry.size

    def close(self) -> None:
        """Draw what waits, and end."""
        with self._wake:
            self._stopping = True
            self._wake.notify()
        self._thread.join()

    def _run(self) -> None:
        passes = 0
        while True:
            with self._wake:
                self._wake.wait_for(lambda: self._stopping, _FLUSH_S)
                stopping = self._stopping
            try:
                self._draw()
                passes += 1
                if stopping or passes % round(_BLUEPRINT_S / _FLUSH_S) == 0:
                    self._arrange()
                if stopping:
                    self._view.finish()
                    self._arrange()
                    self._recording.flush()
            except Exception as error:  # a defect of ours must not cost the bridge more than its picture
                with self._wake:
                    self.failure = f"{type(error).__name__}: {error}"
                    self.dropped += len(self._queue)
                    self._queue.clear()
                return
            if stopping:
                return

    def _draw(self) -> None:
        """Everything that waits; what was dropped shows as a gap in the numbers of the entries."""
        for _ in range(self._max_entries):
            with self._wake:
                if not self._queue:
                    self._shedding = False
                    break
                entry = self._queue.popleft()
                self._bytes -= entry.size
            self._view.take(entry)
        self._view.flush()

    def _arrange(self) -> None:
        """Send the blueprint again if there is more to see than before."""
        seen = self._view.seen
        if len(seen.shown) > self._arranged:
            self._arranged = len(seen.shown)
            arrange(self._recording, self._name, seen)
