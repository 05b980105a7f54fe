"""IMAGE ⇄ sensor_msgs/Image: every encoding by hand, padding, byte orders, what a flat picture cannot hold."""

from __future__ import annotations

import tracemalloc
from typing import Any

import numpy as np
import pytest

from igtl_gateway.base.errors import ConversionError
from igtl_gateway.convert.context import ToIgtlContext, ToRosContext
from igtl_gateway.convert.images import image_to_igtl, image_to_ros
from igtl_gateway.convert.rosmsg import Header
from igtl_gateway.convert.rosmsg import Image as RosImage
from igtl_gateway.wire.image import SCALARS, Image
from tests.tables import table


def to_ros() -> ToRosContext:
    return ToRosContext("Camera", 5, "frame", "")


def sent(message: RosImage) -> Image:
    out = image_to_igtl(message, ToIgtlContext())
    assert out.stamp_ns == message.header.stamp_ns
    assert isinstance(out.content, Image)
    out.content.pack()
    return out.content


def picture(encoding: str, width: int, height: int, data: bytes, step: int = 0, big: int = 0) -> RosImage:
    return RosImage(Header(7, "f"), height, width, encoding, big, step or len(data) // max(height, 1), data)


#: Encoding, scalar type, components, one row of two pixels as it comes and as it goes.
GOLDEN = [
    ("mono8", 3, 1, b"\1\2", b"\1\2"),
    ("rgb8", 3, 3, b"RGBrgb", b"RGBrgb"),
    ("bgr8", 3, 3, b"BGRbgr", b"RGBrgb"),
    ("rgba8", 3, 4, b"RGBArgba", b"RGBArgba"),
    ("bgra8", 3, 4, b"BGRAbgra", b"RGBArgba"),
    ("mono16", 5, 1, b"\1\2\3\4", b"\1\2\3\4"),
    ("rgb16", 5, 3, b"RrGgBbRrGgBb", b"RrGgBbRrGgBb"),
    ("bgr16", 5, 3, b"BbGgRrBbGgRr", b"RrGgBbRrGgBb"),
    ("rgba16", 5, 4, b"RrGgBbAaRrGgBbAa", b"RrGgBbAaRrGgBbAa"),
    ("bgra16", 5, 4, b"BbGgRrAaBbGgRrAa", b"RrGgBbAaRrGgBbAa"),
    ("bayer_rggb8", 3, 1, b"\1\2", b"\1\2"),
    ("bayer_grbg16", 5, 1, b"\1\2\3\4", b"\1\2\3\4"),
    ("8UC3", 3, 3, b"123456", b"123456"),
    ("8SC1", 2, 1, b"12", b"12"),
    ("16SC1", 4, 1, b"1234", b"1234"),
    ("32SC1", 6, 1, b"12345678", b"12345678"),
    ("32FC1", 10, 1, b"12345678", b"12345678"),
    ("64FC2", 11, 2, bytes(range(32)), bytes(range(32))),
]


@table(("encoding", "scalar", "components", "data", "pixels"), GOLDEN, ids=[row[0] for row in GOLDEN])
def test_encodings(encoding: str, scalar: int, components: int, data: bytes, pixels: bytes) -> None:
    image = sent(picture(encoding, 2, 1, data))
    assert (image.scalar_type, image.num_components, bytes(image.pixels)) == (scalar, components, pixels)
    assert (image.dimensions, image.endian) == ((2, 1, 1), 2)
    assert image.wire_matrix == Image.IDENTITY


@table(("encoding", "scalar", "components", "data", "pixels"), GOLDEN, ids=[row[0] for row in GOLDEN])
def test_padded_rows(encoding: str, scalar: int, components: int, data: bytes, pixels: bytes) -> None:
    for tail in (b"###", b""):  # the last row may end with its pixels
        image = sent(picture(encoding, 2, 2, data + b"###" + data + tail, len(data) + 3))
        assert bytes(image.pixels) == pixels * 2


@pytest.mark.parametrize(("encoding", "endian"), [("mono16", 1), ("64FC1", 1), ("mono8", 2), ("rgb8", 2)])
def test_big_endian_is_told_not_swapped(encoding: str, endian: int) -> None:
    data = bytes(range(24))
    width = {"mono16": 12, "64FC1": 3, "mono8": 24, "rgb8": 8}[encoding]
    image = sent(picture(encoding, width, 1, data, big=1))
    assert (image.endian, bytes(image.pixels)) == (endian, data)
    back = image_to_ros(image, to_ros())
    assert (back.is_bigendian, bytes(back.data)) == (int(endian == 1), data)


def test_rows_and_columns() -> None:
    """Dimensions are i (columns), j (rows), k: the original turned them round."""
    image = sent(picture("mono8", 3, 2, b"abcdef"))
    assert image.dimensions == (3, 2, 1)
    assert image.array[0, 1, 2, 0] == ord("f")


@table("scalar", sorted(SCALARS))
@table("components", [1, 2, 3, 4, 5])
def test_there_and_back(scalar: int, components: int) -> None:
    size = 6 * components * np.dtype(SCALARS[scalar]).itemsize
    content = Image((3, 2, 1), scalar, bytes(i % 251 for i in range(size)), components)
    to = to_ros()
    message = image_to_ros(content, to)
    assert (message.header, message.width, message.height) == (Header(5, "frame"), 3, 2)
    assert message.step * message.height == memoryview(message.data).nbytes
    back = sent(message)
    if scalar == 7:
        assert [code for code, _ in to.warnings] == ["uint32_as_float64"]
        assert (back.array == content.array).all()
    else:
        assert (back.scalar_type, back.num_components, bytes(back.pixels)) == (scalar, components, content.pixels)


@pytest.mark.parametrize(
    ("scalar", "components", "name"),
    [(3, 1, "mono8"), (3, 3, "rgb8"), (5, 4, "rgba16"), (4, 1, "16SC1"), (10, 2, "32FC2")],
)
def test_names(scalar: int, components: int, name: str) -> None:
    size = components * np.dtype(SCALARS[scalar]).itemsize
    assert image_to_ros(Image((1, 1, 1), scalar, bytes(size), components), to_ros()).encoding == name


def test_pixels_are_not_copied() -> None:
    pixels = np.zeros(24, np.uint8)
    message = image_to_ros(Image((4, 2, 1), 3, pixels.data, 3), to_ros())
    assert np.shares_memory(np.frombuffer(message.data, np.uint8), pixels)
    image = sent(RosImage(Header(), 2, 4, "rgb8", 0, 12, pixels.data))
    assert np.shares_memory(np.frombuffer(image.pixels, np.uint8), pixels)


@pytest.mark.parametrize(
    "content",
    [
        Image((1, 1, 2), 3, b"ab"),
        Image((1, 1, 0), 3, b""),
        Image((2, 1, 1), 3, b"a", subvol_offset=(1, 0, 0), subvol_size=(1, 1, 1)),
    ],
)
def test_volumes_and_parts_are_refused(content: Image) -> None:
    with pytest.raises(ConversionError):
        image_to_ros(content, to_ros())


@table(
    "changes",
    [
        {"encoding": "yuv422"},
        {"encoding": ""},
        {"encoding": "8UC0"},
        {"encoding": "8UC255"},
        {"encoding": "8UC99999999999"},
        {"step": 1},
        {"height": 3},
        {"width": 3},
        {"height": 2**32 - 1},
        {"step": 2**32 - 1},
        {"width": 2**32 - 1, "step": 2**32 - 1},
        {"width": 70_000, "height": 1, "step": 70_000, "data": bytes(70_000)},
        {"width": 0, "height": 70_000, "step": 0},
    ],
)
def test_contradictions(changes: dict[str, Any]) -> None:
    fields: dict[str, Any] = {
        "height": 2,
        "width": 2,
        "encoding": "mono8",
        "is_bigendian": 0,
        "step": 2,
        "data": b"abcd",
    }
    sent(RosImage(Header(), **fields))
    with pytest.raises(ConversionError):
        sent(RosImage(Header(), **(fields | changes)))


def test_a_lying_step_costs_nothing() -> None:
    tracemalloc.start()
    image = sent(picture("mono8", 2, 1, b"ab", step=2**32 - 1))
    assert tracemalloc.get_traced_memory()[1] < 100_000
    tracemalloc.stop()
    assert bytes(image.pixels) == b"ab"


@table(("width", "height"), [(0, 0), (0, 3), (3, 0)])
@table("encoding", ["mono8", "bgr8", "64FC2"])
def test_empty_pictures(encoding: str, width: int, height: int) -> None:
    image = sent(RosImage(Header(), height, width, encoding, 0, 64, bytes(64 * height)))
    assert image.dimensions == (width, height, 1)
    assert memoryview(image.pixels).nbytes == 0
    image_to_ros(image, to_ros()).pack()
