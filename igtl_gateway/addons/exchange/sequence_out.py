"""Export to a tracked-ultrasound sequence (``.igs.mha``) as PLUS and 3D Slicer read it.

Pixels are little-endian and compressed with zlib.  The header has one position for all images.  If the images move, the
header has none, and each frame has an ``ImageToRasTransform``.  Size, components and scalar type are those of the first
image; images that differ from it are left out.
"""

from __future__ import annotations

import zlib
from collections.abc import Iterator, Sequence
from pathlib import Path

from igtl_gateway.addon import NS_PER_S, UnsupportedRecording, distinct_names
from igtl_gateway.addon.igtl import BIG_ENDIAN, Image
from igtl_gateway.addon.reading import Buffer
from igtl_gateway.addon.streams import GAP_NS, ImagePlacement
from igtl_gateway.addon.terminal import counted
from igtl_gateway.addon.untrusted import whole_number
from igtl_gateway.addon.writing import open_new, written
from igtl_gateway.addons.exchange.account import ExportAccount
from igtl_gateway.addons.exchange.metaimage_out import SIZE_KEY, SIZE_WIDTH, metaimage_header
from igtl_gateway.addons.exchange.selection import Recording
from igtl_gateway.addons.exchange.sequence import EPOCH_FIELD
from igtl_gateway.addons.exchange.sequence_frames import IDENTITY, SequenceFrame, SequenceFrames
from igtl_gateway.addons.exchange.sequence_names import another_name, name_in_file

#: Name of the transform from pixels to RAS millimetres, used if images move and no other has it.
_IMAGE_PLACE = "ImageToRas"
#: Pixel of a frame without an image.
_NO_PIXEL = b"\0"


def export_sequence(recording: Recording, out: Path, globs: Sequence[str], gap_ns: int = GAP_NS) -> ExportAccount:
    """Write the file ``out``, which must not exist.  Raises UnsupportedRecording, ConfigError, OSError.

    ``gap_ns``: largest time between the two poses of a transform that an image may lie between.
    """
    sequence = SequenceFrames(recording, globs, gap_ns)
    survey = sequence.survey()
    count = len(survey.times)
    if not count:
        raise UnsupportedRecording("found neither a complete IMAGE nor a readable TRANSFORM, expected at least one")
    given = recording.session.get("sequence_epoch_ns", "")
    epoch_ns = whole_number(given) or 0
    account = sequence.account
    account.files = 1
    first, moving = sequence.first, ""
    if len(survey.matrices) > 1:
        moving = distinct_names({0: _IMAGE_PLACE}, name_in_file, sequence.names.values(), another_name)[0]
    place = ImagePlacement.of_image(first) if first and not moving else None
    epoch = f"{EPOCH_FIELD} = {epoch_ns}"
    with written(out) as new, open_new(new) as stream:
        text = "\n".join(metaimage_header(first, place, count, recording.session, epoch)) + "\n"
        size_at = text.index(SIZE_KEY) + len(SIZE_KEY)
        stream.write(text.encode("ascii", "replace"))
        for number, frame in enumerate(sequence.frames()):
            lines = _fields(frame, epoch_ns, moving)
            stream.write("".join(f"Seq_Frame{number:04}_{line}\n" for line in lines).encode())
        stream.write(b"ElementDataFile = LOCAL\n")
        start = stream.tell()
        packer = zlib.compressobj()
        for frame in sequence.frames():
            stream.write(packer.compress(_pixels(frame.image) if frame.image else _NO_PIXEL))
        stream.write(packer.flush())
        size = stream.tell() - start
        stream.seek(size_at)
        stream.write(f"{size:<{SIZE_WIDTH}}".encode())
    account.notes += survey.clock.notes
    sources = {name: source for source, name in sequence.names.items()}
    for name, (_, good) in survey.poses.items():
        valid = int(good.sum())
        why = (
            f"; INVALID before its first and after its last pose, and in gaps above {gap_ns / NS_PER_S:g} s (--max-gap)"
        )
        source = sources[name]
        of = "" if source.name == name and not source.link else f", of {source}"
        account.notes.append(
            f"{name}Transform{of}: OK in {valid} of {counted(count, 'frame')}{why if valid < count else ''}"
        )
    if moving:
        account.notes.append(
            f"the images move: the pose of each is its {moving}Transform (pixels to RAS, mm), and the header has none"
        )
    elif first and not place:
        account.notes.append("the matrix of the images is invalid (axes of zero length, coplanar, or not finite)")
    return account


def _pixels(image: Image) -> Buffer:
    """Return the pixels in little-endian byte order, which PLUS requires."""
    if image.endian != BIG_ENDIAN or image.dtype.itemsize == 1:
        return image.pixels
    return image.array.byteswap().tobytes()


def _fields(frame: SequenceFrame, epoch_ns: int, moving: str) -> Iterator[str]:
    """Yield the fields of a frame; ``moving``: name of the transform with the place of its image."""
    for name, (matrix, valid) in frame.transforms.items():
        yield f"{name}Transform = {matrix}"
        yield f"{name}TransformStatus = {'OK' if valid else 'INVALID'}"
    if moving and frame.image:
        place = ImagePlacement.of_image(frame.image)
        yield f"{moving}Transform = {_matrix(place) if place else IDENTITY}"
        yield f"{moving}TransformStatus = {'OK' if place else 'INVALID'}"
    seconds, rest = divmod(frame.time_ns - epoch_ns, NS_PER_S)
    yield f"Timestamp = {seconds}.{rest:09}"
    yield f"ImageStatus = {'OK' if frame.image else 'INVALID'}"


def _matrix(place: ImagePlacement) -> str:
    """Return the matrix from voxel indices to RAS millimetres, row by row."""
    columns = (*place.axes, place.origin)
    return " ".join(f"{column[row]:.9g}" for row in range(3) for column in columns) + " 0 0 0 1"
