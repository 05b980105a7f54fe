"""Export to NRRD: one file per IMAGE, igtl_msgs/Volume or sensor_msgs/Image, with its place in the patient.

``space`` is right-anterior-superior or left-posterior-superior, as the message has it; ``space directions`` and
``space origin`` (centre of the first voxel) are in millimetres.  A sensor_msgs/Image has no place: it lies centred,
with pixels of one millimetre.  Pixels are not packed and keep their byte order.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from igtl_gateway.convert.context import Outgoing, ToIgtl
from igtl_gateway.convert.igtl_msgs import Volume
from igtl_gateway.convert.images import image_to_igtl
from igtl_gateway.convert.rosmsg import Image as RosImage
from igtl_gateway.convert.volumes import volume_to_image
from igtl_gateway.errors import ConversionError
from igtl_gateway.exchange.account import Account
from igtl_gateway.exchange.folder import one_file_each
from igtl_gateway.exchange.recording import Recording
from igtl_gateway.session.entry import Entry
from igtl_gateway.wire import decode
from igtl_gateway.wire.image import BIG_ENDIAN, LPS, SCALARS, Image

_TO_IMAGE: dict[str, Callable[[bytes, ToIgtl], Outgoing]] = {
    Volume.TYPE: lambda data, to: volume_to_image(Volume.unpack(data), to),
    RosImage.TYPE: lambda data, to: image_to_igtl(RosImage.unpack(data), to),
}
_READ = frozenset({"IMAGE", *_TO_IMAGE})
_TYPES = {"i": "int", "u": "uint"}


def export_nrrd(recording: Recording, out: Path, globs: Sequence[str]) -> Account:
    """Write the folder ``out``.  Raises UnsupportedRecording where it is not empty; OSError."""
    return one_file_each(
        recording, out, globs, _READ, "nrrd", _image, lambda content: (header(content), content.pixels)
    )


def _image(entry: Entry) -> Image:
    if entry.type in _TO_IMAGE:
        content = _TO_IMAGE[entry.type](entry.data(), ToIgtl()).content
    else:
        content = decode(entry.data()).content
    if not isinstance(content, Image) or not content.expected_bytes:
        raise ConversionError(f"{entry.channel}: found no pixels")
    if content.sub_size != content.dimensions:
        raise ConversionError(f"{entry.channel}: found a part of an image, expected a whole one")
    return content


def header(image: Image) -> bytes:
    """What stands before the pixels of an image."""
    matrix = np.array(image.wire_matrix, np.float64).reshape(4, 3)
    steps = (np.array(image.dimensions) - 1) / 2
    origin = matrix[3] - steps @ matrix[:3]
    dtype = np.dtype(SCALARS[image.scalar_type])
    kind = (
        _TYPES[dtype.kind] + f"{dtype.itemsize * 8}"
        if dtype.kind in _TYPES
        else {4: "float", 8: "double"}[dtype.itemsize]
    )
    directions = " ".join(_vector(axis) for axis in matrix[:3])
    sizes = " ".join(str(size) for size in image.dimensions)
    many = image.num_components > 1
    lines = [
        "NRRD0004",
        "# igtl-gateway: https://teem.sourceforge.net/nrrd/format.html",
        f"type: {kind}",
        f"dimension: {4 if many else 3}",
        f"space: {'left-posterior-superior' if image.coordinate == LPS else 'right-anterior-superior'}",
        f"sizes: {f'{image.num_components} ' if many else ''}{sizes}",
        f"space directions: {'none ' if many else ''}{directions}",
        f"kinds: {'vector ' if many else ''}domain domain domain",
        *([f"endian: {'big' if image.endian == BIG_ENDIAN else 'little'}"] if dtype.itemsize > 1 else []),
        "encoding: raw",
        f"space origin: {_vector(origin)}",
        'space units: "mm" "mm" "mm"',
    ]
    return "\n".join(lines).encode() + b"\n\n"


def _vector(values: np.ndarray[tuple[int, ...], np.dtype[np.float64]]) -> str:
    return f"({','.join(f'{value:.9g}' for value in values)})"
