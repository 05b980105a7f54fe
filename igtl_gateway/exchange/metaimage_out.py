"""The header of a tracked sequence as MetaImage, such that PLUS, 3D Slicer, ITK and VTK read the same of it.

PLUS's reader (IGSIO) wants ``ObjectType`` first, lines below 1,000 characters, 2 to 4 dimensions, an orientation and a
type of the ultrasound image that it knows, and little-endian pixels, whose order it does not look up.  ITK reads row
*i* of TransformMatrix as the direction of axis *i*, in LPS.  ``docs/formats.md`` has the table; a test holds it.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping

from igtl_gateway.exchange.metaimage import MET_NAMES
from igtl_gateway.exchange.placement import ImagePlacement, Vector
from igtl_gateway.wire.image import SCALARS, Image

#: Orientations of ultrasound images that PLUS knows, by the axes along rows and columns: Marked or Unmarked side, Far
#: or Near, Ascending or Descending.
ORIENTATIONS = (
    *("UF", "UN", "MF", "MN", "FU", "NU", "FM", "NM"),
    *("UFA", "UNA", "MFA", "MNA", "UFD", "UND", "MFD", "MND"),
    *("AMF", "AUF", "AMN", "AUN"),
)
#: Types of ultrasound images that PLUS knows.
IMAGE_TYPES = ("BRIGHTNESS", "RF_REAL", "RF_IQ_LINE", "RF_I_LINE_Q_LINE", "RGB_COLOR")
#: Replaced once the pixels are packed.
SIZE_KEY, SIZE_WIDTH = "CompressedDataSize = ", 20

#: What NRRD files of PLUS call the same fields.
_IN_NRRD = {
    "UltrasoundImageOrientation": "ultrasound image orientation",
    "UltrasoundImageType": "ultrasound image type",
}
_UNPLACED = ImagePlacement(((-1.0, 0.0, 0.0), (0.0, -1.0, 0.0), (0.0, 0.0, 1.0)), (0.0, 0.0, 0.0))


def metaimage_header(
    image: Image | None, place: ImagePlacement | None, count: int, session: Mapping[str, str], epoch: str
) -> list[str]:
    """The lines before the fields of the frames.

    Args:
        image: any of the sequence; None where it has transforms only: then a pixel stands for each image.
        place: of all frames; None writes ITK's identity.
        count: of frames.
        session: facts of the session, which may have the header that the sequence came from.
        epoch: the whole field that says what times count from.

    A slice keeps its direction in space, although the third axis is time: rows have three coordinates.  One frame has
    no axis of time.
    """
    size = list(image.dimensions if image else (1, 1, 1))
    listed = count > 1
    if listed:
        size = [*(size if size[2] > 1 else size[:2]), count]
    axes, origin = (place or _UNPLACED).in_space("LPS")
    lengths = [math.hypot(*axis) for axis in axes]
    directions = [_scaled(axis, 1 / length) for axis, length in zip(axes, lengths, strict=True)]
    dims = len(size)
    matrix = [[directions[i][j] if i < 3 and j < 3 else float(i == j) for j in range(dims)] for i in range(dims)]
    known = _source_header(session)
    components = image.num_components if image else 1
    kinds = [*(["domain"] * (dims - listed)), *(["list"] * listed)]
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
        f"ElementType = {MET_NAMES[SCALARS[image.scalar_type]] if image else 'MET_UCHAR'}",
        f"Offset = {_words([*origin, 0.0][:dims])}",
        f"TransformMatrix = {_words([value for row in matrix for value in row])}",
        f"UltrasoundImageOrientation = {_source_value(known, 'UltrasoundImageOrientation', ORIENTATIONS, 'MF')}",
        f"UltrasoundImageType = {_type(known, components)}",
        epoch,
    ]


def _type(known: Mapping[str, str], components: int) -> str:
    """The type of the source, where it fits the number of components."""
    default = "RGB_COLOR" if components == 3 else "BRIGHTNESS"
    found = _source_value(known, "UltrasoundImageType", IMAGE_TYPES, default)
    return found if (found == "RGB_COLOR") == (components == 3) else default


def _source_value(header: Mapping[str, str], key: str, good: tuple[str, ...], default: str) -> str:
    """A value of the source's header, MetaImage's or NRRD's name of it, that PLUS knows."""
    nrrd = {
        "UltrasoundImageOrientation": "ultrasound image orientation",
        "UltrasoundImageType": "ultrasound image type",
    }
    found = header.get(key, header.get(nrrd[key], "")).upper()
    return found if found in good else default


def _source_header(session: Mapping[str, str]) -> dict[str, str]:
    """The header of the sequence that the session was imported from, if it was one."""
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
