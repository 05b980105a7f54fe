"""The pictures of a stream as RGB of 8 bits, or as codes of depth, of one size with even width and height.

Every form of a picture gives the pixels that it stands for, or is refused by name; a window applies to all of them.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from typing import Any

import numpy as np
import numpy.typing as npt

from igtl_gateway.addon import ConfigError, ConversionError, GatewayError
from igtl_gateway.addon.igtl import Video
from igtl_gateway.addon.messages import (
    JPEG,
    MAX_PIXELS,
    PNG,
    bayer_pattern,
    coding_of,
    decoded_still,
    demosaiced,
    depths,
    import_av,
    is_key_frame,
    pixel_layout,
)
from igtl_gateway.addon.reading import MessageBlock, Stream
from igtl_gateway.addon.ros import CompressedImage, CompressedVideo, Volume
from igtl_gateway.addon.ros import Image as RosImage
from igtl_gateway.addon.streams import Images, find_row
from igtl_gateway.addon.terminal import counted
from igtl_gateway.addons.lerobot.depth import LEAST_SIZE, codes_of, depth_stats, millimetres, outside
from igtl_gateway.addons.lerobot.stats import PictureStats

Pixels = npt.NDArray[Any]
Array = npt.NDArray[Any]

_PLAIN = frozenset({"IMAGE", RosImage.TYPE, Volume.TYPE})
_CODED = frozenset({"VIDEO", CompressedImage.TYPE, CompressedVideo.TYPE})
#: Codecs of VIDEO → names of CompressedImage.
_FOUR_LETTERS = {"H264": "h264", "X265": "h265", "O265": "h265", "VP90": "vp9", "AV10": "av1"}
_VIDEO_DECODERS = {"h264": "h264", "h265": "hevc", "vp9": "vp9", "av1": "libdav1d"}


def has_pictures(stream: Stream) -> bool:
    """Return whether the messages of a stream are pictures."""
    return stream.type in _PLAIN or stream.type in _CODED


def first_pixels(stream: Stream) -> Array:
    """Return the pixels of the first picture as they are.  Raises ConfigError if a stream has none."""
    if stream.type in _PLAIN:
        return stream.images()[0].plane
    coded = _Coded(stream)
    found = next((each for each in map(coded.read, range(len(coded))) if each is not None), None)
    if found is None:
        raise ConfigError(f"{stream.key}: found no picture that can be decoded")
    return found


class Pictures:
    """The pictures of a stream; each one is decoded when it is used.

    Args:
        stream: IMAGE, VIDEO, sensor_msgs/Image, CompressedImage, CompressedVideo, or Volume with one slice.
        window: (low, high) values that become black and white; needed for more than 8 bits.  Depth that
            compressed_depth_image_transport has quantised is in metres again.
        depth_mm: (low, high) depth of the first and the last code, for pictures of one component.

    Attributes:
        usable: indices of the messages that have a picture.
        size: rows and columns of the recorded pictures.
        pixels, outside: number of pixels, and of those whose depth is unknown or outside of ``depth_mm``.

    Raises ConfigError for other types, for a size that changes, for encodings that are not read, and for more than
    8 bits without a window.
    """

    def __init__(self, stream: Stream, window: tuple[float, ...] = (), depth_mm: tuple[float, ...] = ()) -> None:
        if not has_pictures(stream):
            raise ConfigError(f"found type {stream.type} in {stream.key}, expected pictures")
        self._window, self._depth_mm, self._key = window, depth_mm, stream.key
        self._read: Callable[[int], Pixels | None]
        if stream.type in _PLAIN:
            images = stream.images()
            self._read, count = lambda index: self._plain(images, index), len(images)
        else:
            coded = _Coded(stream)
            self._read, count = lambda index: self._coded(coded, index), len(coded)
        self.size = (0, 0)
        self.pixels = self.outside = 0
        self.usable = np.array([index for index in range(count) if self._fits(index)], np.int64)

    def no_stats(self) -> PictureStats:
        """Return statistics of no picture, to which those of the stream can be added."""
        if not self._depth_mm:
            return PictureStats()
        return depth_stats(self._depth_mm)

    def rgb(self, index: int) -> Pixels:
        """Return a usable picture, with rows and columns repeated to even numbers.

        Returns (rows, columns, 3) uint8; of depth (rows, columns, 1) uint16, codes.
        """
        picture = self._read(index)
        if picture is None:
            raise GatewayError(f"{self._key}: found no picture in message {index}, expected one")
        if self._depth_mm:
            picture = codes_of(picture, self._depth_mm)
        rows, columns = picture.shape[:2]
        return np.pad(picture, ((0, rows % 2), (0, columns % 2), (0, 0)), "edge")

    @property
    def padded(self) -> tuple[int, int]:
        """Rows and columns of the video."""
        return self.size[0] + self.size[0] % 2, self.size[1] + self.size[1] % 2

    def _fits(self, index: int) -> bool:
        picture = self._read(index)
        if picture is None:
            return False
        size = picture.shape[0], picture.shape[1]
        if self.size == (0, 0):
            self.size = size
        if size != self.size:
            raise ConfigError(f"{self._key}: found a picture of {size[1]} × {size[0]} pixels in message {index}, "
                              f"expected {self.size[1]} × {self.size[0]} as before")  # fmt: skip
        if self._depth_mm:
            if min(size) < LEAST_SIZE:
                raise ConfigError(f"{self._key}: found depth of {size[1]} × {size[0]} pixels, expected at least "
                                  f"{LEAST_SIZE} × {LEAST_SIZE}")  # fmt: skip
            self.pixels += picture.size
            self.outside += outside(picture, self._depth_mm)
        return True

    def _plain(self, images: Images, index: int) -> Pixels | None:
        """A picture, or None for a damaged or an empty message."""
        try:
            view = images[index]
            plane = view.plane
        except ConfigError:
            raise
        except ConversionError as error:  # an encoding that is not read
            raise ConfigError(f"{self._key}: {error}") from None
        except GatewayError:
            return None
        if not plane.size:
            return None
        pattern = bayer_pattern(view.encoding)
        if self._depth_mm and not pattern:
            return self._depth(plane)
        if pattern:
            return self._eight_bits(demosaiced(np.ascontiguousarray(plane), pattern), False)
        return self._eight_bits(plane, bool(view.encoding) and pixel_layout(view.encoding)[2])

    def _coded(self, coded: _Coded, index: int) -> Pixels | None:
        try:
            picture = coded.read(index)
        except ConversionError as error:
            raise ConfigError(f"{self._key}: message {index}: {error}") from None
        if picture is None:
            return None
        return self._depth(picture) if self._depth_mm else self._eight_bits(picture, False)

    def _depth(self, plane: Array) -> Array:
        """Depth in mm, (rows, columns, 1)."""
        if plane.ndim == 3 and plane.shape[2] != 1:
            raise ConfigError(f"{self._key}: found {counted(plane.shape[2], 'component')}, expected 1 for depth_mm")
        return millimetres(plane if plane.ndim == 3 else plane[:, :, np.newaxis])

    def _eight_bits(self, plane: Array, is_blue_first: bool) -> Pixels:
        if self._depth_mm:
            raise ConfigError(f"{self._key}: found colours, expected depth for depth_mm")
        if plane.ndim == 2:
            plane = plane[:, :, np.newaxis]
        if plane.shape[2] not in (1, 3, 4):
            raise ConfigError(f"{self._key}: found {counted(plane.shape[2], 'component')}, expected 1, 3 or 4")
        if self._window:
            low, high = self._window
            with np.errstate(invalid="ignore"):
                scaled = np.clip((plane.astype(np.float64) - low) / (high - low), 0, 1)
            plane = np.round(np.nan_to_num(scaled) * 255).astype(np.uint8)
        elif plane.dtype != np.uint8:
            raise ConfigError(f"{self._key}: found pixels of {plane.dtype.newbyteorder('=')}, expected uint8, or "
                              "window = [low, high] in the recipe")  # fmt: skip
        if plane.shape[2] == 1:
            return np.repeat(plane, 3, axis=2)
        colours = plane[:, :, :3]
        return np.ascontiguousarray(colours[:, :, ::-1] if is_blue_first else colours)


class _Coded:
    """Encoded pictures, each alone (JPEG, PNG) or with those before it (video)."""

    def __init__(self, stream: Stream) -> None:
        self._av = import_av()
        self._type, self._acceptance = stream.type, stream.acceptance
        self._blocks: list[MessageBlock] = list(stream.blocks())
        self._ends = np.cumsum([len(block) for block in self._blocks], dtype=np.int64)
        self._codec: Any = None
        self._next = 0
        self._last: tuple[int, Array | None] = (-1, None)

    def __len__(self) -> int:
        return int(self._ends[-1]) if len(self._ends) else 0

    def read(self, index: int) -> Array | None:
        """Return a picture (rows, columns) or (rows, columns, 3), or None if the message gives none.

        Raises ConversionError for a format that is not read.
        """
        if self._last[0] == index:
            return self._last[1]
        codec, data = self._frame(index)
        picture: Array | None
        if not data:
            picture = None
        elif codec in _VIDEO_DECODERS:
            if index < self._next:
                self._codec, self._next = None, 0
            picture = None
            for each in range(self._next, index + 1):
                picture = self._decode_next(each)
            self._next = index + 1
        else:
            picture = self._alone(codec, data)
        self._last = (index, picture)
        return picture

    def _frame(self, index: int) -> tuple[str, bytes]:
        """Codec and data of a message; nothing if it is damaged."""
        block, row = find_row(self._blocks, self._ends, index)
        try:
            payload = block.payload(row)
            if self._type == CompressedImage.TYPE:
                image = CompressedImage.unpack(payload)
                return _form(image), bytes(image.data)
            if self._type == CompressedVideo.TYPE:
                video = CompressedVideo.unpack(payload)
                return video.format, bytes(video.data)
            content = self._acceptance.message(payload).content
        except GatewayError:
            return "", b""
        if not isinstance(content, Video):
            return "", b""
        return _FOUR_LETTERS.get(content.codec, content.codec), bytes(content.data)

    def _decode_next(self, index: int) -> Pixels | None:
        codec, data = self._frame(index)
        if codec not in _VIDEO_DECODERS or not data:
            return None
        if self._codec is None:
            if not is_key_frame(codec, data):
                return None
            self._codec = self._open(_VIDEO_DECODERS[codec])
            self._codec.flags |= self._av.codec.context.Flags.low_delay
        packet = self._av.Packet(data)
        packet.pts = index
        try:
            found = [each for each in self._codec.decode(packet) if each.pts == index and not each.is_corrupt]
        except self._av.FFmpegError:
            self._codec = None  # the frames up to the next key frame have no picture
            return None
        return _pixels(found[0]) if found else None

    def _alone(self, form: str, data: bytes) -> Array | None:
        coding = coding_of(form, data)
        if coding.codec not in (JPEG, PNG):
            raise ConversionError(f"found format {form!r}, expected JPEG, PNG or video")
        try:
            pixels = decoded_still(coding.codec, data[coding.start :])
        except ConversionError:
            return None  # damaged
        return depths(pixels, coding) if coding.depth else pixels

    def _open(self, name: str) -> Any:
        codec = self._av.CodecContext.create(name, "r")
        codec.options = {"max_pixels": str(MAX_PIXELS), "err_detect": "explode"}
        codec.thread_count = 1
        return codec


def _form(image: CompressedImage) -> str:
    """The codec of video; the format of other pictures, which states more."""
    with suppress(ConversionError):
        codec = coding_of(image.format, image.data).codec
        return codec if codec in _VIDEO_DECODERS else image.format
    return image.format


def _pixels(picture: Any) -> Pixels:
    found: Pixels = np.ascontiguousarray(picture.to_ndarray(format="rgb24"))
    return found
