"""Compares two messages of one type by value; differences have units.

A message is flattened into *leaves*, each with its path.  Leaves are numbers and strings, and as a whole the values
that have a measure: poses (position and rotation), arrays of elements (points, pixels, values) and stamps.  Our codecs
decode OpenIGTLink; the definitions in the file decode ROS.  So messages of any type can be compared, and padding does
not count.
"""

from __future__ import annotations

import dataclasses
import math
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import zip_longest
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from igtl_gateway.base.errors import ChecksumMismatch, DamagedRecording, GatewayError
from igtl_gateway.base.stamp import ticks_to_ns
from igtl_gateway.config.configuration import Config
from igtl_gateway.convert.units import scale
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.gateway.log.note import Note
from igtl_gateway.gateway.stream_units import StreamUnits
from igtl_gateway.wire import Header, decode
from igtl_gateway.wire.elements import Elements
from igtl_gateway.wire.fields import visible
from igtl_gateway.wire.header import READING
from igtl_gateway.wire.image import Image
from igtl_gateway.wire.polydata import PolyData
from igtl_gateway.wire.registry import describe_content
from igtl_gateway.wire.transform import Position, Transform

if TYPE_CHECKING:
    from igtl_gateway.base.untrusted.decoding import MessageDecoder as RosDecoder

Array = npt.NDArray[Any]
_Leaf = tuple[str, Any]

_SAME_ROTATION = 2 * math.sqrt(2)
#: Arrays up to this length are compared number by number.
_SHORT = 16
_POINTS = frozenset({"geometry_msgs/msg/Point", "geometry_msgs/msg/Point32"})
_BITS = re.compile(r"(8|16|32|64)([USF])C?[0-9]*$")
_NOTES = frozenset({Kind.LINK, Kind.EDGE_NOTE, Kind.NOTE})
_NOTHING = "nothing"
#: The field in which rosbags has the type of a message: no value of it.
_NAME = "__msgtype__"
#: Where random identifiers are: of goals, and of the clients of services.
_UUID, _CLIENT = "unique_identifier_msgs/msg/UUID", "info.client_gid"


class Undecodable(GatewayError):
    """A message that cannot be decoded: its type is unknown, or its bytes are not of that type."""


@dataclass(frozen=True, slots=True)
class PoseValue:
    """A pose, a position or a rotation.

    Attributes:
        numbers: the numbers of the message.
        position: in millimetres; None for a rotation without a position.
        rotation: matrix, row by row; None for a position without a rotation.
    """

    numbers: tuple[float, ...]
    position: tuple[float, ...] | None
    rotation: tuple[float, ...] | None


@dataclass(frozen=True, slots=True, eq=False)
class ElementArray:
    """An array of elements of one kind.

    Attributes:
        values: (elements, components).
        what: name of the elements: "points", "pixels" …
        mm: length of 1 in millimetres if the values are positions; else 0.
    """

    values: Array
    what: str
    mm: float = 0.0


@dataclass(frozen=True, slots=True)
class StampValue:
    """A stamp in a message, UTC ns; 0 = unset."""

    ns: int


@dataclass(frozen=True, slots=True)
class Tolerance:
    """The differences that count as equal."""

    mm: float = 0.0
    deg: float = 0.0


EXACT = Tolerance()


@dataclass(slots=True)
class Delta:
    """The difference of two messages.

    Attributes:
        field: path of the first field that differs by more than the tolerance; ``""`` for none.
        one, other: values of that field.
        mm, deg: largest distance between positions in millimetres, and between rotations in degrees.
        what, elements, of: of the array with the most differing elements: their name, their number, and the total.
        largest: largest difference of numbers in an array without positions.
        stamps_ns: how much later each stamp is in the other message.
    """

    field: str = ""
    one: Any = None
    other: Any = None
    mm: float = 0.0
    deg: float = 0.0
    what: str = ""
    elements: int = 0
    of: int = 0
    largest: float = 0.0
    stamps_ns: list[int] = dataclasses.field(default_factory=list)

    def differ(self, path: str, one: Any, other: Any) -> None:
        """Record a differing field, if it is the first."""
        if not self.field:
            self.field, self.one, self.other = path, one, other

    @property
    def measure(self) -> str:
        """Return the difference in units, for people; ``""`` if it has no unit."""
        parts = [f"{self.mm:.6g} mm"] if self.mm else []
        parts += [f"{self.deg:.6g}°"] if self.deg else []
        parts += [f"{self.elements:,} of {self.of:,} {self.what}"] if self.elements else []
        parts += [f"by up to {self.largest:.6g}"] if self.largest else []
        return ", ".join(parts)


def compare_values(one: Iterator[_Leaf], other: Iterator[_Leaf], tolerance: Tolerance = EXACT) -> Delta:
    """Return the difference of two messages, given their leaves.  Raises Undecodable."""
    delta = Delta()
    for left, right in zip_longest(one, other):
        if left is None or right is None or left[0] != right[0] or type(left[1]) is not type(right[1]):
            path, value = left or (right[0], _NOTHING)
            delta.differ(path, value, right[1] if right and right[0] == path else _NOTHING)
            break
        path, value = left
        match value:
            case StampValue():
                if bool(value.ns) is not bool(right[1].ns):
                    delta.differ(path, value.ns, right[1].ns)
                elif value.ns:
                    delta.stamps_ns.append(right[1].ns - value.ns)
            case PoseValue():
                _compare_poses(delta, path, value, right[1], tolerance)
            case ElementArray():
                _compare_grids(delta, path, value, right[1], tolerance)
            case _:
                if not same(value, right[1]):
                    delta.differ(path, value, right[1])
    return delta


def same(one: Any, other: Any) -> bool:
    """Return whether two values are equal or both NaN."""
    return bool(one == other) or (
        isinstance(one, float) and isinstance(other, float) and math.isnan(one) and math.isnan(other)
    )


def first_byte(one: bytes, other: bytes) -> tuple[str, str, str]:
    """Return offset and values of the first byte that differs, for messages that cannot be decoded."""
    at = next((at for at, (a, b) in enumerate(zip(one, other, strict=False)) if a != b), min(len(one), len(other)))
    return f"byte {at}", one[at : at + 8].hex(), other[at : at + 8].hex()


def _compare_poses(delta: Delta, path: str, one: PoseValue, other: PoseValue, tolerance: Tolerance) -> None:
    if all(map(same, one.numbers, other.numbers)):
        return
    mm = deg = 0.0
    if one.position is not None and other.position is not None and not all(map(same, one.position, other.position)):
        mm = _finite(math.dist(one.position, other.position))
    if one.rotation is not None and other.rotation is not None and not all(map(same, one.rotation, other.rotation)):
        # the chord between two rotations: exact for small angles, and not 0 for matrices that are not orthonormal
        chord = _finite(math.dist(one.rotation, other.rotation))
        deg = math.degrees(2 * math.asin(min(1.0, chord / _SAME_ROTATION))) if chord < math.inf else chord
    delta.mm, delta.deg = max(delta.mm, mm), max(delta.deg, deg)
    if mm > tolerance.mm or deg > tolerance.deg or not (tolerance.mm or tolerance.deg):
        delta.differ(path, list(one.numbers), list(other.numbers))


def _compare_grids(delta: Delta, path: str, one: ElementArray, other: ElementArray, tolerance: Tolerance) -> None:
    a, b = one.values, other.values
    if a.shape != b.shape or a.dtype != b.dtype:
        delta.differ(path, f"{a.shape} {a.dtype}", f"{b.shape} {b.dtype}")
        return
    unequal = a != b
    if a.dtype.kind == "f":
        unequal &= ~(np.isnan(a) & np.isnan(b))
    rows = np.flatnonzero(unequal.any(axis=1))
    if not len(rows):
        return
    with np.errstate(invalid="ignore", over="ignore"):
        apart = np.where(unequal[rows], np.abs(b[rows].astype(np.float64) - a[rows].astype(np.float64)), 0.0)
        apart = np.nan_to_num(apart, nan=np.inf, posinf=np.inf)
        mm = float(np.sqrt((apart**2).sum(axis=1)).max()) * one.mm if one.mm else 0.0
    largest = 0.0 if one.mm else float(apart.max())
    delta.mm, delta.largest = max(delta.mm, mm), max(delta.largest, largest)
    if len(rows) > delta.elements:
        delta.what, delta.elements, delta.of = one.what, len(rows), len(a)
    if not one.mm or not tolerance.mm or mm > tolerance.mm:
        at = int(rows[0])
        delta.differ(f"{path}[{at}]", a[at].tolist(), b[at].tolist())


def _finite(value: float) -> float:
    return math.inf if math.isnan(value) else value


class LeafDecoder:
    """Flattens messages into leaves.

    Args:
        definitions: ROS type → its definition with all dependencies, as in ``ros2msg`` schemas.
        units: the unit of lengths in each stream.
        ids: random identifiers of goals and clients → what stands for them (`random_ids`).
    """

    def __init__(
        self,
        definitions: Mapping[str, str] | None = None,
        units: StreamUnits | None = None,
        ids: Mapping[bytes, str] | None = None,
    ) -> None:
        self._ids = ids or {}
        self._definitions = definitions or {}
        self._units = units or StreamUnits(Config())

    def leaves(self, entry: Entry) -> Iterator[_Leaf]:
        """Yield the leaves of the message of an entry.  Raises Undecodable, possibly after the first leaves."""
        if entry.kind in _NOTES:
            yield from _of_note(entry)
        elif entry.kind in (Kind.IGTL_IN, Kind.IGTL_OUT):
            yield from self._igtl(entry)
        else:
            yield from self._ros(entry)

    def _mm(self, entry: Entry) -> float:
        """Return how many millimetres the unit of lengths in a message is."""
        return scale(self._units.of(entry.kind, entry.channel, entry.type, entry.links), "mm")

    # -- OpenIGTLink --------------------------------------------------------------------------------------------

    def _igtl(self, entry: Entry) -> Iterator[_Leaf]:
        data = entry.data()
        try:
            header = Header.unpack(data)
            yield "header_version", header.version
            yield "type", visible(header.type)
            yield "device_name", visible(header.device_name)
            yield "timestamp", StampValue(ticks_to_ns(header.ticks))
            right = True
            try:
                message = decode(data, reading=READING)
            except ChecksumMismatch:
                message, right = decode(data, check_crc=False, reading=READING), False
        except GatewayError as error:
            raise Undecodable(str(error)) from None
        yield "message_id", message.message_id
        for item in message.metadata:
            yield f"metadata.{visible(item.key)}", item.text
        yield from self._content(message.content, self._mm(entry))
        yield "crc_ok", right

    def _content(self, content: Any, mm: float) -> Iterator[_Leaf]:
        values = describe_content(content)
        match content:
            case Transform(wire_matrix):
                values["matrix"] = _of_matrix(wire_matrix, mm)
            case Position():
                values = {"pose": _pose_value(values.pop("position", ()), values.pop("quaternion", ()), mm), **values}
            case Elements():
                values["elements"] = [
                    self._element(one, row, mm) for one, row in zip(values["elements"], content.elements, strict=True)
                ]
            case Image(wire_matrix=wire_matrix):
                values["wire_matrix"] = _of_image_matrix(wire_matrix, mm)
                values["spacing"] = _spacing(wire_matrix)
                pixels = content.array
                values["data"] = ElementArray(pixels.reshape(-1, max(1, pixels.shape[-1])), "pixels")
                del values["data_crc64"]
            case PolyData(points=points):
                values["points"] = ElementArray(points.reshape(-1, 3), "points", mm)
        yield from flattened(values, "content")

    def _element(self, values: dict[str, Any], row: Any, mm: float) -> dict[str, Any]:
        """Return an element of a list, such as a tool or a landmark, with its pose as one value."""
        values = dict(values)
        if "matrix" in values:
            values["matrix"] = _of_matrix(row["matrix"].tolist(), mm)
        if "quaternion" in values:
            values["position"] = _pose_value(values["position"], values.pop("quaternion"), mm)
        for name in ("position", "entry", "target"):
            if isinstance(values.get(name), list | tuple):
                values[name] = _pose_value(values[name], (), mm)
        return values

    # -- ROS ----------------------------------------------------------------------------------------------------

    def _ros(self, entry: Entry) -> Iterator[_Leaf]:
        try:
            message = self._decoder.decode(entry.type, entry.data())
        except DamagedRecording as error:
            raise Undecodable(str(error)) from None
        except Exception as error:  # rosbags raises many types of errors for invalid bytes
            raise Undecodable(f"{entry.type}: {type(error).__name__}: {error}") from None
        yield from self._walk(message, "", self._mm(entry))

    @cached_property
    def _decoder(self) -> RosDecoder:
        # imported only if messages differ or are shown
        from igtl_gateway.base.untrusted.decoding import MessageDecoder as RosDecoder

        return RosDecoder(lambda ros_type: self._definitions.get(ros_type, ""))

    def _walk(self, value: Any, path: str, mm: float) -> Iterator[_Leaf]:
        ros_type = getattr(value, "__msgtype__", "")
        special = _SPECIAL.get(ros_type)
        if ros_type == "builtin_interfaces/msg/Time" and path.rpartition(".")[2] in ("stamp", "timestamp"):
            yield path, StampValue(value.sec * 1_000_000_000 + value.nanosec)
        elif special:
            yield path, special(value, mm)
        elif self._ids and (ros_type == _UUID or path.endswith(_CLIENT)):
            own = bytes(getattr(value, "uuid", value))
            yield path, self._ids.get(own, own.hex())
        elif ros_type in _ARRAYS:
            parts = {item.name: getattr(value, item.name) for item in dataclasses.fields(value) if item.name != _NAME}
            for name, part in {**parts, **_ARRAYS[ros_type](value, mm)}.items():
                yield from self._walk(part, f"{path}.{name}" if path else name, mm)
        elif ros_type:
            for item in dataclasses.fields(value):
                if item.name != _NAME:
                    yield from self._walk(getattr(value, item.name), f"{path}.{item.name}" if path else item.name, mm)
        elif isinstance(value, list) and value and getattr(value[0], "__msgtype__", "") in _POINTS:
            yield path, ElementArray(np.array([(one.x, one.y, one.z) for one in value]), "points", mm)
        elif isinstance(value, list):
            for index, part in enumerate(value):
                yield from self._walk(part, f"{path}[{index}]", mm)
        elif isinstance(value, np.ndarray) and value.ndim and value.size > _SHORT:
            yield path, ElementArray(value.reshape(-1, 1), "values")
        else:
            yield from flattened(value, path)


def flattened(value: Any, path: str) -> Iterator[_Leaf]:
    """Yield the leaves of nested values with their paths, such as ``content.matrix[0][3]``."""
    if isinstance(value, PoseValue | ElementArray | StampValue):
        yield path, value
        return
    if dataclasses.is_dataclass(value):
        value = {item.name: getattr(value, item.name) for item in dataclasses.fields(value)}
    if isinstance(value, dict):
        for name, part in value.items():
            yield from flattened(part, f"{path}.{name}" if path else name)
    elif isinstance(value, np.ndarray):
        yield from flattened(value.tolist(), path)
    elif isinstance(value, list | tuple):
        for index, part in enumerate(value):
            yield from flattened(part, f"{path}[{index}]")
    elif isinstance(value, memoryview):
        yield path, bytes(value)
    else:
        yield path, value


def _of_note(entry: Entry) -> Iterator[_Leaf]:
    """Yield the leaves of a note: code, level and stream, without the text."""
    try:
        note = Note.unpack(entry.data())
    except ValueError as error:
        raise Undecodable(f"note: {error}") from None
    yield "code", note.code
    yield "level", note.level.name
    yield "stream", note.stream


def _pose_value(position: Sequence[float], quaternion: Sequence[float], mm: float) -> PoseValue:
    """Build a pose from a position and a quaternion x, y, z, w; either may be empty."""
    rotation = None
    if quaternion:
        x, y, z = quaternion[:3]
        w = quaternion[3] if len(quaternion) > 3 else math.sqrt(max(0.0, 1 - x * x - y * y - z * z))
        norm = x * x + y * y + z * z + w * w
        s = 2 / norm if norm else math.nan
        rotation = (
            *(1 - s * (y * y + z * z), s * (x * y - z * w), s * (x * z + y * w)),
            *(s * (x * y + z * w), 1 - s * (x * x + z * z), s * (y * z - x * w)),
            *(s * (x * z - y * w), s * (y * z + x * w), 1 - s * (x * x + y * y)),
        )
    scaled = tuple(value * mm for value in position) if len(position) else None
    return PoseValue((*position, *quaternion), scaled, rotation)


def _of_matrix(columns: Sequence[float], mm: float) -> PoseValue:
    """Build a pose from three columns of directions and one of the position."""
    turned = tuple(columns[3 * column + row] for row in range(3) for column in range(3))
    return PoseValue(tuple(columns), tuple(value * mm for value in columns[9:12]), turned)


def _spacing(columns: Sequence[float]) -> list[float]:
    """Return the lengths of the directions of an image, without the noise of the rotation."""
    return [float(f"{math.hypot(*columns[at : at + 3]):.6g}") for at in (0, 3, 6)]


def _of_image_matrix(columns: Sequence[float], mm: float) -> PoseValue:
    """Build a pose from four columns of which the directions have the length of a pixel."""
    lengths = [math.hypot(*columns[at : at + 3]) or 1.0 for at in (0, 3, 6)]
    place = _of_matrix([*(columns[at] / lengths[at // 3] for at in range(9)), *columns[9:]], mm)
    return dataclasses.replace(place, numbers=tuple(columns))


def _vector(value: Any) -> tuple[float, float, float]:
    return float(value.x), float(value.y), float(value.z)


def _quaternion(value: Any) -> tuple[float, float, float, float]:
    return *_vector(value), float(value.w)


#: ROS type → function (message, length of 1 in millimetres) that returns its pose.
_SPECIAL: dict[str, Callable[[Any, float], PoseValue]] = {
    **dict.fromkeys(_POINTS, lambda point, mm: _pose_value(_vector(point), (), mm)),
    "geometry_msgs/msg/Quaternion": lambda turn, mm: _pose_value((), _quaternion(turn), mm),
    "geometry_msgs/msg/Pose": lambda pose, mm: _pose_value(_vector(pose.position), _quaternion(pose.orientation), mm),
    "geometry_msgs/msg/Transform": lambda pose, mm: _pose_value(
        _vector(pose.translation), _quaternion(pose.rotation), mm
    ),
}


def _of_image(image: Any, _mm: float) -> dict[str, Any]:
    """Return the pixels of a sensor_msgs/Image, without row padding."""
    height, width, step, data = image.height, image.width, image.step, image.data
    found = _BITS.match(image.encoding)
    bits, kind = (int(found[1]), found[2]) if found else (16 if image.encoding.endswith("16") else 8, "U")
    dtype = np.dtype(f"{'>' if image.is_bigendian else '<'}{ {'U': 'u', 'S': 'i', 'F': 'f'}[kind] }{bits // 8}")
    if not width or not height or len(data) != height * step or step % width or step // width % dtype.itemsize:
        return {"data": ElementArray(data.reshape(-1, 1), "bytes")}
    return {"data": ElementArray(data.view(dtype).reshape(height * width, -1), "pixels")}


def _of_cloud(cloud: Any, mm: float) -> dict[str, Any]:
    """Return the points of a sensor_msgs/PointCloud2: positions, and the bytes of all other fields."""
    number, step, data = cloud.width * cloud.height, cloud.point_step, cloud.data
    if not number or len(data) != number * step:
        return {"data": ElementArray(data.reshape(-1, 1), "bytes")}
    rows = data.reshape(number, step)
    order = ">" if cloud.is_bigendian else "<"
    axes, rest = [], np.ones(step, bool)
    for field in cloud.fields:
        if field.name in ("x", "y", "z") and field.datatype in _FLOATS and field.count == 1:
            dtype = np.dtype(order + _FLOATS[field.datatype])
            end = field.offset + dtype.itemsize
            if end <= step:
                axes.append(np.ascontiguousarray(rows[:, field.offset : end]).view(dtype))
                rest[field.offset : end] = False
    parts: dict[str, Any] = {"data": ElementArray(rows[:, rest], "points' other fields")}
    if axes:
        parts = {"points": ElementArray(np.hstack(axes), "points", mm), **parts}
    return parts


_FLOATS = {7: "f4", 8: "f8"}

#: ROS type → function that returns its fields that are arrays of elements.
_ARRAYS: dict[str, Callable[[Any, float], dict[str, Any]]] = {
    "sensor_msgs/msg/Image": _of_image,
    "sensor_msgs/msg/PointCloud2": _of_cloud,
}
