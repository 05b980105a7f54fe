"""Launch files of ROS 2 read without ``launch``: what a file declares and starts, from XML and from Python alike.

Strategy: both notations become the same plain tuples, so a test compares them with ``==``.  Substitutions have the
notation of XML: ``$(var listen)``.  Python files run with small stand-ins for ``launch`` and ``launch_ros``, which know
only the classes and arguments that our files use: anything else is an error of the test.
"""

from __future__ import annotations

import importlib.util
import re
import sys
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import ModuleType
from typing import Any
from unittest import mock
from xml.etree import ElementTree

#: ``("set_parameter", {"name": …})`` and so on; the actions of a group are its "actions".
Action = tuple[str, dict[str, Any]]


@dataclass(frozen=True)
class LaunchFile:
    """What a launch file has.

    Attributes:
        arguments: name → default (None: required) and description.
        actions: in their order.
    """

    arguments: dict[str, tuple[str | None, str]] = field(default_factory=dict)
    actions: list[Action] = field(default_factory=list)


def read(path: Path) -> LaunchFile:
    return _read_xml(path) if path.suffix == ".xml" else _read_python(path)


def every(actions: Iterable[Action], kind: str) -> list[dict[str, Any]]:
    """The actions of a kind, those in groups included."""
    found = []
    for name, attributes in actions:
        found += [attributes] if name == kind else []
        found += every(attributes.get("actions", []), kind)
    return found


# -- XML ---------------------------------------------------------------------------------------------------------------

#: Element → its attributes, those that must be there first; more are an error.
_ATTRIBUTES = {
    "node": (
        {"pkg", "exec", "name"},
        {"namespace", "output", "args", "ros_args", "on_exit", "if"},
    ),
    "include": ({"file"}, {"if"}),
    "set_parameter": ({"name", "value"}, {"if"}),
    "set_parameters_from_file": ({"filename"}, {"if"}),
    "set_remap": ({"from", "to"}, set()),
    "group": (set(), {"if"}),
}
_GIVEN = re.compile(r"\$\(not-equals x\$\(var (\w+)\) x\)")
_TYPES: dict[str, Callable[[str], object]] = {"bool": lambda text: text == "true", "float": str, "int": str, "str": str}


def _read_xml(path: Path) -> LaunchFile:
    root = ElementTree.parse(path).getroot()
    assert root.tag == "launch"
    arguments = {}
    for each in root.findall("arg"):
        assert {"name", "description"} <= each.attrib.keys() <= {"name", "description", "default"}
        arguments[each.attrib["name"]] = (each.get("default"), each.attrib["description"])
    return LaunchFile(arguments, [_element(each) for each in root if each.tag != "arg"])


def _element(element: ElementTree.Element) -> Action:
    needed, known = _ATTRIBUTES[element.tag]
    assert needed <= element.attrib.keys() <= needed | known, (element.tag, element.attrib)
    attributes: dict[str, Any] = {key: " ".join(value.split()) for key, value in element.attrib.items()}
    if condition := attributes.get("if"):
        attributes["if"] = _GIVEN.sub(r"given \1", condition)
    if element.tag == "group":
        attributes["actions"] = [_element(each) for each in element]
    elif element.tag == "include":
        attributes["file"] = attributes["file"].removesuffix(".launch.xml")
        attributes["arguments"] = {each.attrib["name"]: each.attrib["value"] for each in element}
    elif element.tag == "node":
        attributes["parameters"] = {
            each.attrib["name"]: _TYPES[each.attrib["type"]](each.attrib["value"]) for each in element
        }
    else:
        assert not len(element)
    return element.tag, attributes


# -- Python ------------------------------------------------------------------------------------------------------------


def _text(value: Any) -> str:
    """Substitutions as XML has them: strings are joined."""
    return value if isinstance(value, str) else "".join(map(_text, value))


def _var(name: str) -> str:
    return f"$(var {name})"


def _condition(condition: str | None) -> dict[str, str]:
    return {} if condition is None else {"if": condition}


def _not_equals(left: str, right: str) -> str:
    assert right == ""
    return "given " + left.removeprefix("$(var ").removesuffix(")")


def _declare(name: str, *, default_value: Any, description: str) -> Action:
    default = None if default_value is None else _text(default_value)
    return "arg", {"name": name, "default": default, "description": description}


def _group(actions: list[Action], *, condition: str | None = None) -> Action:
    return "group", {"actions": actions} | _condition(condition)


def _include(source: str, *, launch_arguments: Iterable[tuple[str, str]]) -> Action:
    return "include", {"file": source.removesuffix(".launch.py"), "arguments": dict(launch_arguments)}


def _set_parameter(name: str, value: Any, *, condition: str | None = None) -> Action:
    text = str(value).lower() if isinstance(value, bool) else _text(value)
    return "set_parameter", {"name": name, "value": text} | _condition(condition)


def _set_parameters_from_file(filename: str, *, condition: str | None = None) -> Action:
    return "set_parameters_from_file", {"filename": filename} | _condition(condition)


def _node(
    *,
    package: str,
    executable: str,
    parameters: Iterable[Mapping[str, Any]] = (),
    arguments: Iterable[str] = (),
    ros_arguments: Iterable[str] = (),
    on_exit: str | None = None,
    condition: str | None = None,
    **names: str,
) -> Action:
    more = {"args": " ".join(arguments), "ros_args": " ".join(ros_arguments), "on_exit": on_exit}
    parameter = {name: value for each in parameters for name, value in each.items()}
    given = {key: value for key, value in more.items() if value}
    return "node", {"pkg": package, "exec": executable, "parameters": parameter} | names | given | _condition(condition)


def _lifecycle_node(**node: Any) -> Action:
    kind, attributes = _node(**node)
    return kind, attributes | {"managed": True}


def _on_transition(
    *,
    target_lifecycle_node: Action,
    start_state: str,
    goal_state: str,
    entities: list[Action],
    handle_once: bool = False,
) -> Action:
    states = {"from": start_state, "to": goal_state, "once": handle_once}
    return "on_transition", {"node": target_lifecycle_node, "actions": entities} | states


def _change_state(*, lifecycle_node_matcher: Action, transition_id: int) -> Action:
    return "change_state", {"node": lifecycle_node_matcher, "transition": transition_id}


class _Transition:
    """The numbers of lifecycle_msgs."""

    TRANSITION_CONFIGURE = 1
    TRANSITION_ACTIVATE = 3


_STAND_INS: dict[str, dict[str, Any]] = {
    "launch": {"LaunchDescription": list},
    "launch.actions": {
        "DeclareLaunchArgument": _declare,
        "EmitEvent": lambda *, event: event,
        "GroupAction": _group,
        "IncludeLaunchDescription": _include,
        "RegisterEventHandler": lambda handler: handler,
        "Shutdown": lambda: "shutdown",
    },
    "launch.events": {"matches_action": lambda action: action},
    "launch.conditions": {"IfCondition": _text},
    "launch.launch_description_sources": {"PythonLaunchDescriptionSource": _text},
    "launch.substitutions": {
        "LaunchConfiguration": _var,
        "NotEqualsSubstitution": _not_equals,
        "NotSubstitution": lambda value: f"$(not {value})",
        "ThisLaunchFileDir": lambda: "$(dirname)",
    },
    "launch_ros": {},
    "launch_ros.actions": {
        "LifecycleNode": _lifecycle_node,
        "Node": _node,
        "SetParameter": _set_parameter,
        "SetParametersFromFile": _set_parameters_from_file,
        "SetRemap": lambda old, new: ("set_remap", {"from": old, "to": new}),
    },
    "launch_ros.event_handlers": {"OnStateTransition": _on_transition},
    "launch_ros.events": {},
    "launch_ros.events.lifecycle": {"ChangeState": _change_state},
    "lifecycle_msgs": {},
    "lifecycle_msgs.msg": {"Transition": _Transition},
    "launch_ros.parameter_descriptions": {"ParameterValue": lambda value, *, value_type: value_type and _text(value)},
}


def _read_python(path: Path) -> LaunchFile:
    modules = {}
    for name, contents in _STAND_INS.items():
        modules[name] = ModuleType(name)
        vars(modules[name]).update(contents)
    spec = importlib.util.spec_from_file_location("launch_file", path)
    assert spec
    assert spec.loader
    module = importlib.util.module_from_spec(spec)
    with mock.patch.dict(sys.modules, modules), mock.patch.object(sys, "dont_write_bytecode", new=True):
        spec.loader.exec_module(module)
        actions: list[Action] = module.generate_launch_description()
    arguments = {each["name"]: (each["default"], each["description"]) for kind, each in actions if kind == "arg"}
    return LaunchFile(arguments, [action for action in actions if action[0] != "arg"])
