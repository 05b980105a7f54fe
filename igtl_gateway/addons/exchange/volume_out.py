"""Export to NRRD: one file per IMAGE, igtl_msgs/Volume or sensor_msgs/Image, with position and orientation.

``space`` is right-anterior-superior or left-posterior-superior, as in the message; ``space directions`` and
``space origin`` (centre of the first voxel) are in millimetres.  A sensor_msgs/Image has no position: it is centred,
with pixels of 1 mm.  If the matrix of an IMAGE is invalid (axes of zero length, coplanar, or not finite), the file has
spacings of 1 instead, and a note reports it; a slice without a third axis gets its normal.  Pixels are not compressed
and keep their byte order.

A picture is written once: the outputs of the gateway that an input caused are copies of it, and are left out.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from igtl_gateway.addon import ConversionError
from igtl_gateway.addon.igtl import BIG_ENDIAN, SCALARS, Image
from igtl_gateway.addon.messages import (
    ConvertedMessage,
    LengthUnits,
    ToIgtlContext,
    image_to_igtl,
    millimetres,
    volume_to_image,
)
from igtl_gateway.addon.reading import Entry, recorded_acceptance, recorded_units
from igtl_gateway.addon.ros import Image as RosImage
from igtl_gateway.addon.ros import Volume
from igtl_gateway.addon.settings import Acceptance
from igtl_gateway.addon.streams import ImagePlacement, Vector, has_own_normal
from igtl_gateway.addon.terminal import counted
from igtl_gateway.addons.exchange.account import ExportAccount
from igtl_gateway.addons.exchange.folder import export_one_file_each
from igtl_gateway.addons.exchange.selection import Recording

_TO_IMAGE: dict[str, Callable[[bytes, ToIgtlContext], ConvertedMessage]] = {
    Volume.TYPE: lambda data, to: volume_to_image(Volume.unpack(data), to),
    RosImage.TYPE: lambda data, to: image_to_igtl(RosImage.unpack(data), to),
}
#: Types of messages with a picture.
PICTURES = frozenset({"IMAGE", *_TO_IMAGE})
_TYPES = {"i": "int", "u": "uint"}
_SPACES = {"LPS": "left-posterior-superior", "RAS": "right-anterior-superior"}


def export_nrrd(recording: Recording, out: Path, globs: Sequence[str]) -> ExportAccount:
    """Write the directory ``out``.  Raises UnsupportedRecording if it is not empty; OSError."""
    unplaced: Counter[str] = Counter()
    completed: Counter[str] = Counter()

    def count(image: Image, entry: Entry, _account: ExportAccount) -> None:
        unplaced[entry.channel] += ImagePlacement.of_image(image) is None
        completed[entry.channel] += ImagePlacement.of_image(image) is not None and not has_own_normal(image)

    units, accepted = recorded_units(recording), recorded_acceptance(recording)

    def read(entry: Entry) -> Image:
        return export_picture_of(entry, units.of(entry.kind, entry.channel, entry.type, entry.links), accepted)

    account = export_one_file_each(
        recording, out, globs, PICTURES, "nrrd", read, lambda content: (nrrd_header(content), content.pixels), count,
        once=True,
    )  # fmt: skip
    for stream, number in sorted((+unplaced).items()):
        account.notes.append(
            f"{stream}: {number} without a position: invalid matrix (axes of zero length, coplanar, or not finite)"
        )
    for stream, number in sorted((+completed).items()):
        account.notes.append(
            f"{stream}: {counted(number, 'slice')} without a third axis: it is set to the normal, 1 mm"
        )
    return account


def export_picture_of(entry: Entry, unit: str, acceptance: Acceptance) -> Image:
    """Return the picture of a message with lengths in ``unit``, placed in millimetres.

    Raises WireError or ConversionError if it has none, or only a part of one.
    """
    if entry.type in _TO_IMAGE:
        content = _TO_IMAGE[entry.type](entry.data(), ToIgtlContext(LengthUnits(unit, "mm"))).content
    else:
        content = acceptance.message(entry.data()).content
        if isinstance(content, Image):
            content = in_millimetres(content, unit)
    if not isinstance(content, Image) or not content.expected_bytes:
        raise ConversionError(f"{entry.channel}: found no pixels, expected an image with pixels")
    if content.sub_size != content.dimensions:
        raise ConversionError(f"{entry.channel}: found part of an image, expected a complete one")
    return content


def in_millimetres(image: Image, unit: str) -> Image:
    """Return a picture whose matrix has lengths in ``unit``, with one in millimetres."""
    if unit == "mm":
        return image
    return replace(image, wire_matrix=tuple(map(millimetres(unit).to_ros, image.wire_matrix)))


def nrrd_header(image: Image) -> bytes:
    """Return the header before the pixels of an image."""
    place, space = ImagePlacement.of_image(image), "LPS" if image.is_lps else "RAS"
    dtype = np.dtype(SCALARS[image.number_type])
    kind = (
        _TYPES[dtype.kind] + f"{dtype.itemsize * 8}"
        if dtype.kind in _TYPES
        else {4: "float", 8: "double"}[dtype.itemsize]
    )
    sizes = " ".join(str(size) for size in image.dimensions)
    many = image.num_components > 1
    lines = [
        "NRRD0004",
        "# igtl-gateway: https://teem.sourceforge.net/nrrd/format.html",
        f"type: {kind}",
        f"dimension: {4 if many else 3}",
        *([f"space: {_SPACES[space]}"] if place else []),
        f"sizes: {f'{image.num_components} ' if many else ''}{sizes}",
        f"kinds: {'vector ' if many else ''}domain domain domain",
        *([f"endian: {'big' if image.endian == BIG_ENDIAN else 'little'}"] if dtype.itemsize > 1 else []),
        "encoding: raw",
        *(_placement_lines(place, space, many=many) if place else [f"spacings: {'nan ' if many else ''}1 1 1"]),
    ]
    return "\n".join(lines).encode() + b"\n\n"


def _placement_lines(place: ImagePlacement, space: str, *, many: bool) -> list[str]:
    axes, origin = place.in_space(space)
    return [
        f"space directions: {'none ' if many else ''}{' '.join(map(_vector, axes))}",
        f"space origin: {_vector(origin)}",
        'space units: "mm" "mm" "mm"',
    ]


def _vector(values: Vector) -> str:
    return f"({','.join(f'{value:.17g}' for value in values)})"
