"""Parses untrusted XML to elements, within the limits of size, depth and count.

A document type is rejected, and with it every entity: no text expands, and no other file is read.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from xml.parsers import expat

from igtl_gateway.base.errors import DamagedRecording
from igtl_gateway.base.untrusted import limits


@dataclass(slots=True)
class Element:
    """One element.

    Attributes:
        name: its tag.
        line: line of its tag, from 1.
        attributes: name → value.
        children: elements in it, in their order.
        text: text directly in it.
    """

    name: str
    line: int
    attributes: dict[str, str]
    children: list[Element] = field(default_factory=list)
    text: str = ""

    def all(self, name: str) -> list[Element]:
        """Return the children with this name."""
        return [child for child in self.children if child.name == name]

    def first(self, name: str) -> Element | None:
        """Return the first child with this name, or None."""
        return next((child for child in self.children if child.name == name), None)


def parse_xml(data: str | bytes, place: str) -> Element:
    """Return the root element.

    Args:
        data: text, or the bytes of a file in the encoding that they declare.
        place: name of the document for errors.

    Raises DamagedRecording, LimitExceeded.
    """
    limits.check_limit("document", len(data), place)
    encoding = "utf-8" if isinstance(data, str) else None
    parser = expat.ParserCreate(encoding)
    top: list[Element] = []
    opened: list[Element] = []
    count = 0

    def start(name: str, attributes: dict[str, str]) -> None:
        nonlocal count
        count += 1
        at = f"{place}: line {parser.CurrentLineNumber}"
        limits.check_limit("count", count, f"{at}: elements")
        limits.check_limit("depth", len(opened) + 1, at)
        element = Element(name, parser.CurrentLineNumber, attributes)
        (opened[-1].children if opened else top).append(element)
        opened.append(element)

    def end(_name: str) -> None:
        opened.pop()

    def text(part: str) -> None:
        opened[-1].text += part

    def doctype(*_: object) -> None:
        raise DamagedRecording(f"{place}: line {parser.CurrentLineNumber}: found a document type, expected none")

    parser.buffer_text = True
    parser.StartElementHandler = start
    parser.EndElementHandler = end
    parser.CharacterDataHandler = text
    parser.StartDoctypeDeclHandler = doctype
    try:
        parser.Parse(data.encode("utf-8", "replace") if isinstance(data, str) else data, True)
    except expat.ExpatError as error:
        reason = expat.ErrorString(error.code)
        what = f"line {error.lineno}: found invalid XML: {reason}"
        raise DamagedRecording(f"{place}: {what}, expected a whole document") from None
    except (LookupError, ValueError) as error:  # an encoding that Python does not know
        raise DamagedRecording(f"{place}: found invalid XML: {error}, expected a whole document") from None
    return top[0]
