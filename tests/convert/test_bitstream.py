"""Key frames detected from bytes; ``tests/edges/test_video.py`` compares the result with real encoders."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from igtl_gateway.convert.bitstream import is_key_frame
from tests.tables import table

SPS, PPS, SEI, IDR, SLICE = "00000001 67 42", "000001 68 ce", "000001 06 05", "000001 65 88", "00000001 41 9a"


@table(
    ("codec", "data", "expected"),
    [
        ("h264", f"{SPS} {PPS} {SEI} {IDR}", True),
        ("h264", IDR, True),
        ("h264", SLICE, False),
        ("h264", f"{SPS} {PPS} {SLICE}", False),  # some encoders repeat the headers before every frame
        ("h264", f"{SLICE} {IDR}", False),
        ("h264", SPS, False),
        ("h264", "0000 0002 65 88", False),  # with lengths (MP4) instead of start codes
        ("h264", "000001", False),
        ("h265", "00000001 40 01 00000001 42 01 00000001 26 01", True),
        ("h265", "000001 2a 01", True),  # CRA
        ("h265", "000001 02 01", False),
        ("vp9", "82 49 83 42", True),
        ("vp9", "a2 49 83 42", True),  # profile 1
        ("vp9", "b0 24 c1", True),  # profile 3 has a bit more
        ("vp9", "b2 24 c1", False),
        ("vp9", "86 00", False),
        ("vp9", "88", False),  # shows a frame that was decoded before
        ("vp9", "42 49", False),
        ("av1", "1200 0a0b 00000024c666feafffff40 32 10", True),
        ("av1", "1200 3210 10", False),
        ("av1", "", False),
        ("av1", "12ffffffffffffffffff", False),
        ("av1", "128080", False),  # ends within the size
        ("jpeg", "ffd8", False),
    ],
)
def test_golden(codec: str, data: str, expected: bool) -> None:
    assert is_key_frame(codec, bytes.fromhex(data)) is expected


@given(st.sampled_from(["h264", "h265", "vp9", "av1", "", "H264"]), st.binary(max_size=40))
def test_any_bytes(codec: str, data: bytes) -> None:
    assert is_key_frame(codec, memoryview(data)) in (True, False)
