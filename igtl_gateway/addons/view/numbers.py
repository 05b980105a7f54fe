"""Numbers: plots over time, bar charts, tensors."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
import rerun as rr

from igtl_gateway.addon import ConversionError
from igtl_gateway.addon.igtl import NDARRAY_SCALARS
from igtl_gateway.addon.ros import JointState, Joy, MultiArray, NdArray, Sensor, TwistStamped, WrenchStamped
from igtl_gateway.addon.terminal import counted
from igtl_gateway.addons.view.canvas import Canvas
from igtl_gateway.addons.view.colours import line_colour
from igtl_gateway.addons.view.contents import EntityKind
from igtl_gateway.addons.view.other_msgs import Float64

#: Up to this many numbers are curves; more numbers are a bar chart.
_CURVES = 16
#: Sets of joints of one topic that are drawn.
_MOST_GROUPS = 64
_WRENCH = (*(f"force {axis} (N)" for axis in "xyz"), *(f"torque {axis} (Nm)" for axis in "xyz"))
_TWIST = (*(f"linear {axis} (m/s)" for axis in "xyz"), *(f"angular {axis} (rad/s)" for axis in "xyz"))
#: Units of revolute and of prismatic joints: the message does not state the kind of a joint.
_JOINTS = {"position": "rad or m", "velocity": "rad/s or m/s", "effort": "Nm or N"}


def draw_joints(message: JointState, canvas: Canvas) -> None:
    """sensor_msgs/JointState: positions at the path of the topic, velocities and efforts below it; moves robots."""
    for (what, unit), values in zip(_JOINTS.items(), (message.position, message.velocity, message.effort), strict=True):
        _joint_curves(canvas, message.name, values.tolist(), unit, "" if what == "position" else what)
    canvas.robots.move(message.name, message.position.tolist(), canvas)


def _joint_curves(canvas: Canvas, names: tuple[str, ...], values: list[Any], unit: str, child: str) -> None:
    """Draw a curve for each joint, by its name: another message may have them in another order, or other ones.

    Joints of another arm have curves of their own, ``<number>``; the curve of a joint that a message does not have has
    a gap.  A message whose names are not those of its numbers has curves without names.
    """
    if not values:
        return
    if len(set(names)) != len(values) or len(names) != len(values):
        if names:
            canvas.text_once(
                f"found {counted(len(values), 'number')} and the names {', '.join(names)[:200]}, expected one each"
            )
            child = f"{child}/unnamed" if child else "unnamed"
        _curves(canvas, values, (), child)
        return
    groups: list[tuple[str, ...]] = canvas.memory.setdefault(f"joints {child}", [])
    number = next((each for each, known in enumerate(groups) if set(names) <= set(known)), len(groups))
    if number == len(groups):
        if number >= _MOST_GROUPS:
            canvas.text_once(f"more than {_MOST_GROUPS} sets of joints are not drawn")
            return
        groups.append(names)
    by_name = dict(zip(names, values, strict=True))
    if number:
        child = f"{child}/{number + 1}" if child else str(number + 1)
    shown = [f"{name} ({unit})" for name in groups[number]]
    _curves(canvas, [by_name.get(name, math.nan) for name in groups[number]], shown, child)


def draw_sensor(message: Sensor, canvas: Canvas) -> None:
    """igtl_msgs/Sensor."""
    unit = f" ({message.unit_text})" if message.unit_text else ""
    _curves(canvas, message.values.tolist(), [f"{number}{unit}" for number in range(1, len(message.values) + 1)])


def draw_number(message: Float64, canvas: Canvas) -> None:
    """std_msgs/Float64."""
    canvas.numbers([message.data])


def draw_twist(message: TwistStamped, canvas: Canvas) -> None:
    """geometry_msgs/TwistStamped."""
    _curves(canvas, list(message.twist), _TWIST)


def draw_buttons(message: Joy, canvas: Canvas) -> None:
    """sensor_msgs/Joy: axes, then buttons."""
    values = [*message.axes.tolist(), *message.buttons.tolist()]
    axes = len(message.axes)
    names = [f"axis {number}" if number <= axes else f"button {number - axes}" for number in range(1, len(values) + 1)]
    _curves(canvas, values, names)


def draw_wrench(message: WrenchStamped, canvas: Canvas) -> None:
    """geometry_msgs/WrenchStamped."""
    _curves(canvas, list(message.wrench), _WRENCH)


def draw_multi_array(message: MultiArray, canvas: Canvas) -> None:
    """std_msgs/…MultiArray."""
    sizes = [each.size for each in message.layout.dim]
    _array(message.data[message.layout.data_offset :], sizes, canvas)


def draw_array(message: NdArray, canvas: Canvas) -> None:
    """igtl_msgs/NdArray; complex numbers are drawn by their magnitude."""
    code = NDARRAY_SCALARS.get(message.scalar_type)
    if code is None:
        raise ConversionError(
            f"{message.TYPE}: found scalar type {message.scalar_type}, expected one that can be drawn"
        )
    dtype = np.dtype(("<" if not message.is_bigendian else ">") + code[1:])
    values = np.frombuffer(message.data, dtype)
    if dtype.kind == "c":
        canvas.text_once("complex numbers are drawn by their magnitude")
        values = np.abs(values)
    _array(values, message.size.tolist(), canvas)


def _array(values: npt.NDArray[Any], sizes: Sequence[int], canvas: Canvas) -> None:
    flat = values.astype(values.dtype.newbyteorder("="), copy=False)
    long = [size for size in sizes if size > 1]
    if len(long) > 1 and math.prod(sizes) == len(flat):
        canvas.set_kind(EntityKind.TENSOR)
        canvas.log(rr.Tensor(flat.reshape(sizes)))
    elif 0 < len(flat) <= _CURVES:
        canvas.set_kind(EntityKind.PLOT)
        _curves(canvas, flat.astype(np.float64).tolist())
    elif len(flat):
        canvas.set_kind(EntityKind.BARS)
        canvas.log(rr.BarChart(flat))


def _curves(canvas: Canvas, values: Sequence[Any], names: Sequence[str] = (), child: str = "") -> None:
    """Draw a curve for each value; a message whose length differs from the first gets separate curves, ``<length>``."""
    if not values:
        return
    if canvas.memory.setdefault(f"curves {child}", len(values)) != len(values):
        child = f"{child}/{len(values)}" if child else str(len(values))
    names = names or [str(number) for number in range(1, len(values) + 1)]
    if len(values) > 1 and canvas.memory.get(f"names {child}") != names:
        canvas.memory[f"names {child}"] = names
        shades = [line_colour(place) for place in range(len(names))]
        canvas.static(
            rr.SeriesLines(names=[canvas.pen.displayable(name) for name in names], colors=np.array(shades, np.uint32)),
            child,
        )
    canvas.numbers(values, child)
