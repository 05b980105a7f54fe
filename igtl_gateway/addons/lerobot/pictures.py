"""The pictures of a stream as RGB of 8 bits, or as codes of depth, of one size with even width and height.

Every form of a picture gives the pixels that it stands for, or is refused by name; a window applies to all of them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from enum import Enum
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
from igtl_gateway.addon.terminal import counted
from igtl_gateway.addons.lerobot.depth import LEAST_SIZE, codes_of, depth_stats, millimetres, outside
from igtl_gateway.addons.lerobot.stats import PictureStats

Pixels = npt.NDArray[Any]
Array = npt.NDArray[Any]
#: Where a picture is: gateway times (ns) of the message that its decoding begins with and of its own, and the number of
#: messages of the stream with that time before it, which is 0 in recordings of the gateway.
Place = tuple[int, int, int]

_PLAIN = frozenset({"IMAGE", RosImage.TYPE, Volume.TYPE})
_CODED = frozenset({"VIDEO", CompressedImage.TYPE, CompressedVideo.TYPE})
#: Codecs of VIDEO → names of CompressedImage.
_FOUR_LETTERS = {"H264": "h264", "X265": "h265", "O265": "h265", "VP90": "vp9", "AV10": "av1"}
#: Messages whose pictures show the range of a stream.
_SOME = 10
_VIDEO_DECODERS = {"h264": "h264", "h265": "hevc", "vp9": "vp9", "av1": "libdav1d"}


def has_pictures(stream: Stream) -> bool:
    """Return whether the messages of a stream are pictures."""
    return stream.type in _PLAIN or stream.type in _CODED


def some_pixels(stream: Stream) -> Iterator[Array]:
    """Yield the pixels of pictures as they are, of about 10 messages from the first to the last."""
    decoder, step = (_Plain(stream) if stream.type in _PLAIN else _Coded(stream)), max(len(stream) // _SOME, 1)
    for index, (_, block, row) in enumerate(_numbered(stream.blocks())):
        pixels = decoder.read(block, row, Want.NOTHING if index % step else Want.PIXELS)
        if pixels is not None and not index % step:
            yield pixels


class Pictures:
    """The pictures of a stream; each one is read and decoded when it is used.

    Args:
        stream: IMAGE, VIDEO, sensor_msgs/Image, CompressedImage, CompressedVideo, or Volume with one slice.
        window: (low, high) values that become black and white; needed for more than 8 bits.  Depth that
            compressed_depth_image_transport has quantised is in metres again.
        depth_mm: (low, high) depth of the first and the last code, for pictures of one component.

    Attributes:
        usable: indices of the messages that have a picture.
        places: (N, 3) int64, where the picture of each message is: a ``Place``.
        size: rows and columns of the recorded pictures.
        pixels, outside: number of pixels, and of those whose depth is unknown or outside of ``depth_mm``.
        is_indexed: whether one is read without those before it.

    Raises ConfigError for other types, for a size that changes, for encodings that are not read, and for more than
    8 bits without a window.
    """

    def __init__(self, stream: Stream, window: tuple[float, ...] = (), depth_mm: tuple[float, ...] = ()) -> None:
        if not has_pictures(stream):
            raise ConfigError(f"found type {stream.type} in {stream.key}, expected pictures")
        if stream.type in _PLAIN:
            stream.check_sender()
        self._reader, self._depth_mm = PictureReader(stream, window, depth_mm), depth_mm
        self.is_indexed = stream.is_indexed
        self.size, self.pixels, self.outside = (0, 0), 0, 0
        places: list[Place] = []
        usable: list[int] = []
        for index, (place, picture) in enumerate(self._reader.look_through()):
            places.append(place)
            if picture is None:
                continue
            size = picture.shape[0], picture.shape[1]
            if self.size == (0, 0):
                self.size = size
            if size != self.size:
                raise ConfigError(f"{stream.key}: found a picture of {size[1]} × {size[0]} pixels in message {index}, "
                                  f"expected {self.size[1]} × {self.size[0]} as before")  # fmt: skip
            if depth_mm:
                if min(size) < LEAST_SIZE:
                    raise ConfigError(f"{stream.key}: found depth of {size[1]} × {size[0]} pixels, expected at least "
                                      f"{LEAST_SIZE} × {LEAST_SIZE}")  # fmt: skip
                self.pixels += picture.size
                self.outside += outside(picture, depth_mm)
            usable.append(index)
        self.places = np.array(places, np.int64).reshape(-1, 3)
        self.usable = np.array(usable, np.int64)

    def no_stats(self) -> PictureStats:
        """Return statistics of no picture, to which those of the stream can be added."""
        return depth_stats(self._depth_mm) if self._depth_mm else PictureStats()

    def rgb(self, index: int) -> Pixels:
        """Return a usable picture, with rows and columns repeated to even numbers.

        Returns (rows, columns, 3) uint8; of depth (rows, columns, 1) uint16, codes.
        """
        begin_ns, time_ns, before = self.places[index].tolist()
        return self._reader.rgb((begin_ns, time_ns, before))

    @property
    def padded(self) -> tuple[int, int]:
        """Rows and columns of the video."""
        return self.size[0] + self.size[0] % 2, self.size[1] + self.size[1] % 2


class PictureReader:
    """Reads single pictures of a stream in any order, as RGB or codes of depth, by the index of the file.

    The last picture is kept, and the decoder of a video: of pictures that follow each other each is decoded once.  A
    file without a usable index is kept in memory.

    Args:
        stream, window, depth_mm: as of ``Pictures``.
    """

    def __init__(self, stream: Stream, window: tuple[float, ...] = (), depth_mm: tuple[float, ...] = ()) -> None:
        self._stream, self._window, self._depth_mm = stream, window, depth_mm
        self._decoder = _Plain(stream) if stream.type in _PLAIN else _Coded(stream)
        self._held: list[MessageBlock] = [] if stream.is_indexed else list(stream.blocks())
        self._place: Place = (0, 0, 0)
        self._plane: Array | None = None

    def look_through(self) -> Iterator[tuple[Place, Array | None]]:
        """Yield the place of each message in order, with its pixels (rows, columns, components), or None without any.

        Depth is in mm; of other pictures only shape and type count: encoded ones are not converted to RGB, which takes
        longer than to decode them.

        Raises ConfigError for forms that are not read.
        """
        begin_ns, want = 0, Want.PIXELS if self._depth_mm else Want.SHAPE
        for index, (at, block, row) in enumerate(_numbered(self._stream.blocks())):
            try:
                plane = self._decoder.read(block, row, want)
            except ConversionError as error:
                raise ConfigError(f"{self._stream.key}: message {index}: {error}") from None
            begin_ns = at[0] if self._decoder.can_begin else begin_ns
            yield (begin_ns, *at), None if plane is None else self._checked(plane)
        self._decoder.begin()

    def rgb(self, place: Place) -> Pixels:
        """Return the picture at a place, as ``Pictures.rgb`` does.

        Raises GatewayError if there is none, or it cannot be read.
        """
        if place != self._place or self._plane is None:
            # a decoder may need more for a key frame of open groups than what follows it
            self._decode(place)
            if self._plane is None:
                self._decode((0, *place[1:]))
        if self._plane is None:
            raise GatewayError(f"{self._stream.key}: found no picture in the message at {place[1]} ns, expected one")
        plane = self._checked(self._plane)
        picture = codes_of(plane, self._depth_mm) if self._depth_mm else self._eight_bits(plane)
        rows, columns = picture.shape[0] % 2, picture.shape[1] % 2
        return np.pad(picture, ((0, rows), (0, columns), (0, 0)), "edge") if rows or columns else picture

    def _decode(self, place: Place) -> None:
        """Read the picture at a place, after the messages from where decoding begins, or goes on."""
        begin_ns, wanted = place[0], place[1:]
        after = self._place[1:]
        if self._place[0] != begin_ns or after >= wanted:
            self._decoder.begin()
            after = begin_ns, -1
        self._place, self._plane = (0, 0, 0), None  # if it fails, the next one begins again
        for at, block, row in _numbered(self._between(after[0], wanted[0] + 1)):
            if after < at <= wanted:
                self._plane = self._decoder.read(block, row, Want.PIXELS if at == wanted else Want.NOTHING)
        self._place = place

    def _between(self, start_ns: int, end_ns: int) -> Iterable[MessageBlock]:
        if not self._held:
            return self._stream.blocks_between(start_ns, end_ns)
        return (block.where((block.times >= start_ns) & (block.times < end_ns)) for block in self._held)

    def _checked(self, plane: Array) -> Array:
        """The pixels (rows, columns, components), of depth in mm.  Raises ConfigError for other forms."""
        if plane.ndim == 2:
            plane = plane[:, :, np.newaxis]
        key = self._stream.key
        if self._depth_mm:
            if plane.shape[2] != 1:
                raise ConfigError(f"{key}: found {counted(plane.shape[2], 'component')}, expected 1 for depth_mm")
            return millimetres(plane)
        if plane.shape[2] not in (1, 3, 4):
            raise ConfigError(f"{key}: found {counted(plane.shape[2], 'component')}, expected 1, 3 or 4")
        if not self._window and plane.dtype != np.uint8:
            raise ConfigError(f"{key}: found pixels of {plane.dtype.newbyteorder('=')}, expected uint8, or "
                              "window = [low, high] in the recipe")  # fmt: skip
        return plane

    def _eight_bits(self, plane: Array) -> Pixels:
        """The pixels as an array of their own."""
        if self._window:
            low, high = self._window
            with np.errstate(invalid="ignore"):
                scaled = np.clip((plane.astype(np.float64) - low) / (high - low), 0, 1)
            plane = np.round(np.nan_to_num(scaled) * 255).astype(np.uint8)
        if plane.shape[2] == 1:
            return np.repeat(plane, 3, axis=2)
        return np.array(plane[:, :, :3], order="C")


def _numbered(blocks: Iterable[MessageBlock]) -> Iterator[tuple[tuple[int, int], MessageBlock, int]]:
    """Yield time and number among those of this time of each message, with its block and row."""
    last_ns, before = -1, 0
    for block in blocks:
        for row, time_ns in enumerate(block.times.tolist()):
            before = before + 1 if time_ns == last_ns else 0
            last_ns = time_ns
            yield (time_ns, before), block, row


class Want(Enum):
    """What is wanted of a message: the pixels, shape and type of them, or that those after it can be decoded."""

    PIXELS, SHAPE, NOTHING = range(3)


class _Plain:
    """Pictures that are not encoded.

    Attributes:
        can_begin: whether the last message that was read needs none before it.
    """

    can_begin = True

    def __init__(self, stream: Stream) -> None:
        self._stream = stream

    def begin(self) -> None:
        """Forget what was read."""

    def read(self, block: MessageBlock, row: int, want: Want = Want.PIXELS) -> Array | None:
        """Return a picture, or None for a damaged or an empty message.  Raises ConfigError for other forms."""
        try:
            view = self._stream.images_of([block])[row]
            plane = view.plane
        except ConfigError:
            raise
        except ConversionError as error:  # an encoding that is not read
            raise ConfigError(f"{self._stream.key}: {error}") from None
        except GatewayError:
            return None
        if not plane.size:
            return None
        if pattern := bayer_pattern(view.encoding):
            return demosaiced(np.ascontiguousarray(plane), pattern)
        is_blue_first = bool(view.encoding) and pixel_layout(view.encoding)[2]
        return plane[:, :, 2::-1] if is_blue_first else plane


class _Coded:
    """Encoded pictures, each alone (JPEG, PNG) or with those before it (video).

    Attributes:
        can_begin: whether the last message that was read needs none before it.
    """

    def __init__(self, stream: Stream) -> None:
        self._av = import_av()
        self._type, self._acceptance = stream.type, stream.acceptance
        self._codec: Any = None
        self._has_begun = self.can_begin = False
        self._count = 0

    def begin(self) -> None:
        """Forget what was read: the next picture of a video is a key frame."""
        self._has_begun = False

    def read(self, block: MessageBlock, row: int, want: Want = Want.PIXELS) -> Array | None:
        """Return a picture (rows, columns) or (rows, columns, 3), or None if the message gives none.

        Messages of a video come in their order; one that is not wanted is only decoded if others need it.  Raises
        ConversionError for a format that is not read.
        """
        codec, data = self._frame(block, row)
        is_video = codec in _VIDEO_DECODERS
        self.can_begin = bool(data) and (not is_video or is_key_frame(codec, data))
        if not data:
            return None
        if is_video:
            picture = self._decoded(codec, data)
            return None if picture is None else _FROM_VIDEO[want](picture)
        return None if want == Want.NOTHING else self._alone(codec, data, want)

    def _frame(self, block: MessageBlock, row: int) -> tuple[str, bytes]:
        """Codec and data of a message; nothing if it is damaged."""
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

    def _decoded(self, codec: str, data: bytes) -> Any:
        """The picture of a frame, which the decoder returns before the next one; None if it does not."""
        if not self._has_begun:
            if not self.can_begin:
                return None
            self._open(_VIDEO_DECODERS[codec])
        packet = self._av.Packet(data)
        packet.pts = self._count = self._count + 1
        try:
            found = [each for each in self._codec.decode(packet) if each.pts == packet.pts and not each.is_corrupt]
        except self._av.FFmpegError:
            self._codec, self._has_begun = None, False  # the frames up to the next key frame have no picture
            return None
        return found[0] if found else None

    def _alone(self, form: str, data: bytes, want: Want) -> Array | None:
        coding = coding_of(form, data)
        if coding.codec not in (JPEG, PNG):
            raise ConversionError(f"found format {form!r}, expected JPEG, PNG or video")
        try:
            is_shape_alone = want == Want.SHAPE and not coding.depth
            pixels = decoded_still(coding.codec, data[coding.start :], is_shape_alone=is_shape_alone)
        except ConversionError:
            return None  # damaged
        return depths(pixels, coding) if coding.depth else pixels

    def _open(self, name: str) -> None:
        """Make a decoder ready for a key frame."""
        self._has_begun = True
        if self._codec is not None and self._codec.name == name:
            self._codec.flush_buffers()
            return
        self._codec = self._av.CodecContext.create(name, "r")
        self._codec.options = {"max_pixels": str(MAX_PIXELS), "err_detect": "explode"}
        self._codec.thread_count = 1
        self._codec.flags |= self._av.codec.context.Flags.low_delay


def _form(image: CompressedImage) -> str:
    """The codec of video; the format of other pictures, which states more."""
    with suppress(ConversionError):
        codec = coding_of(image.format, image.data).codec
        return codec if codec in _VIDEO_DECODERS else image.format
    return image.format


def _pixels(picture: Any) -> Pixels:
    found: Pixels = np.ascontiguousarray(picture.to_ndarray(format="rgb24"))
    return found


#: What is wanted of a picture of a video → what gives it.
_FROM_VIDEO: dict[Want, Callable[[Any], Array | None]] = {
    Want.PIXELS: _pixels,
    Want.SHAPE: lambda picture: np.broadcast_to(np.uint8(0), (picture.height, picture.width, 3)),
    Want.NOTHING: lambda picture: None,
}
