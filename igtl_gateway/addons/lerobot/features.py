"""What ``info.json`` states about a feature: numbers, text, or pictures, as a video or in the table.

It has all forms that LeRobot writes (``get_hf_features_from_features`` of its version 0.6.1), not only ours.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import pyarrow as pa

#: Types of features without pictures: those of numpy that LeRobot stores.
ARROW = {
    "float16": pa.float16(),
    "float32": pa.float32(),
    "float64": pa.float64(),
    "int8": pa.int8(),
    "int16": pa.int16(),
    "int32": pa.int32(),
    "int64": pa.int64(),
    "uint8": pa.uint8(),
    "uint16": pa.uint16(),
    "uint32": pa.uint32(),
    "uint64": pa.uint64(),
    "string": pa.string(),
    "bool": pa.bool_(),
}
#: Types of features with pictures: in files of their own, or encoded in a column.
VIDEO, IMAGE = "video", "image"
#: Types without statistics; annotations in ``language`` have a form of their own, and LeRobot alone knows it.
LANGUAGE = "language"
TEXTS = ("string", LANGUAGE)
#: The column of encoded pictures.
IMAGE_COLUMN = pa.struct([("bytes", pa.binary()), ("path", pa.string())])
_CHANNELS = (1, 3, 4)
_DEPTH = "is_depth_map"


def is_picture(feature: Mapping[str, Any]) -> bool:
    """Return whether a feature is a picture."""
    return feature["dtype"] in (VIDEO, IMAGE)


def is_depth(feature: Mapping[str, Any]) -> bool:
    """Return whether a picture is a depth map, whose statistics are in the unit of the depth."""
    parts = [feature.get(each) for each in ("info", "video_info")]
    return any(
        isinstance(part, Mapping) and (part.get(_DEPTH) is True or part.get(f"video.{_DEPTH}") is True)
        for part in parts
    )


def picture_size(feature: Mapping[str, Any]) -> tuple[int, int]:
    """Return rows and columns of a picture; some programs state the channels first."""
    one, two, three = feature["shape"]
    names = feature.get("names")
    named_first = isinstance(names, list) and bool(names) and str(names[0]).startswith("channel")
    if one in _CHANNELS and (named_first or three not in _CHANNELS):
        return two, three
    return one, two


def stats_shapes(feature: Mapping[str, Any]) -> list[tuple[int, ...]]:
    """Return the shapes that the statistics of a feature may have; the first is that of an export."""
    if is_picture(feature):
        return [(1, 1, 1), (3, 1, 1)] if is_depth(feature) else [(3, 1, 1)]
    sizes = tuple(feature["shape"])
    # of numbers in several dimensions LeRobot has those of the last one, and of a single frame those of all
    return list(dict.fromkeys([(math.prod(sizes),), sizes[-1:], sizes]))


def innermost(kind: pa.DataType) -> tuple[pa.DataType, int]:
    """Return the type in the innermost lists of a type, and how many lists are around it."""
    depth = 0
    while is_list(kind):
        kind, depth = kind.value_type, depth + 1
    return kind, depth


def is_list(kind: pa.DataType) -> bool:
    """Return whether a type is a list, of one length or of any."""
    return bool(pa.types.is_list(kind) or pa.types.is_large_list(kind) or pa.types.is_fixed_size_list(kind))


def is_number(kind: pa.DataType) -> bool:
    """Return whether a type is a number."""
    return bool(pa.types.is_floating(kind) or pa.types.is_integer(kind) or pa.types.is_boolean(kind))
