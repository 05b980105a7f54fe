"""Stamps of replayed messages: unchanged, the time of sending, or shifted by one constant.

Only stamps change: in an OpenIGTLink message those in ``gateway.stamps``, in a ROS message all stamps
(``stamp_places``), in its CDR bytes.  Stamp 0 is "unset" and stays 0 when stamps are shifted.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Literal

from igtl_gateway.base.buffers import Buffer
from igtl_gateway.base.once import Once
from igtl_gateway.base.stamp import ns_to_ros, ros_to_ns
from igtl_gateway.gateway.acceptance import DEFAULT_ACCEPTANCE, Acceptance
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.gateway.stamps import restamped
from igtl_gateway.replay.stamp_places import StampPlaces

Mode = Literal["keep", "now", "shift"]

_IGTL = frozenset({Kind.IGTL_IN, Kind.IGTL_OUT})


class Restamper:
    """Sets the stamps of messages.

    Args:
        mode: ``keep``, ``now`` or ``shift``.
        on_unknown: called once for each ROS type whose stamps cannot be changed, because its definition is unknown.
        definitions: definitions of ROS types from the recording.
        acceptance: which bytes its session accepted as messages of OpenIGTLink; of others, only the header changes.
    """

    def __init__(
        self,
        mode: Mode,
        on_unknown: Callable[[str], None],
        definitions: Mapping[str, str] = MappingProxyType({}),
        acceptance: Acceptance = DEFAULT_ACCEPTANCE,
    ) -> None:
        self._acceptance = acceptance
        self._mode = mode
        self._places = StampPlaces(definitions)
        self._on_unknown = on_unknown
        self._reported = Once()
        self._shift_ns: int | None = None

    def begin(self, recorded_ns: int | None, now_ns: int) -> None:
        """Shift stamps so that ``recorded_ns`` becomes ``now_ns``; None: so that the next message does."""
        self._shift_ns = None if recorded_ns is None else now_ns - recorded_ns

    def payload(self, entry: Entry, now_ns: int) -> tuple[Buffer, ...]:
        """Return the payload of an entry that is sent at ``now_ns`` (UTC)."""
        if self._mode == "keep":
            return tuple(entry.payload)
        if self._shift_ns is None:
            self._shift_ns = now_ns - entry.stamp_ns

        def moved(stamp_ns: int) -> int:
            if self._mode == "now":
                return now_ns
            return stamp_ns + (self._shift_ns or 0) if stamp_ns else 0

        if entry.kind in _IGTL:
            return (restamped(entry.data(), moved, self._acceptance, entry.source_ns),)
        return (self._ros(entry, moved),)

    def _ros(self, entry: Entry, moved: Callable[[int], int]) -> bytes:
        data = entry.data()
        places = self._places.of(entry.type, data)
        if places is None:
            if self._reported.first(entry.type):
                self._on_unknown(entry.type)
            return data
        new = bytearray(data)
        stamp = struct.Struct(_order(data) + "iI")
        for at in places:
            stamp.pack_into(new, at, *ns_to_ros(moved(ros_to_ns(*stamp.unpack_from(data, at)))))
        return bytes(new)


def _order(data: bytes) -> str:
    """Return the byte order of CDR from its encapsulation header."""
    return "<" if data[1] & 1 else ">"
