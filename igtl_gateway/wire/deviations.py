"""Deviations of known programs: which are read, and what an error means to the author of the sender.

Only a message that would be refused is looked at, so this costs nothing otherwise.  The rows are from the sources of
these programs, or from messages that they sent here.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import dataclass

from igtl_gateway.base.errors import WireError
from igtl_gateway.wire.fields import visible
from igtl_gateway.wire.header import Header
from igtl_gateway.wire.registry import BODIES, read_content

#: Keys of what is read: no extended header where the header version asks for one, and the header version 3.
BARE, VERSION_3 = "bare", "version_3"
#: Deviations that are read because their meaning is certain → what was done, and who does it.
READ = {
    BARE: "no extended header, which the header version asks for: read as version 1; openigtlink-rust 0.4.1 writes "
    "version 2 so unless its version is set to 1",
    VERSION_3: "header version 3 with the layout of version 2: read so; openigtlink-rust 0.4.1 writes it with metadata",
}

#: ITEM of pyigtl's own POSITION.
_PYIGTL_POSITION = 152
_TYPE_NAME = 12
#: Offsets in an IMAGE: components, size, size of the sub-volume, pixels.
_COMPONENTS_AT, _SIZE_AT, _PART_AT, _PIXELS_AT = 2, 6, 66, 72
_RGB = 3
#: Larger bodies are not decoded once more.
_MAX_SECOND_LOOK = 65_536


@dataclass(frozen=True, slots=True)
class Deviation:
    """One known deviation.

    Attributes:
        type: of the message; "" for any.
        shows: returns whether header and body show it.
        text: what the sender does, with its name.
    """

    type: str
    shows: Callable[[Header, memoryview], bool]
    text: str


def _is_other_version(header: Header, body: memoryview) -> bool:
    """Return whether the body of a message of version 2 or more is a content without an extended header."""
    if header.version < 2 or body.nbytes > _MAX_SECOND_LOOK or visible(header.type) not in BODIES:
        return False
    try:
        read_content(header.type, body)
    except WireError:
        return False
    return True


def _has_swapped_part(_: Header, body: memoryview) -> bool:
    if body.nbytes < _PIXELS_AT:
        return False
    columns, rows, slices = struct.unpack_from(">3H", body, _SIZE_AT)
    return columns != rows and struct.unpack_from(">3H", body, _PART_AT) == (rows, columns, slices)


def _has_rgb_as_two(_: Header, body: memoryview) -> bool:
    if body.nbytes < _PIXELS_AT or body[_COMPONENTS_AT] != _RGB - 1:
        return False
    columns, rows, slices = struct.unpack_from(">3H", body, _SIZE_AT)
    return body.nbytes - _PIXELS_AT == _RGB * columns * rows * slices > 0


DEVIATIONS = (
    Deviation(
        "",
        _is_other_version,
        "the body is one of header version 1, without an extended header: openigtlink-rust 0.4.1 writes this unless "
        "its version is set to 1",
    ),
    Deviation(
        "",
        lambda header, _: header.version > 2,
        "openigtlink-rust 0.4.1 writes version 3 with metadata; the library numbers protocol 3 as header version 2",
    ),
    Deviation(
        "CAPABILITY",
        lambda _, body: body.nbytes % _TYPE_NAME != 0,
        "OpenIGTLink-Java (WPI) does not pad the type names to 12 bytes",
    ),
    Deviation("IMAGE", _has_swapped_part, "columns and rows of the sub-volume are exchanged, as pyIGTLink 0.2.1 does"),
    Deviation("IMAGE", _has_rgb_as_two, "RGB is declared as 2 components, as pyIGTLink 0.2.1 does"),
    Deviation(
        "POSITION",
        lambda _, body: body.nbytes % _PYIGTL_POSITION == 0 and body.nbytes > 0,
        "pyigtl writes a layout of its own; let it send TRANSFORM",
    ),
)


def explained(error: WireError, header: Header, body: memoryview, content: memoryview) -> WireError:
    """Return the error of a message, with what is known of senders of such messages.

    Args:
        error: why it was refused.
        header: its header.
        body: what follows the header.
        content: the part of the body that has the format of the type.
    """
    kind = visible(header.type)
    for row in DEVIATIONS:
        if row.type in ("", kind) and row.shows(header, content if row.type else body):
            return type(error)(error.place, error.found, f"{error.expected} ({row.text})")
    return error
