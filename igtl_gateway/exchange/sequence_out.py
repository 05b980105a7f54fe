"""Export to a tracked-ultrasound sequence (``.igs.mha``) as PLUS and 3D Slicer read it.

A frame is an IMAGE with every TRANSFORM as it was at that moment: the last one before, and of status OK unless it
is more than a second old, or was said to be invalid, or has not come yet.  Without images a frame is a moment at
which transforms came.  Times are the senders' stamps, where set.

Pixels are copied as they are and packed by zlib.  The place of an image in the patient is kept as spacing and offset
only; components, byte order and scalar type are those of the first image, and images unlike it are left out.
"""

from __future__ import annotations

import json
import math
import re
import zlib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from igtl_gateway.buffers import Buffer
from igtl_gateway.convert.geometry import Placement
from igtl_gateway.convert.units import Lengths
from igtl_gateway.errors import ConfigError, UnsupportedRecording, WireError
from igtl_gateway.exchange.account import Account
from igtl_gateway.exchange.recording import Recording, chosen, fits, time_of
from igtl_gateway.exchange.sequence import EPOCH_FIELD, MET_NAMES, TRANSFORM_STATUS
from igtl_gateway.session.entry import Entry, Kind
from igtl_gateway.session.note import Note
from igtl_gateway.stamp import NS_PER_S
from igtl_gateway.wire import decode
from igtl_gateway.wire.image import BIG_ENDIAN, RAS, SCALARS, Image
from igtl_gateway.wire.transform import Transform

#: A transform that is older than this when an image is taken is not valid any more.
MAX_AGE_NS = NS_PER_S
_IDENTITY = "1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1"
_MM = Lengths("mm", "mm")
#: Filled in once all is written.
_SIZE_KEY, _SIZE_WIDTH = "CompressedDataSize = ", 20


@dataclass(slots=True)
class _Tracked:
    """The last word on a transform."""

    time_ns: int = 0
    matrix: str = _IDENTITY
    valid: bool = False


@dataclass(frozen=True, slots=True)
class _Frame:
    time_ns: int
    transforms: dict[str, tuple[str, bool]]
    image: Image | None


class _Sequence:
    """The frames of a session; gone through once for the header and once for the pixels."""

    def __init__(self, recording: Recording, globs: Sequence[str]) -> None:
        self._recording, self._globs = recording, globs
        self.account = Account()
        kinds: dict[Kind, set[str]] = {Kind.IGTL_IN: set(), Kind.IGTL_OUT: set()}
        invalid: set[str] = set()
        for entry in chosen(recording, (*kinds, Kind.EDGE_NOTE), globs):
            if entry.kind is Kind.EDGE_NOTE:
                stream = _invalid_stream(entry)
                invalid |= {stream} if stream and fits(stream, Kind.IGTL_IN, globs) else set()
            elif entry.type in ("IMAGE", "TRANSFORM"):
                kinds[entry.kind].add(entry.channel)
        self.kind = next((kind for kind, streams in kinds.items() if streams), Kind.IGTL_IN)
        streams = sorted(kinds[self.kind])
        self.images = [stream for stream in streams if stream.startswith("IMAGE/")]
        if not streams:
            raise UnsupportedRecording("found no IMAGE and no TRANSFORM of OpenIGTLink, expected some")
        if len(self.images) > 1:
            raise ConfigError(f"--streams: found {', '.join(self.images)}, expected one IMAGE and its TRANSFORMs")
        self.names: dict[str, str] = {}
        # those that never were valid are in it, too
        for stream in sorted({*streams, *invalid}):
            if stream.startswith("TRANSFORM/"):
                name = re.sub(r"[^A-Za-z0-9]", "", stream.partition("/")[2]) or "Unnamed"
                while name in self.names.values():
                    name += "_"
                self.names[stream] = name
        self.first: Image | None = None

    def frames(self, account: Account) -> Iterator[_Frame]:
        """All frames; ``account`` counts what is in them."""
        tracked = {stream: _Tracked() for stream in self.names}
        moment: int | None = None  # of the frame that is being put together, where there are no images
        for entry in chosen(self._recording, (self.kind, Kind.EDGE_NOTE), ()):
            if entry.kind is Kind.EDGE_NOTE:
                stream = _invalid_stream(entry)
                if stream in tracked:
                    tracked[stream].valid = False
                continue
            if entry.channel not in self.names and entry.channel not in self.images:
                continue
            row = account.row(entry)
            try:
                content = decode(entry.data()).content
            except WireError as error:
                row.why = str(error)
                continue
            if isinstance(content, Transform):
                at = time_of(entry)
                if not self.images and moment is not None and at != moment:
                    yield self._frame(moment, tracked, None)
                moment = at
                text = " ".join(f"{value:.9g}" for matrix_row in content.rows for value in matrix_row)
                tracked[entry.channel] = _Tracked(at, text, all(map(math.isfinite, content.wire_matrix)))
                row.taken += 1
            elif isinstance(content, Image):
                if why := self._unlike(content):
                    row.why = why
                    continue
                row.taken += 1
                yield self._frame(time_of(entry), tracked, content)
            else:
                row.why = "not decoded"
        if not self.images and moment is not None:
            yield self._frame(moment, tracked, None)

    def _frame(self, time_ns: int, tracked: dict[str, _Tracked], image: Image | None) -> _Frame:
        told = {
            self.names[stream]: (one.matrix, one.valid and time_ns - one.time_ns <= MAX_AGE_NS)
            for stream, one in tracked.items()
        }
        return _Frame(time_ns, told, image)

    def _unlike(self, image: Image) -> str:
        """Why an image cannot be a frame of this sequence; ``""`` if it can."""
        if image.sub_size != image.dimensions or not math.prod(image.dimensions):
            return "part of an image, or empty"
        if self.first is None:
            self.first = image
        first = self.first
        same = (image.dimensions, image.scalar_type, image.num_components, image.endian) == (
            first.dimensions,
            first.scalar_type,
            first.num_components,
            first.endian,
        )
        return "" if same else f"unlike the first image of {first.dimensions}"


def export_sequence(recording: Recording, out: Path, globs: Sequence[str]) -> Account:
    """Write the file ``out``, which must not be there.  Raises UnsupportedRecording, ConfigError, OSError."""
    sequence = _Sequence(recording, globs)
    count = sum(1 for _ in sequence.frames(Account()))
    given = recording.session.get("sequence_epoch_ns", "")
    epoch_ns = int(given) if given.isdigit() else 0
    account = sequence.account
    account.files = 1
    with out.open("xb") as stream, _whole(out):
        header = "\n".join(_header(sequence.first, count, recording.session, epoch_ns)) + "\n"
        size_at = header.index(_SIZE_KEY) + len(_SIZE_KEY)
        stream.write(header.encode("ascii", "replace"))
        for number, frame in enumerate(sequence.frames(account)):
            stream.write("".join(f"Seq_Frame{number:04}_{line}\n" for line in _fields(frame, epoch_ns)).encode())
        stream.write(b"ElementDataFile = LOCAL\n")
        start = stream.tell()
        if sequence.first:
            packer = zlib.compressobj()
            for frame in sequence.frames(Account()):
                if frame.image:
                    stream.write(packer.compress(frame.image.pixels))
            stream.write(packer.flush())
        size = stream.tell() - start
        stream.seek(size_at)
        stream.write(f"{size:<{_SIZE_WIDTH}}".encode())
    first = sequence.first
    if first and not _is_plain(first):
        account.notes.append("the images' directions in the patient are not kept")
    return account


@contextmanager
def _whole(path: Path) -> Iterator[None]:
    """Around the writing of a file: half a sequence is none."""
    try:
        yield
    except BaseException:
        path.unlink(missing_ok=True)
        raise


def _header(image: Image | None, count: int, session: Mapping[str, str], epoch_ns: int) -> list[str]:
    known = _source_header(session)
    size = list(image.dimensions if image else (0, 0, 1))
    size = [*(size if size[2] > 1 else size[:2]), count]
    spacing, offset = (1.0, 1.0, 1.0), (0.0, 0.0, 0.0)
    if image and image.wire_matrix != Image.IDENTITY:
        placement = Placement.of_wire(image.wire_matrix, RAS, _MM)
        spacing, offset = placement.spacing, placement.origin(image.dimensions)
    axes = len(size) - 1
    numbers = " ".join
    return [
        "ObjectType = Image",
        f"NDims = {len(size)}",
        "AnatomicalOrientation = RAI",
        "BinaryData = True",
        f"BinaryDataByteOrderMSB = {bool(image and image.endian == BIG_ENDIAN)}",
        f"CenterOfRotation = {numbers(['0'] * len(size))}",
        f"CompressedData = {image is not None}",
        f"{_SIZE_KEY}{'':<{_SIZE_WIDTH}}",
        f"DimSize = {numbers(map(str, size))}",
        f"Kinds = {numbers(['domain'] * axes)} list",
        f"ElementNumberOfChannels = {image.num_components if image else 1}",
        f"ElementSpacing = {numbers(f'{value:.9g}' for value in (*spacing[:axes], 1.0))}",
        f"ElementType = {MET_NAMES[SCALARS[image.scalar_type]] if image else 'MET_UCHAR'}",
        f"Offset = {numbers(f'{value:.9g}' for value in (*offset[:axes], 0.0))}",
        f"TransformMatrix = {numbers('1' if i == j else '0' for i in range(len(size)) for j in range(len(size)))}",
        f"UltrasoundImageOrientation = {known.get('UltrasoundImageOrientation', 'XX')}",
        f"UltrasoundImageType = {known.get('UltrasoundImageType', 'XX')}",
        f"{EPOCH_FIELD} = {epoch_ns}",
    ]


def _source_header(session: Mapping[str, str]) -> dict[str, str]:
    """The header of the sequence that the session was imported from, if it was one."""
    try:
        told = json.loads(session.get("sequence_header", "{}"))
    except ValueError:
        return {}
    return {str(key): str(value) for key, value in told.items()} if isinstance(told, dict) else {}


def _fields(frame: _Frame, epoch_ns: int) -> Iterator[str]:
    for name, (matrix, valid) in frame.transforms.items():
        yield f"{name}Transform = {matrix}"
        yield f"{name}TransformStatus = {'OK' if valid else 'INVALID'}"
    seconds, rest = divmod(frame.time_ns - epoch_ns, NS_PER_S)
    yield f"Timestamp = {seconds}.{rest:09}"
    yield f"ImageStatus = {'OK' if frame.image else 'INVALID'}"


def _is_plain(image: Image) -> bool:
    """Whether the image's axes are those of the patient."""
    matrix = image.wire_matrix
    return image.coordinate == RAS and not any(matrix[index] for index in (1, 2, 3, 5, 6, 7))


def _invalid_stream(entry: Entry) -> str:
    """The stream that a note calls invalid; ``""`` for other notes."""
    payload: Buffer = entry.data()
    if TRANSFORM_STATUS.encode() not in bytes(payload):
        return ""
    try:
        note = Note.unpack(bytes(payload))
    except (ValueError, LookupError, TypeError):
        return ""
    return note.stream if note.code == TRANSFORM_STATUS else ""
