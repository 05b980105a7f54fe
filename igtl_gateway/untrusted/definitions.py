"""The one place where text that defines ROS types is parsed, for rosbags makes Python code of what comes out.

A definition is text of somebody else: of a bag, of an MCAP schema, of a recording.  Here it is bounded before it is
parsed (characters, lines, steps of the parser), and examined (``definition_checks``) before code can be made of it.
Names are ASCII identifiers, so none of them can be code.  The grammar is that of rosidl: ``ros2msg`` and ``ros2idl``.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

from rosbags.interfaces import Nodetype
from rosbags.typesys import TypesysError
from rosbags.typesys.base import make_typesdict
from rosbags.typesys.idl import IDLParser
from rosbags.typesys.msg import MSGParser
from rosbags.typesys.store import Typestore

from igtl_gateway.errors import DamagedRecording
from igtl_gateway.untrusted import limits
from igtl_gateway.untrusted.definition_checks import LONGEST_NAME, TYPE, Types, check_types

MSG, IDL = "ros2msg", "ros2idl"
#: What a type without fields has, as rosidl makes it.
PLACEHOLDER = ("structure_needs_at_least_one_member", (Nodetype.BASE, ("uint8", 0)))

_EMPTY_LINES = re.compile(r"^[ \t]*(#[^\n]*)?\n", re.MULTILINE)
_SEPARATOR = "=" * 80 + "\n"
#: Calls of the parser's rules for each character of a text: twenty times what definitions in use need.
_STEPS_PER_CHARACTER = 100

# In IDL: comments and annotations, which say nothing of the bytes; then what only an expression has.
_IDL_BESIDE = re.compile(
    r'("(?:\\.|[^"\\])*(?:"|\Z))|//[^\n]*|/\*.*?(?:\*/|\Z)|@\w+[ \t]*(?:\((?:"(?:\\.|[^"\\])*"|[^()"])*\))?',
    re.DOTALL | re.ASCII,
)
_IDL_EXPRESSION = re.compile(r"<<|[*/%^|&~(]")


class UnreadableDefinition(DamagedRecording):
    """Text in a dialect that rosbags does not read, or none at all."""


def parse_definition(text: str, ros_type: str, encoding: str = MSG) -> Types:
    """The type ``package/msg/Name`` and all others that ``text`` defines, examined.

    Raises UnreadableDefinition, DamagedRecording, LimitExceeded.
    """
    place = f"definition of {ros_type[:LONGEST_NAME]}"
    if not TYPE.fullmatch(ros_type) or len(ros_type) > LONGEST_NAME:
        raise DamagedRecording(f"{place}: found this name of a type, expected package/msg/Name")
    limits.check_limit("definition", len(text), place)
    try:
        found = _parsed_idl(text, place) if encoding == IDL else _parsed_msg(text, ros_type, place)
    except (TypesysError, ValueError, TypeError, AssertionError, KeyError, OverflowError, RecursionError) as error:
        raise UnreadableDefinition(f"{place}: found {_unread(error)!r}, expected {encoding}") from None
    types = {name: (list(constants), list(fields) or [PLACEHOLDER]) for name, (constants, fields) in found.items()}
    check_types(types, place)
    return types


def type_hash(types: Types, ros_type: str) -> str:
    """RIHS01 of a type (REP-2016).  Raises KeyError where a type that it needs is missing.

    The ``char`` of a ``.msg`` is hashed as rosidl has it since Humble: as ``uint8``.
    """
    store = Typestore()
    store.fielddefs = {
        name: (types[name][0], [*map(_hashed, types[name][1])]) for name in with_dependencies(types, ros_type)
    }
    return store.hash_rihs01(ros_type)


def with_dependencies(types: Types, ros_type: str) -> list[str]:
    """The type and all that it needs, as far as ``types`` has them."""
    found, wanted = dict.fromkeys([ros_type] if ros_type in types else []), [ros_type]
    while wanted:
        for name in types_of_fields(types.get(wanted.pop(), ([], []))[1]):
            if name in types and name not in found:
                found[name] = None
                wanted.append(name)
    return list(found)


def types_of_fields(fields: list[Any]) -> list[str]:
    """The message types that fields name."""
    each = [inner[0] if kind in (Nodetype.ARRAY, Nodetype.SEQUENCE) else (kind, inner) for _, (kind, inner) in fields]
    return [inner for kind, inner in each if kind == Nodetype.NAME]


def definition_text(types: Types, ros_type: str) -> str:
    """``ros2msg`` of a type with all that it needs.  Raises TypesysError where something is missing."""
    store = Typestore()
    store.fielddefs = dict(types)
    return store.generate_msgdef(ros_type, ros_version=2)[0]


# -- parsing -----------------------------------------------------------------------------------------------------


def _parsed_msg(text: str, ros_type: str, place: str) -> Mapping[str, Any]:
    bare = _EMPTY_LINES.sub("", text)
    limits.check_limit("fields", bare.count("\n") - bare.count(_SEPARATOR), f"{place}: lines")
    return make_typesdict(_Msg(f"MSG: {ros_type}\n{bare}", place).specification())


def _parsed_idl(text: str, place: str) -> Mapping[str, Any]:
    limits.check_limit("fields", text.count("@"), f"{place}: annotations")
    found: dict[str, Any] = {}
    for part in text.split(_SEPARATOR):
        head, _, body = part.partition("\n")
        bare = _IDL_BESIDE.sub(lambda match: match.group(1) or " ", body if head.startswith("IDL: ") else part)
        if not bare.strip():
            continue
        unquoted = re.sub(r'"[^"]*"', "", "\n".join(line for line in bare.split("\n") if not line.startswith("#")))
        if expression := _IDL_EXPRESSION.search(unquoted):
            raise DamagedRecording(f"{place}: found {expression.group()!r}, expected constants without expressions")
        for opening in "<{[":
            limits.check_limit("depth", _deepest(unquoted, opening), f"{place}: nesting of {opening}")
        found.update(make_typesdict(_Idl(bare, place).specification()))
    return found


def _deepest(text: str, opening: str) -> int:
    closing = {"<": ">", "{": "}", "[": "]"}[opening]
    depth = deepest = 0
    for char in re.findall(f"[{re.escape(opening + closing)}]", text):
        depth += 1 if char == opening else -1
        deepest = max(deepest, depth)
    return deepest


def _unread(error: Exception) -> str:
    """What a parser stumbled over: rosbags gives the whole text, the place in it, and the rest from there."""
    words = str(error).split("\n")
    text = words[3] if len(words) > 3 else f"{type(error).__name__} {words[0]}"
    return text[:60]


class _Steps:
    """Of a parser: how often it may try something."""

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


class _Msg(_Steps, MSGParser):
    def string_literal(self, pos: int) -> Any:
        """As rosbags', within one line: a quote that nothing closes does not look through all that follows."""
        found = self.regex(pos, r"""('(?:\\[^\n]|[^'\\\n])*')|("(?:\\[^\n]|[^"\\\n])*")""")
        if hasattr(found, "value"):
            return type(found)(found.pos, found.value[1:-1])
        found = self.regex(pos, r"[ \t]*[^# \t\n][^\n]*")
        return type(found)(found.pos, found.value.strip()) if hasattr(found, "value") else found


class _Idl(_Steps, IDLParser):
    pass


def _hashed(field: tuple[str, Any]) -> tuple[str, Any]:
    name, (kind, inner) = field
    if kind in (Nodetype.ARRAY, Nodetype.SEQUENCE):
        each, size = inner
        return name, (kind, (_hashed(("", each))[1], size))
    return name, (kind, ("uint8", inner[1])) if kind == Nodetype.BASE and inner[0] == "char" else (kind, inner)
