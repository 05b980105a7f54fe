"""Builds the MetaImage header of a tracked sequence, which PLUS, 3D Slicer, ITK and VTK interpret equally.

PLUS's reader (IGSIO) requires ``ObjectType`` first, lines below 1,000 characters, 2 to 4 dimensions, a known
orientation and type of the ultrasound image, and little-endian pixels: it ignores the byte order field.  ITK reads row
*i* of TransformMatrix as the direction of axis *i*, in LPS.  ``docs/reference/formats.md`` has the table of rules; a
test checks it.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping

from igtl_gateway.addon.igtl import SCALARS, Image
from igtl_gateway.addon.streams import ImagePlacement, Vector
from igtl_gateway.addons.exchange.metaimage import MET_NAMES

#: Orientations of ultrasound images in PLUS, by the axes along rows and columns: Marked or Unmarked side, Far or Near,
#: Ascending or Descending.
ORIENTATIONS = (
    *("UF", "UN", "MF", "MN", "FU", "NU", "FM", "NM"),
    *("UFA", "UNA", "MFA", "MNA", "UFD", "UND", "MFD", "MND"),
    *("AMF", "AUF", "AMN", "AUN"),
)
#: Types of ultrasound images in PLUS.
IMAGE_TYPES = ("BRIGHTNESS", "RF_REAL", "RF_IQ_LINE", "RF_I_LINE_Q_LINE", "RGB_COLOR")
#: Field that is filled in after the pixels are compressed, and the width of its value.
SIZE_KEY, SIZE_WIDTH = "CompressedDataSize = ", 20

#: Field of MetaImage → name of the field in NRRD files of PLUS.
_NRRD_NAMES = {
    "UltrasoundImageOrientation": "ultrasound image orientation",
    "UltrasoundImageType": "ultrasound image type",
}
_UNPLACED = ImagePlacement(((-1.0, 0.0, 0.0), (0.0, -1.0, 0.0), (0.0, 0.0, 1.0)), (0.0, 0.0, 0.0))


def metaimage_header(
    image: Image | None, place: ImagePlacement | None, count: int, session: Mapping[str, str], epoch: str
) -> list[str]:
    """Return the lines before the fields of the frames.

    Args:
        image: any image of the sequence; None if it has only transforms: each frame then has one pixel.
        place: position and orientation of all frames; None writes ITK's identity.
        count: number of frames.
        session: metadata of the session; that of an imported session contains the header of the source.
        epoch: the complete line of the field with the epoch of the times.

    A slice keeps its direction in space, although the third axis is time: rows have three coordinates.  A single frame
    has no time axis.
    """
    size = list(image.dimensions if image else (1, 1, 1))
    has_time_axis = count > 1
    if has_time_axis:
        size = [*(size if size[2] > 1 else size[:2]), count]
    axes, origin = (place or _UNPLACED).in_space("LPS")
    lengths = [math.hypot(*axis) for axis in axes]
    directions = [_scaled(axis, 1 / length) for axis, length in zip(axes, lengths, strict=True)]
    dims = len(size)
    matrix = [[directions[i][j] if i < 3 and j < 3 else float(i == j) for j in range(dims)] for i in range(dims)]
    known = _source_header(session)
    components = image.num_components if image else 1
    kinds = [*(["domain"] * (dims - has_time_axis)), *(["list"] * has_time_axis)]
    return [
        "ObjectType = Image",
        f"NDims = {dims}",
        "AnatomicalOrientation = RAI",
        "BinaryData = True",
        "BinaryDataByteOrderMSB = False",
        f"CenterOfRotation = {_words([0.0] * dims)}",
        "CompressedData = True",
        f"{SIZE_KEY}{'':<{SIZE_WIDTH}}",
        f"DimSize = {' '.join(map(str, size))}",
        f"Kinds = {' '.join(kinds)}",
        f"ElementNumberOfChannels = {components}",
        f"ElementSpacing = {_words([*lengths, 1.0][:dims])}",
        f"ElementType = {MET_NAMES[SCALARS[image.number_type]] if image else 'MET_UCHAR'}",
        f"Offset = {_words([*origin, 0.0][:dims])}",
        f"TransformMatrix = {_words([value for row in matrix for value in row])}",
        f"UltrasoundImageOrientation = {_source_value(known, 'UltrasoundImageOrientation', ORIENTATIONS, 'MF')}",
        f"UltrasoundImageType = {_type(known, components)}",
        epoch,
    ]


def _type(known: Mapping[str, str], components: int) -> str:
    """Return the image type of the source if it fits the number of components, otherwise a default."""
    default = "RGB_COLOR" if components == 3 else "BRIGHTNESS"
    found = _source_value(known, "UltrasoundImageType", IMAGE_TYPES, default)
    return found if (found == "RGB_COLOR") == (components == 3) else default


def _source_value(header: Mapping[str, str], key: str, good: tuple[str, ...], default: str) -> str:
    """Return a field of the source's header, by its name in MetaImage or NRRD, if PLUS knows the value."""
    found = header.get(key, header.get(_NRRD_NAMES[key], "")).upper()
    return found if found in good else default


def _source_header(session: Mapping[str, str]) -> dict[str, str]:
    """Return the header of the sequence that the session was imported from; empty for other sessions."""
    try:
        header = json.loads(session.get("sequence_header", "{}"))
    except (ValueError, RecursionError):
        return {}
    return {str(key): str(value) for key, value in header.items()} if isinstance(header, dict) else {}


def _scaled(vector: Vector, factor: float) -> Vector:
    x, y, z = vector
    return x * factor, y * factor, z * factor


def _words(values: list[float]) -> str:
    return " ".join(f"{value:.17g}" for value in values)
