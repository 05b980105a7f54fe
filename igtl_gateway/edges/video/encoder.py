"""Raw pictures to encoded frames."""

from __future__ import annotations

from collections.abc import Callable
from fractions import Fraction
from typing import Any

import numpy as np

from igtl_gateway.base.errors import ConversionError, Unavailable
from igtl_gateway.base.quantities import counted
from igtl_gateway.convert.bitstream import is_key_frame
from igtl_gateway.convert.common_msgs import CompressedImage
from igtl_gateway.convert.rosmsg import Image
from igtl_gateway.edges.video.options import ENCODERS, VideoOptions
from igtl_gateway.edges.video.worker import (
    CHANGED,
    DROPPED,
    MAX_PIXELS,
    NO_ALPHA,
    PADDED,
    THREADS,
    UPPER_BITS,
    CodecThread,
    OnNote,
    VideoStream,
    import_av,
)
from igtl_gateway.gateway.log.note import Note

#: Pictures of one topic that wait for the encoder: 100 ms at 30 Hz.
MAX_PICTURES = 3

#: The encoder spends the bit rate divided by the picture rate on a picture, and needs that rate when it is opened: this
#: one, until the stamps of about a second have shown the true one.
_FIRST_RATE = 30
_MAX_RATE = 240
_RATE_PICTURES = 15
_BT601, _LIMITED = 6, 1  # AVCOL_SPC_SMPTE170M, AVCOL_RANGE_MPEG: written into the stream for players

#: ROS encoding → FFmpeg's pixel format, bytes of a pixel.
_PIXELS = {"mono8": ("gray", 1), "mono16": ("gray", 2), "rgb8": ("rgb24", 3), "bgr8": ("bgr24", 3),
           "rgba8": ("rgba", 4), "bgra8": ("bgra", 4)}  # fmt: skip

OnFrame = Callable[[str, str, bytes, int], None]


class VideoEncoder(CodecThread[tuple[bytes, int]]):
    """sensor_msgs/Image → sensor_msgs/CompressedImage that holds one encoded frame, with the picture's header.

    Args:
        options: codec and its settings.
        on_frame: called in the encoder's thread with topic, type, CDR and source stamp, as the hub's ``ros``.
        on_note: called with notes, from any thread.

    Raises Unavailable where PyAV is missing, or lacks the codec.
    """

    def __init__(self, options: VideoOptions, *, on_frame: OnFrame, on_note: OnNote) -> None:
        self._options = options
        self._on_frame = on_frame
        av = import_av()
        try:
            av.codec.Codec(ENCODERS[options.codec][0], "w")
        except ValueError as error:
            raise Unavailable(f"video codec {options.codec}: this PyAV has no {error}") from error
        super().__init__("igtl-video-encoder", on_note)

    def submit(self, topic: str, cdr: bytes, source_ns: int) -> None:
        """Queue a picture for encoding.  At the bound the oldest one of the topic is dropped."""

        def take(stream: VideoStream[tuple[bytes, int]]) -> Note | None:
            note = None
            if len(stream.queue) >= MAX_PICTURES:
                stream.queue.popleft()
                stream.counts.dropped["queue_full"] += 1
                note = self._note_once(stream, DROPPED, f"pictures come faster than {self._options.codec} is encoded")
            stream.queue.append((cdr, source_ns))
            return note

        self._enqueue(topic, take)

    def _process(self, stream: VideoStream[tuple[bytes, int]], item: tuple[bytes, int]) -> None:
        cdr, source_ns = item
        image = Image.unpack(cdr)
        frame = _picture(self._av, image)
        stamp_ns = image.header.stamp_ns or source_ns
        if stream.codec is None or not stream.codec.fits(frame, stamp_ns):
            rate = stream.codec.rate if stream.codec else _FIRST_RATE
            stream.codec = None  # in case the next line fails
            stream.codec = _OpenEncoder(self._av, self._options, frame, rate, stamp_ns)
        data = stream.codec.encode(frame)
        message = CompressedImage(image.header, self._options.codec, data).pack()
        with self._condition:
            stream.counts.done += 1
            stream.counts.key_frames += is_key_frame(self._options.codec, data)
            stream.counts.encoded_bytes += len(data)
        self._tell_changes(stream, image)
        self._on_frame(stream.name, CompressedImage.TYPE, message, source_ns)

    def _tell_changes(self, stream: VideoStream[tuple[bytes, int]], image: Image) -> None:
        """Count what the picture has lost besides the losses of the codec; note it once."""
        width, height = image.width, image.height
        changes = {}
        if image.encoding == "mono16":
            changes[UPPER_BITS] = "mono16 is encoded by the upper 8 of its 16 bits"
        if image.encoding in ("rgba8", "bgra8"):
            changes[NO_ALPHA] = f"{image.encoding} is encoded without its alpha"
        if width % 2 or height % 2:
            size = f"{width + width % 2} x {height + height % 2}"
            changes[PADDED] = f"{width} x {height} is encoded as {size}: the last column or row is repeated"
        if not changes:
            return
        with self._condition:
            stream.counts.changed.update(changes.keys())
            note = self._note_once(stream, CHANGED, "; ".join(changes.values()))
        if note:
            self._on_note(note)


class _OpenEncoder:
    """An open encoder for pictures of one size.

    Attributes:
        rate: pictures per second, from their stamps.
    """

    def __init__(self, av: Any, options: VideoOptions, frame: Any, rate: int, stamp_ns: int) -> None:
        name, settings = ENCODERS[options.codec]
        codec = av.CodecContext.create(name, "w")
        codec.width, codec.height, codec.pix_fmt = frame.width, frame.height, "yuv420p"
        codec.framerate, codec.time_base = Fraction(rate), Fraction(1, rate)
        codec.bit_rate, codec.gop_size, codec.max_b_frames = options.bit_rate, options.key_frame_interval, 0
        codec.thread_count = THREADS
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
        """Whether this encoder suits the picture: its size and, checked at key frames, its rate."""
        if (frame.width, frame.height) != (self._codec.width, self._codec.height):
            return False
        first, since_ns = self._measured_from
        pictures, passed_ns = self._count - first, stamp_ns - since_ns
        if pictures < _RATE_PICTURES or self._count % self._interval:
            return True
        self._measured_from = (self._count, stamp_ns)
        if passed_ns <= 0:  # no stamps, or a bag that restarted
            return True
        self.rate = min(max(round(pictures * 1e9 / passed_ns), 1), _MAX_RATE)
        # a new encoder begins with a key frame, which is due now anyway
        return abs(self.rate - self._opened_for) * 4 <= self._opened_for

    def encode(self, frame: Any) -> bytes:
        """Return the frame of one picture."""
        planes = self._reformatter.reformat(
            frame, format="yuv420p", dst_colorspace="ITU601", src_color_range="JPEG", dst_color_range="MPEG"
        )
        planes.pts, planes.time_base = self._count, self._codec.time_base
        self._count += 1
        packets = self._codec.encode(planes)
        return b"".join(bytes(packet) for packet in packets)


def _picture(av: Any, image: Image) -> Any:
    """Return the picture as a frame of even size, the last column or row repeated.  Raises ConversionError."""
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
            f"sensor_msgs/Image: found {counted(size, 'byte')} with step {image.step}, expected "
            f"{counted(height, 'row')} of {counted(row, 'byte')}"
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
