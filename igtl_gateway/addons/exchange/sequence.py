"""Import of images and tracked sequences: MetaImage, NRRD and NIfTI become IMAGE and TRANSFORM.

A *tracked sequence* of PLUS or 3D Slicer has images over time and fields ``Seq_Frame0012_ProbeToTrackerTransform`` in
its header.  Each frame becomes the messages of the tracker and the ultrasound machine: a TRANSFORM for each transform
whose status is OK, named as in the file without ``Transform``, then an IMAGE named ``Image``, all with the stamp of the
frame.  A *plain image* (slice, volume, volumes over time) becomes an IMAGE for each frame.

Every IMAGE has the position of the header, in RAS.  Pixels are not changed, nor is their byte order; the session
metadata contains the other fields of the header.  Times of frames are seconds from a start time, which is
``epoch_ns``.

Memory: the header, and one frame.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from decimal import Decimal, InvalidOperation
from pathlib import Path
from typing import BinaryIO

from igtl_gateway.addon import NS_PER_S, DamagedRecording
from igtl_gateway.addon.igtl import (
    BIG_ENDIAN,
    LITTLE_ENDIAN,
    SCALARS,
    Image,
    Message,
    Transform,
    cut_text,
    encode,
    ns_to_ticks,
)
from igtl_gateway.addon.reading import Buffer, join
from igtl_gateway.addon.streams import COORDINATE
from igtl_gateway.addon.terminal import by_count, counted
from igtl_gateway.addon.untrusted import files, limits, whole_number
from igtl_gateway.addons.exchange import pixels
from igtl_gateway.addons.exchange.header import ImageFile
from igtl_gateway.addons.exchange.metaimage import read_metaimage
from igtl_gateway.addons.exchange.nrrd import read_nrrd
from igtl_gateway.addons.exchange.raster import WIDER, check_room
from igtl_gateway.addons.exchange.source import (
    ImportedItem,
    ImportedStream,
    NonRosSource,
    file_begin_items,
    file_end_item,
    library_errors_as_damage,
    note_item,
    peer_item,
)

#: Default epoch of the times in a file: 2000-01-01T00:00:00Z.
DEFAULT_EPOCH_NS = 946_684_800 * NS_PER_S
#: Header field of our own exports with the epoch, UTC ns.
EPOCH_FIELD = "IgtlGatewayEpochNs"
#: Code of the note at the frame where a transform becomes invalid.
TRANSFORM_STATUS = "transform_status"
IMAGE_DEVICE = "Image"
OK = "OK"
#: Fields with the status of a frame's image: PLUS writes the first in MetaImage, the second in NRRD.
_IMAGE_STATUS = ("ImageStatus", "Status")
_TIMESTAMP = "Timestamp"

_LINK = 1
#: Largest number of a TRANSFORM; difference of numbers that are equal.
_MOST, _EQUAL = 3.4e38, 1e-6
#: End of the range of OpenIGTLink stamps, in 2106; UTC ns.
_STAMPS_END = NS_PER_S << 32
#: Longest header field that the session metadata contains, in characters.
_MAX_FIELD_CHARS = 10_000
_SCALAR_OF = {dtype: number for number, dtype in SCALARS.items()}

Reader = Callable[[Path, BinaryIO], ImageFile]


class Sequence(NonRosSource):
    """An open file.  Raises DamagedRecording, or UnsupportedRecording if IMAGE cannot represent its pixels."""

    def __init__(self, path: Path, epoch_ns: int | None = None, read: Reader | None = None) -> None:
        super().__init__("", {})
        self._path = path
        with library_errors_as_damage(path), files.open_file(path) as stream:
            if read is None:
                start = stream.read(4)
                stream.seek(0)
                read = read_nrrd if start == b"NRRD" else read_metaimage
            imported = read(path, stream)
            check_room(imported.raster, files.size_of(imported.raster.data))
        self._raster, self._fields = (raster := imported.raster), imported.fields
        self.notes += imported.notes
        tracked = any(fields.keys() - {*_IMAGE_STATUS} for fields in imported.frames.values())
        self._frames = self._numbered(imported)
        self.title = f"{'tracked sequence' if tracked else 'image'} {path.name}"
        self.epoch_ns = self._epoch(imported.fields) if epoch_ns is None else epoch_ns
        stored_fields = {key: value for key, value in imported.fields.items() if len(value) <= _MAX_FIELD_CHARS}
        if left := sorted(imported.fields.keys() - stored_fields.keys()):
            names = _shortened(left)
            self.notes.append(f"header fields of more than {_MAX_FIELD_CHARS} characters are not imported: {names}")
        self.facts |= {
            "imported_format": "sequence" if tracked else "image",
            "sequence_epoch_ns": str(self.epoch_ns),
            "sequence_header": json.dumps(stored_fields, sort_keys=True),
        }
        self._transform_rows = self._rows_of_transforms()
        self._image_row = ImportedStream(IMAGE_DEVICE, raster.frames, "IMAGE")
        if not raster.frame_bytes:
            self._image_row.left_out, self._image_row.why = raster.frames, "the file has no pixels"
        self.rows = [*self._transform_rows.values(), self._image_row]
        self._matrix = raster.place.wire_matrix(raster.size, str(path)) if raster.place else Image.IDENTITY
        self._stampless, self._tracked = 0, tracked
        self._note_differences()

    def _numbered(self, imported: ImageFile) -> dict[int, dict[str, str]]:
        """Return the fields of the frames by index; in an excerpt of a sequence the numbers do not begin at 0."""
        numbers, frames = sorted(imported.frames), self._raster.frames
        if numbers and numbers[-1] >= frames > numbers[-1] - numbers[0]:
            return {number - numbers[0]: imported.frames[number] for number in numbers}
        return {number: imported.frames[number] for number in numbers}

    def _epoch(self, fields: dict[str, str]) -> int:
        declared = fields.get(EPOCH_FIELD, "")
        epoch_ns = whole_number(declared, _STAMPS_END - 1)
        return DEFAULT_EPOCH_NS if epoch_ns is None else epoch_ns

    def _rows_of_transforms(self) -> dict[str, ImportedStream]:
        rows: dict[str, ImportedStream] = {}
        for fields in self._frames.values():
            for name in _transforms_of(fields):
                row = rows.setdefault(name, ImportedStream(name, 0, "TRANSFORM"))
                row.declared += 1
                if _transform_status(fields, name) != OK:
                    row.left_out += 1
                    row.why = "status not OK"
        limits.check_limit("fields", len(rows), f"{self._path}: transforms")
        self._devices = _device_names(sorted(rows))
        for name, device in self._devices.items():
            if device != name:
                self.notes.append(f"{name}: shortened to {device}, because a device name has at most 20 bytes")
        return dict(sorted(rows.items()))

    def _note_differences(self) -> None:
        """Add notes on everything that is not imported unchanged."""
        raster = self._raster
        extra = {name for fields in self._frames.values() for name in fields} - {_TIMESTAMP, *_IMAGE_STATUS}
        extra -= {f"{name}Transform{end}" for name in self._devices for end in ("", "Status")}
        if extra:
            self.notes.append(f"fields of frames that are not imported: {_shortened(sorted(extra))}")
        if self._frames and (len(self._frames) != raster.frames or max(self._frames) >= raster.frames):
            self.notes.append(
                f"{counted(raster.frames, 'frame')} declared, but {counted(len(self._frames), 'frame')} "
                f"{by_count(len(self._frames), 'has', 'have')} fields"
            )
        if not self._tracked and raster.frames > 1 and not raster.times_s:
            self.notes.append("the frames have no times: they are placed 1 ns apart")
        if (orientation := _source_orientation(self._fields)) and raster.frame_bytes:
            self.notes.append(
                f"ultrasound images keep the orientation {orientation[:20]}, as in the file; "
                "PLUS converts them when it reads them"
            )
        if raster.dtype in WIDER:
            self.notes.append(
                "64-bit integers, which IMAGE does not support, are converted to float64 with the same values"
            )

    def items(self) -> Iterator[ImportedItem]:
        raster = self._raster
        images = pixels.read_frames(raster, self.notes) if raster.frame_bytes else iter(())
        count = raster.frames if raster.frame_bytes else 0
        start_ns = time_ns = self._time_ns(0, self.epoch_ns)
        yield from file_begin_items(self._path, start_ns, _LINK)
        self._stampless = same = 0
        invalid: set[str] = set()
        for index in self._indices(count):
            before_ns, time_ns = time_ns, self._time_ns(index, time_ns)
            same += index > 0 and time_ns == before_ns
            fields = self._frames.get(index, {})
            yield from self._transforms(index, time_ns, fields, invalid)
            if index >= count:
                continue
            data = next(images)
            if (status := _image_status(fields)) != OK:
                self._image_row.left_out += 1
                self._image_row.why = f"image status {status[:20]}"
                continue
            self._image_row.taken += 1
            head, _ = encode(Message("IMAGE", IMAGE_DEVICE, self._image(data), ns_to_ticks(time_ns)))
            yield peer_item(time_ns, _LINK, _with_head(head, data))
        yield file_end_item(self._path, time_ns, _LINK)
        next(images, None)  # adds a note if there is data after the last frame
        if same and not self._stampless and (self._tracked or raster.times_s):
            self.notes.append(f"frames with the time of the frame before them: {same}")
        if self._stampless:
            self.notes.append(f"frames without a time stamp: {self._stampless}; they get that of the previous frame")

    def _indices(self, images: int) -> Iterator[int]:
        """Yield the indices of frames with pixels or fields, in order."""
        yield from range(images)
        yield from (index for index in self._frames if index >= images)

    def _transforms(
        self, index: int, time_ns: int, fields: dict[str, str], invalid: set[str]
    ) -> Iterator[ImportedItem]:
        """Yield the TRANSFORMs of a frame; ``invalid`` is updated: names of transforms whose last status is not OK."""
        ticks = ns_to_ticks(time_ns)
        for name in _transforms_of(fields):
            device, status = self._devices[name], _transform_status(fields, name)
            if status == OK:
                invalid.discard(name)
                text, place = fields[f"{name}Transform"], f"{self._path}: frame {index}, {name}Transform"
                rows = _matrix(text, place)
                if why := no_pose(rows):
                    row = self._transform_rows[name]
                    row.left_out += 1
                    row.why = f"{row.why}; {why}" if row.why and why not in row.why else why
                    continue
                content = Transform.from_rows(rows)
                self._transform_rows[name].taken += 1
                yield peer_item(time_ns, _LINK, join(encode(Message("TRANSFORM", device, content, ticks))))
            elif name not in invalid:
                invalid.add(name)
                text = f"{name} has the status {status} from frame {index}"
                data: dict[str, object] = {"status": status, "transform": name}
                yield note_item(time_ns, TRANSFORM_STATUS, text, stream=f"TRANSFORM/{device}", data=data)

    def _time_ns(self, index: int, before_ns: int) -> int:
        """Return the time of a frame, UTC ns; ``before_ns``, that of the previous frame, if it has no stamp."""
        times = self._raster.times_s
        text = self._frames.get(index, {}).get(_TIMESTAMP, repr(times[index]) if index < len(times) else "")
        try:
            seconds = Decimal(text)
        except InvalidOperation:
            seconds = Decimal("NaN")
        if not seconds.is_finite():
            self._stampless += self._tracked
            return before_ns
        # 10^12 s is later than every stamp; a larger power of ten must not be computed as an integer
        time_ns = self.epoch_ns + int(seconds * NS_PER_S) if seconds.adjusted() < 12 else _STAMPS_END
        if not 0 <= time_ns < _STAMPS_END:
            raise DamagedRecording(
                f"{self._path}: frame {index}: found time stamp {text[:40]}, expected a time from 1970 to 2106"
            )
        return time_ns

    def _image(self, data: Buffer) -> Image:
        raster = self._raster
        return Image(
            raster.size,
            _SCALAR_OF[WIDER.get(raster.dtype, raster.dtype)],
            data,
            raster.components,
            BIG_ENDIAN if raster.big_endian else LITTLE_ENDIAN,
            COORDINATE,
            self._matrix,
        )

    def close(self) -> None:
        """Do nothing: no file is open outside ``items``."""


def _with_head(head: Buffer, pixels: bytearray | bytes) -> Buffer:
    """Return a message; its pixels are moved and not copied if they can be, because a volume may fill the memory."""
    if isinstance(pixels, bytes):
        return join([head, pixels])
    pixels[:0] = head
    return memoryview(pixels)


def _image_status(fields: dict[str, str]) -> str:
    return next((fields[key].upper() for key in _IMAGE_STATUS if fields.get(key)), OK)


def _transform_status(fields: dict[str, str], name: str) -> str:
    """Return the status in upper case, because PLUS ignores the case."""
    return fields.get(f"{name}TransformStatus", OK).upper()


def _source_orientation(fields: dict[str, str]) -> str:
    """Return the orientation of ultrasound images in the file if PLUS turns them when it reads it, else ``""``."""
    values = {key.lower().replace(" ", ""): value.upper() for key, value in fields.items()}
    orientation = values.get("ultrasoundimageorientation", "XX")
    unchanged = ("FM",) if values.get("ultrasoundimagetype", "").startswith("RF") else ("MF", "MFA")
    return "" if orientation in {"XX", *unchanged} else orientation


def _transforms_of(fields: dict[str, str]) -> list[str]:
    """Return the names of the transforms of a frame."""
    return sorted(name.removesuffix("Transform") for name in fields if name.endswith("Transform"))


def _shortened(names: list[str]) -> str:
    """Return the first names as text, with the number of further ones."""
    more = f" and {len(names) - 12} more" if len(names) > 12 else ""
    return ", ".join(name[:60] for name in names[:12]) + more


def _device_names(names: list[str]) -> dict[str, str]:
    """Return name in the file → device name of at most 20 bytes, all different."""
    devices: dict[str, str] = {}
    taken: set[str] = set()
    last: dict[str, int] = {}
    for name in names:
        cut = device = cut_text(name, 20)
        number = last.get(cut, 1)
        while device in taken:
            number += 1
            device = f"{cut_text(name, 20 - len(str(number)))}{number}"
        last[cut] = number
        devices[name] = device
        taken.add(device)
    return devices


def no_pose(rows: list[list[float]]) -> str:
    """Return why a matrix (4, 4) cannot be that of a TRANSFORM, whose numbers are float32; ``""`` if it can."""
    if not all(abs(value) <= _MOST for row in rows for value in row):  # NaN neither
        return "not finite, or beyond float32"
    last = zip(rows[3], (0.0, 0.0, 0.0, 1.0), strict=True)
    return "" if all(abs(value - wanted) <= _EQUAL for value, wanted in last) else "its last row is not 0 0 0 1"


def _matrix(text: str, place: str) -> list[list[float]]:
    try:
        values = [float(word) for word in text.split()]
    except ValueError:
        values = []
    if len(values) != 16:
        raise DamagedRecording(f"{place}: found {text[:60]!r}, expected 16 numbers")
    return [values[row * 4 : row * 4 + 4] for row in range(4)]
