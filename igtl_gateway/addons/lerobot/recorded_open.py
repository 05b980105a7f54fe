"""The recordings that a process has open for the pictures of a data set, within bounds.

Each process has its own: an open file has one position, so two processes that share it read each other's bytes.
"""

from __future__ import annotations

import os
from collections import OrderedDict
from collections.abc import Sequence
from threading import Lock

from igtl_gateway.addon.reading import Recording, open_recording
from igtl_gateway.addons.lerobot.pictures import PictureReader, Pixels, Place
from igtl_gateway.addons.lerobot.recorded_sessions import Files, KnownRecording, PictureSource

#: Recordings that are open at a time.
MOST_OPEN = 32


class OpenRecordings:
    """Opens recordings when they are used.

    At most ``MOST_OPEN`` are open.  Unpacked chunks (64 MiB) and decoders are kept of the last one that was used.

    Args:
        recordings: of the data set.
        inherited: what the parent of this process has open; it is kept and not used.
    """

    def __init__(self, recordings: Sequence[KnownRecording], inherited: OpenRecordings | None = None) -> None:
        self.pid = os.getpid()
        self._recordings, self._inherited, self._lock = recordings, inherited, Lock()
        self._files: dict[int, Files] = {}
        self._open: OrderedDict[int, tuple[Recording, dict[PictureSource, PictureReader]]] = OrderedDict()

    def check(self, number: int) -> None:
        """Check a recording at its first use in this process.  Raises GatewayError if it has changed."""
        if number not in self._files:
            self._compare(number)

    def _compare(self, number: int) -> None:
        self._files[number] = self._recordings[number].check(self._files.get(number, ()))

    def picture(self, number: int, source: PictureSource, place: Place) -> Pixels:
        """Return a picture, as ``PictureReader.rgb`` does.  Raises GatewayError, also if the recording has changed."""
        with self._lock:
            # the index in memory also fits a file that was written over it, with pictures of another session
            self._compare(number)
            recording, readers = self._use(number)
            if source not in readers:
                readers[source] = PictureReader(recording[source.stream], source.window, source.depth_mm)
            return readers[source].rgb(place)

    def _use(self, number: int) -> tuple[Recording, dict[PictureSource, PictureReader]]:
        last = next(reversed(self._open), number)
        if number in self._open and last == number:
            return self._open[number]
        if last != number:
            recording, readers = self._open[last]
            recording.forget_chunks()
            readers.clear()
        if number in self._open:
            self._open.move_to_end(number)
            return self._open[number]
        if len(self._open) >= MOST_OPEN:
            self._open.popitem(last=False)[1][0].close()
        self._open[number] = open_recording(self._recordings[number].path), {}
        return self._open[number]

    def close(self) -> None:
        """Close all of them."""
        with self._lock:
            while self._open:
                self._open.popitem()[1][0].close()
