"""Sizes of pictures: from real encoders, by hand where they do not reach, and from no bytes that make sense."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from igtl_gateway.convert.framesize import frame_size
from tests.tables import table


def pack(*fields: tuple[int, int] | str) -> bytes:
    """Bits from (value, width) pairs and from strings of bits, filled up with zeros."""
    bits = "".join(field if isinstance(field, str) else f"{field[0]:0{field[1]}b}" for field in fields)
    bits += "0" * (-len(bits) % 8)
    return int(bits, 2).to_bytes(len(bits) // 8, "big")


def ue(value: int) -> str:
    """An unsigned Exp-Golomb code."""
    digits = f"{value + 1:b}"
    return "0" * (len(digits) - 1) + digits


def se(value: int) -> str:
    return ue(2 * value - 1 if value > 0 else -2 * value)


def escaped(unit: bytes) -> bytes:
    """With the bytes that keep start codes out."""
    out = bytearray()
    for byte in unit:
        if byte <= 3 and out[-2:] == b"\x00\x00":
            out.append(3)
        out.append(byte)
    return bytes(out)


def h264_sps(*tail: tuple[int, int] | str, profile: int = 66) -> bytes:
    return b"\x00\x00\x00\x01" + escaped(b"\x67" + pack((profile, 8), (0, 8), (30, 8), *tail))


def h265_sps(*tail: tuple[int, int] | str, layers: int = 0) -> bytes:
    return b"\x00\x00\x01" + escaped(b"\x42\x01" + pack((0, 4), (layers, 3), "1", (0, 96), *tail))


#: What follows the sequence's id in a plain stream: frame numbers, picture order by type 2, one reference.
PLAIN = (ue(0), ue(2), ue(1), "0")

CASES = {
    "h264 with a number of more than 31 bits": ("h264", h264_sps("0" * 32 + "1" * 80), None),
    "h264 baseline, 5 × 4 macro blocks": ("h264", h264_sps(ue(0), *PLAIN, ue(4), ue(3), "1", "1", "0"), (80, 64)),
    "h264 cropped": (
        "h264",
        h264_sps(ue(0), *PLAIN, ue(4), ue(3), "1", "1", "1", ue(1), ue(2), ue(0), ue(3)),
        (80 - 6, 64 - 6),
    ),
    "h264 interlaced": (
        "h264",
        h264_sps(ue(0), *PLAIN, ue(4), ue(3), "0", "1", "1", "1", ue(0), ue(1), ue(0), ue(1)),
        (80 - 2, 128 - 4),
    ),
    "h264 picture order with a list": (
        "h264",
        h264_sps(
            *(ue(0), ue(3), ue(1), "1", se(-2), se(3), ue(2), se(1), se(-1), ue(1), "0"),
            *(ue(4), ue(3), "1", "1", "0"),
        ),
        (80, 64),
    ),
    "h264 picture order by count": (
        "h264",
        h264_sps(ue(0), ue(3), ue(0), ue(4), ue(1), "0", ue(4), ue(3), "1", "1", "0"),
        (80, 64),
    ),
    "h264 high, grey": (
        "h264",
        h264_sps(
            *(ue(0), ue(0), ue(0), ue(0), "0", "0", *PLAIN, ue(4), ue(3), "1", "1", "1", ue(1), ue(0), ue(0), ue(1)),
            profile=100,
        ),
        (79, 63),
    ),
    "h264 high, scaling lists": (
        "h264",
        h264_sps(
            *(ue(0), ue(1), ue(0), ue(0), "0", "1"),
            "1" + se(-8),  # falls back at once
            "1" + se(1) * 15 + se(-3),
            "0" * 4,
            "1" + se(0) * 64,
            "1" + se(1) + se(-9),  # ends after the first
            *(*PLAIN, ue(4), ue(3), "1", "1", "0"),
            profile=100,
        ),
        (80, 64),
    ),
    "h264 4:4:4 in separate planes": (
        "h264",
        h264_sps(
            *(ue(0), ue(3), "1", ue(0), ue(0), "0", "1", "0" * 12, *PLAIN, ue(4), ue(3), "1", "1", "1"),
            *(ue(0), ue(1), ue(0), ue(1)),
            profile=244,
        ),
        (79, 63),
    ),
    "h264 second parameter set behind others": (
        "h264",
        b"\x00\x00\x01\x09\x10" + h264_sps(ue(0), *PLAIN, ue(4), ue(3), "1", "1", "0") + b"\x00\x00\x01\x65\x88",
        (80, 64),
    ),
    "h264 parameters behind the slice": (
        "h264",
        b"\x00\x00\x01\x65\x88" + h264_sps(ue(0), *PLAIN, ue(4), ue(3), "1", "1", "0"),
        None,
    ),
    "h264 without picture": (
        "h264",
        h264_sps(ue(0), *PLAIN, ue(0), ue(0), "1", "1", "1", ue(4), ue(4), ue(0), ue(0)),
        None,
    ),
    "h264 too wide": ("h264", h264_sps(ue(0), *PLAIN, ue(4095), ue(3), "1", "1", "0"), None),
    "h265 4:2:0, cropped": (
        "h265",
        h265_sps(ue(0), ue(1), ue(80), ue(64), "1", ue(0), ue(2), ue(0), ue(1)),
        (76, 62),
    ),
    "h265 4:4:4 in layers": (
        "h265",
        h265_sps("10", "11", (0, 12), (0, 88), (0, 96), ue(0), ue(3), "0", ue(80), ue(64), "1", *"1" * 4, layers=2),
        (80, 64),
    ),
    "h265 slice": ("h265", b"\x00\x00\x01\x02\x01\xff\xff", None),
    "vp9 profile 0": ("vp9", pack("1000", "0010", (0x498342, 24), "0010", (319, 16), (239, 16)), (320, 240)),
    "vp9 profile 1, sRGB": (
        "vp9",
        pack("1010", "0010", (0x498342, 24), "1110", (319, 16), (239, 16)),
        (320, 240),
    ),
    "vp9 profile 2, 10 bits": ("vp9", pack("1001", "0010", (0x498342, 24), "00010", (319, 16), (239, 16)), (320, 240)),
    "vp9 profile 3, 4:2:2": (
        "vp9",
        pack("10110", "0010", (0x498342, 24), "0", "001", "0100", (319, 16), (239, 16)),
        (320, 240),
    ),
    "vp9 between": ("vp9", pack("1000", "0110", (0x498342, 24), "0010", (319, 16), (239, 16)), None),
    "vp9 without its sync code": ("vp9", pack("1000", "0010", (0, 24), "0010", (319, 16), (239, 16)), None),
    "vp9 65,536 wide": ("vp9", pack("1000", "0010", (0x498342, 24), "0010", (65535, 16), (239, 16)), None),
    "av1 reduced header": (
        "av1",
        b"\x12\x00\x0a\x06" + pack((0, 3), "1", "1", (4, 5), (8, 4), (7, 4), (319, 9), (239, 8)),
        (320, 240),
    ),
    "av1 with all there is": (
        "av1",
        b"\x0c\x08"  # extended, without a size: to the end
        + pack(
            *((0, 3), "0", "0", "1", (1, 32), (30, 32), "1", ue(3), "1", (9, 5), (1, 32), (9, 5), (9, 5)),
            *("1", (1, 5)),
            *((0, 12), (8, 5), "1", "1", (5, 10), (6, 10), "0", "1", (3, 4)),
            *((0, 12), (4, 5), "0", "0"),
            *((8, 4), (7, 4), (319, 9), (239, 8)),
        ),
        (320, 240),
    ),
    "av1 timing without a model": (
        "av1",
        b"\x08"
        + pack(
            *((0, 3), "0", "0", "1", (1, 32), (30, 32), "0", "0", "0", (0, 5), (0, 12), (4, 5)),
            *((8, 4), (7, 4), (319, 9), (239, 8)),
        ),
        (320, 240),
    ),
    "av1 frame": ("av1", b"\x12\x00\x32\x02\x10\x00", None),
    "unknown": ("jpeg", b"\xff\xd8", None),
}  # fmt: skip


@table(("codec", "data", "expected"), CASES.values(), ids=CASES.keys())
def test_golden(codec: str, data: bytes, expected: tuple[int, int] | None) -> None:
    assert frame_size(codec, data) == expected


@table(
    ("codec", "data"), [case[:2] for case in CASES.values() if case[2]], ids=[name for name in CASES if CASES[name][2]]
)
def test_cut_off(codec: str, data: bytes) -> None:
    assert all(frame_size(codec, data[:size]) in (None, frame_size(codec, data)) for size in range(len(data)))
    assert frame_size(codec, data[: len(data) // 2]) is None


@given(st.sampled_from(["h264", "h265", "vp9", "av1"]), st.binary(max_size=60), st.integers(0, 255))
def test_any_bytes(codec: str, data: bytes, first: int) -> None:
    for head in (b"", b"\x00\x00\x01" + bytes((first,)), bytes((first,)), b"\x82\x49\x83\x42", b"\x0a"):
        size = frame_size(codec, memoryview(head + data))
        assert size is None or all(0 < length < 65_536 for length in size)


@table(
    ("codec", "pixels"),
    [
        *(("h264", "yuv420p"), ("h264", "yuv422p"), ("h264", "yuv444p"), ("h264", "gray")),
        *(("h265", "yuv420p"), ("h265", "yuv422p"), ("h265", "yuv444p"), ("h265", "gray")),
        *(("vp9", "yuv420p"), ("vp9", "yuv444p"), ("vp9", "gbrp"), ("av1", "yuv420p")),
    ],
)
@table("size", [(64, 64), (130, 98), (322, 246)])
def test_of_real_encoders(codec: str, pixels: str, size: tuple[int, int]) -> None:
    pytest.importorskip("av")
    from tests.convert.real_video import frames

    told = [(frame_size(codec, data), is_key) for data, is_key in frames(codec, *size, pixels)]
    assert told[0] == (size, True)
    assert all(found == (size if is_key else None) for found, is_key in told)
    assert {is_key for _, is_key in told} == {True, False}
