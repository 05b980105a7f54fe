"""Pictures through real encoders and decoders: what they look like behind, and what happens when frames are missing."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from fractions import Fraction
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from igtl_gateway.base.buffers import Buffer
from igtl_gateway.base.errors import ConfigError, Unavailable
from igtl_gateway.convert.bitstream import is_key_frame
from igtl_gateway.convert.common_msgs import CompressedImage
from igtl_gateway.convert.rosmsg import Header, Image
from igtl_gateway.edges.video import (
    CODECS,
    MAX_FRAMES,
    MAX_PICTURES,
    MAX_STREAMS,
    VideoDecoder,
    VideoEncoder,
    VideoOptions,
)
from igtl_gateway.edges.video import decoder as decoder_module
from igtl_gateway.edges.video.options import ENCODERS
from igtl_gateway.gateway.log.note import Note

av = pytest.importorskip("av")

TIMEOUT_S = 30.0
WIDTH, HEIGHT = 160, 120
MS = 1_000_000
Pixels = npt.NDArray[np.uint8]


class Collector:
    """Takes frames, pictures and notes from the threads; can hold the thread that brings them."""

    def __init__(self) -> None:
        self._condition = threading.Condition()
        self.frames: list[tuple[str, CompressedImage, int]] = []
        self.pictures: list[tuple[str, Image]] = []
        self.notes: list[Note] = []
        self.open = threading.Event()
        self.open.set()
        self.held = threading.Event()

    def on_frame(self, topic: str, ros_type: str, cdr: bytes, source_ns: int) -> None:
        assert ros_type == CompressedImage.TYPE
        self._take(self.frames, (topic, CompressedImage.unpack(cdr), source_ns))

    def on_image(self, name: str, cdr: bytes) -> None:
        self._take(self.pictures, (name, Image.unpack(cdr)))

    def on_note(self, note: Note) -> None:
        with self._condition:
            self.notes.append(note)
            self._condition.notify_all()

    def _take(self, where: list[Any], what: Any) -> None:
        self.held.set()
        assert self.open.wait(TIMEOUT_S)
        with self._condition:
            where.append(what)
            self._condition.notify_all()

    def hold(self) -> None:
        """Stop the next thread that brings something; ``held`` is set then, ``open`` releases the thread."""
        self.open.clear()
        self.held.clear()

    def wait(self, condition: Callable[[], bool]) -> None:
        with self._condition:
            assert self._condition.wait_for(condition, TIMEOUT_S)


@pytest.fixture
def got() -> Collector:
    return Collector()


@pytest.fixture
def decoder(got: Collector) -> Iterator[VideoDecoder]:
    made = VideoDecoder(on_image=got.on_image, on_note=got.on_note)
    made.start()
    yield made
    got.open.set()
    made.stop()


def encoder_of(got: Collector, codec: str = "h264", bit_rate: int = 2_000_000, interval: int = 10) -> VideoEncoder:
    made = VideoEncoder(VideoOptions(codec, bit_rate, interval), on_frame=got.on_frame, on_note=got.on_note)
    made.start()
    return made


def scene(number: int, width: int = WIDTH, height: int = HEIGHT) -> Pixels:
    """A soft background that drifts and a disc that moves: RGB."""
    y, x = np.mgrid[0:height, 0:width].astype(float)
    waves = [np.sin((x * a + y * b) / 23 + number * 0.2 + a) for a, b in ((1, 0.3), (0.4, 1), (0.7, 0.7))]
    picture = np.stack([127 + 100 * wave for wave in waves], axis=-1)
    picture[(x - width / 4 - 3 * number) ** 2 + (y - height / 2) ** 2 < (height / 6) ** 2] = (220, 60, 40)
    return picture.astype(np.uint8)


def image(pixels: npt.NDArray[Any], encoding: str = "rgb8", stamp_ns: int = 0, pad: int = 0, big: int = 0) -> bytes:
    height, width = pixels.shape[:2]
    rows = np.ascontiguousarray(pixels).view(np.uint8).reshape(height, -1)
    padded = np.pad(rows, ((0, 0), (0, pad)), constant_values=77)
    header = Header(stamp_ns, "camera")
    return Image(header, height, width, encoding, big, padded.shape[1], padded.reshape(-1).data).pack()


def pixels_of(message: Image) -> Pixels:
    shape = (message.height, message.width, -1) if message.encoding == "rgb8" else (message.height, message.width)
    return np.frombuffer(message.data, np.uint8).reshape(shape)


def psnr(a: npt.NDArray[Any], b: npt.NDArray[Any]) -> float:
    assert a.shape == b.shape
    return float(10 * np.log10(255**2 / max(np.mean((a.astype(float) - b) ** 2), 1e-9)))


def encoded(
    got: Collector, pictures: list[bytes], *, changed: tuple[str, ...] = (), **options: Any
) -> list[CompressedImage]:
    """All of them, however slow this machine: one at a time; ``changed``: what they lose besides, which is noted."""
    encoder = encoder_of(got, **options)
    before = len(got.frames)
    try:
        for count, cdr in enumerate(pictures, start=1):
            encoder.submit("/camera", cdr, count)
            got.wait(lambda count=count: len(got.frames) == before + count)  # type: ignore[misc]
            assert [note.code for note in got.notes] == ["video_changed"] * bool(changed)
        counters = encoder.counters()["/camera"]
    finally:
        encoder.stop()
    frames = [frame for _, frame, _ in got.frames[before:]]
    assert counters["received"] == counters["done"] == len(pictures)
    assert counters["encoded_bytes"] == sum(len(memoryview(frame.data)) for frame in frames)
    assert counters["key_frames"] == len(keys(frames))
    assert counters["dropped"] == {}
    assert counters.get("changed", {}) == dict.fromkeys(changed, len(pictures))
    return frames


def keys(frames: list[CompressedImage]) -> list[int]:
    return [number for number, frame in enumerate(frames) if is_key_frame(frame.format, frame.data)]


def moving(count: int, rate: int = 30) -> list[bytes]:
    return [image(scene(number), stamp_ns=10**18 + number * 10**9 // rate) for number in range(count)]


@pytest.mark.parametrize("codec", CODECS)
def test_a_moving_picture_there_and_back(codec: str, got: Collector, decoder: VideoDecoder) -> None:
    frames = encoded(got, moving(25), codec=codec)
    assert keys(frames) == [0, 10, 20]
    assert [source_ns for _, _, source_ns in got.frames] == list(range(1, 26))
    for number, frame in enumerate(frames):
        assert (frame.format, frame.header) == (codec, Header(10**18 + number * 10**9 // 30, "camera"))
        decoder.submit("Camera", frame.pack())
    got.wait(lambda: len(got.pictures) == len(frames))
    for number, (name, picture) in enumerate(got.pictures):
        assert (name, picture.encoding, picture.header) == ("Camera", "rgb8", frames[number].header)
        assert psnr(pixels_of(picture), scene(number)) > 30
    # a still picture would not do
    assert psnr(scene(0), scene(10)) < 20
    assert got.notes == []
    assert decoder.counters() == {
        "Camera": {
            "received": 25,
            "done": 25,
            "key_frames": 3,
            "encoded_bytes": sum(len(memoryview(frame.data)) for frame in frames),
            "dropped": {},
        }
    }


@pytest.mark.parametrize("codec", CODECS)
def test_every_frame_comes_at_once(codec: str, got: Collector, decoder: VideoDecoder) -> None:
    """Neither encoder nor decoder waits for the next picture before it gives this one."""
    encoder = encoder_of(got, codec)
    try:
        for number in range(1, 13):
            encoder.submit("/camera", image(scene(number)), 0)
            got.wait(lambda number=number: len(got.frames) == number)  # type: ignore[misc]
            decoder.submit("Camera", got.frames[-1][1].pack())
            got.wait(lambda number=number: len(got.pictures) == number)  # type: ignore[misc]
    finally:
        encoder.stop()


RGB = scene(3)
GREY = RGB[:, :, 0]
ALPHA = np.full((HEIGHT, WIDTH, 1), 9, np.uint8)


#: Name → picture, what a decoder shows, and what has been lost besides the losses of the codec.
ENCODINGS: dict[str, tuple[bytes, Pixels, tuple[str, ...]]] = {
    "rgb": (image(RGB, "rgb8"), RGB, ()),
    "bgr": (image(RGB[:, :, ::-1], "bgr8"), RGB, ()),
    "rgba": (image(np.concatenate([RGB, ALPHA], 2), "rgba8"), RGB, ("without_alpha",)),
    "bgra": (image(np.concatenate([RGB[:, :, ::-1], ALPHA], 2), "bgra8"), RGB, ("without_alpha",)),
    "mono8": (image(GREY, "mono8"), GREY, ()),
    "mono16": (image((GREY.astype("<u2") << 8) + 200, "mono16"), GREY, ("upper_8_of_16_bits",)),
    "mono16be": (
        image(((GREY.astype(">u2") << 8) + 200).astype(">u2"), "mono16", big=1), GREY, ("upper_8_of_16_bits",)
    ),
    "padded": (image(RGB, "rgb8", pad=13), RGB, ()),
    "padded mono": (image(GREY, "mono8", pad=1), GREY, ()),
    "odd": (
        image(RGB[:101, :151], "rgb8"),
        np.pad(RGB[:101, :151], ((0, 1), (0, 1), (0, 0)), "edge"),
        ("padded_to_even",),
    ),
    "odd mono": (image(GREY[:101], "mono8", pad=3), np.pad(GREY[:101], ((0, 1), (0, 0)), "edge"), ("padded_to_even",)),
    "dot": (
        image(RGB[:1, :1], "rgb8"), np.pad(RGB[:1, :1], ((0, 1), (0, 1), (0, 0)), "edge"), ("padded_to_even",)
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", ENCODINGS)
@pytest.mark.parametrize("codec", CODECS)
def test_encodings_and_sizes(codec: str, name: str, got: Collector, decoder: VideoDecoder) -> None:
    cdr, expected, changed = ENCODINGS[name]
    (frame,) = encoded(got, [cdr], changed=changed, codec=codec)
    decoder.submit("Camera", frame.pack())
    got.wait(lambda: len(got.pictures) == 1)
    if expected.ndim == 2:
        expected = np.repeat(expected[:, :, None], 3, 2)
    assert psnr(pixels_of(got.pictures[0][1]), expected) > 28


@pytest.mark.parametrize("codec", CODECS)
def test_a_new_size_begins_a_new_stream(codec: str, got: Collector, decoder: VideoDecoder) -> None:
    sizes = [(160, 120), (160, 120), (96, 64), (96, 64), (160, 120)]
    frames = encoded(got, [image(scene(0, *size)) for size in sizes], codec=codec)
    assert keys(frames) == [0, 2, 4]
    for frame in frames:
        decoder.submit("Camera", frame.pack())
    got.wait(lambda: len(got.pictures) == len(frames))
    assert [(picture.width, picture.height) for _, picture in got.pictures] == sizes
    for size, (_, picture) in zip(sizes, got.pictures, strict=True):
        assert psnr(pixels_of(picture), scene(0, *size)) > 30


@pytest.mark.slow
@pytest.mark.parametrize("codec", CODECS)
@pytest.mark.parametrize(("bit_rate", "rate"), [(300_000, 30), (1_500_000, 30), (300_000, 10), (1_500_000, 60)])
def test_bit_rate(codec: str, bit_rate: int, rate: int, got: Collector) -> None:
    """It is kept to at any rate of pictures, once their stamps have shown it."""
    noise = np.random.default_rng(1)
    pictures = [scene(n) // 2 + noise.integers(0, 80, (HEIGHT, WIDTH, 3), np.uint8) for n in range(60)]
    cdrs = [image(picture, stamp_ns=10**18 + n * 10**9 // rate) for n, picture in enumerate(pictures)]
    frames = encoded(got, cdrs, codec=codec, bit_rate=bit_rate, interval=15)
    assert keys(frames) == [0, 15, 30, 45]
    settled = [len(memoryview(frame.data)) for frame in frames[30:]]
    assert 8 * sum(settled) / len(settled) * rate == pytest.approx(bit_rate, rel=0.35)


def test_two_topics_do_not_mix(got: Collector, decoder: VideoDecoder) -> None:
    encoder = encoder_of(got)
    try:
        for number in range(6):
            for topic, shift in (("/a", 0), ("/b", 50)):
                encoder.submit(topic, image(scene(number + shift)), 0)
            got.wait(lambda number=number: len(got.frames) == 2 * number + 2)  # type: ignore[misc]
        assert encoder.counters().keys() == {"/a", "/b"}
    finally:
        encoder.stop()
    for topic, frame, _ in got.frames:
        decoder.submit(topic, frame.pack())
    got.wait(lambda: len(got.pictures) == 12)
    for topic, shift in (("/a", 0), ("/b", 50)):
        pictures = [picture for name, picture in got.pictures if name == topic]
        assert all(psnr(pixels_of(picture), scene(n + shift)) > 30 for n, picture in enumerate(pictures))


# -- what cannot be encoded -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("cdr", "found"),
    [
        (image(RGB, "32FC1"), "found encoding '32FC1'"),
        (image(GREY.astype("<u2"), "16UC1"), "found encoding '16UC1'"),
        (image(GREY, "bayer_rggb8"), "found encoding 'bayer_rggb8'"),
        (Image(Header(), 0, 160, "rgb8", 0, 480, b"").pack(), "found 160 x 0"),
        (image(RGB[:10], "rgba8"), "expected 10 rows of 640 bytes"),
        (Image(Header(), 5000, 5000, "mono8", 0, 5000, b"").pack(), "found 5000 x 5000"),
        (image(RGB)[:-1], "CDR ends"),
        (b"", "found encapsulation nothing"),
    ],
)
def test_pictures_that_are_none(cdr: bytes, found: str, got: Collector) -> None:
    """Only these pictures are rejected; the stream reports it once and continues."""
    encoder = encoder_of(got)
    try:
        for number in range(3):
            encoder.submit("/camera", cdr, 0)
            encoder.submit("/camera", image(scene(number)), 0)
            got.wait(lambda number=number: len(got.frames) == number + 1)  # type: ignore[misc]
        assert encoder.counters()["/camera"]["dropped"] == {"refused": 3}
    finally:
        encoder.stop()
    (note,) = got.notes
    assert (note.code, note.stream) == ("video_refused", "/camera")
    assert found in note.text
    assert keys([frame for _, frame, _ in got.frames]) == [0]


def test_bound_of_raw_pictures(got: Collector) -> None:
    """The oldest is dropped, never the newest; that is reported once and counted each time."""
    encoder = encoder_of(got)
    got.hold()
    try:
        encoder.submit("/camera", image(scene(0)), 1)
        assert got.held.wait(TIMEOUT_S)
        for number in range(2, 12):
            encoder.submit("/camera", image(scene(number)), number)
        assert encoder.counters()["/camera"]["dropped"] == {"queue_full": 10 - MAX_PICTURES}
        got.open.set()
        got.wait(lambda: len(got.frames) == 1 + MAX_PICTURES)
    finally:
        got.open.set()
        encoder.stop()
    assert [source_ns for _, _, source_ns in got.frames] == [1, *range(12 - MAX_PICTURES, 12)]
    assert [note.code for note in got.notes] == ["video_drop"]


def test_what_waits_at_the_end_is_counted(got: Collector) -> None:
    encoder = encoder_of(got)
    got.hold()
    encoder.submit("/camera", image(scene(0)), 1)
    assert got.held.wait(TIMEOUT_S)
    encoder.submit("/camera", image(scene(1)), 2)
    stopper = threading.Thread(target=encoder.stop)
    stopper.start()
    while "stopped" not in encoder.counters()["/camera"]["dropped"]:
        assert stopper.is_alive()
    got.open.set()
    stopper.join(TIMEOUT_S)
    assert encoder.counters()["/camera"]["dropped"] == {"stopped": 1}
    encoder.submit("/camera", image(scene(2)), 3)
    encoder.stop()
    assert [source_ns for _, _, source_ns in got.frames] == [1]


def test_bound_of_streams(got: Collector) -> None:
    encoder = encoder_of(got)
    try:
        for number in range(MAX_STREAMS + 3):
            encoder.submit(f"/camera{number}", b"", 0)
        got.wait(lambda: len(got.notes) == MAX_STREAMS + 1)
        counters = encoder.counters()
        assert len(counters) == MAX_STREAMS + 1
        assert counters["(others)"]["dropped"] == {"too_many_streams": 3}
    finally:
        encoder.stop()


# -- frames that are missing, broken or too many ------------------------------------------------------------------


def decoded_stamps(got: Collector) -> list[int]:
    return [picture.header.stamp_ns // MS % 1000 for _, picture in got.pictures]


def numbered(got: Collector, codec: str, count: int) -> list[CompressedImage]:
    """Frames with stamps of 0, 1, 2 … ms, a key frame each ten."""
    return encoded(got, [image(scene(n), stamp_ns=10**18 + n * MS) for n in range(count)], codec=codec)


@pytest.mark.parametrize("codec", CODECS)
def test_the_decoder_joins_at_a_key_frame(codec: str, got: Collector, decoder: VideoDecoder) -> None:
    for frame in numbered(got, codec, 13)[4:]:
        decoder.submit("Camera", frame.pack())
    got.wait(lambda: len(got.pictures) == 3)
    assert decoded_stamps(got) == [10, 11, 12]
    assert decoder.counters()["Camera"]["dropped"] == {"no_key_frame": 6}
    assert psnr(pixels_of(got.pictures[0][1]), scene(10)) > 30
    assert got.notes == []


GARBAGE: dict[str, Callable[[Buffer], bytes]] = {
    "noise": lambda data: bytes(data[:8]) + np.random.default_rng(2).bytes(len(data)),
    "nothing": lambda data: bytes(data[:0]),
    "cut off": lambda data: bytes(data[: len(data) // 2]),
}


@pytest.mark.parametrize("codec", CODECS)
@pytest.mark.parametrize("damage", GARBAGE)
def test_garbage_ends_at_the_next_key_frame(codec: str, damage: str, got: Collector, decoder: VideoDecoder) -> None:
    """Frame 4 is broken.  What is shown before and behind looks as it should, and the thread lives."""
    frames = numbered(got, codec, 30)
    for number, frame in enumerate(frames):
        data = GARBAGE[damage](memoryview(frame.data)) if number == 4 else frame.data
        decoder.submit("Camera", CompressedImage(frame.header, codec, data).pack())
    got.wait(lambda: decoded_stamps(got)[-1:] == [29])
    shown = decoded_stamps(got)
    assert shown[:4] == [0, 1, 2, 3]
    assert shown[-20:] == list(range(10, 30))
    for number, (_, picture) in zip(shown, got.pictures, strict=True):
        if number < 4 or number >= 10:
            assert psnr(pixels_of(picture), scene(number)) > 30
    counters = decoder.counters()["Camera"]
    assert counters["done"] + sum(counters["dropped"].values()) == counters["received"] == 30


def test_bound_of_frames(got: Collector, decoder: VideoDecoder) -> None:
    """Beyond it all goes up to the next key frame, which takes the place of all that waits."""
    frames = numbered(got, "h264", 50)
    got.hold()
    decoder.submit("Camera", frames[0].pack())
    assert got.held.wait(TIMEOUT_S)
    for frame in frames[1 : 2 + MAX_FRAMES]:  # the last one finds the queue full: frame 31
        decoder.submit("Camera", frame.pack())
    assert decoder.counters()["Camera"]["dropped"] == {"queue_full": 1}
    for frame in frames[2 + MAX_FRAMES : 40]:
        decoder.submit("Camera", frame.pack())
    assert decoder.counters()["Camera"]["dropped"] == {"queue_full": 1, "no_key_frame": 8}
    for frame in frames[40:43]:
        decoder.submit("Camera", frame.pack())
    assert decoder.counters()["Camera"]["dropped"] == {"queue_full": 1 + MAX_FRAMES, "no_key_frame": 8}
    got.open.set()
    got.wait(lambda: len(got.pictures) == 4)
    assert decoded_stamps(got) == [0, 40, 41, 42]
    assert psnr(pixels_of(got.pictures[-1][1]), scene(42)) > 30
    assert [note.code for note in got.notes] == ["video_drop"]


def test_bound_of_bytes(got: Collector, decoder: VideoDecoder, monkeypatch: pytest.MonkeyPatch) -> None:
    """One frame alone always fits."""
    monkeypatch.setattr(decoder_module, "MAX_FRAME_BYTES", 1)
    frames = numbered(got, "h264", 3)
    got.hold()
    decoder.submit("Camera", frames[0].pack())
    assert got.held.wait(TIMEOUT_S)
    decoder.submit("Camera", frames[1].pack())
    decoder.submit("Camera", frames[2].pack())
    assert decoder.counters()["Camera"]["dropped"] == {"queue_full": 1}
    got.open.set()
    got.wait(lambda: len(got.pictures) == 2)


def test_another_codec_on_the_same_stream(got: Collector, decoder: VideoDecoder) -> None:
    for codec in ("h264", "vp9", "h264"):
        decoder.submit("Camera", encoded(got, moving(1), codec=codec)[0].pack())
    got.wait(lambda: len(got.pictures) == 3)
    assert all(psnr(pixels_of(picture), scene(0)) > 30 for _, picture in got.pictures)


def test_other_formats_are_left_alone(got: Collector, decoder: VideoDecoder) -> None:
    decoder.submit("Camera", CompressedImage(Header(), "rgb8; jpeg compressed bgr8", b"\xff\xd8").pack())
    assert decoder.counters() == {}


def foreign(encoder: str, pixel_format: str, options: dict[str, str], count: int) -> list[bytes]:
    """Frames from another encoder."""
    context = av.CodecContext.create(encoder, "w")
    context.width, context.height, context.pix_fmt = WIDTH, HEIGHT, pixel_format
    context.time_base, context.framerate, context.gop_size, context.max_b_frames = Fraction(1, 30), 30, 4, 0
    context.options = options
    packets = []
    for number in [*range(count), None]:
        frame = None
        if number is not None:
            frame = av.VideoFrame.from_ndarray(scene(number), format="rgb24").reformat(format=pixel_format)
            frame.pts = number
        packets += context.encode(frame)
    frames = [(bytes(packet), packet.is_keyframe) for packet in packets]
    codec = {"libx264": "h264", "libx265": "h265", "libvpx-vp9": "vp9", "libsvtav1": "av1"}[encoder]
    assert [is_key_frame(codec, data) for data, _ in frames] == [is_key for _, is_key in frames]
    return [data for data, _ in frames]


@pytest.mark.parametrize(
    ("codec", "encoder", "pixel_format", "options"),
    [
        ("h264", "libx264", "yuv420p", {"preset": "medium", "tune": "zerolatency"}),
        ("h264", "libx264", "yuv444p", {"tune": "zerolatency"}),
        ("h264", "libx264", "gray", {"tune": "zerolatency"}),  # FFmpeg gives it back in colours
        ("h265", "libx265", "gray", {"tune": "zerolatency", "preset": "ultrafast", "x265-params": "log-level=none"}),
        ("h265", "libx265", "yuv420p", {"tune": "zerolatency", "preset": "ultrafast", "x265-params": "log-level=none"}),
        ("vp9", "libvpx-vp9", "yuv444p", {"lag-in-frames": "0", "deadline": "realtime"}),
        ("av1", "libsvtav1", "yuv420p", {"preset": "12", "svtav1-params": "pred-struct=1:rc=0:lookahead=0"}),
    ],
)
def test_foreign_streams(
    codec: str, encoder: str, pixel_format: str, options: dict[str, str], got: Collector, decoder: VideoDecoder
) -> None:
    try:
        av.codec.Codec(encoder, "w")
    except ValueError:
        pytest.skip(f"this PyAV has no {encoder}")
    for data in foreign(encoder, pixel_format, options, 9):
        decoder.submit("Camera", CompressedImage(Header(1, "theirs"), codec, data).pack())
    got.wait(lambda: len(got.pictures) == 9)
    for number, (_, picture) in enumerate(got.pictures):
        assert picture.encoding == ("mono8" if (codec, pixel_format) == ("h265", "gray") else "rgb8")
        pixels = pixels_of(picture)
        if pixel_format == "gray":
            grey = scene(number) @ (0.299, 0.587, 0.114)
            assert psnr(pixels, grey if pixels.ndim == 2 else np.repeat(grey[:, :, None], 3, 2)) > 28
        else:
            assert psnr(pixels, scene(number)) > 28


def test_a_small_frame_that_claims_a_huge_picture(got: Collector, decoder: VideoDecoder) -> None:
    frames = numbered(got, "vp9", 2)
    data = bytearray(frames[0].data)
    # behind the sync code and the colours: width − 1 and height − 1 in 16 bits each; all ones are 65,536
    data[5:9] = b"\xff\xff\xff\xff"
    decoder.submit("Camera", CompressedImage(Header(), "vp9", bytes(data)).pack())
    got.wait(lambda: bool(got.notes))
    decoder.submit("Camera", frames[0].pack())
    got.wait(lambda: len(got.pictures) == 1)
    assert got.notes[0].code == "video_failed"
    assert decoder.counters()["Camera"]["dropped"] == {"broken": 1}


# -- set-up -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("options", "found"),
    [
        (("mpeg2", 1_000_000, 30), "video codec: found 'mpeg2', expected one of h264, vp9"),
        (("h264", 0, 30), "bit_rate: found 0, expected 10000 to"),
        (("h264", 1_000_000, 0), "key_frame_interval: found 0, expected 1 to"),
    ],
)
def test_options(options: tuple[str, int, int], found: str) -> None:
    with pytest.raises(ConfigError, match=found):
        VideoOptions(*options)


def test_without_pyav(monkeypatch: pytest.MonkeyPatch, got: Collector) -> None:
    monkeypatch.setitem(__import__("sys").modules, "av", None)
    with pytest.raises(Unavailable, match=r"^av is not installed here: pip install \"igtl-gateway\[video\]\"$"):
        encoder_of(got)
    with pytest.raises(Unavailable, match=r"^av is not installed here: pip install \"igtl-gateway\[video\]\"$"):
        VideoDecoder(on_image=got.on_image, on_note=got.on_note)


def test_a_pyav_without_the_codec(monkeypatch: pytest.MonkeyPatch, got: Collector) -> None:
    monkeypatch.setitem(ENCODERS, "h264", ("libnothing", {}))
    with pytest.raises(Unavailable, match=r"video codec h264: .*libnothing"):
        encoder_of(got)
