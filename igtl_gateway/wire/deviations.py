"""Deviations of known programs: which are read, and what an error means to the author of the sender.

Only a message that would be refused is looked at, so this costs nothing otherwise.  The rows are from the sources of
these programs, or from messages that they sent here.
"""

from __future__ import annotations

import math
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
#: Offset of the pixels in an IMAGE without the fields of the sub-volume.
_WITHOUT_PART = 60
#: Scalar type of an IMAGE → bytes.
_PIXEL_BYTES = {2: 1, 3: 1, 4: 2, 5: 2, 6: 4, 7: 4, 10: 4, 11: 8}
_RGB = 3
#: Larger bodies are not decoded once more.
_MAX_SECOND_LOOK = 65_536


@dataclass(frozen=True, slots=True)
class Deviation:
    """One known deviation of a program.

    Attributes:
        program: its name and version, or commit.
        differs: what it does.
        gateway: what the gateway does with it.
        change: what to change in the program, or in the settings of the gateway.
        type: of the refused message that shows it; "" for any.
        shows: returns whether header and body of a refused message show it; None: no refused message does.
    """

    program: str
    differs: str
    gateway: str
    change: str
    type: str = ""
    shows: Callable[[Header, memoryview], bool] | None = None

    @property
    def text(self) -> str:
        """What an error states about it."""
        return f"{self.program}: {self.differs}"


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
    size = struct.unpack_from(">3H", body, _SIZE_AT)
    return size[2] == _RGB and body.nbytes - _PIXELS_AT == math.prod(size) > 0


def _has_no_part(_: Header, body: memoryview) -> bool:
    if body.nbytes < _WITHOUT_PART:
        return False
    size = struct.unpack_from(">3H", body, _SIZE_AT)
    if body.nbytes >= _PIXELS_AT and sorted(struct.unpack_from(">3H", body, _PART_AT)) == sorted(size):
        return False  # these fields are there
    pixels = body[_COMPONENTS_AT] * math.prod(size)
    return body.nbytes - _WITHOUT_PART == pixels * _PIXEL_BYTES.get(body[_COMPONENTS_AT + 1], 0) > 0


def _has_names_behind_a_count(_: Header, body: memoryview) -> bool:
    count = int.from_bytes(body[:4], "big")
    return 0 < count <= body.nbytes and bytes(body[4:]).count(b"\0") == count and body[-1] == 0


_RUST, _4J, _WPI = "openigtlink-rust 0.4.1", "OpenIGTLink4J 4cbcb31", "OpenIGTLink-Java (WPI) 94ffbb9"
_PYIGTLINK, _PYGTLINK, _NG = "pyIGTLink 0.2.1", "pygtlink 1.0.0", "openigtlink-ng 43c38fa"
_REFUSED = "refused; the error has this line"

DEVIATIONS = (
    Deviation(
        _RUST,
        "header version 2 without an extended header, unless its version is set to 1",
        "reads it as version 1 if its first bytes cannot be an extended header (`deviation_read`), and answers in 1",
        "`message.header.version = 1`",
        "",
        _is_other_version,
    ),
    Deviation(
        _RUST,
        "header version 3 with metadata, in the layout of version 2",
        "reads it as version 2 (`deviation_read`), and answers in version 1",
        "write 2: the C++ library numbers protocol 3 as header version 2",
        "",
        lambda header, _: header.version > 2,
    ),
    Deviation(
        _RUST,
        "TDATA has its matrices by rows",
        "leaves out tools without a valid pose (`not_a_pose`); `doctor` W504",
        "transpose: T, S, N and P one after the other",
    ),
    Deviation(
        _RUST,
        "IMAGE has no fields of the sub-volume, and its matrix by rows",
        _REFUSED,
        "write offset and size of the sub-volume, and the matrix by columns",
        "IMAGE",
        _has_no_part,
    ),
    Deviation(
        _RUST,
        "CAPABILITY has a count, and names that end with NUL",
        _REFUSED,
        "write 12 bytes for each name",
        "CAPABILITY",
        _has_names_behind_a_count,
    ),
    Deviation(
        _RUST,
        "reads a STATUS of code 12 or more as an extended header, TDATA by rows, and no CAPABILITY or IMAGE of others",
        "with the profile `openigtlink-rust`: header version 2, poses as TRANSFORM, nothing in place of the others",
        "`--peer HOST:PORT=openigtlink-rust`",
    ),
    Deviation(
        _4J,
        "milliseconds in place of the fraction of a second",
        "reads them with the profile `openigtlink4j`, set or detected; `doctor` W307",
        "`--peer HOST:PORT=openigtlink4j`; or multiply by 2^32 / 1000",
    ),
    Deviation(
        _4J,
        "the interval of STT_ is 8 bytes, milliseconds",
        "reads it; it shows the profile `openigtlink4j`, as STT_POLYDATA does not",
        "nothing",
    ),
    Deviation(
        _4J,
        "its reader ends at POSITION, QTDATA, NDARRAY, and metadata in UTF-8",
        "with the profile: poses as TRANSFORM, no NDARRAY, header version 1",
        "`--peer HOST:PORT=openigtlink4j`",
    ),
    Deviation(_4J, "text beyond US-ASCII is `?`", "publishes it as received", "write UTF-8, encoding 106"),
    Deviation(
        _WPI,
        "CAPABILITY has names that are not padded to 12 bytes",
        _REFUSED,
        "pad them with NUL",
        "CAPABILITY",
        lambda _, body: body.nbytes % _TYPE_NAME != 0,
    ),
    Deviation(
        _WPI,
        "IMAGE has its directions by rows, where its own reader takes columns",
        "publishes them as received: no byte shows it",
        "give it the transposed matrix",
    ),
    Deviation(_WPI, "stamps are up to 8 µs late", "publishes them as received", "nothing"),
    Deviation(
        _WPI,
        "reads a TRANSFORM of header version 2 as one of version 1; a client ends at a STRING",
        "sends version 1 until it has sent version 2",
        "nothing, if no program behind it writes version 2",
    ),
    Deviation(
        _PYIGTLINK,
        "IMAGE has columns and rows of the sub-volume exchanged",
        _REFUSED + ", unless columns and rows are equal",
        "exchange them in `pack_body`, or send square images",
        "IMAGE",
        _has_swapped_part,
    ),
    Deviation(
        _PYIGTLINK,
        "RGB is declared as 2 components in 3 slices",
        _REFUSED,
        "write 3",
        "IMAGE",
        _has_rgb_as_two,
    ),
    Deviation(
        _PYGTLINK,
        "the size of IMAGE is rows, columns, components; spacing is 0 unless set",
        "publishes it as received; `doctor` W506",
        "set the dimensions to columns, rows, slices after the pixels; `setSpacing`",
    ),
    Deviation(
        _PYGTLINK,
        "pixels of several bytes are little-endian, and declared big-endian",
        "publishes them as received: no byte shows it",
        "`setEndian(2)`; this makes the order of pixels Fortran's",
    ),
    Deviation(_PYGTLINK, "STATUS ends after 30 bytes", "reads it, without text", "nothing"),
    Deviation(_PYGTLINK, "the quaternion is 0 unless set", "refuses the pose; `doctor` W509", "`setQuaternion`"),
    Deviation(
        "pyigtl 0.3.4",
        "POSITION has a layout of its own",
        _REFUSED,
        "let it send TRANSFORM",
        "POSITION",
        lambda _, body: body.nbytes % _PYIGTL_POSITION == 0 and body.nbytes > 0,
    ),
    Deviation(
        "MatlabOpenIGTLink (Perk Lab)",
        "CRC 0, and the seconds in the word of the fraction",
        "refused; `doctor` E206 and W305",
        '`check_crc = false` and `stamp = "receive"` in the configuration',
    ),
    Deviation(
        "MatlabOpenIGTLink dc9632d (maribernardes)",
        "header version 2 whatever is asked for, stamp 0, and metadata as of 3D Slicer",
        "recognises it as 3D Slicer (`peer_profile`)",
        "`--peer HOST:PORT=default`",
    ),
    Deviation(
        _NG,
        "clients and servers in Python and TypeScript send header version 1 and stamp 0",
        "uses the time of receipt; `doctor` W301",
        "set a stamp",
    ),
    Deviation(
        _NG,
        "refuses text beyond US-ASCII in fixed fields and device names; a server in Python closes the link",
        "connects again, and sends what it keeps",
        "names in US-ASCII",
    ),
    Deviation(_NG, "status of RTS_ and type of TRAJ are signed", "shows them unsigned", "nothing"),
    Deviation(
        "OpenIGTLink-Unity 5389a61",
        "sends poses in the left-handed axes of Unity, and mirrors x of what it reads; stamp 0",
        "publishes them as received: no byte shows it; `doctor` W301",
        "mirror x in `SendTransformMessage`, too; set a stamp",
    ),
    Deviation(
        "Sofa.IGTLink 345e19d, OpenEphysIGTLink 18fea50, mrigtlbridge 0b9741e",
        "nothing: the C++ library sends for them",
        "reads POINT and POLYDATA; POINT, STRING and TRANSFORM; IMAGE, STRING and TDATA",
        "nothing",
    ),
)

#: Those that a refused message shows, those of one type first.
_SHOWN = sorted((row for row in DEVIATIONS if row.shows), key=lambda row: not row.type)


def explained(error: WireError, header: Header, body: memoryview, content: memoryview) -> WireError:
    """Return the error of a message, with what is known of senders of such messages.

    Args:
        error: why it was refused.
        header: its header.
        body: what follows the header.
        content: the part of the body that has the format of the type.
    """
    kind = visible(header.type)
    for row in _SHOWN:
        if row.shows and row.type in ("", kind) and row.shows(header, content if row.type else body):
            return type(error)(error.place, error.found, f"{error.expected} ({row.text})")
    return error
