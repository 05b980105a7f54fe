"""Definitions of ROS types in files of other programs: as they are, with their hash, separate for each file.

The definition in the file has priority over installed ones: the bytes were written with it, and a type might have had
other fields at that time.  One that cannot be read here is kept: other programs might read it.
"""

from __future__ import annotations

import re
from collections.abc import Callable

from rosbags.typesys.base import TypesysError

from igtl_gateway.addon import DamagedRecording
from igtl_gateway.addon.untrusted import DerivedType, Types, limits, new_store
from igtl_gateway.addon.untrusted import ros_definitions as definitions
from igtl_gateway.addon.writing import Definition

_MOST_NAMES = 6
_LOWER = re.compile(r"(?!.*__)(?!.*_$)[a-z][a-z0-9_]*", re.ASCII)
_CAMEL = re.compile(r"[A-Z][A-Za-z0-9]*(?:_(?:Request|Response|Goal|Result|Feedback))?", re.ASCII)
_CONSTANT = re.compile(r"[A-Z](?:[A-Z0-9_]?[A-Z0-9]+)*", re.ASCII)


def names_not_allowed(types: Types, ros_type: str) -> str:
    """Return which names of a type and its dependencies ROS 2 does not allow, as words for people; ``""``: none.

    ROS 1 allows them, and what is made of its bags has them.  Readers that follow rosidl refuse the whole definition.
    """
    found: list[str] = []
    for name in definitions.with_dependencies(types, ros_type):
        package, _, last = name.partition("/msg/")
        constants, fields = types[name]
        if last and not (_LOWER.fullmatch(package) and _CAMEL.fullmatch(last)):
            found.append(name)
        found += [f"{last}.{field}" for field, _ in fields if not _LOWER.fullmatch(field)]
        found += [f"{last}.{each[0]}" for each in constants if not _CONSTANT.fullmatch(each[0])]
    if not found:
        return ""
    more = f" and {len(found) - _MOST_NAMES} more" if len(found) > _MOST_NAMES else ""
    return f"ROS 2 does not allow {', '.join(found[:_MOST_NAMES])}{more}: some programs cannot read its messages"


def with_hash(ros_type: str, found: Definition, note: Callable[[str], None] = lambda _: None) -> Definition | None:
    """Return a definition that is read here with its RIHS01 hash; None without one, or above the limit.

    The hash is ``""`` if it cannot be computed: a nested type is missing, or the definition cannot be read here.  Where
    the file has the definition of a service or an action, the result has that of the message: rosbags refuses a whole
    file for the encoding ``unknown``, and other readers for ``SRV:``.

    Args:
        ros_type: name of the type.
        found: its definition.
        note: called with a line for people if messages of the type are not decoded here.
    """
    # an empty text with a hash is the definition of a type without fields; without a hash there is no definition
    if not found.is_read(ros_type) or not (found.data.strip() or found.type_hash):
        return None
    place, derived = f"definition of {ros_type[:100]}", DerivedType.of(ros_type)
    try:
        limits.check_limit("definition", len(found.data), place)
    except DamagedRecording as error:
        note(f"{error}: left out")
        return None
    try:
        types = definitions.parse_definition(found.text(ros_type), ros_type)
        if not derived and (names := names_not_allowed(types, ros_type)):
            note(f"{ros_type}: {names}")
        known = {**new_store().fielddefs, **types}  # includes Time and Duration, which need no definition
        type_hash = definitions.type_hash(known, ros_type)
    except DamagedRecording as error:
        note(f"{error}: kept as it is; its messages are not decoded here")
        type_hash = ""
    except (TypesysError, KeyError, AssertionError):
        type_hash = ""
    data, encoding = found.data, found.encoding
    if derived and encoding != definitions.IDL:
        data, encoding = found.text(ros_type).encode(), definitions.MSG
    return Definition(data, encoding, found.type_hash or type_hash)
