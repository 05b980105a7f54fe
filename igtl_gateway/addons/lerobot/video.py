"""Videos of a data set: constant frame rate, frame i at i / fps, a key frame at every second frame.

Those of depth are lossless: their codes of 12 bits are the depth.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from fractions import Fraction
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, BinaryIO

import numpy as np
import numpy.typing as npt

from igtl_gateway.addon import DamagedRecording, Unavailable
from igtl_gateway.addon.messages import MAX_PIXELS, import_av
from igtl_gateway.addon.messages import VIDEO_THREADS as THREADS
from igtl_gateway.addon.untrusted import Deadline, deadline_of, open_file
from igtl_gateway.addon.writing import empty_file, make_folder
from igtl_gateway.addons.lerobot import depth
from igtl_gateway.addons.lerobot.mp4_samples import check_samples

Pixels = npt.NDArray[Any]

KEY_FRAME_INTERVAL = 2
PIXEL_FORMAT, RGB = "yuv420p", "rgb24"
#: x265 takes its options in one string.
_LOSSLESS = (
    f"lossless=1:keyint={KEY_FRAME_INTERVAL}:min-keyint={KEY_FRAME_INTERVAL}:scenecut=0:bframes=0:"
    f"pools=none:frame-threads=1:info=0:log-level=none"
)
#: Codec → encoder, its options, its pixels, and those that it is given.  B-frames would delay the first picture.  The
#: macroblock tree of x264 makes other bytes of the same small pictures from one time to the next; a key frame at every
#: second one leaves it nothing to do.
_ENCODERS: dict[str, tuple[str, dict[str, str], str, str]] = {
    "h264": ("libx264", {"preset": "veryfast", "crf": "18", "bf": "0", "mbtree": "0"}, PIXEL_FORMAT, RGB),
    "av1": ("libsvtav1", {"preset": "10", "crf": "30"}, PIXEL_FORMAT, RGB),
    depth.CODEC: ("libx265", {"preset": "veryfast", "x265-params": _LOSSLESS}, depth.PIXEL_FORMAT, depth.PIXEL_FORMAT),
}
_BT601, _LIMITED = 6, 1  # AVCOL_SPC_SMPTE170M, AVCOL_RANGE_MPEG


class VideoFile:
    """An mp4 file that is being written.

    Args:
        path: new file.
        size: rows and columns, both even.
        fps: frames per second.
        codec: ``h264``, ``av1``, or ``hevc`` for depth.

    Raises Unavailable where PyAV is missing or lacks the codec; OSError.
    """

    def __init__(self, path: Path, size: tuple[int, int], fps: int, codec: str) -> None:
        self._av = import_av()
        encoder, options, pixels, self._given = _ENCODERS[codec]
        if encoder not in self._av.codecs_available:
            raise Unavailable(f"video codec {codec}: this PyAV has no {encoder}")
        os.environ.setdefault("SVT_LOG", "1")  # libsvtav1 writes its settings to stderr: errors only
        make_folder(path.parent, parents=True, exist_ok=True)
        self.path, self.count = path, 0
        self._file = self._av.open(str(empty_file(path)), "w", format="mp4")
        self._stream = self._file.add_stream(encoder, rate=fps, options=options)
        self._stream.height, self._stream.width = size
        self._stream.pix_fmt = pixels
        self._stream.codec_context.time_base = Fraction(1, fps)
        self._stream.codec_context.gop_size = KEY_FRAME_INTERVAL
        self._stream.codec_context.thread_count = THREADS
        self._stream.codec_context.colorspace, self._stream.codec_context.color_range = _BT601, _LIMITED

    @property
    def size(self) -> int:
        """Bytes so far: the file exists from its first encoded frame on."""
        return self.path.stat().st_size if self.path.exists() else 0

    def add(self, picture: Pixels) -> None:
        """Add a picture: (rows, columns, 3) RGB, or of depth (rows, columns, 1) codes."""
        plane = picture if self._given == RGB else picture[:, :, 0]
        frame = self._av.VideoFrame.from_ndarray(plane, format=self._given)
        frame.pts, frame.time_base = self.count, self._stream.codec_context.time_base
        for packet in self._stream.encode(frame):
            self._file.mux(packet)
        self.count += 1

    def close(self) -> None:
        """Write the end of the file."""
        for packet in self._stream.encode(None):
            self._file.mux(packet)
        self._file.close()


def read_video(path: Path, size: tuple[int, int] | None = None, form: str = RGB) -> Iterator[tuple[float, Pixels]]:
    """Yield time (s) and picture of the frames of a file: (rows, columns, 3), or of depth (rows, columns, 1) codes.

    Args:
        path: an mp4 file.  Nothing else is opened: other formats may name further files.
        size: rows and columns of its pictures, if others are refused.
        form: ``rgb24``, or ``gray12le`` for codes of depth.

    Raises:
        UnsupportedRecording: it is missing, or not an ordinary file.
        DamagedRecording: it is not a video of that size, or it cannot be decoded.
        LimitExceeded: decoding it takes longer than a file of its size may take.
    """
    with opened_video(path) as (file, deadline):
        codec = file.streams.video[0].codec_context
        _check_size(path, (codec.height, codec.width), size)
        for packet in file.demux(video=0):
            frames = packet.decode()
            deadline.check(str(path))
            for frame in frames:
                _check_size(path, (frame.height, frame.width), size)
                picture = pixels_of(path, frame, form)
                with deadline.paused():
                    yield float(frame.time or 0.0), picture


@contextmanager
def opened_video(path: Path) -> Iterator[tuple[Any, Deadline]]:
    """Context manager: an mp4 file with a video, open in PyAV, and the deadline for reading it.

    Raises as ``read_video``, also for the errors of PyAV inside of it.
    """
    av = import_av()
    with open_file(path) as stream:
        length = os.fstat(stream.fileno()).st_size
        check_samples(stream, length, str(path))
        deadline, source = deadline_of(path), _Source(stream)
        try:
            with av.open(source, format="mp4") as file:
                if not file.streams.video:
                    raise DamagedRecording(f"{path}: found no video, expected one")
                codec = file.streams.video[0].codec_context
                if codec is None:
                    raise DamagedRecording(f"{path}: found a video of an unknown codec, expected one of FFmpeg")
                codec.options = {"max_pixels": str(MAX_PIXELS), "err_detect": "explode"}
                yield file, deadline
        except (av.FFmpegError, OSError, ValueError, OverflowError, MemoryError) as error:
            raise DamagedRecording(f"{path}: cannot be decoded: {_reason(source.error or error)}") from None


def pixels_of(path: Path, frame: Any, form: str = RGB) -> Pixels:
    """Return the picture of a frame of PyAV, as ``read_video`` does.  Raises DamagedRecording."""
    if frame.is_corrupt:
        raise DamagedRecording(f"{path}: cannot be decoded: found a damaged frame")
    if form not in (RGB, frame.format.name):
        raise DamagedRecording(f"{path}: found pixels of {frame.format.name}, expected {form}")
    picture: Pixels = frame.to_ndarray(format=form)
    return picture if form == RGB else picture[:, :, np.newaxis]


class _Source:
    """What FFmpeg reads: it would print a traceback of an error of the system, so the file ends there.

    Attributes:
        error: the error.
    """

    def __init__(self, stream: BinaryIO) -> None:
        self._stream = stream
        self.error: OSError | None = None
        self.seek, self.tell = stream.seek, stream.tell

    def read(self, size: int) -> bytes:
        try:
            return self._stream.read(size)
        except OSError as error:
            self.error = error
            return b""


def _check_size(path: Path, found: tuple[int, int], expected: tuple[int, int] | None) -> None:
    if expected is not None and found != expected:
        raise DamagedRecording(f"{path}: found {found[1]} × {found[0]} pixels, expected {expected[1]} × {expected[0]}")


def _reason(error: BaseException) -> str:
    """The reason of the system; messages of FFmpeg end with the name that it has for an open file."""
    return (error.strerror if isinstance(error, OSError) else "") or str(error).partition("\n")[0]


def coded(pictures: Iterable[Pixels], size: tuple[int, int], fps: int, codec: str) -> Iterator[Pixels]:
    """Yield pictures as a video of a data set shows them, with the loss of its codec.  Raises as VideoFile."""
    with TemporaryDirectory(prefix="igtl-gateway-") as folder:
        video = VideoFile(Path(folder) / "coded.mp4", size, fps, codec)
        for picture in pictures:
            video.add(picture)
        video.close()
        yield from (picture for _, picture in read_video(video.path, size))


def video_info(size: tuple[int, int], fps: int, codec: str) -> dict[str, Any]:
    """Return the description of a video for info.json."""
    return {
        "video.height": size[0],
        "video.width": size[1],
        "video.codec": codec,
        "video.pix_fmt": PIXEL_FORMAT,
        "video.is_depth_map": False,
        "video.fps": fps,
        "video.channels": 3,
        "has_audio": False,
    }
