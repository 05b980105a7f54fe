"""Parses definitions of ROS types.  Nothing else parses them, because rosbags generates Python code from the result.

A definition is untrusted text: from a bag, an MCAP schema or a recording.  It is limited before it is parsed
(characters, lines, steps of the parser), and checked (``definition_checks``) before code is generated.  Names are ASCII
identifiers, so none of them can be code.  The grammars are those of rosidl: ``ros2msg``, read by ``msg_text``, and
``ros2idl``, read by rosbags.  Text shows which it is: ``ros2idl`` begins with the name of its first type.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

from rosbags.interfaces import Nodetype
from rosbags.typesys import TypesysError
from rosbags.typesys.base import make_typesdict
from rosbags.typesys.idl import IDLParser
from rosbags.typesys.store import Typestore

from igtl_gateway.base.errors import DamagedRecording
from igtl_gateway.base.untrusted import elements, limits
from igtl_gateway.base.untrusted.definition_checks import LONGEST_NAME, TYPE, Types, check_types
from igtl_gateway.base.untrusted.derived_types import DerivedType
from igtl_gateway.base.untrusted.dialects import IDL, MSG, RULE, is_idl
from igtl_gateway.base.untrusted.msg_text import line_count, needed_types, read_types

__all__ = [
    "IDL",
    "MSG",
    "PLACEHOLDER",
    "UnreadableDefinition",
    "definition_text",
    "halves",
    "is_idl",
    "is_same",
    "needs_of_file",
    "parse_definition",
    "service_hash",
    "type_hash",
    "types_of_fields",
    "with_dependencies",
]

#: The field that rosidl adds to a type without fields.
PLACEHOLDER = (elements.PLACEHOLDER, (Nodetype.BASE, ("uint8", 0)))

_SEPARATOR = f"{RULE}\n"
_SEVERAL = (Nodetype.ARRAY, Nodetype.SEQUENCE)
_LINE_END = re.compile(r"\r\n|\r")
_IDL_DIRECTIVE = re.compile(r"^[ \t]*#[^\n]*$", re.MULTILINE)
_IDL_INCLUDE = re.compile(r"""^[ \t]*#[ \t]*include[ \t]+["<]([A-Za-z0-9_/]+)\.idl[">]""", re.MULTILINE)
#: Maximum number of parser steps per character: twenty times the need of real definitions.
_STEPS_PER_CHARACTER = 100

# In IDL: comments and annotations, which do not influence the bytes; then the characters of expressions.
_IDL_BESIDE = re.compile(
    r'("(?:\\.|[^"\\])*(?:"|\Z))|//[^\n]*|/\*.*?(?:\*/|\Z)|@\w+[ \t]*(?:\((?:"(?:\\.|[^"\\])*"|[^()"])*\))?',
    re.DOTALL | re.ASCII,
)
_IDL_EXPRESSION = re.compile(r"<<|[*/%^|&~(]")


class UnreadableDefinition(DamagedRecording):
    """A definition in a dialect that is not read, with types that are not decoded, or an empty one."""


def parse_definition(text: str, ros_type: str, encoding: str = MSG, *, wide_strings: bool = False) -> Types:
    """Return the type ``package/msg/Name`` and all others that ``text`` defines, checked.

    Args:
        text: the definition.  One that begins with the name of its first type in IDL is ``ros2idl``.
        ros_type: name of the type.
        encoding: the dialect of text without such a beginning.
        wide_strings: also types with ``wstring``, which nothing here decodes.

    Raises UnreadableDefinition, DamagedRecording, LimitExceeded.
    """
    place = f"definition of {ros_type[:LONGEST_NAME]}"
    if not TYPE.fullmatch(ros_type) or len(ros_type) > LONGEST_NAME:
        raise DamagedRecording(f"{place}: found this name of a type, expected package/msg/Name")
    limits.check_limit("definition", len(text), place)
    try:
        found = _parsed_idl(text, place) if encoding == IDL or is_idl(text) else _parsed_msg(text, ros_type, place)
    except (TypesysError, ValueError, TypeError, AssertionError, KeyError, OverflowError, RecursionError) as error:
        raise UnreadableDefinition(f"{place}: found {_unread(error)!r}, expected {encoding}") from None
    types = {name: (list(constants), list(fields) or [PLACEHOLDER]) for name, (constants, fields) in found.items()}
    check_types(types, place)
    if not wide_strings and (wide := _wide_strings(types)):
        raise UnreadableDefinition(f"{place}: found {wide}, a wstring: messages with wstring are not decoded")
    return types


def type_hash(types: Types, ros_type: str) -> str:
    """Return the RIHS01 hash of a type (REP-2016).  Raises KeyError if a type that it needs is missing.

    The ``char`` of a ``.msg`` is hashed as rosidl has it since Humble: as ``uint8``.
    """
    store = Typestore()
    store.fielddefs = {name: (types[name][0], fields) for name, fields in _layout(types, ros_type).items()}
    if derived := DerivedType.of(ros_type):
        store.fielddefs = {
            derived.true_name(name): (constants, [_renamed(each, derived) for each in fields])
            for name, (constants, fields) in store.fielddefs.items()
        }
    return store.hash_rihs01(ros_type)


def service_hash(types: Types, ros_type: str, text: str) -> str:
    """Return the RIHS01 hash of a service ``package/srv/Name``, which ROS describes as three nested messages.

    Args:
        types: all types that its fields need.
        ros_type: name of the service.
        text: its ``.srv`` file.

    Raises UnreadableDefinition, DamagedRecording, LimitExceeded; KeyError if a type that it needs is missing.
    """
    made = dict(types)
    for part, body in zip(("Request", "Response"), halves(text), strict=True):
        name = f"{ros_type}_{part}"
        as_message = name.replace("/srv/", "/msg/")
        made[name] = parse_definition(body, as_message)[as_message]
    info = ("info", (Nodetype.NAME, "service_msgs/msg/ServiceEventInfo"))
    both = [
        (name, (Nodetype.SEQUENCE, ((Nodetype.NAME, f"{ros_type}_{part}"), 1)))
        for name, part in (("request", "Request"), ("response", "Response"))
    ]
    made[f"{ros_type}_Event"] = ([], [info, *both])
    parts = (("request_message", "Request"), ("response_message", "Response"), ("event_message", "Event"))
    made[ros_type] = ([], [(name, (Nodetype.NAME, f"{ros_type}_{part}")) for name, part in parts])
    return type_hash(made, ros_type)


def halves(text: str) -> tuple[str, str]:
    """Return request and response of a ``.srv`` file."""
    request, _, response = f"\n{text}".partition("\n---")
    return request, response.partition("\n")[2]


def is_same(one: str, other: str, ros_type: str) -> bool:
    """Return whether two definitions of a type give messages the same bytes; False if one of them cannot be read."""
    try:
        first, second = (_layout(parse_definition(text, ros_type), ros_type) for text in (one, other))
    except DamagedRecording:
        return False
    return first == second


def _layout(types: Types, ros_type: str) -> dict[str, list[Any]]:
    return {name: [*map(_hashed, types[name][1])] for name in with_dependencies(types, ros_type)}


def needs_of_file(text: str, ros_type: str, encoding: str) -> list[str]:
    """Return the types that one definition file needs: by its fields, or the files that it includes.

    Raises ValueError for text that is not a definition.
    """
    if encoding == IDL:
        return list(dict.fromkeys(_IDL_INCLUDE.findall(text)))
    return needed_types(text, ros_type)


def with_dependencies(types: Types, ros_type: str) -> list[str]:
    """Return the type and all its dependencies that ``types`` has."""
    found, wanted = dict.fromkeys([ros_type] if ros_type in types else []), [ros_type]
    while wanted:
        for name in types_of_fields(types.get(wanted.pop(), ([], []))[1]):
            if name in types and name not in found:
                found[name] = None
                wanted.append(name)
    return list(found)


def types_of_fields(fields: list[Any]) -> list[str]:
    """Return the message types of fields."""
    each = [inner[0] if kind in (Nodetype.ARRAY, Nodetype.SEQUENCE) else (kind, inner) for _, (kind, inner) in fields]
    return [inner for kind, inner in each if kind == Nodetype.NAME]


def definition_text(types: Types, ros_type: str) -> str:
    """Return the ``ros2msg`` text of a type with its dependencies.  Raises TypesysError if one is missing.

    Constants are written as rosidl reads them: rosbags writes ``True``, which other readers refuse, and strings without
    quotes, which end at ``#``.
    """
    store = Typestore()
    store.fielddefs = {
        name: ([(constant, of, _literal(of, value)) for constant, of, value in constants], list(fields))
        for name, (constants, fields) in types.items()
    }
    return store.generate_msgdef(ros_type, ros_version=2)[0]


def _literal(of_type: str, value: Any) -> Any:
    if of_type == "bool":
        return "true" if value else "false"
    if of_type not in ("string", "wstring") or not isinstance(value, str):
        return value
    quote = "'" if '"' in value and "'" not in value else '"'
    return f"{quote}{value}{quote}"


# -- parsing -----------------------------------------------------------------------------------------------------


def _parsed_msg(text: str, ros_type: str, place: str) -> Mapping[str, Any]:
    limits.check_limit("fields", line_count(text), f"{place}: lines")
    return read_types(text, ros_type)


def _parsed_idl(text: str, place: str) -> Mapping[str, Any]:
    limits.check_limit("fields", text.count("@"), f"{place}: annotations")
    found: dict[str, Any] = {}
    for part in _LINE_END.sub("\n", text).split(_SEPARATOR):
        head, _, body = part.partition("\n")
        bare = _IDL_BESIDE.sub(lambda match: match.group(1) or " ", body if head.startswith("IDL: ") else part)
        bare = _IDL_DIRECTIVE.sub("", bare)
        if not bare.strip():
            continue
        unquoted = re.sub(r'"[^"]*"', "", bare)
        if expression := _IDL_EXPRESSION.search(unquoted):
            raise DamagedRecording(f"{place}: found {expression.group()!r}, expected constants without expressions")
        for opening in "<{[":
            limits.check_limit("depth", _deepest(unquoted, opening), f"{place}: nesting of {opening}")
        found.update(make_typesdict(_Idl(bare, place).specification()))
    return found


def _wide_strings(types: Types) -> str:
    """Return the name of the first field of ``wstring``; ``""`` without one."""
    for name, (_, fields) in types.items():
        for field, (kind, inner) in fields:
            if (inner[0] if kind in _SEVERAL else (kind, inner))[1][0] == "wstring":
                return f"{name}.{field}"[:60]
    return ""


def _deepest(text: str, opening: str) -> int:
    closing = {"<": ">", "{": "}", "[": "]"}[opening]
    depth = deepest = 0
    for char in re.findall(f"[{re.escape(opening + closing)}]", text):
        depth += 1 if char == opening else -1
        deepest = max(deepest, depth)
    return deepest


def _unread(error: Exception) -> str:
    """Return the text at which a parser failed: rosbags reports the whole text, the offset, and the rest."""
    words = str(error).split("\n")
    if isinstance(error, ValueError):  # of msg_text: the line
        return words[0][:60]
    text = words[3] if len(words) > 3 else f"{type(error).__name__} {words[0]}"
    return text[:60]


class _Steps:
    """A parser with a limited number of steps."""

    text: str

    def __init__(self, text: str, place: str) -> None:
        super().__init__(text)  # type: ignore[call-arg]
        self._place = place
        self._left = _STEPS_PER_CHARACTER * len(text)

    def _step(self) -> None:
        self._left -= 1
        if self._left < 0:
            raise DamagedRecording(f"{self._place}: found text that takes too long to parse, expected a definition")

    def regex(self, pos: int, pattern: str, flags: int = 0) -> Any:
        self._step()
        return super().regex(pos, pattern, flags)  # type: ignore[misc]

    def literal(self, pos: int, text: str) -> Any:
        self._step()
        return super().literal(pos, text)  # type: ignore[misc]


class _Idl(_Steps, IDLParser):
    pass


def _renamed(field: tuple[str, Any], derived: DerivedType) -> tuple[str, Any]:
    """Return a field whose type has its name in ROS."""
    name, (kind, inner) = field
    if kind == Nodetype.NAME:
        return name, (kind, derived.true_name(inner))
    if kind in _SEVERAL:
        each, size = inner
        return name, (kind, (_renamed(("", each), derived)[1], size))
    return field


def _hashed(field: tuple[str, Any]) -> tuple[str, Any]:
    name, (kind, inner) = field
    if kind in (Nodetype.ARRAY, Nodetype.SEQUENCE):
        each, size = inner
        return name, (kind, (_hashed(("", each))[1], size))
    return name, (kind, ("uint8", inner[1])) if kind == Nodetype.BASE and inner[0] == "char" else (kind, inner)
