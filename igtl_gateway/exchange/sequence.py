"""Tracked-ultrasound sequences of PLUS and 3D Slicer: ``.igs.mha``, ``.mha``, ``.mhd``, ``.igs.nrrd``, ``.nrrd``.

A sequence is one image whose last axis is time, with fields ``Seq_Frame0012_ProbeToTrackerTransform`` in its header.
Frame by frame it becomes what the tracker and the ultrasound machine would have sent: a TRANSFORM for each transform
whose status is OK, named as in the file without ``Transform``, then an IMAGE named ``Image``, all with the frame's
own stamp.  Pixels are passed on as they are, byte order included; the header's other fields are kept in the session.

Frames are seconds from some start: ``epoch_ns`` says when that was.  Memory: the header, and one frame.
"""

from __future__ import annotations

import json
import math
import re
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from decimal import Decimal, InvalidOperation
from pathlib import Path
from typing import IO

import numpy as np

from igtl_gateway.buffers import join
from igtl_gateway.convert.geometry import Placement
from igtl_gateway.errors import DamagedRecording, UnsupportedRecording
from igtl_gateway.exchange.source import Item, Row, Told, fact, from_peer, link_down, link_up, reading
from igtl_gateway.stamp import NS_PER_S, ns_to_ticks
from igtl_gateway.wire import Message, encode
from igtl_gateway.wire.fields import cut_text
from igtl_gateway.wire.image import BIG_ENDIAN, LITTLE_ENDIAN, SCALARS, Image
from igtl_gateway.wire.transform import Transform

#: What a file without any other word counts from: 2000-01-01T00:00:00Z.
DEFAULT_EPOCH_NS = 946_684_800 * NS_PER_S
#: Header field of our own exports, in UTC nanoseconds.
EPOCH_FIELD = "IgtlGatewayEpochNs"
#: Code of the note that says that a transform is not valid from now on.
TRANSFORM_STATUS = "transform_status"
IMAGE_DEVICE = "Image"
OK = "OK"

_LINK = 1
_MAX_HEADER = 1 << 30
_READ = 1 << 20
_FIELD = re.compile(r"Seq_Frame(\d+)_(.+)")

_MET_TYPES = {
    "MET_CHAR": "i1",
    "MET_UCHAR": "u1",
    "MET_SHORT": "i2",
    "MET_USHORT": "u2",
    "MET_INT": "i4",
    "MET_UINT": "u4",
    "MET_FLOAT": "f4",
    "MET_DOUBLE": "f8",
}
#: numpy's name of a type without byte order → MetaIO's.
MET_NAMES = {dtype: name for name, dtype in _MET_TYPES.items()}
_NRRD_TYPES = {
    **dict.fromkeys(("signed char", "int8", "int8_t"), "i1"),
    **dict.fromkeys(("uchar", "unsigned char", "uint8", "uint8_t"), "u1"),
    **dict.fromkeys(("short", "short int", "signed short", "signed short int", "int16", "int16_t"), "i2"),
    **dict.fromkeys(("ushort", "unsigned short", "unsigned short int", "uint16", "uint16_t"), "u2"),
    **dict.fromkeys(("int", "signed int", "int32", "int32_t"), "i4"),
    **dict.fromkeys(("uint", "unsigned int", "uint32", "uint32_t"), "u4"),
    "float": "f4",
    "double": "f8",
}
_SCALAR_OF = {dtype: number for number, dtype in SCALARS.items()}


@dataclass(frozen=True, slots=True)
class Layout:
    """How the pixels lie, whichever of the formats told it.

    Attributes:
        size: columns, rows, slices.
        frames: number of them.
        components: values per pixel.
        dtype: numpy's name without byte order; ``""`` where the file has no pixels.
        big_endian: of the pixels.
        spacing, origin: as the header says.
        compression: ``""``, ``"zlib"`` or ``"gzip"``.
        data_file: where the pixels are; None: behind the header.
    """

    size: tuple[int, int, int]
    frames: int
    components: int
    dtype: str
    big_endian: bool
    spacing: tuple[float, float, float]
    origin: tuple[float, float, float]
    compression: str
    data_file: str | None

    @property
    def frame_bytes(self) -> int:
        return math.prod(self.size) * self.components * (np.dtype(self.dtype).itemsize if self.dtype else 0)


class Sequence(Told):
    """An open sequence.  Raises DamagedRecording, or UnsupportedRecording for an image that is no sequence."""

    def __init__(self, path: Path, epoch_ns: int | None = None) -> None:
        super().__init__(f"tracked sequence {path.name}", {"imported_format": "sequence"})
        self._path = path
        self._stream: IO[bytes] = path.open("rb")
        try:
            with reading(path):
                self._open(epoch_ns)
        except BaseException:
            self.close()
            raise

    def _open(self, epoch_ns: int | None) -> None:
        is_nrrd = self._stream.read(4) == b"NRRD"
        self._stream.seek(0)
        header, self._frames = _read_nrrd(self._stream) if is_nrrd else _read_meta(self._stream)
        self._layout = layout = _nrrd_layout(header) if is_nrrd else _meta_layout(header)
        if not self._frames:
            raise UnsupportedRecording(f"{self._path}: has no Seq_Frame fields: an image, not a tracked sequence")
        declared_epoch = header.get(EPOCH_FIELD, "")
        default = int(declared_epoch) if declared_epoch.isdigit() else DEFAULT_EPOCH_NS
        self.epoch_ns = default if epoch_ns is None else epoch_ns
        self.facts |= {"sequence_epoch_ns": str(self.epoch_ns), "sequence_header": json.dumps(header, sort_keys=True)}
        names = sorted({name for frame in self._frames for name in frame if _is_transform(name)})
        self._devices = _device_names([name.removesuffix("Transform") for name in names])
        for name, device in self._devices.items():
            if device != name:
                self.notes.append(f"{name}: cut to {device}, a device name has at most 20 bytes")
        self._transform_rows = {}
        for name in self._devices:
            held = [frame for frame in self._frames if f"{name}Transform" in frame]
            valid = sum(frame.get(f"{name}TransformStatus", OK) == OK for frame in held)
            why = "status not OK" if valid < len(held) else ""
            row = Row(name, len(held), "TRANSFORM", left_out=len(held) - valid, why=why)
            self._transform_rows[name] = row
        self._image_row = Row(IMAGE_DEVICE, layout.frames, "IMAGE")
        if not layout.frame_bytes:
            self._image_row.left_out, self._image_row.why = layout.frames, "the file has no pixels"
        self.rows = [*self._transform_rows.values(), self._image_row]
        extra = {name for frame in self._frames for name in frame} - {"Timestamp", "ImageStatus"}
        extra -= {f"{name}Transform{end}" for name in self._devices for end in ("", "Status")}
        if extra:
            self.notes.append(f"fields of frames that are not kept: {', '.join(sorted(extra))}")
        if layout.frames != len(self._frames):
            self.notes.append(f"{layout.frames} frames declared, fields of {len(self._frames)} of them")

    def items(self) -> Iterator[Item]:
        peer = {"peer": f"file {self._path.name}", "local": "import", "role": "server"}
        pixels = self._pixels()
        start_ns = time_ns = self._time_ns(0, self.epoch_ns)
        yield link_up(start_ns, _LINK, peer)
        yield fact(start_ns, "imported", f"imported from {self._path.name}: nothing of this was sent to a gateway")
        invalid: set[str] = set()
        for index in range(max(self._layout.frames, len(self._frames))):
            time_ns = self._time_ns(index, time_ns)
            ticks = ns_to_ticks(time_ns)
            frame = self._frames[index] if index < len(self._frames) else {}
            for name, device in self._devices.items():
                text = frame.get(f"{name}Transform")
                if text is None:
                    continue
                status = frame.get(f"{name}TransformStatus", OK)
                if status != OK:
                    if name not in invalid:
                        told = f"{name} is {status} from frame {index} on"
                        yield fact(
                            time_ns,
                            TRANSFORM_STATUS,
                            told,
                            stream=f"TRANSFORM/{device}",
                            data={"status": status, "transform": name},
                        )
                    invalid.add(name)
                    continue
                invalid.discard(name)
                content = Transform.from_rows(_matrix(text, f"frame {index}, {name}Transform"))
                self._transform_rows[name].taken += 1
                yield from_peer(time_ns, _LINK, join(encode(Message("TRANSFORM", device, content, ticks))))
            if index < self._layout.frames and self._layout.frame_bytes:
                data = next(pixels)
                if frame.get("ImageStatus", OK) != OK:
                    self._image_row.left_out += 1
                    self._image_row.why = "image status not OK"
                    continue
                self._image_row.taken += 1
                yield from_peer(time_ns, _LINK, join(encode(Message("IMAGE", IMAGE_DEVICE, self._image(data), ticks))))
        yield link_down(time_ns, _LINK, peer, "the end of the file")

    def _time_ns(self, index: int, before_ns: int) -> int:
        """When a frame was taken; a frame without a stamp is as late as the one before."""
        text = self._frames[index].get("Timestamp", "") if index < len(self._frames) else ""
        try:
            time_ns = self.epoch_ns + int(Decimal(text) * NS_PER_S)
        except (InvalidOperation, ValueError, OverflowError):
            return before_ns
        if not 0 <= time_ns < 1 << 62:
            raise DamagedRecording(f"{self._path}: frame {index}: found time stamp {text}, expected seconds")
        return time_ns

    def _image(self, pixels: bytes) -> Image:
        layout = self._layout
        placement = Placement.from_origin(Image.IDENTITY[:9], layout.spacing, layout.origin, layout.size)
        x, y, z = layout.spacing
        # such a header as PLUS writes for want of a better one says nothing of a place
        unplaced = layout.spacing == (1.0, 1.0, 1.0) and layout.origin == (0.0, 0.0, 0.0)
        matrix = (x, 0.0, 0.0, 0.0, y, 0.0, 0.0, 0.0, z, *placement.center)
        return Image(
            layout.size,
            _SCALAR_OF[layout.dtype],
            pixels,
            layout.components,
            BIG_ENDIAN if layout.big_endian else LITTLE_ENDIAN,
            wire_matrix=Image.IDENTITY if unplaced else matrix,
        )

    def _pixels(self) -> Iterator[bytes]:
        """The frames, unpacked one after the other."""
        layout, size = self._layout, self._layout.frame_bytes
        if layout.data_file is not None:
            if Path(layout.data_file).name != layout.data_file:
                raise UnsupportedRecording(
                    f"{self._path}: found data file {layout.data_file!r}, expected one beside it"
                )
            self._stream.close()
            with reading(self._path.parent / layout.data_file):
                self._stream = (self._path.parent / layout.data_file).open("rb")
        unpack = zlib.decompressobj(zlib.MAX_WBITS | 32) if layout.compression else None
        for index in range(layout.frames):
            data = bytearray()
            while len(data) < size:
                missing = size - len(data)
                if unpack is None:
                    part = self._stream.read(missing)
                    ended = not part
                else:
                    packed = unpack.unconsumed_tail or self._stream.read(_READ)
                    with reading(self._path):
                        part = unpack.decompress(packed, missing)
                    ended = not packed and not part
                if ended:
                    raise DamagedRecording(
                        f"{self._path}: frame {index}: found {len(data)} bytes of pixels, expected {size}"
                    )
                data += part
            yield bytes(data)

    def close(self) -> None:
        """Close the file."""
        self._stream.close()


def _is_transform(name: str) -> bool:
    return name.endswith("Transform")


def _device_names(names: list[str]) -> dict[str, str]:
    """Name in the file → device name of at most 20 bytes, all different."""
    made: dict[str, str] = {}
    for name in names:
        device, number = cut_text(name, 20), 1
        while device in made.values():
            number += 1
            device = f"{cut_text(name, 20 - len(str(number)))}{number}"
        made[name] = device
    return made


def _matrix(text: str, place: str) -> list[list[float]]:
    try:
        values = [float(word) for word in text.split()]
    except ValueError:
        values = []
    if len(values) != 16:
        raise DamagedRecording(f"{place}: found {text[:60]!r}, expected 16 numbers")
    return [values[row * 4 : row * 4 + 4] for row in range(4)]


# --- headers ---------------------------------------------------------------------------------------------------------

Frames = list[dict[str, str]]


def _lines(stream: IO[bytes]) -> Iterator[str]:
    """Header lines; the stream stands behind each as it is given."""
    left = _MAX_HEADER
    while left > 0:
        line = stream.readline(left)
        if not line:
            return
        left -= len(line)
        yield line.decode("utf-8", "replace").rstrip("\r\n")


class _Fields:
    """Fields of the header, and of the frames by number."""

    def __init__(self) -> None:
        self.header: dict[str, str] = {}
        self._frames: dict[int, dict[str, str]] = {}

    def add(self, key: str, value: str) -> None:
        found = _FIELD.fullmatch(key)
        if found:
            self._frames.setdefault(int(found[1]), {})[found[2]] = value
        else:
            self.header[key] = value

    @property
    def frames(self) -> Frames:
        """In order of their numbers, which begin at 0 in what PLUS writes and need not in what was cut from that."""
        return [self._frames[number] for number in sorted(self._frames)]


def _read_meta(stream: IO[bytes]) -> tuple[dict[str, str], Frames]:
    """MetaIO: ``Key = value`` lines, the last one ElementDataFile."""
    fields = _Fields()
    for line in _lines(stream):
        key, equals, value = (part.strip() for part in line.partition("="))
        if equals:
            fields.add(key, value)
        if key == "ElementDataFile":
            return fields.header, fields.frames
    raise DamagedRecording("the header has no ElementDataFile")


def _meta_layout(header: dict[str, str]) -> Layout:
    size = [int(word) for word in header["DimSize"].split()]
    if len(size) not in (3, 4):
        raise UnsupportedRecording(f"found {len(size)} dimensions, expected 3 or 4, the last one time")
    spacing = [float(word) for word in header.get("ElementSpacing", "").split()]
    origin = [float(word) for word in header.get("Offset", header.get("Position", "")).split()]
    element = header.get("ElementType", "")
    data_file = header["ElementDataFile"]
    has_pixels = math.prod(size) > 0
    if has_pixels and element not in _MET_TYPES:
        raise UnsupportedRecording(f"found element type {element!r}, expected one of {', '.join(_MET_TYPES)}")
    msb = header.get("BinaryDataByteOrderMSB", header.get("ElementByteOrderMSB", "False"))
    return Layout(
        _triple(size[:-1], 1),
        size[-1],
        int(header.get("ElementNumberOfChannels", "1")),
        _MET_TYPES.get(element, "") if has_pixels else "",
        msb.lower() == "true",
        _floats(spacing[: len(size) - 1], 1.0),
        _floats(origin[: len(size) - 1], 0.0),
        "zlib" if header.get("CompressedData", "False").lower() == "true" else "",
        None if data_file.upper() == "LOCAL" else data_file,
    )


def _read_nrrd(stream: IO[bytes]) -> tuple[dict[str, str], Frames]:
    """NRRD: ``field: value`` and ``key:=value`` lines up to an empty one."""
    fields = _Fields()
    for line in _lines(stream):
        if not line:
            break
        if line.startswith(("#", "NRRD")):
            continue
        key, separator, value = line.partition(":=")
        if not separator:
            key, separator, value = line.partition(": ")
        if separator:
            fields.add(key.strip(), value.strip())
    return fields.header, fields.frames


def _nrrd_layout(header: dict[str, str]) -> Layout:
    size = [int(word) for word in header["sizes"].split()]
    kinds = header.get("kinds", "").split()
    components = 1
    if len(size) > 3 and kinds and kinds[0] not in ("domain", "space"):
        components = size.pop(0)
    if len(size) not in (3, 4):
        raise UnsupportedRecording(f"found {len(size)} axes, expected 3 or 4, the last one time")
    has_pixels = math.prod(size) > 0
    element = header.get("type", "")
    if has_pixels and element not in _NRRD_TYPES:
        raise UnsupportedRecording(f"found type {element!r}, expected a number")
    encoding = header.get("encoding", "raw")
    if encoding not in ("raw", "gzip", "gz"):
        raise UnsupportedRecording(f"found encoding {encoding!r}, expected raw or gzip")
    vectors = re.findall(r"\(([^)]*)\)", header.get("space directions", ""))
    lengths = [math.hypot(*(float(word) for word in vector.split(","))) for vector in vectors]
    if not lengths and (words := header.get("spacings", "").split()):
        lengths = [float(word) for word in words][len(words) - len(size) :]
    lengths = [length if math.isfinite(length) and length > 0 else 1.0 for length in lengths]
    origin = [float(word) for word in header.get("space origin", "").strip("()").split(",") if word]
    return Layout(
        _triple(size[:-1], 1),
        size[-1],
        components,
        _NRRD_TYPES.get(element, "") if has_pixels else "",
        header.get("endian", "little") == "big",
        _floats(lengths[: len(size) - 1], 1.0),
        _floats(origin[: len(size) - 1], 0.0),
        "" if encoding == "raw" else "gzip",
        header.get("data file", header.get("datafile")),
    )


def _triple(values: list[int], rest: int) -> tuple[int, int, int]:
    x, y, z = [*values, rest, rest, rest][:3]
    return x, y, z


def _floats(values: list[float], rest: float) -> tuple[float, float, float]:
    x, y, z = [*values, rest, rest, rest][:3]
    return x, y, z
