"""A live view: a sink for the entries of the hub that never blocks the hub.

The sink puts entries into a bounded queue.  A separate thread draws them and sends the result several times a
second.  Entries that do not fit into the queue are dropped, counted, and shown as a gap in the log of the view.
"""

from __future__ import annotations

import threading
from collections import deque
from dataclasses import replace

import rerun as rr

from igtl_gateway.addon.checking import Session, make_core
from igtl_gateway.addon.reading import Entry, Kind
from igtl_gateway.addon.settings import Config
from igtl_gateway.addon.terminal import by_count, count_text
from igtl_gateway.addons.view.canvas import Options
from igtl_gateway.addons.view.session import SessionView
from igtl_gateway.addons.view.stream import arrange, to_viewer
from igtl_gateway.addons.view.viewer import Viewer

MAX_ENTRIES, MAX_BYTES = 20_000, 256 << 20
_FLUSH_S = 0.1
_BLUEPRINT_S = 2.0
_LAST_S = 5.0


class LiveView:
    """A sink: call it with every entry, and ``close`` it at the end.

    Args:
        recording: the stream to draw into; the caller sets its sink.
        base_frame: base frame of the session.
        options: options for drawing.
        through: a gateway that converts OpenIGTLink messages, for sessions of a relay, which converts none.
        name: name of the blueprint; "" = chosen by the contents, again when new topics appear.
        max_entries, max_bytes: limits of the queue.

    Attributes:
        dropped: number of entries that were not drawn.
        failure: why drawing has stopped; "" while it works.
    """

    def __init__(
        self,
        recording: rr.RecordingStream,
        base_frame: str,
        options: Options | None = None,
        through: Session | None = None,
        name: str = "",
        *,
        max_entries: int = MAX_ENTRIES,
        max_bytes: int = MAX_BYTES,
    ) -> None:
        self.dropped = 0
        self.failure = ""
        self._recording = recording
        self._view = SessionView(recording, base_frame, options)
        self._through = through
        self._name = name
        self._max_entries, self._max_bytes = max_entries, max_bytes
        self._queue: deque[Entry] = deque()
        self._bytes = 0
        self._shedding = False  # after a full queue nothing is taken until it is empty, so that a flood is one gap
        self._arranged = 0  # number of topics when the blueprint was last sent
        self._wake = threading.Condition()
        self._stopping = False
        self._thread = threading.Thread(target=self._run, name="igtl-view", daemon=True)
        self._thread.start()

    def __call__(self, entry: Entry) -> None:
        """Queue an entry, or drop it; never blocks."""
        with self._wake:
            full = len(self._queue) >= self._max_entries or self._bytes + entry.size > self._max_bytes
            self._shedding = self._shedding or full
            if self._shedding or self.failure:
                self.dropped += 1
                return
            self._queue.append(entry)
            self._bytes += entry.size

    def close(self) -> None:
        """Draw the queued entries, then stop."""
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
                    self._recording.flush(timeout_sec=_LAST_S)  # a closed viewer accepts no data
            except Exception as error:  # an internal error must stop the view only, not the bridge
                with self._wake:
                    self.failure = f"{type(error).__name__}: {error}"
                    self.dropped += len(self._queue)
                    self._queue.clear()
                return
            if stopping:
                return

    def _draw(self) -> None:
        """Draw all queued entries; dropped entries show as a gap in the entry numbers."""
        for _ in range(self._max_entries):
            with self._wake:
                if not self._queue:
                    self._shedding = False
                    break
                entry = self._queue.popleft()
                self._bytes -= entry.size
            self._view.take(entry)
            if self._through and entry.kind.is_input:
                for output in self._through.recorded(entry):
                    if output.kind is Kind.ROS_OUT:
                        self._view.take(output)
        self._view.flush()

    def _arrange(self) -> None:
        """Send the blueprint again if there are new topics."""
        seen = self._view.seen
        if len(seen.shown) > self._arranged:
            self._arranged = len(seen.shown)
            arrange(self._recording, self._name, seen)


class LiveWindow:
    """A window of the viewer for a running session: a sink that opens the window and closes it at the end.

    Raises ViewerError if there is no screen or no viewer.
    """

    def __init__(self, config: Config) -> None:
        self._viewer = Viewer.window()
        try:
            self._recording = to_viewer(self._viewer.url)
        except Exception:
            self._viewer.close()
            raise
        through = Session(make_core(replace(config, relay=False), fast_path=False)) if config.relay else None
        self._view = LiveView(self._recording, config.base_frame, through=through)

    def __call__(self, entry: Entry) -> None:
        """Draw an entry; does nothing after the user has closed the window."""
        if not self._viewer.ended:
            self._view(entry)

    def close(self) -> str:
        """Stop drawing and close the window; return what failed, "" for nothing."""
        closed = self._viewer.ended  # by the user: not a failure, and nothing reads the stream
        self._view.close()
        if not closed:
            self._recording.disconnect()  # before the viewer exits, or rerun logs an error
        messages = [self._view.failure] if self._view.failure and not closed else []
        if self._view.dropped:
            messages.append(
                f"{count_text(self._view.dropped, 'entry', 'entries')} "
                f"{by_count(self._view.dropped, 'was', 'were')} dropped: the viewer was too slow"
            )
        self._viewer.close()
        return "; ".join(messages)
