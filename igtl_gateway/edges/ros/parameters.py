"""Settings as parameters of the node: declared with their descriptors, and checked as everywhere.

rclpy checks type and range of a parameter with messages of its own, and refuses the integer 5 for a number and an empty
list for a list.  So the node checks a value by the table of settings before rclpy sees it, and gives it the type of its
setting.  What rclpy adds is the answer that a parameter is read-only.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager
from typing import Any

from igtl_gateway.base.errors import ConfigError
from igtl_gateway.config.setting import ROWS, Setting, Value, unknown
from igtl_gateway.config.settings import all_settings, parameters
from igtl_gateway.edges.interface import Change
from igtl_gateway.edges.ros.middleware import interface_class

#: Beginning of the parameters that rclpy declares for topics.
_QOS = "qos_overrides."


def checking_node(rclpy: Any, base: type, changing: AbstractContextManager[object]) -> type:
    """Return a class of nodes that check their parameters by the table of settings.

    Args:
        rclpy: the module.
        base: a class of nodes of rclpy.
        changing: a lock that is held while parameters are set, from the check to the new values.
    """
    rows, make = parameters(), _Parameters(rclpy)

    def set_parameters_atomically(node: Any, given: Sequence[Any]) -> Any:
        """Set parameters as ``base`` does, after the check of their values."""
        checked = []
        for parameter in given:
            try:
                if not node.has_parameter(parameter.name):
                    raise ConfigError(unknown(parameter.name, rows))
                row = rows.get(parameter.name)
                checked.append(make.of(row, row.check(listed(row, parameter.value))) if row else parameter)
            except ConfigError as error:
                return make.result(successful=False, reason=f"{parameter.name}: {error}")
        with changing:
            return base.set_parameters_atomically(node, checked)  # type: ignore[attr-defined]

    return type("GatewayNode", (base,), {"set_parameters_atomically": set_parameters_atomically})


def overrides(node: Any) -> dict[str, Any]:
    """Return name → value of the parameters that the node was started with, without those of rclpy itself."""
    given = node._parameter_overrides  # rclpy has no other list of those that are not declared yet
    return {
        name: parameter.value
        for name, parameter in given.items()
        if not (node.has_parameter(name) or name.startswith(_QOS))
    }


def declare(rclpy: Any, node: Any, values: Mapping[str, Value], change: Change) -> None:
    """Declare all parameters with their values.

    Args:
        rclpy: the module.
        node: of a class of ``checking_node``.
        values: of all parameters.
        change: called with the parameters that are set while the bridge runs; a ConfigError refuses them.
    """
    make, rows = _Parameters(rclpy), parameters()
    # A list without a string has no type in a declaration: it gets its value afterwards, and only then it is read-only.
    empty = [row for name, row in rows.items() if row.is_list and not values[name]]
    declared = []
    for name, row in rows.items():
        descriptor, value = make.descriptor(row), values[name]
        descriptor.read_only = descriptor.read_only and row not in empty
        declared.append((name, list(value or ("",)) if isinstance(value, tuple) else value, descriptor))
    node.declare_parameters("", declared, ignore_override=True)
    for row in empty:
        node.set_parameters_atomically([make.of(row, ())])
        node.set_descriptor(row.name, make.descriptor(row))

    def on_set(given: Sequence[Any]) -> Any:
        changed = {each.name: each.value for each in given if each.name in rows}
        try:
            if changed:
                change({name: tuple(value) if rows[name].is_list else value for name, value in changed.items()})
        except ConfigError as error:
            return make.result(successful=False, reason=str(error))
        return make.result(successful=True)

    node.add_on_set_parameters_callback(on_set)


def show(rclpy: Any, node: Any, values: Mapping[str, Value]) -> None:
    """Set the declared parameters that may change while a bridge runs to these values, where they are others."""
    make, rows, now = _Parameters(rclpy), parameters(), changeable(node)
    changed = [name for name, value in now.items() if name in values and values[name] != value]
    if changed:
        node.set_parameters_atomically([make.of(rows[name], values[name]) for name in changed])


def changeable(node: Any) -> dict[str, Value]:
    """Return the values of the declared parameters that may change while a bridge runs."""
    rows = [row for row in parameters().values() if row.changes and node.has_parameter(row.name)]
    return {row.name: row.check(listed(row, node.get_parameter(row.name).value)) for row in rows}


def listed(row: Setting, value: Any) -> Any:
    """Return a value from ROS, where an empty list has no type: it is one of bytes, of booleans, or no value."""
    return () if row.is_list and (value is None or value in ([], b"")) else value


def description(row: Setting) -> str:
    """Return what a setting does, with the names of parameters instead of options."""
    names = {each.flag: each.name for each in all_settings()}
    return re.sub(r"--[a-z][a-z-]*", lambda found: names.get(found[0], found[0]), row.about)


def constraints(row: Setting) -> str:
    """Return unit, range and form of a parameter, as ``additional_constraints`` has them."""
    parts = [f"unit: {row.unit}"] if row.unit and not row.is_list else []
    parts += [row.range_text] if row.range_text else []
    if row.choices:
        parts.append(f"one of: {', '.join(map(str, row.usual))}")
    if row.is_list:
        parts.append(f"each: {row.metavar or 'KIND'}")
    if row.table == ROWS:
        parts.append(f"or a JSON object with the keys of [[{row.name}]]")
    return "; ".join(parts)


class _Parameters:
    """Makes the objects of rclpy for parameters."""

    def __init__(self, rclpy: Any) -> None:
        self._parameter = rclpy.parameter.Parameter
        self.result = interface_class("rcl_interfaces/msg/SetParametersResult")
        self._descriptor = interface_class("rcl_interfaces/msg/ParameterDescriptor")
        self._integers = interface_class("rcl_interfaces/msg/IntegerRange")
        self._floats = interface_class("rcl_interfaces/msg/FloatingPointRange")

    def of(self, row: Setting, value: Value) -> Any:
        """Return a parameter with the type of its setting."""
        return self._parameter(row.name, self._type(row), list(value) if isinstance(value, tuple) else value)

    def _type(self, row: Setting) -> Any:
        kinds = self._parameter.Type
        names = {bool: "BOOL", int: "INTEGER", float: "DOUBLE", str: "STRING", tuple: "STRING_ARRAY"}
        return kinds[names[type(row.default)]]

    def descriptor(self, row: Setting) -> Any:
        """Return the descriptor of a setting."""
        made = self._descriptor(
            name=row.name,
            type=self._type(row).value,
            description=description(row),
            additional_constraints=constraints(row),
            read_only=not row.changes,
        )
        if row.least is not None and row.most is not None:
            if isinstance(row.default, float):
                made.floating_point_range = [
                    self._floats(from_value=float(row.least), to_value=float(row.most), step=0.0)
                ]
            else:
                made.integer_range = [self._integers(from_value=int(row.least), to_value=int(row.most), step=1)]
        return made
