"""YAML of others as plain values: mappings, lists and texts, within the limits of size, depth and count.

Only events of the parser are used: nothing is composed or constructed, so no tag makes an object, and an alias is
refused rather than followed.  Scalars stay texts; whoever reads them knows whether a number belongs there.
"""

from __future__ import annotations

from typing import Any

from ruamel.yaml import YAML
from ruamel.yaml.error import YAMLError
from ruamel.yaml.events import (
    AliasEvent,
    MappingEndEvent,
    MappingStartEvent,
    NodeEvent,
    ScalarEvent,
    SequenceEndEvent,
    SequenceStartEvent,
)

from igtl_gateway.errors import DamagedRecording
from igtl_gateway.untrusted import limits
from igtl_gateway.untrusted.text import check_nesting

#: A node, such as a key, has more on average in documents of use.
_CHARACTERS_PER_NODE = 32


def parse_yaml(text: str, place: str) -> Any:
    """The first document: dicts with texts as keys, lists, texts; None for an empty one.

    Raises DamagedRecording, LimitExceeded.
    """
    limits.check_limit("document", len(text), place)
    check_nesting(text, place)
    most = limits.current_limits().document // _CHARACTERS_PER_NODE
    root: list[Any] = []
    open_nodes: list[tuple[Any, list[str]]] = [(root, [])]
    try:
        for count, event in enumerate(YAML(typ="safe", pure=True).parse(text)):
            limits.check_limit("document", count, f"{place}: nodes", most)
            if isinstance(event, NodeEvent):
                _add(event, open_nodes, place)
            elif isinstance(event, MappingEndEvent | SequenceEndEvent):
                open_nodes.pop()
    except (YAMLError, ValueError, TypeError, AttributeError, IndexError, RecursionError, AssertionError) as error:
        raise DamagedRecording(f"{place}: found invalid YAML: {_reason(error)}") from None
    return root[0] if root else None


def _add(event: NodeEvent, open_nodes: list[tuple[Any, list[str]]], place: str) -> None:
    at = f"{place}: line {event.start_mark.line + 1}"
    if isinstance(event, AliasEvent):
        raise DamagedRecording(f"{at}: found an alias, expected a value")
    tag = getattr(event, "ctag", None) or getattr(event, "tag", None)
    if tag is not None and str(tag) not in ("!", "None"):
        raise DamagedRecording(f"{at}: found the tag {str(tag)[:40]!r}, expected a value without one")
    node: Any = event.value if isinstance(event, ScalarEvent) else {} if isinstance(event, MappingStartEvent) else []
    into, keys = open_nodes[-1]
    if isinstance(into, list):
        into.append(node)
    elif keys:
        into[keys.pop()] = node
    elif isinstance(event, ScalarEvent):
        keys.append(event.value)
        return
    else:
        raise DamagedRecording(f"{at}: found a list or a mapping as a key, expected a string")
    if isinstance(event, MappingStartEvent | SequenceStartEvent):
        open_nodes.append((node, []))
        limits.check_limit("depth", len(open_nodes) - 1, at)


def _reason(error: Exception) -> str:
    mark = getattr(error, "problem_mark", None)
    what = getattr(error, "problem", None) or type(error).__name__
    return f"{what}, line {mark.line + 1}" if mark else str(what)
