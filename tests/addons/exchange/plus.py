"""What the sequence reader of PLUS (IGSIO) asks of a MetaImage file, as a table of rules in our own words.

The reader is C++ and not here.  Each rule was read in its source (vtkIGSIOMetaImageSequenceIO, igsioVideoFrame and
igsioCommon of github.com/IGSIO/IGSIO); ``docs/reference/formats.md`` has the same table.
"""

from __future__ import annotations

import re
import zlib
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

#: From a type of MetaIO to its bytes, for the types that PLUS knows.
BYTES = {
    **{"MET_CHAR": 1, "MET_UCHAR": 1, "MET_SHORT": 2, "MET_USHORT": 2, "MET_INT": 4, "MET_UINT": 4},
    **{"MET_FLOAT": 4, "MET_DOUBLE": 8},
}
ORIENTATIONS = "UF UN MF MN FU NU FM NM UFA UNA MFA MNA UFD UND MFD MND AMF AUF AMN AUN".split()
TYPES = "BRIGHTNESS RF_REAL RF_IQ_LINE RF_I_LINE_Q_LINE RGB_COLOR".split()
STATUSES = "OK MISSING OUT_OF_VIEW OUT_OF_VOLUME REQ_TIMEOUT INVALID PATH_NOT_FOUND".split()


@dataclass
class Read:
    """A file as the reader takes it: lines, fields, fields of frames by number, the bytes behind the header."""

    lines: list[str]
    fields: dict[str, str] = field(default_factory=dict)
    frames: dict[int, dict[str, str]] = field(default_factory=dict)
    data: bytes = b""

    @property
    def kinds(self) -> list[str]:
        return self.fields["Kinds"].split()

    @property
    def sizes(self) -> dict[str, list[int]]:
        """Sizes of the axes of each kind."""
        sizes: dict[str, list[int]] = {}
        for kind, size in zip(self.kinds, self.fields["DimSize"].split(), strict=True):
            sizes.setdefault(kind, []).append(int(size))
        return sizes

    @property
    def count(self) -> int:
        return self.sizes.get("list", self.sizes.get("time", [1]))[0]

    @property
    def pixel_bytes(self) -> int:
        size = self.count * BYTES[self.fields["ElementType"]] * int(self.fields.get("ElementNumberOfChannels", "1"))
        for length in self.sizes["domain"]:
            size *= length
        return size


def read(path: Path) -> Read:
    """The header, line by line, up to ElementDataFile."""
    data = path.read_bytes()
    end = data.index(b"\n", data.index(b"\nElementDataFile") + 1) + 1
    found = Read(data[:end].decode().removesuffix("\n").split("\n"), data=data[end:])
    for line in found.lines:
        key, _, value = (part.strip() for part in line.partition("="))
        frame = re.fullmatch(r"Seq_Frame(\d+)_(.+)", key)
        if frame:
            found.frames.setdefault(int(frame[1]), {})[frame[2]] = value
        else:
            found.fields[key] = value
    return found


def _unpacked(found: Read) -> int:
    size = int(found.fields["CompressedDataSize"])
    return len(zlib.decompress(found.data[:size])) if size == len(found.data) else -1


def _same(found: Read, kind: str) -> bool:
    return all(len(found.fields[key].split()) == len(found.kinds) for key in (kind, "ElementSpacing"))


#: The rule, and whether a file keeps it.
RULES: dict[str, Callable[[Read], bool]] = {
    "the first line is `ObjectType = Image`": lambda found: found.lines[0] == "ObjectType = Image",
    "every line has a `=` and less than 1,000 characters": lambda found: all(
        "=" in line and len(line) < 1000 for line in found.lines
    ),
    "`NDims` is 2, 3 or 4, and `DimSize` and `Kinds` have as many words": lambda found: (
        found.fields["NDims"] in {"2", "3", "4"}
        and len(found.kinds) == int(found.fields["NDims"]) == sum(map(len, found.sizes.values()))
    ),
    "`Kinds` are at most three `domain` and one `list` or `time`; without it the last axis is time": lambda found: (
        1 < found.kinds.count("domain") < 4
        and found.kinds[-1] in {"domain", "list"}
        and set(found.kinds) <= {"domain", "list"}
    ),
    "`UltrasoundImageOrientation` is one that it knows; it refuses pixels with `XX`, or none": lambda found: (
        found.fields["UltrasoundImageOrientation"] in ORIENTATIONS
    ),
    "`UltrasoundImageType` is one that it knows, by which it turns images to `MF` or `FM`": lambda found: (
        found.fields["UltrasoundImageType"] in TYPES
    ),
    "`BinaryData` is `True`": lambda found: found.fields["BinaryData"] == "True",
    "`ElementType` is one that it knows": lambda found: found.fields["ElementType"] in BYTES,
    "pixels are little-endian, independent of `BinaryDataByteOrderMSB`": lambda found: (
        found.fields["BinaryDataByteOrderMSB"] == "False"
    ),
    "with `CompressedData = True`, `CompressedDataSize` bytes of zlib unpack to all frames exactly": lambda found: (
        found.fields["CompressedData"] == "True" and _unpacked(found) == found.pixel_bytes
    ),
    "`Seq_FrameNNNN_` fields have the number of a frame, from 0": lambda found: (
        list(found.frames) == list(range(found.count))
    ),
    "a frame whose `ImageStatus` is not `OK` has no image, but has pixels": lambda found: all(
        fields["ImageStatus"] in {"OK", "INVALID"} for fields in found.frames.values()
    ),
    "each `XToYTransform` has 16 numbers, and a `XToYTransformStatus`": lambda found: all(
        len(value.split()) == 16 and fields[f"{key}Status"] in STATUSES
        for fields in found.frames.values()
        for key, value in fields.items()
        if key.endswith("Transform")
    ),
    "`Timestamp` is seconds": lambda found: all(
        re.fullmatch(r"-?\d+\.\d+", fields["Timestamp"]) for fields in found.frames.values()
    ),
    "`TransformMatrix`, `Offset` and `ElementSpacing` have as many axes as `NDims`": lambda found: (
        _same(found, "Offset") and len(found.fields["TransformMatrix"].split()) == len(found.kinds) ** 2
    ),
    "`ElementDataFile` is the last line": lambda found: found.lines[-1] == "ElementDataFile = LOCAL",
}


def faults(path: Path) -> list[str]:
    """The rules that a file breaks."""
    found = read(path)
    return [rule for rule, keeps in RULES.items() if not keeps(found)]
