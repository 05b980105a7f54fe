"""BIND: several contents in one message (``Protocol/bind.md``).

Content: u16 number of children; per child its type (12 bytes) and size (u64); u16 size of the table of names;
the names, each ending in NUL, and one more NUL where that makes an odd size; the contents of the children, each
followed by one zero byte where its size is odd.

Children are contents as of header version 1: they have no header, time stamp, id or metadata of their own.
They are cut out of the received bytes and decoded only on demand, so an invalid child affects neither its siblings
nor the message.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Self

from igtl_gateway.buffers import Buffer
from igtl_gateway.errors import MalformedBody, TruncatedMessage, WireError
from igtl_gateway.wire.body import Body
from igtl_gateway.wire.fields import decode_text, encode_text, visible
from igtl_gateway.wire.layout import Field, Layout

_COUNT = struct.Struct(">H")
_CHILD = struct.Struct(">12sQ")

#: How deep BIND may lie in BIND, the outermost counted.  Real messages have one level.
MAX_DEPTH = 4

#: Children on all levels together.  Real messages have tens; each costs a look, and in the gateway conversions.
MAX_CHILDREN = 4_096

#: The size field of the table of names has 16 bits.
MAX_NAME_TABLE = 65_535


@dataclass(frozen=True, slots=True)
class BindChild:
    """One content inside a BIND.

    Attributes:
        type: type name, at most 12 bytes.
        name: its device name (C++ readers hold 20 bytes), without NUL.
        content: as after a version 1 header.
    """

    type: str
    name: str
    content: Buffer

    def body(self) -> Body:
        """The decoded content.  Raises TruncatedMessage or MalformedBody."""
        from igtl_gateway.wire.registry import read_content  # a child may be of any type, BIND among them

        return read_content(self.type, memoryview(self.content))

    def describe(self) -> dict[str, Any]:
        """As in ``Bind.describe``; a content that cannot be decoded gives ``"error"`` in its place."""
        shown: dict[str, Any] = {
            "type": visible(self.type),
            "name": visible(self.name),
            "size": memoryview(self.content).nbytes,
        }
        try:
            shown["content"] = self.body().describe()
        except WireError as error:
            shown["error"] = {"code": error.code, "text": str(error)}
        return shown


@dataclass(frozen=True, slots=True)
class Bind:
    """BIND: several contents in one message.

    Children have no header, time stamp, id or metadata of their own.

    Accepted: a table of names of odd size (the contents follow after ``names_size`` bytes: the C++ library does not
    always pad the table), names without the last NUL, a missing last pad byte, nested BIND up to four levels, 4,096
    children on all levels together.

    Sent: names and contents padded to even sizes with zero.

    Attributes:
        children: in wire order.
        name_table: the names as received, where they were not laid out as we do it (no padding, for one).
        pads: the bytes behind contents of odd size as received, where one is not zero or the last is missing.
    """

    PROTOCOL: ClassVar[str] = "2"
    LAYOUT: ClassVar[Layout] = (
        Field("count", "u16", 1, "number of children"),
        Field("type", "char", 12, "type name", per="child"),
        Field("size", "u64", 1, "bytes of the content, without the pad byte", per="child"),
        Field("names_size", "u16", 1, "bytes of the table of names"),
        Field("names", "char", "names_size", "device names, each ending in NUL; one more NUL if their size is odd"),
        Field("content", "bytes", "size", "as after a header of version 1", per="child"),
        Field("pad", "bytes", "0 or 1", "present if the size of the content is odd", per="child"),
    )

    children: tuple[BindChild, ...]
    name_table: bytes | None = None
    pads: bytes | None = None

    @classmethod
    def unpack(cls, content: memoryview) -> Self:
        children, name_table, pads, _ = _read(content, 1, 0)
        return cls(children, name_table, pads)

    def pack(self) -> list[Buffer]:
        total = len(self.children)
        _check_number(total)
        head = [_COUNT.pack(total)]
        bodies: list[Buffer] = []
        pads, pad = bytes(len(self.children)) if self.pads is None else self.pads, 0
        for child in self.children:
            content = memoryview(child.content)
            head.append(_CHILD.pack(encode_text(child.type, 12, "BIND child, type name"), content.nbytes))
            if visible(child.type) == "BIND" and content.nbytes:
                *_, total = _read(content, 2, total)
            bodies.append(child.content)
            if content.nbytes % 2:
                bodies.append(pads[pad : pad + 1])
                pad += 1
        table = self.name_table
        if table is None:
            table = pack_names([child.name for child in self.children])
        head += (_COUNT.pack(len(table)), table)
        return [b"".join(head), *(part for part in bodies if len(part))]

    def describe(self) -> dict[str, Any]:
        return {"children": [child.describe() for child in self.children]}


def _check_number(total: int) -> None:
    if total > MAX_CHILDREN:
        raise MalformedBody("BIND content", f"{total} children", f"at most {MAX_CHILDREN} on all levels together")


def _read(
    content: memoryview, depth: int, before: int
) -> tuple[tuple[BindChild, ...], bytes | None, bytes | None, int]:
    """Children, names and pads where they are unusual, and how many children there are with those ``before``.

    BIND inside is read too, to know that it ends.
    """
    if depth > MAX_DEPTH:
        raise MalformedBody("BIND content", "BIND in BIND", f"at most {MAX_DEPTH} levels")
    count = read_count(content, 0, "BIND content")
    total = before + count
    _check_number(total)
    heads_end = _COUNT.size + _CHILD.size * count
    need(content, heads_end, "BIND children")
    heads = list(_CHILD.iter_unpack(content[_COUNT.size : heads_end]))
    names, table, offset = read_names(content, heads_end, len(heads), "BIND")
    children: list[BindChild] = []
    pads = bytearray()
    for (kind, size), name in zip(heads, names, strict=True):
        need(content, offset + size, f"BIND child {len(children)}")
        child = BindChild(decode_text(kind), name, content[offset : offset + size])
        offset += size
        if size % 2:
            pads += content[offset : offset + 1]  # the last one may be missing
            offset = min(offset + 1, content.nbytes)
        if visible(child.type) == "BIND" and size:
            *_, total = _read(memoryview(child.content), depth + 1, total)
        children.append(child)
    if offset != content.nbytes:
        raise MalformedBody("BIND content", f"{content.nbytes} bytes", f"{offset} bytes by its own sizes")
    usual_pads = bytes(sum(size % 2 for _, size in heads))
    return tuple(children), table, None if pads == usual_pads else bytes(pads), total


# -- shared with the queries GET_BIND and STT_BIND ------------------------------------------------------------------


def need(content: memoryview, size: int, what: str) -> None:
    """Raises TruncatedMessage where ``content`` has fewer than ``size`` bytes."""
    if size > content.nbytes:
        raise TruncatedMessage(what, f"{content.nbytes} bytes of content", f"at least {size} bytes")


def read_count(content: memoryview, offset: int, what: str) -> int:
    """The u16 at ``offset``."""
    need(content, offset + _COUNT.size, what)
    (count,) = _COUNT.unpack_from(content, offset)
    return int(count)


def read_names(content: memoryview, offset: int, count: int, place: str) -> tuple[list[str], bytes | None, int]:
    """The table of ``count`` names at ``offset``.

    Returns the names, the table itself where ``pack_names`` would make another one, and where it ends.
    """
    size = read_count(content, offset, f"{place} table of names")
    start = offset + _COUNT.size
    need(content, start + size, f"{place} table of names")
    table = bytes(content[start : start + size])
    pieces = table.split(b"\x00")
    # the C++ library forgets the padding in places; a last name without NUL can be read just as well
    if count and (len(pieces) < count or (len(pieces) == count and not pieces[-1])):
        raise MalformedBody(f"{place} table of names", f"{table.count(0)} names", f"{count} names")
    names = [piece.decode("utf-8", "surrogateescape") for piece in pieces[:count]]
    return names, None if pack_names(names) == table else table, start + size


def pack_names(names: Sequence[str]) -> bytes:
    """The table of names, padded to an even size.  Raises MalformedBody."""
    table = b"".join(_terminated(names))
    table += bytes(len(table) % 2)
    if len(table) > MAX_NAME_TABLE:
        raise MalformedBody("table of names", f"{len(table)} bytes", f"at most {MAX_NAME_TABLE} bytes")
    return table


def _terminated(names: Iterable[str]) -> Iterable[bytes]:
    for name in names:
        data = name.encode("utf-8", "surrogateescape")
        if b"\x00" in data:
            raise MalformedBody("name of a child", repr(name), "no NUL")
        yield data + b"\x00"
