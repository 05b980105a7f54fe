"""Pictures of ROS: what a format and the first bytes show, depth of another package, Bayer mosaics."""

from __future__ import annotations

import struct

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from igtl_gateway.base.errors import ConversionError
from igtl_gateway.base.quantities import counted
from igtl_gateway.convert.pictures import (
    Coding,
    bayer_pattern,
    coding_of,
    demosaiced,
    depths,
    is_deep_png,
)
from tests.tables import table

JPEG_DATA, PNG_DATA = b"\xff\xd8\xff\xe0 and more", b"\x89PNG\r\n\x1a\n and more"


@table(
    ("form", "data", "codec"),
    [
        ("rgb8; jpeg compressed bgr8", JPEG_DATA, "jpeg"),
        ("png", JPEG_DATA, "jpeg"),  # the bytes decide
        ("", PNG_DATA, "png"),
        ("rgb8; jpeg compressed bgr8", b"", "jpeg"),
        ("JPG", b"xx", "jpeg"),
        ("H.264", b"\0\0\0\1", "h264"),
        ("h.265", b"", "h265"),
        ("hevc", b"", "h265"),
        ("avc", b"", "h264"),
        ("VP90", b"", "vp9"),
        ("av10", b"", "av1"),
        ("theora; h264", b"", "h264"),
        ("rgb8; tiff compressed rgb8", b"II*\0", ""),
        ("xh264", b"", ""),
        ("", b"", ""),
        ("", b"\xff\xd8", ""),  # cut off
    ],
)
def test_what_a_picture_is(form: str, data: bytes, codec: str) -> None:
    assert coding_of(form, memoryview(data)) == Coding(codec)


def depth(scale: float, shift: float, data: bytes = PNG_DATA) -> bytes:
    return struct.pack("<iff", 0, scale, shift) + data


def test_depth_is_a_png_behind_its_parameters() -> None:
    assert coding_of("16UC1; compressedDepth png", depth(0, 0)) == Coding("png", "16UC1", 12)
    assert coding_of("32fc1;compressedDepth", depth(10.5, -2.0)) == Coding("png", "32FC1", 12, 10.5, -2.0)


@table(
    ("form", "data", "text"),
    [
        ("compressedDepth png", depth(1, 1), "found format 'compressedDepth png' with 89504e47 behind its 12 bytes"),
        ("8UC1; compressedDepth png", depth(1, 1), "expected 16UC1 or 32FC1 as PNG"),
        ("16UC1; compressedDepth rvl", depth(1, 1, b"\1\2\3\4\5\6\7\x08"), "with 01020304 behind"),
        ("16UC1; compressedDepth png", depth(1, 1, JPEG_DATA), "with ffd8ffe0 behind"),
        ("16UC1; compressedDepth png", b"\0\0", "with no data behind"),
        ("32FC1; compressedDepth png", depth(0, 1), "found the quantisation 0, 1 of"),
        ("32FC1; compressedDepth png", depth(-1, 1), "found the quantisation -1, 1 of"),
        ("32FC1; compressedDepth png", depth(float("nan"), 1), "found the quantisation nan, 1 of"),
        ("32FC1; compressedDepth png", depth(1, float("inf")), "the quantisation 1, inf of"),
    ],
)
def test_depth_in_another_form_is_refused(form: str, data: bytes, text: str) -> None:
    with pytest.raises(ConversionError) as error:
        coding_of(form, data)
    assert text in str(error.value)


def test_depth_in_whole_numbers_is_as_it_was() -> None:
    pixels = np.array([[0, 1, 65535]], np.uint16)
    assert depths(pixels, Coding("png", "16UC1", 12)) is pixels


@given(st.floats(0.5, 5000, width=32), st.floats(-100, 100, width=32), st.lists(st.floats(0.5, 20), min_size=1))
def test_depth_in_metres_is_the_inverse_of_its_numbers(scale: float, shift: float, metres: list[float]) -> None:
    """As compressed_depth_image_transport writes it: n = scale / metres + shift, and 0 for no measurement."""
    numbers = np.array([scale / each + shift for each in metres])
    stored = np.clip(np.round(numbers), 0, 65535).astype(np.uint16)
    found = depths(stored.reshape(1, -1), Coding("png", "32FC1", 12, scale, shift))
    assert found.dtype == np.float32 and found.shape == (1, len(metres))
    for number, got in zip(stored.tolist(), found[0].tolist(), strict=True):
        if number == 0:
            assert np.isnan(got)
        elif number != shift:
            assert got == pytest.approx(scale / (number - shift), rel=1e-3)


@pytest.mark.parametrize("pixels", [np.zeros((2, 2), np.uint8), np.zeros((2, 2, 3), np.uint16), np.zeros(4, np.uint16)])
def test_other_pixels_are_no_depth(pixels: np.ndarray) -> None:
    with pytest.raises(ConversionError) as error:
        depths(pixels, Coding("png", "16UC1", 12))
    assert f"found a PNG of {pixels.dtype} with {counted(pixels.ndim, 'axis', 'axes')} as depth" in str(error.value)


def test_the_bits_of_a_png() -> None:
    head = PNG_DATA[:8] + b"\0\0\0\rIHDR" + struct.pack(">II", 640, 480)
    assert is_deep_png(head + b"\x10\2\0\0\0")
    assert not is_deep_png(head + b"\x08\2\0\0\0")
    assert not is_deep_png(head)


@table(
    ("encoding", "pattern"),
    [
        ("bayer_rggb8", "rggb"), ("bayer_bggr16", "bggr"), ("bayer_gbrg8", "gbrg"), ("BAYER_GRBG16", "grbg"),
        ("bayer_rggb", ""), ("bayer_rgbg8", ""), ("bayer_rggb32", ""), ("xbayer_rggb8", ""), ("rgb8", ""), ("", ""),
    ],
)  # fmt: skip
def test_names_of_mosaics(encoding: str, pattern: str) -> None:
    assert bayer_pattern(encoding) == pattern


@table("pattern", ["rggb", "bggr", "gbrg", "grbg"])
def test_a_cell_gets_its_red_its_blue_and_the_mean_of_its_greens(pattern: str) -> None:
    values = {"r": [9], "g": [200, 255], "b": [77]}
    cell = np.array([values[colour].pop(0) for colour in pattern], np.uint8).reshape(2, 2)
    found = demosaiced(cell, pattern)
    assert found.dtype == np.uint8 and found.tolist() == [[[9, 227, 77]] * 2] * 2


def test_the_mean_of_two_greens_of_16_bits_does_not_overflow() -> None:
    mosaic = np.full((2, 2), 65535, np.uint16)
    assert demosaiced(mosaic, "rggb").max() == demosaiced(mosaic, "rggb").min() == 65535


@given(st.integers(1, 5), st.integers(1, 5), st.sampled_from(["rggb", "bggr", "gbrg", "grbg"]))
def test_a_mosaic_of_one_colour_stays_it_also_at_a_cut_edge(rows: int, columns: int, pattern: str) -> None:
    colours = {"r": 10, "g": 20, "b": 30}
    mosaic = np.zeros((rows, columns), np.uint8)
    for number, colour in enumerate(pattern):
        mosaic[number // 2 :: 2, number % 2 :: 2] = colours[colour]
    found = demosaiced(mosaic, pattern)
    assert found.shape == (rows, columns, 3)
    if min(rows, columns) > 1:
        assert np.unique(found.reshape(-1, 3), axis=0).tolist() == [[10, 20, 30]]


def test_cells_are_independent() -> None:
    left, right = np.array([[1, 2], [2, 3]], np.uint8), np.array([[11, 12], [12, 13]], np.uint8)
    found = demosaiced(np.hstack([left, right]), "rggb")
    assert found[0].tolist() == [[1, 2, 3]] * 2 + [[11, 12, 13]] * 2
