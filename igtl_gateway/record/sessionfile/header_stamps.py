"""The stamps in ROS messages: ``header.stamp`` is the time of a measurement.

Only messages that begin with a header have it at a known place: of most sensor and geometry types, and of lists such as
TFMessage, where it is that of the first element.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from rosbags.interfaces import Nodetype

from igtl_gateway.base.stamp import NS_PER_S
from igtl_gateway.record.sessionfile.bulk import MessageBlock, gathered

Times = npt.NDArray[np.int64]

_HEADER, _TIME = "std_msgs/msg/Header", "builtin_interfaces/msg/Time"
#: CDR begins with four bytes: the second one is the byte order.
_ENCAPSULATION = 4
#: A definition that is deeper has no header in its first field.
_DEEPEST = 8


@dataclass(frozen=True, slots=True)
class StampPlace:
    """Where the stamp of a type is.

    Attributes:
        at: offset in the payload.
        in_list: whether the number of elements, four bytes before it, must not be 0.
    """

    at: int = _ENCAPSULATION
    in_list: bool = False

    def of(self, block: MessageBlock) -> Times:
        """Return the stamps of messages (N,), UTC ns; 0 = unset, or the message is too short."""
        found = np.zeros(len(block), np.int64)
        sizes = block.ends - block.begins
        rows = np.flatnonzero(sizes >= self.at + 8)
        heads = gathered(block.data, block.begins[rows], self.at + 8)
        is_big = heads[:, 1] & 1 == 0
        for order, chosen in (("<", ~is_big), (">", is_big)):
            words = (
                np.ascontiguousarray(heads[chosen][:, _ENCAPSULATION:]).view(f"{order}u4").reshape(-1, self.at // 4 + 1)
            )
            stamps = words[:, -2].astype(np.int64) * NS_PER_S + words[:, -1]
            if self.in_list:
                stamps[words[:, 0] == 0] = 0
            found[rows[chosen]] = stamps
        return found

    def with_stamps(self, block: MessageBlock, stamps: Times) -> MessageBlock:
        """Return a block with other stamps (N,), UTC ns; messages for which there is none (0) stay as they are."""
        data = block.data.copy()
        own = self.of(block)
        is_long = block.ends - block.begins >= self.at + 8
        for row in np.flatnonzero((stamps > 0) & (own != stamps) & is_long).tolist():
            begin = int(block.begins[row])
            order = "<" if data[begin + 1] & 1 else ">"
            struct.pack_into(f"{order}II", data, begin + self.at, *divmod(int(stamps[row]), NS_PER_S))
        return MessageBlock(data, block.begins, block.ends, block.numbers, block.times, block.source_times)


def stamp_place(types: Mapping[str, Any], ros_type: str) -> StampPlace | None:
    """Return where the messages of a type have their stamp; None if they begin with something else.

    ``types``: definitions of the type and all that it needs, as rosbags has them.
    """
    name = ros_type
    for depth in range(_DEEPEST):
        fields = types[name][1] if name in types else ()
        if not fields:
            return None
        kind, inner = fields[0][1]
        if kind == Nodetype.NAME and inner == _HEADER:
            first = types[_HEADER][1][0][1] if _HEADER in types and types[_HEADER][1] else None
            return StampPlace() if first == (Nodetype.NAME, _TIME) else None
        if kind == Nodetype.SEQUENCE and not depth and inner[0][0] == Nodetype.NAME:
            element = stamp_place(types, inner[0][1])
            return StampPlace(_ENCAPSULATION + 4, in_list=True) if element == StampPlace() else None
        if kind != Nodetype.NAME:
            return None
        name = inner
    return None
