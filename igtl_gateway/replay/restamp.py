"""New stamps for old messages: as they were, the time of sending, or all moved by one constant.

Only stamps change.  In an OpenIGTLink message that is the tick word of the header, which no checksum covers, and where
there is one the ROS stamp in the metadata, with the checksum of the body.  In a ROS message it is the stamp of the
header, in the CDR bytes as they are, of the types that are known here.  Stamp 0 is "unset" and stays so when moved.
"""

from __future__ import annotations

import dataclasses
import struct
from collections.abc import Callable
from typing import Literal

from igtl_gateway.buffers import Buffer
from igtl_gateway.convert import common_msgs, igtl_msgs, rosmsg
from igtl_gateway.errors import GatewayError
from igtl_gateway.gateway.metadata import STAMP
from igtl_gateway.replay.simclock import CLOCK_TYPE
from igtl_gateway.session.entry import Entry, Kind
from igtl_gateway.stamp import ns_to_ros, ns_to_ticks, ros_to_ns, ticks_to_ns
from igtl_gateway.wire import decode, encode
from igtl_gateway.wire.message import HEADER_SIZE, Item

Mode = Literal["keep", "now", "shift"]
MODES: tuple[Mode, ...] = ("keep", "now", "shift")

_IGTL = frozenset({Kind.IGTL_IN, Kind.IGTL_OUT})
_TICKS = struct.Struct(">Q")
_TICKS_AT = 34  # in the header of OpenIGTLink
_STAMP_AT = 4  # in CDR, behind the encapsulation
_TF = common_msgs.TFMessage.TYPE
_TRANSFORM = 7 * 8  # bytes of a geometry_msgs/Transform


def _with_header() -> set[str]:
    """Of the types that we convert those that begin with a std_msgs/Header."""
    found = set()
    for module in (rosmsg, common_msgs, igtl_msgs):
        for kind in vars(module).values():
            if (
                dataclasses.is_dataclass(kind)
                and hasattr(kind, "TYPE")
                and dataclasses.fields(kind)[0].name == "header"
            ):
                found.add(kind.TYPE)
    return found


#: Types whose first field is a header: ours, and the usual ones of ROS 2.
WITH_HEADER = frozenset(_with_header()) | {
    f"{package}/msg/{name}"
    for package, names in {
        "diagnostic_msgs": "DiagnosticArray",
        "geometry_msgs": "AccelStamped InertiaStamped PolygonStamped PoseWithCovarianceStamped QuaternionStamped "
        "TwistStamped TwistWithCovarianceStamped Vector3Stamped WrenchStamped",
        "nav_msgs": "GridCells OccupancyGrid Odometry",
        "sensor_msgs": "BatteryState CameraInfo FluidPressure Illuminance Imu JointState Joy LaserScan MagneticField "
        "MultiDOFJointState MultiEchoLaserScan NavSatFix PointCloud Range RelativeHumidity Temperature TimeReference",
    }.items()
    for name in names.split()
}


class Restamper:
    """Gives messages their new stamps.

    Args:
        mode: ``keep``, ``now`` or ``shift``.
        on_unknown: told once of each ROS type that stays as it is, since it is not known here.
    """

    def __init__(self, mode: Mode, on_unknown: Callable[[str], None]) -> None:
        self._mode = mode
        self._on_unknown = on_unknown
        self._told: set[str] = set()
        self._shift_ns: int | None = None

    def begin(self, recorded_ns: int | None, now_ns: int) -> None:
        """What comes next is moved so that ``recorded_ns`` becomes ``now_ns``; None: the first message does."""
        self._shift_ns = None if recorded_ns is None else now_ns - recorded_ns

    def payload(self, entry: Entry, now_ns: int) -> tuple[Buffer, ...]:
        """The payload of an entry that is sent at ``now_ns`` (UTC)."""
        if self._mode == "keep":
            return tuple(entry.payload)
        if self._shift_ns is None:
            self._shift_ns = now_ns - entry.stamp_ns

        def moved(stamp_ns: int) -> int:
            if self._mode == "now":
                return now_ns
            return stamp_ns + (self._shift_ns or 0) if stamp_ns else 0

        if entry.kind in _IGTL:
            return _igtl(entry.data(), moved)
        return (self._ros(entry, moved),)

    def _ros(self, entry: Entry, moved: Callable[[int], int]) -> bytes:
        data = entry.data()
        places = _places(entry.type, data)
        if places is None:
            if entry.type not in self._told:
                self._told.add(entry.type)
                self._on_unknown(entry.type)
            return data
        new = bytearray(data)
        stamp = struct.Struct(_order(data) + "iI")
        for at in places:
            stamp.pack_into(new, at, *ns_to_ros(moved(ros_to_ns(*stamp.unpack_from(data, at)))))
        return bytes(new)


def _order(data: bytes) -> str:
    """Byte order of CDR, by its encapsulation."""
    return "<" if data[1] & 1 else ">"


def _places(ros_type: str, data: bytes) -> list[int] | None:
    """Where the stamps are in a message; None for a type that is not known or bytes that are not of it."""
    if ros_type in WITH_HEADER or ros_type == CLOCK_TYPE:
        return [_STAMP_AT] if len(data) >= _STAMP_AT + 8 else None
    return _tf_places(data) if ros_type == _TF else None


def _tf_places(data: bytes) -> list[int] | None:
    """Of each transform of a TFMessage."""
    number = struct.Struct(_order(data) + "I")
    places = []
    try:
        (count,) = number.unpack_from(data, _STAMP_AT)
        at = _STAMP_AT + number.size
        for _ in range(count):
            at += -at % 4
            places.append(at)
            at += 8
            for _name in ("frame_id", "child_frame_id"):
                at += -at % 4
                at += number.size + number.unpack_from(data, at)[0]
            # alignment counts from behind the encapsulation
            at += -(at - _STAMP_AT) % 8 + _TRANSFORM
    except struct.error:
        return None
    return places if at <= len(data) else None


def _igtl(data: bytes, moved: Callable[[int], int]) -> tuple[Buffer, ...]:
    if len(data) < HEADER_SIZE:
        return (data,)
    (ticks,) = _TICKS.unpack_from(data, _TICKS_AT)
    new = _TICKS.pack(ns_to_ticks(moved(ticks_to_ns(ticks))))
    body = _restamped_metadata(data, moved) or data
    return (body[:_TICKS_AT] + new + body[_TICKS_AT + _TICKS.size :],)


def _restamped_metadata(data: bytes, moved: Callable[[int], int]) -> bytes | None:
    """The message with the ROS stamp in its metadata moved; None where there is none, or the message is damaged."""
    if STAMP.encode() not in data:
        return None
    try:
        message = decode(data)
        items = tuple(_item(item, moved) for item in message.metadata)
        return b"".join(encode(dataclasses.replace(message, metadata=items))) if items != message.metadata else None
    except GatewayError:
        return None


def _item(item: Item, moved: Callable[[int], int]) -> Item:
    if item.key != STAMP or not (item.text.isascii() and item.text.isdigit()):
        return item
    return Item.of(STAMP, str(moved(int(item.text))))
