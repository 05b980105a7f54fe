"""IMGMETA, LBMETA and VIDEOMETA: what a peer has to offer.

Each element names a device whose IMAGE or VIDEO can be asked for.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from igtl_gateway.base.stamp import fraction_to_ns
from igtl_gateway.wire.elements import Elements
from igtl_gateway.wire.layout import Layout, of_dtype
from igtl_gateway.wire.traits import LIST, Traits

#: One image, 260 bytes.
IMAGE_META_DTYPE = np.dtype(
    [
        ("name", "S64"),
        ("device_name", "S20"),
        ("modality", "S32"),
        ("patient_name", "S64"),
        ("patient_id", "S64"),
        ("ticks", ">u8"),
        ("size", ">u2", 3),
        ("scalar_type", "u1"),
        ("reserved", "u1"),
    ]
)

#: One label map, 116 bytes.
LABEL_META_DTYPE = np.dtype(
    [
        ("name", "S64"),
        ("device_name", "S20"),
        ("label", "u1"),
        ("reserved", "u1"),
        ("rgba", "u1", 4),
        ("size", ">u2", 3),
        ("owner", "S20"),
    ]
)

#: One video source, 322 bytes.
VIDEO_META_DTYPE = np.dtype(
    [
        ("name", "S64"),
        ("device_name", "S64"),
        ("patient_name", "S64"),
        ("patient_id", "S64"),
        ("zoom_level", ">i2"),
        ("focal_length", ">f8"),
        ("size", ">u2", 3),
        ("matrix", ">f4", 12),
        ("scalar_type", "u1"),
        ("reserved", "u1"),
    ]
)


def _describe_ticks(ticks: int) -> dict[str, int]:
    return {"sec": ticks >> 32, "nanosec": fraction_to_ns(ticks & 0xFFFFFFFF)}


@dataclass(frozen=True, slots=True, eq=False)
class ImageMetaList(Elements):
    """IMGMETA: the images that can be requested (``Protocol/imagemeta.md``).

    Attributes:
        elements: structured array of ``IMAGE_META_DTYPE``.
    """

    PROTOCOL: ClassVar[str] = "2"
    TRAITS: ClassVar[Traits] = Traits(LIST, ns_per_byte=35)
    NAME: ClassVar[str] = "IMGMETA"
    DTYPE: ClassVar[np.dtype[np.void]] = IMAGE_META_DTYPE
    LAYOUT: ClassVar[Layout] = of_dtype(
        IMAGE_META_DTYPE,
        name="for people",
        device_name="for GET_IMAGE and GET_COLORT",
        modality="such as CT",
        ticks="time of the scan, as in the header; 0 = unset",
        size="columns, rows, slices",
        scalar_type="as in IMAGE",
        reserved="0",
    )
    SHOWN: ClassVar[Mapping[str, tuple[str, Callable[[Any], Any]]]] = {"ticks": ("timestamp", _describe_ticks)}


@dataclass(frozen=True, slots=True, eq=False)
class LabelMetaList(Elements):
    """LBMETA: the label maps that can be requested (``Protocol/labelmeta.md``).

    Attributes:
        elements: structured array of ``LABEL_META_DTYPE``.
    """

    PROTOCOL: ClassVar[str] = "2"
    TRAITS: ClassVar[Traits] = Traits(LIST, ns_per_byte=70)
    NAME: ClassVar[str] = "LBMETA"
    DTYPE: ClassVar[np.dtype[np.void]] = LABEL_META_DTYPE
    LAYOUT: ClassVar[Layout] = of_dtype(
        LABEL_META_DTYPE,
        name="for people",
        device_name="for GET_IMAGE",
        label="value of its voxels; 0 is unused",
        reserved="0",
        rgba="all 0 = no colour",
        size="columns, rows, slices of the box around it",
        owner="device name of the image that it belongs to",
    )


@dataclass(frozen=True, slots=True, eq=False)
class VideoMetaList(Elements):
    """VIDEOMETA: the videos that can be requested (``Protocol/videometa.md``).

    Attributes:
        elements: structured array of ``VIDEO_META_DTYPE``.
    """

    PROTOCOL: ClassVar[str] = "3.1"
    TRAITS: ClassVar[Traits] = Traits(LIST, ns_per_byte=100)
    NAME: ClassVar[str] = "VIDEOMETA"
    DTYPE: ClassVar[np.dtype[np.void]] = VIDEO_META_DTYPE
    LAYOUT: ClassVar[Layout] = of_dtype(
        VIDEO_META_DTYPE,
        name="for people",
        device_name="for STT_VIDEO",
        focal_length="millimetres",
        size="columns, rows, slices",
        matrix="as in IMAGE",
        scalar_type="as in IMAGE",
        reserved="0",
    )
    SHOWN: ClassVar[Mapping[str, tuple[str, Callable[[Any], Any]]]] = {"matrix": ("wire_matrix", list)}
