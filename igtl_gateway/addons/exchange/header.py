"""The common part of MetaImage and NRRD headers: lines of text, and fields of frames named ``Seq_Frame0012_…``.

The limits bound a header: ``free`` bytes in total, ``count`` fields, and the reading time for a file of its size.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import BinaryIO

from igtl_gateway.addon.untrusted import limits
from igtl_gateway.addons.exchange.raster import Raster

_FRAME_FIELD = re.compile(r"Seq_Frame([0-9]{1,9})_(.+)", re.IGNORECASE)

Frames = dict[int, dict[str, str]]


@dataclass(slots=True)
class ImageFileHeader:
    """The fields of a header, unchanged.

    Attributes:
        fields: fields of the whole file.
        frames: frame number → fields of the frame; frames without fields are missing.
        end: offset of the first byte after the header.
    """

    fields: dict[str, str] = field(default_factory=dict)
    frames: Frames = field(default_factory=dict)
    end: int = 0

    def add(self, key: str, value: str) -> None:
        """Add a field."""
        found = _FRAME_FIELD.fullmatch(key)
        if found:
            self.frames.setdefault(int(found[1]), {})[found[2]] = value
        else:
            self.fields[key] = value


@dataclass(frozen=True, slots=True)
class ImageFile:
    """The header of an image file, for the importer.

    Attributes:
        fields: fields of the header.
        frames: frame number → fields of the frame; empty for a plain image.
        raster: layout of the pixels.
        notes: further facts for people.
    """

    fields: dict[str, str]
    frames: Frames
    raster: Raster
    notes: list[str]


def header_lines(stream: BinaryIO, where: str) -> Iterator[str]:
    """Yield the lines of a header; the position of the stream is after the line.  Raises LimitExceeded."""
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
