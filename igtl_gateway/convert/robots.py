"""Messages of robots ⇄ TRANSFORM, NDARRAY, SENSOR and STRING, as sawOpenIGTLink sends them.

A joint state is an NDARRAY of float64 with six rows and a column for each joint: has position, position, has velocity,
velocity, has effort, effort.  Velocities and forces are SENSOR with six values: linear, then angular; force, then
torque.  SENSOR has one unit for all values, so none is set: the values are in SI units.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from igtl_gateway.base.errors import ConversionError
from igtl_gateway.base.quantities import counted
from igtl_gateway.convert.common_msgs import (
    Empty,
    JointState,
    Joy,
    OperatingState,
    PoseStamped,
    StringStamped,
    TwistStamped,
    WrenchStamped,
)
from igtl_gateway.convert.context import ConvertedMessage, ToIgtlContext, ToRosContext
from igtl_gateway.convert.igtl_msgs import MetadataItem
from igtl_gateway.convert.poses import pose_of_matrix
from igtl_gateway.convert.rosmsg import Header
from igtl_gateway.convert.rosmsg import String as RosString
from igtl_gateway.convert.structs import Array, SixNumbers
from igtl_gateway.convert.texts import string_to_igtl
from igtl_gateway.wire.ndarray import NdArray
from igtl_gateway.wire.sensor import MAX_VALUES, Sensor
from igtl_gateway.wire.text import String
from igtl_gateway.wire.transform import Transform

#: Rows of a joint state as NDARRAY, and the scalar type float64.
JOINT_ROWS, _FLOAT64 = 6, 11
#: Maximum number of joints: NDARRAY has 16 bits for a size, and no robot has more.
MAX_JOINTS = 1_000
#: Key of the metadata with the names of the joints, separated by commas.
JOINT_NAMES = "JointNames"
_SIX = 6
_HOMED, _BUSY = "homed", "busy"


def transform_to_pose(content: Transform, to: ToRosContext) -> PoseStamped:
    """Convert to PoseStamped.  Raises ConversionError as ``poses.transform_to_ros``."""
    pose = pose_of_matrix(content.wire_matrix, to, f"TRANSFORM {to.device_name!r}")
    return PoseStamped(Header(to.stamp_ns, to.frame_id), pose)


def is_joint_state(content: NdArray) -> bool:
    """Return whether an array has the form of a joint state."""
    return content.scalar_type == _FLOAT64 and len(content.size) == 2 and content.size[0] == JOINT_ROWS


def array_to_joints(content: NdArray, to: ToRosContext) -> JointState:
    """Convert to JointState.  Raises ConversionError for a quantity that only some of the joints have."""
    rows = np.asarray(content.flat, np.float64).reshape(JOINT_ROWS, -1)
    count = rows.shape[1]
    if count > MAX_JOINTS:
        raise ConversionError(
            f"NDARRAY {to.device_name!r}: found {counted(count, 'joint')}, expected at most {MAX_JOINTS:,}"
        )
    values = []
    for index, name in enumerate(("position", "velocity", "effort")):
        has = rows[2 * index] != 0
        if has.any() and not has.all():
            raise ConversionError(
                f"NDARRAY {to.device_name!r}: found {name} of {int(has.sum())} of {counted(count, 'joint')}, "
                "expected all or none"
            )
        values.append(rows[2 * index + 1] if has.any() else np.empty(0))
    names = joint_names(to.metadata)
    return JointState(Header(to.stamp_ns, to.frame_id), names if len(names) == count else (), *values)


def joint_names(metadata: Iterable[MetadataItem]) -> tuple[str, ...]:
    """Return the names of the joints that metadata have; () if they have none."""
    return next((tuple(item.value.split(",")) for item in metadata if item.key == JOINT_NAMES), ())


def joints_to_array(message: JointState, _: ToIgtlContext) -> ConvertedMessage:
    """Convert to NDARRAY, the names as metadata.  Raises ConversionError for vectors of different lengths."""
    vectors = (message.position, message.velocity, message.effort)
    count = max(map(len, vectors))
    if any(len(vector) not in (0, count) for vector in vectors) or not 0 < count <= MAX_JOINTS:
        found = ", ".join(str(len(vector)) for vector in vectors)
        raise ConversionError(
            f"{message.TYPE}: found {found} positions, velocities, efforts, expected one number of joints "
            f"from 1 to {MAX_JOINTS:,}, or 0 where they are not known"
        )
    rows = np.zeros((JOINT_ROWS, count), ">f8")
    for index, vector in enumerate(vectors):
        if len(vector):
            rows[2 * index], rows[2 * index + 1] = 1.0, vector
    names = message.name
    are_listed = len(names) == count and all(name and "," not in name for name in names)
    metadata = (MetadataItem(JOINT_NAMES, 0, ",".join(names)),) if are_listed else ()
    content = NdArray(_FLOAT64, (JOINT_ROWS, count), rows.reshape(-1).view(np.uint8).data)
    return ConvertedMessage(content, message.header.stamp_ns, message.header.frame_id, metadata=metadata)


def sensor_to_joints(content: Sensor, to: ToRosContext) -> JointState:
    """Convert the values of a joint command to positions, with the names that its metadata have for them."""
    names, values = joint_names(to.metadata), np.asarray(content.values, np.float64)
    return JointState(Header(to.stamp_ns, to.frame_id), names if len(names) == len(values) else (), values)


def sensor_to_twist(content: Sensor, to: ToRosContext) -> TwistStamped:
    """Convert six values to a velocity.  Raises ConversionError for another number."""
    return TwistStamped(Header(to.stamp_ns, to.frame_id), _six(content, to))


def sensor_to_wrench(content: Sensor, to: ToRosContext) -> WrenchStamped:
    """Convert six values to force and torque.  Raises ConversionError for another number."""
    return WrenchStamped(Header(to.stamp_ns, to.frame_id), _six(content, to))


def _six(content: Sensor, to: ToRosContext) -> SixNumbers:
    values = tuple(map(float, content.values))
    if len(values) != _SIX:
        raise ConversionError(f"SENSOR {to.device_name!r}: found {counted(len(values), 'value')}, expected {_SIX}")
    return values  # type: ignore[return-value]  # six of them


def twist_to_sensor(message: TwistStamped, _: ToIgtlContext) -> ConvertedMessage:
    """Convert to SENSOR with six values."""
    return _sensor(np.array(message.twist), message.header)


def wrench_to_sensor(message: WrenchStamped, _: ToIgtlContext) -> ConvertedMessage:
    """Convert to SENSOR with six values."""
    return _sensor(np.array(message.wrench), message.header)


def sensor_to_joy(content: Sensor, to: ToRosContext) -> Joy:
    """Convert to buttons.  Raises ConversionError for values that are not integers of 32 bits."""
    values = np.asarray(content.values, np.float64)
    if not (np.abs(values) < 2**31).all() or (values != np.trunc(values)).any():
        raise ConversionError(f"SENSOR {to.device_name!r}: found {values.tolist()}, expected states of buttons")
    return Joy(Header(to.stamp_ns, to.frame_id), buttons=values.astype(np.int32))


def joy_to_sensor(message: Joy, _: ToIgtlContext) -> ConvertedMessage:
    """Convert the buttons to SENSOR.  Raises ConversionError for more than SENSOR has values."""
    if len(message.buttons) > MAX_VALUES:
        raise ConversionError(
            f"{message.TYPE}: found {counted(len(message.buttons), 'button')}, expected at most {MAX_VALUES}"
        )
    return _sensor(np.asarray(message.buttons), message.header)


def _sensor(values: Array, header: Header) -> ConvertedMessage:
    return ConvertedMessage(Sensor(values.astype(">f8")), header.stamp_ns, header.frame_id)


def string_to_state(content: String, to: ToRosContext) -> OperatingState:
    """Convert a state and its words ``homed`` and ``busy``, such as ``ENABLED homed``."""
    state, *words = content.text.split(" ") if content.text else [""]
    return OperatingState(Header(to.stamp_ns, to.frame_id), state, _HOMED in words, _BUSY in words)


def state_to_string(message: OperatingState, to: ToIgtlContext) -> ConvertedMessage:
    """Convert to STRING: the state, then ``homed`` and ``busy`` where they hold."""
    words = (message.state, *(word for word, holds in ((_HOMED, message.is_homed), (_BUSY, message.is_busy)) if holds))
    return _string(" ".join(words), message.header, to)


def string_to_stamped(content: String, to: ToRosContext) -> StringStamped:
    """Convert to StringStamped."""
    return StringStamped(Header(to.stamp_ns, to.frame_id), content.text)


def stamped_to_string(message: StringStamped, to: ToIgtlContext) -> ConvertedMessage:
    """Convert to STRING.  Raises ConversionError for a string that is too long."""
    return _string(message.string, message.header, to)


def string_to_empty(_content: String, _to: ToRosContext) -> Empty:
    """Convert to a message without content: ``hold`` and ``free`` of CRTK."""
    return Empty()


def _string(text: str, header: Header, to: ToIgtlContext) -> ConvertedMessage:
    return ConvertedMessage(string_to_igtl(RosString(text), to).content, header.stamp_ns, header.frame_id)
