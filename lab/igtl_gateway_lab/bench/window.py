"""A flood that loses nothing: no more messages on their way than every queue between the two ends can hold.

The receiver stores the last number that it received in a file which both programs map into memory: one store of eight
bytes, no system call.  The sender looks there only when its window is full.
"""

from __future__ import annotations

import mmap
from pathlib import Path

from igtl_gateway.base.clock import Clock
from igtl_gateway.base.stamp import NS_PER_S
from igtl_gateway.convert.table import TO_IGTL, TO_ROS
from igtl_gateway_lab.bench.cases import Direction, payload

_SIZE = 8
_MOST, _LEAST, _BYTES = 256, 2, 64 << 20
#: After this time without a new number the messages on their way are lost.
_PATIENCE_NS = 2 * NS_PER_S


def progress(path: str = "") -> memoryview:
    """The last received number, as element 0; shared by all programs that map the same file, or not shared."""
    if not path:
        return memoryview(bytearray(_SIZE)).cast("q")
    place = Path(path)
    if not place.exists():
        place.write_bytes(bytes(_SIZE))
    with place.open("r+b") as file:
        return memoryview(mmap.mmap(file.fileno(), _SIZE)).cast("q")


def window(kind: str, direction: Direction) -> int:
    """How many messages of a kind may be on their way: as many as the shortest queue of the gateway holds."""
    made = payload(kind)
    depths = {
        Direction.ROS_TO_IGTL: [
            row.qos.depth for row in TO_IGTL if (row.message.TYPE, row.igtl_type) == (made.ros_type, made.igtl_type)
        ],
        Direction.IGTL_TO_ROS: [
            row.qos.depth
            for row in TO_ROS
            if row.message.TYPE == made.ros_type and made.igtl_type in row.igtl_types and row.kind == made.kind
        ],
    }
    return max(_LEAST, min(_MOST, _BYTES // made.size, *depths[direction]))


class SendWindow:
    """What a sender may send.

    Args:
        ``heard``: see ``progress``.
        size: messages on their way at most.
        clock: monotonic.
    """

    def __init__(self, heard: memoryview, size: int, clock: Clock) -> None:
        self._heard = heard
        self._size = size
        #: Going on for one message at a time would cost more waiting than sending.
        self._worth = max(1, size // 4)
        self._clock = clock
        self._over = 0  # messages that are no longer on their way: received, or given up
        self._news_ns = 0

    def room(self, sent: int) -> int:
        """How many more may follow those ``sent``; 0: none yet, look again soon."""
        heard = self._heard[0]
        if heard > self._over or not self._news_ns:
            self._over = max(heard, self._over)
            self._news_ns = self._clock.monotonic_ns()
        elif sent - self._over >= self._size and self._clock.monotonic_ns() - self._news_ns > _PATIENCE_NS:
            self._over = sent
        room = self._size - (sent - self._over)
        return room if room >= self._worth else 0
