"""What it costs to read and convert a message, estimated from its first bytes: where it is handled depends on that.

The figures are upper bounds that were measured on one core of 2024, for the most expensive contents of each type.
"""

from __future__ import annotations

from struct import Struct

from igtl_gateway.base.buffers import Buffer
from igtl_gateway.wire.header import BODY_SIZE, HEADER_SIZE
from igtl_gateway.wire.registry import BODIES
from igtl_gateway.wire.traits import traits_of

#: What takes longer is handled aside, and converted before its turn.
AT_ONCE_NS = 1_000_000

#: Type → ns for each byte of its content.
_NS_PER_BYTE = {
    name.encode(): ns for name, content in BODIES.items() if (ns := traits_of(content).ns_per_byte) is not None
}
#: Of POLYDATA: where all cells have one size, where they have not, and for each attribute.
_NS_PER_EVEN_BYTE, _NS_PER_ODD_BYTE, _NS_PER_ATTRIBUTE = 15, 200, 10_000
#: Number of points; number and bytes of vertices, lines, polygons and strips; number of attributes.
_POLYDATA = Struct(">10I")
#: Of IMAGE: components, scalar type; sizes of the volume, offset and sizes of the part that the message has.
_IMAGE, _ITEM_BYTES = Struct(">2xBB2x3H48x6H"), {2: 1, 3: 1, 15: 1, 4: 2, 5: 2, 6: 4, 7: 4, 10: 4, 11: 8}
#: A part of a volume makes a copy of the whole.
_NS_PER_BYTE_OF_WHOLE = 2
#: Pictures are views, so this is what copies take: into the ROS message, and of both for the recorder.
_PICTURES, _NS_PER_PICTURE_BYTE = frozenset({b"IMAGE", b"VIDEO"}), 1
_NS_PER_OTHER_BYTE = 5
#: What is shorter is never expensive, except parts of volumes.
_LEAST_BYTES = 512
_NS_PER_ITEM, _NS_PER_METADATA_BYTE = 6_000, 20
_ITEM_SIZE = 8
_TYPE_BEGIN = slice(2, 8)


def cost_ns(message: Buffer) -> int:
    """Return an estimate of the CPU time of a whole message, ns."""
    if len(message) < _LEAST_BYTES and message[_TYPE_BEGIN] != b"IMAGE\0":
        return 0
    head = bytes(message[: HEADER_SIZE + 8])
    size = int.from_bytes(head[BODY_SIZE], "big")
    igtl_type = head[2:14].partition(b"\0")[0]
    is_version_1 = head[:2] == b"\0\1"
    content_at = HEADER_SIZE + (0 if is_version_1 else int.from_bytes(head[HEADER_SIZE : HEADER_SIZE + 2], "big"))
    if igtl_type == b"POLYDATA":
        cost = _of_polydata(message, size, content_at)
    elif igtl_type == b"IMAGE":
        cost = _of_image(message, content_at) or _NS_PER_PICTURE_BYTE * size
    elif igtl_type in _PICTURES:
        cost = _NS_PER_PICTURE_BYTE * size
    else:
        cost = _NS_PER_BYTE.get(igtl_type, _NS_PER_OTHER_BYTE) * size
    if not is_version_1:
        items = int.from_bytes(head[HEADER_SIZE + 2 : HEADER_SIZE + 4], "big") // _ITEM_SIZE
        cost += (
            items * _NS_PER_ITEM
            + int.from_bytes(head[HEADER_SIZE + 4 : HEADER_SIZE + 8], "big") * _NS_PER_METADATA_BYTE
        )
    return cost


def _of_image(message: Buffer, at: int) -> int:
    """Return the estimate for the content at this offset: 0 for whole images."""
    if len(message) < at + _IMAGE.size:
        return 0
    components, scalar_type, i, j, k, _, _, _, *part = _IMAGE.unpack_from(message, at)
    if part == [i, j, k]:
        return 0
    return _NS_PER_BYTE_OF_WHOLE * i * j * k * components * _ITEM_BYTES.get(scalar_type, 1)


def _of_polydata(message: Buffer, size: int, at: int) -> int:
    """Return the estimate for a body of this size, with the content at this offset of the message."""
    if len(message) < at + _POLYDATA.size:
        return 0
    _, a, of_a, b, of_b, c, of_c, d, of_d, attributes = _POLYDATA.unpack_from(message, at)
    is_odd = of_a % (4 * a or 4) or of_b % (4 * b or 4) or of_c % (4 * c or 4) or of_d % (4 * d or 4)
    each = _NS_PER_ODD_BYTE if is_odd else _NS_PER_EVEN_BYTE
    return each * size + _NS_PER_ATTRIBUTE * min(attributes, size)
