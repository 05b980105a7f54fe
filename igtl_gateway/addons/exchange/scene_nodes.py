"""The nodes of a scene of 3D Slicer as MRML: an XML element each, with attributes and references to other nodes."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from xml.sax.saxutils import escape

#: Version that the scene states: readers of it and newer ones know all that is in it.
_HEAD = '<?xml version="1.0" encoding="UTF-8"?>\n<MRML version="Slicer5.8.0" userTags="">\n'
#: What XML cannot hold.
_UNWRITABLE = re.compile("[\x00-\x08\x0b\x0c\x0e-\x1f\ud800-\udfff\ufffe\uffff]")
_SIGNS = {'"': "&quot;", "\n": "&#10;", "\r": "&#13;", "\t": "&#9;"}
#: Element → class of its nodes, where it is not the same word.
_CLASSES = {"VolumeDisplay": "ScalarVolumeDisplay", "Volume": "ScalarVolume"}


def attribute(value: object) -> str:
    """Return a value as the content of an XML attribute."""
    return escape(_UNWRITABLE.sub("\ufffd", str(value)), _SIGNS)


def facts(values: Mapping[str, str]) -> str:
    """Return custom attributes of a node, as MRML writes them: ``%`` and ``;`` as ``%XX``; names have no colon."""
    return ";".join(f"{name}:{value.replace('%', '%25').replace(';', '%3B')}" for name, value in values.items())


def read_facts(text: str) -> dict[str, str]:
    """Return the custom attributes of a node; the inverse of ``facts``."""
    pairs = (each.partition(":") for each in text.split(";"))
    return {name: value.replace("%3B", ";").replace("%25", "%") for name, _, value in pairs}


@dataclass(slots=True)
class Scene:
    """A scene that is being built."""

    _texts: list[str] = field(default_factory=list)
    _counts: dict[str, int] = field(default_factory=dict)

    def new_id(self, tag: str) -> str:
        """Return the identity of the next node of an element."""
        number = self._counts[tag] = self._counts.get(tag, 0) + 1
        return f"vtkMRML{_CLASSES.get(tag, tag)}Node{number}"

    def add(
        self,
        tag: str,
        name: str,
        values: Mapping[str, object] | None = None,
        refers: Iterable[tuple[str, str]] = (),
        *,
        node: str = "",
        hidden: bool = False,
    ) -> str:
        """Add a node and return its identity.

        Args:
            tag: its XML element.
            name: what a user reads.
            values: further attributes.
            refers: role → identity of another node; without an identity, none is written.
            node: its identity, if it was given one by ``new_id``.
            hidden: whether lists of nodes do not show it.
        """
        node = node or self.new_id(tag)
        found = {"id": node, "name": name, "hideFromEditors": str(hidden).lower(), "selectable": "true"}
        if links := "".join(f"{role}:{other};" for role, other in refers if other):
            found["references"] = links
        given: dict[str, object] = {**found, **(values or {})}
        words = " ".join(f'{key}="{attribute(value)}"' for key, value in given.items())
        self._texts.append(f"<{tag} {words}></{tag}>\n")
        return node

    def document(self) -> bytes:
        """Return the file."""
        return (_HEAD + "".join(self._texts) + "</MRML>\n").encode()
