"""The columns of a table: a message as cells whose names contain the unit.

A name is the path of the field, with dots, and its unit if the protocol or the message definition fixes one: ``x_mm``,
``transform.translation.x_m``, ``angular.z_rad_s``.  Stamps and durations of ROS become one integer in nanoseconds:
``header.stamp_ns``.  Lengths of OpenIGTLink are millimetres, whatever unit the stream has.  Quaternions, rows of
rotation matrices, colours and counts have no unit.  The names of joint values and of SENSOR values have no unit either:
a joint can rotate or slide, and SENSOR has its unit in the message.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
from rosbags.typesys.base import normalize_fieldname
from rosbags.typesys.store import Typestore

from igtl_gateway.base.errors import ConversionError, LimitExceeded
from igtl_gateway.base.quantities import counted
from igtl_gateway.base.stamp import NS_PER_S
from igtl_gateway.base.untrusted import limits
from igtl_gateway.convert.context import ToRosContext
from igtl_gateway.convert.poses import pose_of_matrix
from igtl_gateway.convert.units import LengthUnits, millimetres

Cells = dict[str, Any]

#: First columns of every table; an underscore is appended to a field of such a name.
HEAD = ("entry", "time_ns", "source_ns", "item")
#: Column with the link of a message that was received, in tables of what several peers have sent; no type has a field
#: of this name.  It is empty before the second one sent it.
LINK = "link"
#: Longest array of numbers that becomes columns.
MAX_NUMBERS = 64
#: Largest number of columns of a table.
MAX_COLUMNS = 2048


class TooLong(Exception):
    """A message that does not fit in a table."""


# -- OpenIGTLink --------------------------------------------------------------------------------------------------

_XYZ_MM = ("x_mm", "y_mm", "z_mm")
_QUATERNION = ("qx", "qy", "qz", "qw")
_ROTATION = tuple(f"r{row}{column}" for row in (1, 2, 3) for column in (1, 2, 3))
#: Twelve numbers in the order of the wire: columns of the rotation, then the translation.
_WIRE_MATRIX = (*(f"r{row}{column}" for column in (1, 2, 3) for row in (1, 2, 3)), *_XYZ_MM)

#: Field of a described message → names of the numbers in it.
_NUMBERS: dict[str, tuple[str, ...]] = {
    "position": _XYZ_MM,
    "entry": _XYZ_MM,
    "target": _XYZ_MM,
    "wire_matrix": _WIRE_MATRIX,
    "quaternion": ("x", "y", "z", "w"),
}
#: Field of a described message → its name with the unit.
_NAMED = {"diameter": "diameter_mm", "focal_length": "focal_length_mm", "resolution": "resolution_ms"}
#: Fields of the two tables above that are lengths; the axes of the matrix of an image are as long as a pixel.
_LENGTHS = frozenset({"position", "entry", "target", "wire_matrix", "diameter", "focal_length"})


def name_igtl_fields(fields: Mapping[str, Any], unit: str) -> dict[str, Any]:
    """Return the fields of an OpenIGTLink message named with units; matrices become poses.

    Args:
        fields: as ``describe`` gives them.
        unit: of lengths in the message, which become millimetres.
    """
    return _named(fields, millimetres(unit))


def _named(fields: Mapping[str, Any], lengths: LengthUnits) -> dict[str, Any]:
    named: dict[str, Any] = {}
    for name, value in fields.items():
        if name == "matrix" and isinstance(value, list):
            named |= _pose(value, lengths)
        elif isinstance(value, dict):
            named |= {f"{name}_ns": _nanoseconds(value)} if value.keys() == _TIME else {name: _named(value, lengths)}
        elif isinstance(value, list) and name in _NUMBERS and len(value) == len(_NUMBERS[name]):
            scaled = map(lengths.to_ros, value) if name in _LENGTHS else value
            named[name] = dict(zip(_NUMBERS[name], scaled, strict=True))
        elif isinstance(value, list):
            named[name] = [_named(one, lengths) if isinstance(one, dict) else one for one in value]
        else:
            named[_NAMED.get(name, name)] = lengths.to_ros(value) if name in _LENGTHS else value
    return named


def _pose(rows: list[list[float]], lengths: LengthUnits) -> dict[str, Any]:
    """Return position, quaternion and rotation of a 4 × 4 matrix; an empty quaternion if it is not orthonormal."""
    matrix = tuple(rows[row][column] for column in range(4) for row in range(3))
    named: dict[str, Any] = dict(zip(_XYZ_MM, map(lengths.to_ros, matrix[9:]), strict=True))
    try:
        pose = pose_of_matrix(matrix, ToRosContext("", 0, "", "", lengths), "TRANSFORM")
        named |= zip(_QUATERNION, pose[3:], strict=True)
    except ConversionError:
        named |= dict.fromkeys(_QUATERNION, "")
    return named | dict(zip(_ROTATION, (value for row in rows[:3] for value in row[:3]), strict=True))


# -- ROS ----------------------------------------------------------------------------------------------------------

_TIME = {"sec", "nanosec"}
_TIMES = frozenset({"builtin_interfaces/msg/Time", "builtin_interfaces/msg/Duration"})
#: Types whose numbers have the unit of the field that contains them → the unit if that field has none.
_INHERIT = {"Vector3": "", "Point": "m", "Point32": "m"}

#: package/Type → field → unit, from REP 103 and the comments of the message definitions.
_UNITS: dict[str, dict[str, str]] = {
    "geometry_msgs/Transform": {"translation": "m"},
    "geometry_msgs/Pose2D": {"x": "m", "y": "m", "theta": "rad"},
    "geometry_msgs/Twist": {"linear": "m_s", "angular": "rad_s"},
    "geometry_msgs/Accel": {"linear": "m_s2", "angular": "rad_s2"},
    "geometry_msgs/Wrench": {"force": "N", "torque": "Nm"},
    "geometry_msgs/Inertia": {"m": "kg", "com": "m"}
    | dict.fromkeys(("ixx", "ixy", "ixz", "iyy", "iyz", "izz"), "kg_m2"),
    "sensor_msgs/Imu": {"angular_velocity": "rad_s", "linear_acceleration": "m_s2"},
    "sensor_msgs/MagneticField": {"magnetic_field": "T"},
    "sensor_msgs/Range": {"field_of_view": "rad", "min_range": "m", "max_range": "m", "range": "m"},
    "sensor_msgs/LaserScan": {
        **dict.fromkeys(("angle_min", "angle_max", "angle_increment"), "rad"),
        **dict.fromkeys(("time_increment", "scan_time"), "s"),
        **dict.fromkeys(("range_min", "range_max", "ranges"), "m"),
    },
    "sensor_msgs/NavSatFix": {"latitude": "deg", "longitude": "deg", "altitude": "m"},
    "sensor_msgs/Temperature": {"temperature": "C"},
    "sensor_msgs/FluidPressure": {"fluid_pressure": "Pa"},
    "sensor_msgs/Illuminance": {"illuminance": "lx"},
    "sensor_msgs/BatteryState": {
        **dict.fromkeys(("voltage", "cell_voltage"), "V"),
        **dict.fromkeys(("temperature", "cell_temperature"), "C"),
        **{"current": "A", "charge": "Ah", "capacity": "Ah", "design_capacity": "Ah"},
    },
    "shape_msgs/SolidPrimitive": {"dimensions": "m"},
    "visualization_msgs/Marker": {"scale": "m"},
    "nav_msgs/MapMetaData": {"resolution": "m"},
    "igtl_msgs/LabeledPoint": {"diameter": "m"},
    "igtl_msgs/Trajectory": {"diameter": "m"},
    "igtl_msgs/Volume": {"spacing": "m"},
    "igtl_msgs/VideoFrame": {"spacing": "m"},
    "igtl_msgs/VideoMeta": {"spacing": "m", "focal_length": "m"},
    "igtl_msgs/Query": {"resolution": "ms"},
    "igtl_msgs/Command": {"timeout": "s"},
}


#: Units as names of columns end with them; the longer ones first.
UNITS_OF_NAMES = tuple(
    sorted(
        {
            "ns",
            "ms",
            "mm",
            *(unit for each in _UNITS.values() for unit in each.values()),
            *filter(None, _INHERIT.values()),
        },
        key=lambda unit: (-len(unit), unit),
    )
)


def field_unit(ros_type: str, field: str, unit: str) -> str:
    """Return the unit of a field of a ROS type, as in names of columns; ``unit`` is that of the field above it."""
    package, _, name = ros_type.partition("/msg/")
    inherited = unit or _INHERIT[name] if package == "geometry_msgs" and name in _INHERIT else ""
    return _UNITS.get(f"{package}/{name}", {}).get(field, inherited)


def name_ros_fields(store: Typestore, value: Any) -> Any:
    """Return the fields of a message decoded by rosbags, named with units and without constants."""
    return _FieldNamer(store).name_fields(value, "")


class _FieldNamer:
    """Names the fields of one message with their units; caches the names of each type."""

    def __init__(self, store: Typestore) -> None:
        self._store = store
        self._plans: dict[tuple[str, str], list[tuple[str, str, str]]] = {}

    def name_fields(self, value: Any, unit: str) -> Any:
        ros_type = getattr(value, "__msgtype__", "")
        if not ros_type:
            return [self.name_fields(one, unit) for one in value] if isinstance(value, list) else value
        named: dict[str, Any] = {}
        for field, attribute, field_unit in self._plan(ros_type, unit):
            inner = getattr(value, attribute)
            if isinstance(inner, float | int | str):
                named[f"{field}_{field_unit}" if field_unit else field] = inner
            elif getattr(inner, "__msgtype__", "") in _TIMES:
                named[f"{field}_ns"] = inner.sec * NS_PER_S + inner.nanosec
            else:
                one = inner[0] if isinstance(inner, list) and inner else inner
                is_message = hasattr(one, "__msgtype__")
                key = field if is_message or not field_unit else f"{field}_{field_unit}"
                named[key] = self.name_fields(inner, field_unit)
        return named

    def _plan(self, ros_type: str, unit: str) -> list[tuple[str, str, str]]:
        """Return name, attribute in rosbags and unit of each field of a type; ``unit`` is that of the parent field."""
        if (ros_type, unit) not in self._plans:
            self._plans[ros_type, unit] = [
                (field, normalize_fieldname(field), field_unit(ros_type, field, unit))
                for field, _ in self._store.fielddefs[ros_type][1]
            ]
        return self._plans[ros_type, unit]


def _nanoseconds(value: Mapping[str, int]) -> int:
    return value["sec"] * NS_PER_S + value["nanosec"]


# -- cells --------------------------------------------------------------------------------------------------------


def table_rows(fields: Mapping[str, Any], size: int = 0) -> Iterator[Cells]:
    """Yield the rows of a message: one for each element if a field is a list of messages, otherwise one.

    Args:
        fields: the fields, named with units.
        size: bytes of the message; it bounds the other fields, which every row repeats.

    Raises TooLong.
    """
    lists = [name for name, value in fields.items() if _is_list_of_messages(value)]
    rest = dict(_bounded(_cells("", {name: value for name, value in fields.items() if name not in lists})))
    if not lists:
        yield rest
        return
    count = max(len(fields[name]) for name in lists)
    repeated = sum(len(value) if isinstance(value, str) else 1 for value in rest.values())
    try:
        limits.check_unpacked(size, count * repeated, counted(count, "row"))
    except LimitExceeded as error:
        raise TooLong(str(error)) from None
    for index in range(count):
        line: Cells = {"item": index, **rest}
        for name in lists:
            if index < len(fields[name]):
                line |= _bounded(_cells(name, fields[name][index]))
        yield line


def _bounded(cells: Iterator[tuple[str, Any]]) -> Iterator[tuple[str, Any]]:
    for number, cell in enumerate(cells):
        if number >= MAX_COLUMNS:
            raise TooLong(f"more than {MAX_COLUMNS} columns")
        yield cell


def _is_list_of_messages(value: Any) -> bool:
    return isinstance(value, list) and bool(value) and all(isinstance(one, dict) for one in value)


def _cells(name: str, value: Any) -> Iterator[tuple[str, Any]]:
    """Yield the columns and values of a field.  Raises TooLong."""
    if isinstance(value, np.ndarray | bytes | memoryview):
        _check_length(name, len(value), "numbers")
        value = value.tolist() if isinstance(value, np.ndarray) else list(value)
    match value:
        case dict():
            for key, inner in value.items():
                place = f"{name}.{key}" if name else f"{key}_" if key in HEAD else key
                if isinstance(inner, float | int | str):
                    yield place, inner
                else:
                    yield from _cells(place, inner)
        case list() | tuple():
            _check_length(name, len(value), "values")
            for index, inner in enumerate(value):
                yield from _cells(f"{name}.{index}", inner)
        case _:
            yield name, value


def _check_length(name: str, length: int, things: str) -> None:
    if length > MAX_NUMBERS:
        raise TooLong(f"{name}: found {length:,} {things}, expected at most {MAX_NUMBERS} in a table")
