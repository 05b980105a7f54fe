"""Encoded frames to raw pictures."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from igtl_gateway.base.buffers import Buffer
from igtl_gateway.convert.bitstream import is_key_frame
from igtl_gateway.convert.common_msgs import CompressedImage
from igtl_gateway.convert.rosmsg import Header, Image
from igtl_gateway.edges.video.worker import DROPPED, MAX_PIXELS, THREADS, CodecThread, OnNote, VideoStream
from igtl_gateway.gateway.log.note import Note

#: Codecs to decode: name in CompressedImage.format → FFmpeg's.
_DECODERS = {"h264": "h264", "h265": "hevc", "vp9": "vp9", "av1": "libdav1d"}


#: Frames of one stream that wait for the decoder: a second at 30 Hz …
MAX_FRAMES = 30
#: … and their bytes.
MAX_FRAME_BYTES = 32 << 20

OnImage = Callable[[str, bytes], None]


@dataclass(frozen=True, slots=True)
class _EncodedFrame:
    """An encoded frame that waits."""

    header: Header
    codec: str
    data: Buffer
    is_key: bool


class VideoDecoder(CodecThread[_EncodedFrame]):
    """sensor_msgs/CompressedImage that holds one encoded frame → sensor_msgs/Image, rgb8 (mono8 of grey video).

    Args:
        on_image: called in the decoder's thread with the name of the stream and CDR.
        on_note: called with notes, from any thread.

    Raises Unavailable where PyAV is missing.
    """

    def __init__(self, *, on_image: OnImage, on_note: OnNote) -> None:
        self._on_image = on_image
        super().__init__("igtl-video-decoder", on_note)

    def submit(self, name: str, cdr: Buffer) -> None:
        """Queue a frame for decoding.  At the bound everything is dropped up to the next key frame.

        Pictures of other formats (jpeg, png) are ignored and do not count.  Raises ConversionError for CDR that is not
        a CompressedImage.
        """
        message = CompressedImage.unpack(cdr)
        if message.format not in _DECODERS:
            return
        key = is_key_frame(message.format, message.data)
        frame = _EncodedFrame(message.header, message.format, message.data, key)
        self._enqueue(name, lambda stream: self._take(stream, frame))

    def _take(self, stream: VideoStream[_EncodedFrame], frame: _EncodedFrame) -> Note | None:
        size = memoryview(frame.data).nbytes
        waiting_bytes = sum(memoryview(other.data).nbytes for other in stream.queue)
        stream.counts.encoded_bytes += size
        stream.counts.key_frames += frame.is_key
        note = None
        # one frame alone always fits
        if len(stream.queue) >= MAX_FRAMES or (stream.queue and waiting_bytes + size > MAX_FRAME_BYTES):
            note = self._note_once(stream, DROPPED, f"{frame.codec} frames come faster than they are decoded")
            if frame.is_key:  # everything in the queue is older than its picture
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

    def _process(self, stream: VideoStream[_EncodedFrame], item: _EncodedFrame) -> None:
        try:
            if stream.codec is None or stream.codec.name != item.codec:
                stream.codec = None  # in case the next line fails
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
        self._codec.thread_type, self._codec.thread_count = "SLICE", THREADS
        self._codec.flags |= av.codec.context.Flags.low_delay
        # report missing parts instead of painting over them
        self._codec.options = {"max_pixels": str(MAX_PIXELS), "err_detect": "explode", "ec": "0"}
        self._headers: dict[int, Header] = {}  # of frames without a picture so far
        self._count = 0

    def decode(self, frame: _EncodedFrame) -> list[Image]:
        """Return the pictures that this frame completes: one, as a rule.  Raises FFmpegError."""
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
