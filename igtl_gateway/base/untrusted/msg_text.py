"""Reads ``.msg`` text, of ROS 2 and of ROS 1, with the types behind it: line by line, as rosidl and genmsg do.

The text is untrusted.  All that becomes a name is an ASCII identifier; comments and default values may be anything,
because no bytes depend on them.  So text is read that other parsers refuse: line ends of Windows, tabs, comments that
are not UTF-8, ``#`` in quotes, numbers in octal and binary.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import Any, NamedTuple

from rosbags.interfaces import Nodetype

from igtl_gateway.base.untrusted.dialects import RULE

_LINE_END = re.compile(r"\r\n|\n|\r")
_BLANK = " \t\v\f"
_RULE = re.compile(rf"={{{len(RULE)},}}")
_HEAD = re.compile(r"MSG:[ \t]*([A-Za-z0-9_/]+)", re.ASCII)
_ANNOTATION = re.compile(r"@[a-z]+(?:\([^()]*\))?[ \t]*")
_LINE = re.compile(r"(\S+)[ \t\v\f]+([A-Za-z]\w*)(?:(?=[ \t\v\f=#])(.*))?", re.ASCII)
_TYPE = re.compile(
    r"(?:(w?string)(?:<=([0-9]{1,18}))?|([A-Za-z]\w*(?:/[A-Za-z]\w*)*))(?:\[(?:(<=)?([+-]?[0-9]{1,18}))?\])?", re.ASCII
)
_QUOTED = re.compile(r"""'((?:\\.|[^'\\])*)'|"((?:\\.|[^"\\])*)\"""")
_NUMBERS = frozenset("bool byte char float32 float64 int8 int16 int32 int64 uint8 uint16 uint32 uint64".split())
_TIMES = {"time": "builtin_interfaces/msg/Time", "duration": "builtin_interfaces/msg/Duration"}
_HEADER = "std_msgs/msg/Header"


class MsgLine(NamedTuple):
    """A field or a constant: its type as rosbags describes one, its name; of a constant the value."""

    type: Any
    name: str
    value: Any = None


def read_types(text: str, ros_type: str) -> dict[str, tuple[list[Any], list[Any]]]:
    """Return ``package/msg/Name`` and the types behind it, as rosbags has them.

    Raises ValueError for a line that is neither a field nor a constant.
    """
    sections = list(_sections(text, ros_type))
    defined = {name for name, _ in sections}
    found: dict[str, tuple[list[Any], list[Any]]] = {}
    for name, lines in sections:
        constants, fields = [], []
        for line in lines:
            read = _read(line, name, defined)
            if read.value is not None:
                constants.append((read.name, read.type[1][0], read.value))
            else:
                fields.append((read.name, read.type))
        found[name] = constants, fields
    return found


def needed_types(text: str, ros_type: str) -> list[str]:
    """Return the message types of the fields of one type, also if there are lines that cannot be read.

    A ``Header`` without a package is that of the own package here; ROS 1 and early ROS 2 mean that of ``std_msgs``.
    """
    found: dict[str, None] = {}
    own = {f"{ros_type.partition('/')[0]}/msg/Header"}
    sections = list(_sections(text, ros_type))
    for name, lines in sections:
        for line in lines:
            try:
                kind, inner = _read(line, name, own).type
            except ValueError:
                continue
            kind, inner = inner[0] if kind in (Nodetype.ARRAY, Nodetype.SEQUENCE) else (kind, inner)
            if kind == Nodetype.NAME:
                found[inner] = None
    defined = {name for name, _ in sections}
    return [name for name in found if name not in defined]


def full_name(name: str) -> str:
    """Return ``package/Name`` as ``package/msg/Name``."""
    package, _, last = name.rpartition("/")
    if not package or package.rpartition("/")[2] in ("msg", "srv", "action"):
        return name
    return f"{package}/msg/{last}"


def line_count(text: str) -> int:
    """Return the number of lines that are not empty, a separator, or only a comment."""
    lines = map(_bare, _LINE_END.split(text))
    return sum(bool(line) and not _RULE.fullmatch(line) for line in lines)


def _bare(line: str) -> str:
    """Return a line without blanks and annotations around it; ``""`` if it is a comment."""
    line = line.strip(_BLANK)
    if annotation := _ANNOTATION.match(line):
        line = line[annotation.end() :]
    return "" if line.startswith("#") else line


def _sections(text: str, ros_type: str) -> Iterator[tuple[str, list[str]]]:
    """Yield the types of text with their lines.  Raises ValueError for a separator without a name behind it."""
    name, is_head = full_name(ros_type), False
    lines: list[str] = []
    for each in _LINE_END.split(text.removeprefix("\ufeff")):
        line = _bare(each)
        if not line:
            continue
        if is_head:
            if not (head := _HEAD.fullmatch(line)):
                raise ValueError(line)
            name, is_head = full_name(head[1]), False
        elif _RULE.fullmatch(line):
            yield name, lines
            lines, is_head = [], True
        else:
            lines.append(line)
    if is_head:
        raise ValueError(RULE)
    yield name, lines


def _read(line: str, owner: str, defined: set[str]) -> MsgLine:
    found = _LINE.fullmatch(line)
    if not found:
        raise ValueError(line)
    of_type, name, rest = found.groups()
    described = _described(of_type, line, owner, defined)
    rest = (rest or "").lstrip(_BLANK)
    if not rest.startswith("="):
        return MsgLine(described, name)
    if described[0] != Nodetype.BASE:
        raise ValueError(line)
    return MsgLine(described, name, _value(described[1][0], rest[1:].strip(_BLANK)))


def _described(text: str, line: str, owner: str, defined: set[str]) -> Any:
    found = _TYPE.fullmatch(text)
    if not found:
        raise ValueError(line)
    string, length, name, bound, size = found.groups()
    inner: Any
    if string:
        inner = (Nodetype.BASE, (string, int(length or 0)))
    elif name in _NUMBERS:
        inner = (Nodetype.BASE, (name, 0))
    else:
        inner = (Nodetype.NAME, _resolved(name, owner, defined))
    if not text.endswith("]"):
        return inner
    kind = Nodetype.SEQUENCE if bound or not size else Nodetype.ARRAY
    return kind, (inner, int(size or 0))


def _resolved(name: str, owner: str, defined: set[str]) -> str:
    if name in _TIMES:
        return _TIMES[name]
    own = f"{owner.partition('/')[0]}/msg/{name}"
    if name == "Header" and own not in defined:
        return _HEADER
    return full_name(name) if "/" in name else own


def _value(of_type: str, text: str) -> bool | int | float | str:
    if of_type in ("string", "wstring"):
        if quoted := _QUOTED.match(text):
            return quoted[1] if quoted[1] is not None else quoted[2]
        return text.partition("#")[0].rstrip(_BLANK)
    text = text.partition("#")[0].rstrip(_BLANK)
    lower = text.lower()
    if lower in ("true", "false"):
        return lower == "true"
    if of_type == "bool":
        return bool(int(text, 0))
    if of_type.startswith("float"):
        return float(text)
    try:
        return int(text)  # with leading zeros, decimal as in rosidl
    except ValueError:
        return int(text, 0)
