"""What MetaImage and NRRD headers have in common: lines of text, and fields of frames named ``Seq_Frame0012_…``.

What a header may cost is bounded: ``free`` bytes in all, ``count`` fields, and the time of a file of its size.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import BinaryIO

from igtl_gateway.exchange.raster import Raster
from igtl_gateway.untrusted import limits

_FRAME_FIELD = re.compile(r"Seq_Frame([0-9]{1,9})_(.+)", re.IGNORECASE)

Frames = dict[int, dict[str, str]]


@dataclass(slots=True)
class ImageFileHeader:
    """A header that was read: fields as they stand there, and of the frames by number.

    Attributes:
        fields: of the whole file.
        frames: of each frame that has fields.
        end: offset of the first byte behind the header.
    """

    fields: dict[str, str] = field(default_factory=dict)
    frames: Frames = field(default_factory=dict)
    end: int = 0

    def add(self, key: str, value: str) -> None:
        """Take a field in."""
        found = _FRAME_FIELD.fullmatch(key)
        if found:
            self.frames.setdefault(int(found[1]), {})[found[2]] = value
        else:
            self.fields[key] = value


@dataclass(frozen=True, slots=True)
class ImageFile:
    """What an importer of images needs to know of a file.

    Attributes:
        fields: of the header.
        frames: fields of the frames, by number; empty for a plain image.
        raster: the pixels.
        notes: what people should know.
    """

    fields: dict[str, str]
    frames: Frames
    raster: Raster
    notes: list[str]


def header_lines(stream: BinaryIO, where: str) -> Iterator[str]:
    """Header lines; the stream stands behind each as it is given.  Raises LimitExceeded."""
    bound, size = limits.current_limits(), 0
    deadline = limits.Deadline(os.fstat(stream.fileno()).st_size)
    for count in range(1, bound.count + 2):
        line = stream.readline(bound.document + 1)
        if not line:
            return
        limits.check_limit("document", len(line), f"{where}: bytes of a line of the header")
        size += len(line)
        limits.check_limit("free", size, f"{where}: bytes of the header")
        limits.check_limit("count", count, f"{where}: fields of the header")
        if count % 4096 == 0:
            deadline.check(where)
        yield line.decode("utf-8", "replace").rstrip("\r\n")
