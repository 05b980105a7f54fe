"""What it costs to read and convert a message, estimated from its first bytes: where it is handled depends on that.

The figures are upper bounds that were measured on one core of 2024, for the most expensive contents of each type.
"""

from __future__ import annotations

from igtl_gateway.base.buffers import Buffer
from igtl_gateway.wire.header import BODY_SIZE, HEADER_SIZE

#: What takes longer is handled aside, and converted before its turn.
AT_ONCE_NS = 1_000_000

#: Type → ns for each byte of its content: each element of a list is an object in Python.
_NS_PER_BYTE = {
    b"BIND": 1_500,
    b"TDATA": 300,
    b"QTDATA": 300,
    b"TRAJ": 50,
    b"POINT": 50,
    b"IMGMETA": 35,
    b"LBMETA": 70,
    b"VIDEOMETA": 100,
    b"CAPABILITY": 40,
    b"CAPABIL": 40,
    b"POLYDATA": 200,
    b"COMMAND": 20,
    b"RTS_COMMAND": 20,
    b"NDARRAY": 10,
}
#: Pictures take the same way whatever their size: they are views, and copied without the lock.
_PICTURES = frozenset({b"IMAGE", b"VIDEO"})
_NS_PER_OTHER_BYTE = 5
#: What is shorter is never expensive.
_LEAST_BYTES = 512
_NS_PER_ITEM, _NS_PER_METADATA_BYTE = 6_000, 20
_ITEM_SIZE = 8


def cost_ns(message: Buffer) -> int:
    """Return an estimate of the CPU time of a whole message, ns."""
    if len(message) < _LEAST_BYTES:
        return 0
    head = bytes(message[: HEADER_SIZE + 8])
    size = int.from_bytes(head[BODY_SIZE], "big")
    igtl_type = head[2:14].partition(b"\0")[0]
    cost = 0 if igtl_type in _PICTURES else _NS_PER_BYTE.get(igtl_type, _NS_PER_OTHER_BYTE) * size
    if head[:2] != b"\0\1":
        items = int.from_bytes(head[HEADER_SIZE + 2 : HEADER_SIZE + 4], "big") // _ITEM_SIZE
        cost += (
            items * _NS_PER_ITEM
            + int.from_bytes(head[HEADER_SIZE + 4 : HEADER_SIZE + 8], "big") * _NS_PER_METADATA_BYTE
        )
    return cost
