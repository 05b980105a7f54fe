"""What encoder and decoder have in common: a thread that serves streams in turn, with a bounded queue for each."""

from __future__ import annotations

import threading
from abc import ABC, abstractmethod
from collections import Counter, deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Generic, TypeVar

from igtl_gateway.base.errors import ConversionError, Unavailable
from igtl_gateway.base.extras import missing
from igtl_gateway.base.once import Once
from igtl_gateway.gateway.log.note import Level, Note

#: Streams in each direction: every one holds a codec with its reference pictures.
MAX_STREAMS = 32
#: Largest picture that the decoder allocates (4096 × 4096): a frame of 100 bytes might announce any size.
MAX_PIXELS = 1 << 24

#: Codes of our notes.
DROPPED, REFUSED, FAILED, CHANGED = "video_drop", "video_refused", "video_failed", "video_changed"
#: Reasons of ``changed``: what a picture loses.
UPPER_BITS, NO_ALPHA, PADDED = "upper_8_of_16_bits", "without_alpha", "padded_to_even"

#: Threads of FFmpeg for one picture.
THREADS = 2

OnNote = Callable[[Note], None]


@dataclass(slots=True)
class VideoCounts:
    """The counts of one stream, in pictures.

    Attributes:
        received: handed to us.  With what waits this is the sum of the others.
        done: encoded, or decoded.
        key_frames: of those encoded, or of the frames received.
        encoded_bytes: of the frames made, or received.
        dropped: not done, by reason.
        changed: of those done, with other pixels than they had, by reason.
    """

    received: int = 0
    done: int = 0
    key_frames: int = 0
    encoded_bytes: int = 0
    dropped: Counter[str] = field(default_factory=Counter)
    changed: Counter[str] = field(default_factory=Counter)

    def to_dict(self) -> dict[str, Any]:
        """Return the counts as JSON values."""
        return {
            "received": self.received,
            "done": self.done,
            "key_frames": self.key_frames,
            "encoded_bytes": self.encoded_bytes,
            "dropped": dict(sorted(self.dropped.items())),
            **({"changed": dict(sorted(self.changed.items()))} if self.changed else {}),
        }


T = TypeVar("T")


@dataclass(slots=True)
class VideoStream(Generic[T]):
    """One topic.  ``codec`` belongs to the thread, all else to the lock."""

    name: str
    queue: deque[T] = field(default_factory=deque)
    counts: VideoCounts = field(default_factory=VideoCounts)
    noted: Once = field(default_factory=Once)  # codes
    has_turn: bool = False  # waits for its turn, or has it
    waiting: bool = True  # decoder: for a key frame
    codec: Any = None


class CodecThread(ABC, Generic[T]):
    """A thread that serves its streams in turn."""

    def __init__(self, name: str, on_note: OnNote) -> None:
        self._av = import_av()
        self._on_note = on_note
        self._condition = threading.Condition()
        self._streams: dict[str, VideoStream[T]] = {}
        self._turns: deque[VideoStream[T]] = deque()  # streams with something in the queue
        self._refused = VideoCounts()  # of the streams beyond the bound
        self._noted = Once()
        self._stopping = False
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)

    def start(self) -> None:
        """Start the thread; what was submitted before that waits for it."""
        self._thread.start()

    def stop(self) -> None:
        """End the thread; what waits is dropped.  No callback runs after this.  Further calls do nothing."""
        with self._condition:
            self._stopping = True
            for stream in self._streams.values():
                self._drop_waiting(stream, "stopped")
            self._turns.clear()
            self._condition.notify()
        if self._thread.ident:
            self._thread.join()

    def counters(self) -> dict[str, Any]:
        """Return the counts by stream."""
        with self._condition:
            streams = {name: stream.counts.to_dict() for name, stream in sorted(self._streams.items())}
            return streams | ({"(others)": self._refused.to_dict()} if self._refused.received else {})

    def _enqueue(self, name: str, take: Callable[[VideoStream[T]], Note | None]) -> None:
        """Have ``take`` put an item into the queue of a stream, under the lock."""
        with self._condition:
            if self._stopping:
                return
            stream = self._streams.get(name)
            if stream is None and len(self._streams) < MAX_STREAMS:
                stream = self._streams[name] = VideoStream(name)
            if stream is None:
                self._refused.received += 1
                self._refused.dropped["too_many_streams"] += 1
                text = f"more than {MAX_STREAMS} video streams"
                note = _note(DROPPED, name, text) if self._noted.first() else None
            else:
                stream.counts.received += 1
                note = take(stream)
                if stream.queue and not stream.has_turn:
                    stream.has_turn = True
                    self._turns.append(stream)
                    self._condition.notify()
        if note:
            self._on_note(note)

    def _run(self) -> None:
        while True:
            with self._condition:
                while not self._turns and not self._stopping:
                    self._condition.wait()
                if self._stopping:
                    return
                stream = self._turns.popleft()
                item = stream.queue.popleft()
            note = None
            try:
                self._process(stream, item)
            except ConversionError as error:
                note = self._count_lost(stream, REFUSED, "refused", f"not encoded: {error}")
            except self._av.error.FFmpegError as error:
                note = self._count_lost(stream, FAILED, "broken", f"{type(error).__name__}: {error}")
            except Exception as error:  # a defect of our own must cost one picture, not the thread
                note = self._count_lost(stream, FAILED, "internal_error", f"{type(error).__name__}: {error}")
            if note:
                self._on_note(note)
            with self._condition:
                stream.has_turn = bool(stream.queue)
                if stream.has_turn:
                    self._turns.append(stream)

    @abstractmethod
    def _process(self, stream: VideoStream[T], item: T) -> None:
        """Encode or decode one item."""

    def _count_lost(self, stream: VideoStream[T], code: str, reason: str, text: str) -> Note | None:
        """Count an item that gave no result."""
        with self._condition:
            stream.counts.dropped[reason] += 1
            return self._note_once(stream, code, text)

    @staticmethod
    def _note_once(stream: VideoStream[T], code: str, text: str) -> Note | None:
        """The note, if the stream has not had one of this code."""
        return _note(code, stream.name, f"{stream.name}: {text}") if stream.noted.first(code) else None

    def _drop_waiting(self, stream: VideoStream[T], reason: str) -> None:
        """Empty the queue of a stream.  The caller holds the lock, and ensures that an empty queue gets no turn."""
        if stream.queue:
            stream.counts.dropped[reason] += len(stream.queue)
            stream.queue.clear()


def _note(code: str, stream: str, text: str) -> Note:
    return Note(Level.WARN, code, text, stream)


def import_av() -> Any:
    try:
        import av
        import av.video.reformatter
    except ImportError as error:
        raise Unavailable(missing("av", error)) from error
    return av
