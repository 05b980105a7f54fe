"""IMGMETA, LBMETA and VIDEOMETA: the bytes of an element, and its description."""

from __future__ import annotations

import struct

from igtl_gateway.wire.metalists import ImageMetaList, LabelMetaList, VideoMetaList
from tests.wire.contents import check_golden, check_list, element, f32, text


def test_lists_hold_whole_elements() -> None:
    check_list(ImageMetaList, 260)
    check_list(LabelMetaList, 116)
    check_list(VideoMetaList, 322)


def test_golden_bytes_of_images() -> None:
    """The time of the scan is in seconds and 2⁻³² seconds."""
    described = check_golden(
        element(ImageMetaList, "head", "CT1", "CT", "Doe", "007", 0x0000000180000000, [512, 256, 3], 5, 0),
        text("head", 64)
        + text("CT1", 20)
        + text("CT", 32)
        + text("Doe", 64)
        + text("007", 64)
        + b"\0\0\0\1\x80\0\0\0"
        + b"\2\0\1\0\0\3"
        + b"\5\0",
        lambda size: size == 0,
    )
    assert described["elements"] == [
        {
            "name": "head",
            "device_name": "CT1",
            "modality": "CT",
            "patient_name": "Doe",
            "patient_id": "007",
            "timestamp": {"sec": 1, "nanosec": 500_000_000},
            "size": [512, 256, 3],
            "scalar_type": 5,
        }
    ]


def test_golden_bytes_of_labels() -> None:
    described = check_golden(
        element(LabelMetaList, "liver", "L1", 9, 0, [1, 2, 3, 4], [512, 256, 3], "CT1"),
        text("liver", 64) + text("L1", 20) + b"\x09\0\1\2\3\4" + b"\2\0\1\0\0\3" + text("CT1", 20),
        lambda size: size == 0,
    )
    assert described["elements"] == [
        {
            "name": "liver",
            "device_name": "L1",
            "label": 9,
            "rgba": [1, 2, 3, 4],
            "size": [512, 256, 3],
            "owner": "CT1",
        }
    ]


def test_golden_bytes_of_videos() -> None:
    """The zoom has a sign."""
    described = check_golden(
        element(VideoMetaList, "scope", "V1", "Doe", "007", -2, 50.0, [640, 480, 1], range(12), 3, 0),
        text("scope", 64)
        + text("V1", 64)
        + text("Doe", 64)
        + text("007", 64)
        + struct.pack(">hd3H", -2, 50.0, 640, 480, 1)
        + f32(*range(12))
        + b"\3\0",
        lambda size: size == 0,
    )
    assert described["elements"] == [
        {
            "name": "scope",
            "device_name": "V1",
            "patient_name": "Doe",
            "patient_id": "007",
            "zoom_level": -2,
            "focal_length": 50.0,
            "size": [640, 480, 1],
            "wire_matrix": [float(number) for number in range(12)],
            "scalar_type": 3,
        }
    ]


def test_the_last_fraction_of_a_second_is_that_of_the_reference_library() -> None:
    """It rounds up, bit by bit."""
    (row,) = element(ImageMetaList, "", "", "", "", "", 2**64 - 1, [0, 0, 0], 0, 0).describe()["elements"]
    assert row["timestamp"] == {"sec": 2**32 - 1, "nanosec": 1_000_000_010}
