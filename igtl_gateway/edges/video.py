"""Pictures to encoded video and back, by PyAV (FFmpeg), each way in a thread of its own.

No two builds of an encoder give the same bytes, so it is an edge: what leaves it enters the log, and is never made
again in a replay.  One picture in gives one frame out, at once: no B frames, no look-ahead, no frame threads.

* *Encoding* may be slower than the camera.  Raw pictures wait in a short queue of each topic; at its bound the
  oldest is dropped, which costs a picture and nothing else.
* *Decoding* cannot leave a frame out, since the next ones are told as differences from it.  Where one is broken, or
  had to be dropped here, all is dropped up to the next key frame: no picture is better than one with parts of
  another.  (That a frame was lost before it came to us cannot be seen: FFmpeg paints over it.)

Measured on two cores, per picture, VGA and Full HD: to encode H.264 5 and 18 ms, VP9 10 and 54 ms; to decode H.264 2
and 6 ms, VP9 4 and 13 ms.  Twice that where others want the cores as well.

PyAV is imported when the first of the two is made, so that this module loads without it.
"""

from __future__ import annotations

import threading
from abc import ABC, abstractmethod
from collections import Counter, deque
from collections.abc import Callable
from dataclasses import dataclass, field
from fractions import Fraction
from typing import Any, Generic, TypeVar

import numpy as np

from igtl_gateway.buffers import Buffer
from igtl_gateway.convert.bitstream import is_key_frame
from igtl_gateway.convert.common_msgs import CompressedImage
from igtl_gateway.convert.rosmsg import Header, Image
from igtl_gateway.errors import ConfigError, ConversionError, Unavailable
from igtl_gateway.extras import missing
from igtl_gateway.session.note import Level, Note

#: Codecs to encode with: name in CompressedImage.format → encoder and its options.
#: x264's "ultrafast" is what Full HD at 30 Hz leaves time for, and its baseline profile is what every peer decodes.
#: The bit rate is constant, over a buffer of one second.
_ENCODERS: dict[str, tuple[str, dict[str, str]]] = {
    "h264": ("libx264", {"preset": "ultrafast", "tune": "zerolatency", "x264-params": "scenecut=0:repeat-headers=1"}),
    "vp9": ("libvpx-vp9", {"deadline": "realtime", "cpu-used": "8", "lag-in-frames": "0", "row-mt": "1",
                           "auto-alt-ref": "0", "tile-columns": "2"}),
}  # fmt: skip
CODECS = tuple(_ENCODERS)
#: Codecs to decode: name in CompressedImage.format → FFmpeg's.
_DECODERS = {"h264": "h264", "h265": "hevc", "vp9": "vp9", "av1": "libdav1d"}

#: Pictures of one topic that wait for the encoder: 100 ms at 30 Hz.
MAX_PICTURES = 3
#: Frames of one stream that wait for the decoder: a second at 30 Hz …
MAX_FRAMES = 30
#: … and their bytes.
MAX_FRAME_BYTES = 32 << 20
#: Streams that each way serves: every one holds a codec with its reference pictures.
MAX_STREAMS = 32
#: Largest picture that the decoder makes room for (4096 × 4096): a frame of 100 bytes may claim any size.
MAX_PIXELS = 1 << 24

#: Codes of our notes.
DROPPED, REFUSED, FAILED = "video_drop", "video_refused", "video_failed"

_THREADS = 2
_LIMITS = {"bit_rate": (10_000, 1_000_000_000), "key_frame_interval": (1, 10_000)}
#: What the encoder spends on a picture is the bit rate over the rate of pictures, which it must be told when it is
#: opened: this, until a second or so of stamps has shown the true one.
_FIRST_RATE = 30
_MAX_RATE = 240
_RATE_PICTURES = 15
_BT601, _LIMITED = 6, 1  # AVCOL_SPC_SMPTE170M, AVCOL_RANGE_MPEG: said in the stream, so that no player has to guess

#: ROS encoding → FFmpeg's pixel format, bytes of a pixel.
_PIXELS = {"mono8": ("gray", 1), "mono16": ("gray", 2), "rgb8": ("rgb24", 3), "bgr8": ("bgr24", 3),
           "rgba8": ("rgba", 4), "bgra8": ("bgra", 4)}  # fmt: skip

OnFrame = Callable[[str, str, bytes, int], None]
OnImage = Callable[[str, bytes], None]
OnNote = Callable[[Note], None]


@dataclass(frozen=True, slots=True)
class VideoOptions:
    """How pictures are encoded.

    Attributes:
        codec: one of ``CODECS``.
        bit_rate: bit/s of each stream.
        key_frame_interval: pictures from one key frame to the next; who joins waits for one.

    Raises ConfigError for values that cannot be.
    """

    codec: str = "h264"
    bit_rate: int = 4_000_000
    key_frame_interval: int = 30

    def __post_init__(self) -> None:
        if self.codec not in CODECS:
            raise ConfigError(f"video codec: found {self.codec!r}, expected one of {', '.join(CODECS)}")
        for name, (lowest, highest) in _LIMITS.items():
            value = getattr(self, name)
            if not lowest <= value <= highest:
                raise ConfigError(f"video {name}: found {value}, expected {lowest} to {highest}")


@dataclass(slots=True)
class VideoCounts:
    """Of one stream, in pictures.

    Attributes:
        received: handed to us.  With what waits this is the sum of the others.
        done: encoded, or decoded.
        key_frames: of those encoded, or of the frames received.
        encoded_bytes: of the frames made, or received.
        dropped: not done, by reason.
    """

    received: int = 0
    done: int = 0
    key_frames: int = 0
    encoded_bytes: int = 0
    dropped: Counter[str] = field(default_factory=Counter)

    def to_dict(self) -> dict[str, Any]:
        """As JSON values."""
        return {
            "received": self.received,
            "done": self.done,
            "key_frames": self.key_frames,
            "encoded_bytes": self.encoded_bytes,
            "dropped": dict(sorted(self.dropped.items())),
        }


T = TypeVar("T")


@dataclass(slots=True)
class _VideoStream(Generic[T]):
    """One topic.  ``codec`` belongs to the thread, all else to the lock."""

    name: str
    queue: deque[T] = field(default_factory=deque)
    counts: VideoCounts = field(default_factory=VideoCounts)
    said: set[str] = field(default_factory=set)
    has_turn: bool = False  # is in line, or at work
    waiting: bool = True  # decoder: for a key frame
    codec: Any = None


class _CodecThread(ABC, Generic[T]):
    """A thread that serves its streams in turn; see the module."""

    def __init__(self, name: str, on_note: OnNote) -> None:
        self._av = _import_av()
        self._on_note = on_note
        self._condition = threading.Condition()
        self._streams: dict[str, _VideoStream[T]] = {}
        self._turns: deque[_VideoStream[T]] = deque()  # streams with something in the queue
        self._refused = VideoCounts()  # of the streams beyond the bound
        self._refusal_said = False
        self._stopping = False
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """End the thread; what waits is dropped.  Again: nothing.  Nothing is handed on after this."""
        with self._condition:
            self._stopping = True
            for stream in self._streams.values():
                self._drop_waiting(stream, "stopped")
            self._turns.clear()
            self._condition.notify()
        self._thread.join()

    def counters(self) -> dict[str, Any]:
        """What became of every picture, by stream."""
        with self._condition:
            streams = {name: stream.counts.to_dict() for name, stream in sorted(self._streams.items())}
            return streams | ({"(others)": self._refused.to_dict()} if self._refused.received else {})

    def _enqueue(self, name: str, take: Callable[[_VideoStream[T]], Note | None]) -> None:
        """Let ``take`` put something into the queue of a stream, under the lock."""
        with self._condition:
            if self._stopping:
                return
            stream = self._streams.get(name)
            if stream is None and len(self._streams) < MAX_STREAMS:
                stream = self._streams[name] = _VideoStream(name)
            if stream is None:
                self._refused.received += 1
                self._refused.dropped["too_many_streams"] += 1
                note = None if self._refusal_said else _note(DROPPED, name, f"more than {MAX_STREAMS} video streams")
                self._refusal_said = True
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
            except Exception as error:  # a defect of ours must cost one picture, not the thread
                note = self._count_lost(stream, FAILED, "internal_error", f"{type(error).__name__}: {error}")
            if note:
                self._on_note(note)
            with self._condition:
                stream.has_turn = bool(stream.queue)
                if stream.has_turn:
                    self._turns.append(stream)

    @abstractmethod
    def _process(self, stream: _VideoStream[T], item: T) -> None:
        """Encode or decode one item."""

    def _count_lost(self, stream: _VideoStream[T], code: str, reason: str, text: str) -> Note | None:
        """Count an item that came to nothing."""
        with self._condition:
            stream.counts.dropped[reason] += 1
            return self._note_once(stream, code, text)

    @staticmethod
    def _note_once(stream: _VideoStream[T], code: str, text: str) -> Note | None:
        """The note, if this stream has not said the like.  The caller holds the lock."""
        if code in stream.said:
            return None
        stream.said.add(code)
        return _note(code, stream.name, f"{stream.name}: {text}")

    def _drop_waiting(self, stream: _VideoStream[T], reason: str) -> None:
        """Empty the queue of a stream.  The caller holds the lock, and does not leave it in line with nothing."""
        if stream.queue:
            stream.counts.dropped[reason] += len(stream.queue)
            stream.queue.clear()


# -- encoding ---------------------------------------------------------------------------------------------------


class VideoEncoder(_CodecThread[tuple[bytes, int]]):
    """sensor_msgs/Image → sensor_msgs/CompressedImage that holds one encoded frame, with the picture's header.

    Args:
        options: codec and its settings.
        on_frame: called in the encoder's thread with topic, type, CDR and source stamp, as the hub's ``ros``.
        on_note: takes what there is to say, from any thread.

    Raises Unavailable where PyAV is missing, or lacks the codec.
    """

    def __init__(self, options: VideoOptions, *, on_frame: OnFrame, on_note: OnNote) -> None:
        self._options = options
        self._on_frame = on_frame
        av = _import_av()
        try:
            av.codec.Codec(_ENCODERS[options.codec][0], "w")
        except ValueError as error:
            raise Unavailable(f"video codec {options.codec}: this PyAV has no {error}") from error
        super().__init__("igtl-video-encoder", on_note)

    def submit(self, topic: str, cdr: bytes, source_ns: int) -> None:
        """Encode a picture, soon.  At the bound the oldest one of the topic is dropped."""

        def take(stream: _VideoStream[tuple[bytes, int]]) -> Note | None:
            note = None
            if len(stream.queue) >= MAX_PICTURES:
                stream.queue.popleft()
                stream.counts.dropped["queue_full"] += 1
                note = self._note_once(stream, DROPPED, f"pictures come faster than {self._options.codec} is encoded")
            stream.queue.append((cdr, source_ns))
            return note

        self._enqueue(topic, take)

    def _process(self, stream: _VideoStream[tuple[bytes, int]], item: tuple[bytes, int]) -> None:
        cdr, source_ns = item
        image = Image.unpack(cdr)
        frame = _picture(self._av, image)
        stamp_ns = image.header.stamp_ns or source_ns
        if stream.codec is None or not stream.codec.fits(frame, stamp_ns):
            rate = stream.codec.rate if stream.codec else _FIRST_RATE
            stream.codec = None  # should the next line fail
            stream.codec = _OpenEncoder(self._av, self._options, frame, rate, stamp_ns)
        data = stream.codec.encode(frame)
        message = CompressedImage(image.header, self._options.codec, data).pack()
        with self._condition:
            stream.counts.done += 1
            stream.counts.key_frames += is_key_frame(self._options.codec, data)
            stream.counts.encoded_bytes += len(data)
        self._on_frame(stream.name, CompressedImage.TYPE, message, source_ns)


class _OpenEncoder:
    """An open encoder: for one size of pictures, one after the other.

    Attributes:
        rate: pictures a second, as far as their stamps have told.
    """

    def __init__(self, av: Any, options: VideoOptions, frame: Any, rate: int, stamp_ns: int) -> None:
        name, settings = _ENCODERS[options.codec]
        codec = av.CodecContext.create(name, "w")
        codec.width, codec.height, codec.pix_fmt = frame.width, frame.height, "yuv420p"
        codec.framerate, codec.time_base = Fraction(rate), Fraction(1, rate)
        codec.bit_rate, codec.gop_size, codec.max_b_frames = options.bit_rate, options.key_frame_interval, 0
        codec.thread_count = _THREADS
        codec.colorspace, codec.color_range = _BT601, _LIMITED
        codec.options = settings | dict.fromkeys(("minrate", "maxrate", "bufsize"), str(options.bit_rate))
        codec.open()
        self.rate = rate
        self._codec = codec
        self._interval = options.key_frame_interval
        self._reformatter = av.video.reformatter.VideoReformatter()
        self._opened_for = rate
        self._count = 0
        self._measured_from = (0, stamp_ns)

    def fits(self, frame: Any, stamp_ns: int) -> bool:
        """Whether this encoder is good for the picture: of its size and, told at key frames, of its pace."""
        if (frame.width, frame.height) != (self._codec.width, self._codec.height):
            return False
        first, since_ns = self._measured_from
        pictures, passed_ns = self._count - first, stamp_ns - since_ns
        if pictures < _RATE_PICTURES or self._count % self._interval:
            return True
        self._measured_from = (self._count, stamp_ns)
        if passed_ns <= 0:  # no stamps, or a bag that began again
            return True
        self.rate = min(max(round(pictures * 1e9 / passed_ns), 1), _MAX_RATE)
        # a new encoder begins with a key frame, which is due now anyway
        return abs(self.rate - self._opened_for) * 4 <= self._opened_for

    def encode(self, frame: Any) -> bytes:
        """The frame of one picture."""
        planes = self._reformatter.reformat(
            frame, format="yuv420p", dst_colorspace="ITU601", src_color_range="JPEG", dst_color_range="MPEG"
        )
        planes.pts, planes.time_base = self._count, self._codec.time_base
        self._count += 1
        packets = self._codec.encode(planes)
        return b"".join(bytes(packet) for packet in packets)


def _picture(av: Any, image: Image) -> Any:
    """The picture as a frame of even size, the last column or row repeated.  Raises ConversionError."""
    if image.encoding not in _PIXELS:
        raise ConversionError(
            f"sensor_msgs/Image: found encoding {image.encoding!r}, expected one of {', '.join(_PIXELS)}"
        )
    name, pixel = _PIXELS[image.encoding]
    width, height, row = image.width, image.height, image.width * pixel
    size = memoryview(image.data).nbytes
    if not 0 < width * height <= MAX_PIXELS:
        raise ConversionError(f"sensor_msgs/Image: found {width} x {height}, expected 1 to {MAX_PIXELS} pixels")
    if image.step < row or size < image.step * (height - 1) + row:
        raise ConversionError(
            f"sensor_msgs/Image: found {size} bytes with step {image.step}, expected {height} rows of {row} bytes"
        )
    pixels = np.ndarray((height, width, pixel), np.uint8, image.data, 0, (image.step, pixel, 1))
    if image.encoding == "mono16":
        pixels = pixels[:, :, :1] if image.is_bigendian else pixels[:, :, 1:]  # its upper 8 bits
    frame = av.VideoFrame(width + width % 2, height + height % 2, name)
    plane = frame.planes[0]
    # FFmpeg's own memory, with the margins that its fast loops read over
    lines = np.frombuffer(plane, np.uint8).reshape(-1, plane.line_size)[: frame.height]
    room = lines[:, : frame.width * pixels.shape[2]].reshape(frame.height, frame.width, -1)
    room[:height, :width] = pixels
    room[:height, width:] = pixels[:, -1:]
    room[height:] = room[height - 1]
    return frame


# -- decoding ---------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class _EncodedFrame:
    """An encoded frame that waits."""

    header: Header
    codec: str
    data: Buffer
    is_key: bool


class VideoDecoder(_CodecThread[_EncodedFrame]):
    """sensor_msgs/CompressedImage that holds one encoded frame → sensor_msgs/Image, rgb8 (mono8 of grey video).

    Args:
        on_image: called in the decoder's thread with the name of the stream and CDR.
        on_note: takes what there is to say, from any thread.

    Raises Unavailable where PyAV is missing.
    """

    def __init__(self, *, on_image: OnImage, on_note: OnNote) -> None:
        self._on_image = on_image
        super().__init__("igtl-video-decoder", on_note)

    def submit(self, name: str, cdr: Buffer) -> None:
        """Decode a frame, soon.  At the bound everything is dropped up to the next key frame.

        Pictures of other formats (jpeg, png) are none of ours and do not count.  Raises ConversionError for CDR
        that is no CompressedImage.
        """
        message = CompressedImage.unpack(cdr)
        if message.format not in _DECODERS:
            return
        key = is_key_frame(message.format, message.data)
        frame = _EncodedFrame(message.header, message.format, message.data, key)
        self._enqueue(name, lambda stream: self._take(stream, frame))

    def _take(self, stream: _VideoStream[_EncodedFrame], frame: _EncodedFrame) -> Note | None:
        size = memoryview(frame.data).nbytes
        waiting_bytes = sum(memoryview(other.data).nbytes for other in stream.queue)
        stream.counts.encoded_bytes += size
        stream.counts.key_frames += frame.is_key
        note = None
        # one frame alone always fits
        if len(stream.queue) >= MAX_FRAMES or (stream.queue and waiting_bytes + size > MAX_FRAME_BYTES):
            note = self._note_once(stream, DROPPED, f"{frame.codec} frames come faster than they are decoded")
            if frame.is_key:  # all that waits is older than the picture that it stands for
                self._drop_waiting(stream, "queue_full")
            elif not stream.waiting:
                stream.counts.dropped["queue_full"] += 1
                stream.waiting = True
                return note
        if stream.waiting and not frame.is_key:
            stream.counts.dropped["no_key_frame"] += 1
            return note
        stream.waiting = False
        stream.queue.append(frame)
        return note

    def _process(self, stream: _VideoStream[_EncodedFrame], item: _EncodedFrame) -> None:
        try:
            if stream.codec is None or stream.codec.name != item.codec:
                stream.codec = None  # should the next line fail
                stream.codec = _OpenDecoder(self._av, item.codec)
            images = stream.codec.decode(item)
        except Exception:
            stream.codec = None
            with self._condition:
                while stream.queue and not stream.queue[0].is_key:
                    stream.queue.popleft()
                    stream.counts.dropped["no_key_frame"] += 1
                stream.waiting = not stream.queue
            raise
        with self._condition:
            stream.counts.done += len(images)
            if not images:  # a codec that looks ahead gives its first picture with a later frame
                stream.counts.dropped["no_picture"] += 1
        for image in images:
            self._on_image(stream.name, image.pack())


class _OpenDecoder:
    """An open decoder.

    Attributes:
        name: of the codec.
    """

    def __init__(self, av: Any, name: str) -> None:
        self.name = name
        self._av = av
        self._codec = av.CodecContext.create(_DECODERS[name], "r")
        self._codec.thread_type, self._codec.thread_count = "SLICE", _THREADS
        self._codec.flags |= av.codec.context.Flags.low_delay
        # not to paint over what is missing, but to say so
        self._codec.options = {"max_pixels": str(MAX_PIXELS), "err_detect": "explode", "ec": "0"}
        self._headers: dict[int, Header] = {}  # of frames that no picture has come of yet
        self._count = 0

    def decode(self, frame: _EncodedFrame) -> list[Image]:
        """The pictures that this frame completes: one, mostly.  Raises FFmpegError."""
        data = bytes(frame.data)
        if not data:  # would mean the end of the stream to FFmpeg
            raise self._av.error.InvalidDataError(0, "the frame is empty")
        self._count += 1
        self._headers[self._count] = frame.header
        packet = self._av.Packet(data)
        packet.pts = self._count
        images = []
        for picture in self._codec.decode(packet):
            if picture.is_corrupt:
                raise self._av.error.InvalidDataError(0, "a part of the picture is missing")
            header = self._headers.pop(picture.pts, frame.header)
            self._headers = {pts: waiting for pts, waiting in self._headers.items() if pts > picture.pts}
            images.append(_image(header, picture))
        return images


def _image(header: Header, picture: Any) -> Image:
    grey = picture.format.name.startswith("gray")
    pixels = np.ascontiguousarray(picture.to_ndarray(format="gray" if grey else "rgb24"))
    height, width = pixels.shape[:2]
    step = pixels.nbytes // height
    return Image(header, height, width, "mono8" if grey else "rgb8", 0, step, pixels.reshape(-1).data)


def _note(code: str, stream: str, text: str) -> Note:
    return Note(Level.WARN, code, text, stream)


def _import_av() -> Any:
    try:
        import av
        import av.video.reformatter
    except ImportError as error:
        raise Unavailable(missing("av", error)) from error
    return av
