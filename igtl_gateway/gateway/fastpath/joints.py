"""Where the numbers of a JointState are in CDR, as rows for ``express.bulk_to_igtl``.

A robot sends the same joints in every message: names and counts belong to the sample, only the numbers are new.
"""

from __future__ import annotations

import struct

import numpy as np

from igtl_gateway.base.buffers import Buffer, join
from igtl_gateway.gateway.fastpath.common import NAMES_AT, STAMP_AT, end_of_name
from igtl_gateway.gateway.joint_order import is_state
from igtl_gateway.wire.body import Body
from igtl_gateway.wire.sensor import Sensor

#: Maximum number of joints of a compiled stream: SENSOR has no more.
MAX_JOINTS = 255

_U32 = struct.Struct("<I")
#: Begin and end of a part, and its place in the content (0: the part must be equal).
_ROW = struct.Struct("<III")
_SENSOR_HEAD, _ARRAY_HEAD, _NUMBER = 10, 6, 8


def joints_places(topic: str, cdr: Buffer, content: Body) -> tuple[bytes, tuple[int, ...]] | None:
    """Return the sample and the places that ``bulk_to_igtl`` needs; None for too many joints.

    None also for the measured joints of an arm: the names of one of them may be those that fix the order of its joints.
    """
    packed = join(content.pack())
    frame_end = end_of_name(cdr, NAMES_AT)
    at = frame_end + -frame_end % 4
    names = _count(cdr, at)
    if names > MAX_JOINTS or is_state(topic):
        return None
    rows = [(NAMES_AT, frame_end, 0), (at, at + 4, 0)]
    at += 4
    for _ in range(names):
        end = end_of_name(cdr, at)
        rows.append((at, end, 0))
        at = end + -end % 4
    for vector in range(3):  # position, velocity, effort
        count = _count(cdr, at)
        rows.append((at, at + 4, 0))
        if count > MAX_JOINTS:
            return None
        begin = end = at + 4
        if count:
            begin += (STAMP_AT - begin) % 8  # alignment counts from the end of the encapsulation
            end = begin + count * _NUMBER
            if to := _place(content, vector, count):
                rows.append((begin, end, to))
                if packed[to : to + end - begin] != np.frombuffer(cdr[begin:end], "<u8").byteswap().tobytes():
                    return None  # pragma: no cover - no other layout is known
        at = end
    rows.append((at, len(cdr), 0))
    sample = bytes(cdr) + packed + b"".join(_ROW.pack(*row) for row in rows)
    return sample, (len(rows), len(cdr), len(packed), 0, 0, 0)


def _place(content: Body, vector: int, count: int) -> int:
    """Return where the numbers of a vector are in a content; 0: nowhere."""
    if isinstance(content, Sensor):
        return 0 if vector else _SENSOR_HEAD
    return _ARRAY_HEAD + (2 * vector + 1) * count * _NUMBER  # a row of ones is above each


def _count(cdr: Buffer, at: int) -> int:
    count: int = _U32.unpack_from(cdr, at)[0]
    return count
