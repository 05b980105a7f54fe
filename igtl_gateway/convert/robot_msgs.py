"""Messages of robots as values: velocities, forces, buttons, and the two of crtk_msgs that the gateway converts.

The fields have the order of the definitions of ROS 2 Jazzy and of crtk_msgs; units are m/s, rad/s, N and N m.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated, Any, ClassVar

import numpy as np
import numpy.typing as npt

from igtl_gateway.convert.igtl_msgs import HEADER
from igtl_gateway.convert.rosmsg import Header
from igtl_gateway.convert.structs import BOOL, STRING, UINT8, Struct, fixed_array, number_sequence

Array = npt.NDArray[Any]
SixNumbers = tuple[float, float, float, float, float, float]


@dataclass(frozen=True, slots=True)
class TwistStamped(Struct):
    """geometry_msgs/msg/TwistStamped: linear velocity x, y, z (m/s), then angular velocity x, y, z (rad/s)."""

    TYPE: ClassVar[str] = "geometry_msgs/msg/TwistStamped"
    header: Annotated[Header, HEADER]
    twist: Annotated[SixNumbers, fixed_array("float64", 6, as_name="geometry_msgs/Twist")]


@dataclass(frozen=True, slots=True)
class WrenchStamped(Struct):
    """geometry_msgs/msg/WrenchStamped: force x, y, z (N), then torque x, y, z (N m)."""

    TYPE: ClassVar[str] = "geometry_msgs/msg/WrenchStamped"
    header: Annotated[Header, HEADER]
    wrench: Annotated[SixNumbers, fixed_array("float64", 6, as_name="geometry_msgs/Wrench")]


@dataclass(frozen=True, slots=True)
class Joy(Struct):
    """sensor_msgs/msg/Joy: axes (n,) float32, buttons (m,) int32; of a pedal 1 pressed, 0 released, 2 clicked."""

    TYPE: ClassVar[str] = "sensor_msgs/msg/Joy"
    header: Annotated[Header, HEADER]
    axes: Annotated[Array, number_sequence("float32")] = field(default_factory=lambda: np.empty(0, np.float32))
    buttons: Annotated[Array, number_sequence("int32")] = field(default_factory=lambda: np.empty(0, np.int32))


@dataclass(frozen=True, slots=True)
class Empty(Struct):
    """std_msgs/msg/Empty: the byte is that of every ROS 2 message without a field."""

    TYPE: ClassVar[str] = "std_msgs/msg/Empty"
    structure_needs_at_least_one_member: Annotated[int, UINT8] = 0


@dataclass(frozen=True, slots=True)
class OperatingState(Struct):
    """crtk_msgs/msg/OperatingState: DISABLED, ENABLED, PAUSED or FAULT."""

    TYPE: ClassVar[str] = "crtk_msgs/msg/OperatingState"
    header: Annotated[Header, HEADER]
    state: Annotated[str, STRING]
    is_homed: Annotated[bool, BOOL] = False
    is_busy: Annotated[bool, BOOL] = False


@dataclass(frozen=True, slots=True)
class StringStamped(Struct):
    """crtk_msgs/msg/StringStamped: the type of state_command (enable, disable, pause, resume, home, unhome)."""

    TYPE: ClassVar[str] = "crtk_msgs/msg/StringStamped"
    header: Annotated[Header, HEADER]
    string: Annotated[str, STRING]
