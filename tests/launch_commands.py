"""The command lines that launch_ros makes of a launch file."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from tests.launch_files import Action, read


def commands(path: Path, given: Mapping[str, str], remaps: Mapping[str, str]) -> list[list[str]]:
    """The command lines of the nodes of a launch file, as launch_ros makes them; executables are names.

    launch_ros writes the parameters of ``<param>`` into a file of parameters; here they are arguments, too.

    Args:
        path: the launch file.
        given: name → value of its arguments.
        remaps: of ``SetRemap`` in a launch file around it.
    """
    file = read(path)
    assert given.keys() <= file.arguments.keys()
    values = {name: given.get(name, default) for name, (default, _) in file.arguments.items()}
    assert None not in values.values(), values

    def text(template: str) -> str:
        return re.sub(r"\$\(var (\w+)\)", lambda match: str(values[match[1]]), template)

    def is_met(condition: str) -> bool:
        if condition.startswith("given "):
            return bool(values[condition.removeprefix("given ")])
        inner = re.fullmatch(r"\$\(not (.*)\)", condition)
        return not is_met(inner[1]) if inner else text(condition) == "true"

    def started(actions: Iterable[Action], parameters: list[str]) -> list[list[str]]:
        found = []
        for kind, each in actions:
            if not is_met(each.get("if", "true")):
                continue
            if kind == "group":  # its parameters end with it
                found += started(each["actions"], [*parameters])
            elif kind == "set_parameter":
                value = text(each["value"]).strip("'")
                parameters += ["-p", f"{each['name']}:={value.title() if value in ('true', 'false') else value}"]
            elif kind == "set_parameters_from_file":
                parameters += ["--params-file", text(each["filename"])]
            elif kind == "include":
                other = path.with_name(text(each["file"].removeprefix("$(dirname)/")) + "".join(path.suffixes[-2:]))
                found += commands(other, {name: text(value) for name, value in each["arguments"].items()}, remaps)
            else:
                found.append(command(each, parameters))
        return found

    def command(node: dict[str, Any], parameters: list[str]) -> list[str]:
        words = [node["exec"], *text(node.get("args", "")).split()]
        if ros_args := text(node.get("ros_args", "")):
            words += ["--ros-args", *ros_args.split()]
        words += ["--ros-args", "-r", f"__node:={text(node['name'])}"]
        words += ["-r", f"__ns:=/{text(node.get('namespace', ''))}", *parameters]
        for name, value in node["parameters"].items():
            words += ["-p", f"{name}:={text(str(value))}"]
        return words + [word for rule in remaps.items() for word in ("-r", ":=".join(rule))]

    return started(file.actions, [])
