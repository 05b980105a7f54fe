"""Parses untrusted YAML to mappings, lists and strings, within the limits of size, depth and count.

Only the events of the parser are used.  Nothing is constructed, so tags cannot create objects; aliases are rejected.
Scalars stay strings: the caller knows whether it expects a number.
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

from igtl_gateway.base.errors import DamagedRecording
from igtl_gateway.base.untrusted import limits
from igtl_gateway.base.untrusted.text import check_nesting

#: Minimum average number of characters per node; real documents have more.
_CHARACTERS_PER_NODE = 32


def parse_yaml(text: str, place: str) -> Any:
    """Return the first document: dicts with string keys, lists, strings; None for an empty one.

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
