"""BIND: several contents in one message (``Protocol/bind.md``).

Children are contents as of header version 1: they have no header, time stamp, id or metadata of their own.  They are
cut out of the received bytes and decoded on demand by ``registry.read_child``, so that a child that cannot be decoded
affects neither its siblings nor the message.
"""

from __future__ import annotations

from dataclasses import dataclass
from struct import Struct
from typing import Any, ClassVar

from igtl_gateway.base.buffers import Buffer
from igtl_gateway.base.errors import MalformedBody
from igtl_gateway.base.quantities import counted
from igtl_gateway.base.versions import Self
from igtl_gateway.wire.fields import decode_text, encode_text, visible
from igtl_gateway.wire.header import TYPE_SIZE
from igtl_gateway.wire.layout import Field, Layout, compile_struct
from igtl_gateway.wire.name_table import COUNT, need, pack_names, read_count, read_names
from igtl_gateway.wire.traits import Traits

#: How deep BIND may lie in BIND, the outermost counted.  Real messages have one level.
MAX_DEPTH = 4

#: Children on all levels together.  Real messages have tens; each costs conversions and outputs of its own, for which
#: all others wait: what a message causes stands together in the log.
MAX_CHILDREN = 64


#: A BIND without children: their number, and the size of their names.
_NO_CHILDREN = bytes(4)


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

    def describe(self) -> dict[str, Any]:
        """Return what is known without decoding the content."""
        return {"type": visible(self.type), "name": visible(self.name), "size": memoryview(self.content).nbytes}


@dataclass(frozen=True, slots=True)
class Bind:
    """BIND: several contents in one message.

    Children have no header, time stamp, id or metadata of their own.

    Accepted: a table of names of odd size (the contents follow after ``names_size`` bytes: the C++ library does not
    always pad the table), names without the last NUL, a missing last pad byte, nested BIND up to four levels, 64
    children on all levels together.  Any 4 bytes, which have no child: the C++ library reserves them for the two sizes
    of a BIND without children, and leaves them uninitialised.

    Sent: names and contents padded to even sizes with zero.

    Attributes:
        children: in wire order.
        name_table: the names as received, where they were not laid out as we do it (no padding, for one).
        pads: the bytes behind contents of odd size as received, where one is not zero or the last is missing.
        unset: the content as received, where it is the uninitialised one of the C++ library.
    """

    PROTOCOL: ClassVar[str] = "2"
    TRAITS: ClassVar[Traits] = Traits(ns_per_byte=1_500)
    LAYOUT: ClassVar[Layout] = (
        Field("count", "u16", 1, "number of children"),
        Field("type", "char", TYPE_SIZE, "type name", per="child"),
        Field("size", "u64", 1, "bytes of the content, without the pad byte", per="child"),
        Field("names_size", "u16", 1, "bytes of the table of names"),
        Field("names", "char", "names_size", "device names, each ending in NUL; one more NUL if their size is odd"),
        Field("content", "bytes", "size", "as after a header of version 1", per="child"),
        Field("pad", "bytes", "0 or 1", "present if the size of the content is odd", per="child"),
    )

    _CHILD: ClassVar[Struct] = compile_struct(LAYOUT, "child")

    children: tuple[BindChild, ...]
    name_table: bytes | None = None
    pads: bytes | None = None
    unset: bytes | None = None

    @classmethod
    def unpack(cls, content: memoryview) -> Self:
        if content.nbytes == len(_NO_CHILDREN) and content != _NO_CHILDREN:
            return cls((), unset=bytes(content))
        children, name_table, pads, _ = _read(content, 1, 0)
        return cls(children, name_table, pads)

    def pack(self) -> list[Buffer]:
        if self.unset is not None:
            return [self.unset]
        total = len(self.children)
        _check_number(total)
        head = [COUNT.pack(total)]
        bodies: list[Buffer] = []
        pads, pad = bytes(len(self.children)) if self.pads is None else self.pads, 0
        for child in self.children:
            content = memoryview(child.content)
            head.append(self._CHILD.pack(encode_text(child.type, TYPE_SIZE, "BIND child, type name"), content.nbytes))
            if visible(child.type) == "BIND" and content.nbytes:
                *_, total = _read(content, 2, total)
            bodies.append(child.content)
            if content.nbytes % 2:
                bodies.append(pads[pad : pad + 1])
                pad += 1
        table = self.name_table
        if table is None:
            table = pack_names([child.name for child in self.children])
        head += (COUNT.pack(len(table)), table)
        return [b"".join(head), *(part for part in bodies if len(part))]

    def describe(self) -> dict[str, Any]:
        """Describe the children without their contents, which ``registry.describe_content`` adds."""
        return {"children": [child.describe() for child in self.children]}


def _check_number(total: int) -> None:
    if total > MAX_CHILDREN:
        raise MalformedBody(
            "BIND content", counted(total, "child", "children"), f"at most {MAX_CHILDREN} on all levels together"
        )


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
    heads_end = COUNT.size + Bind._CHILD.size * count
    need(content, heads_end, "BIND children")
    heads = list(Bind._CHILD.iter_unpack(content[COUNT.size : heads_end]))
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
        raise MalformedBody(
            "BIND content", counted(content.nbytes, "byte"), f"{counted(offset, 'byte')} by its own sizes"
        )
    usual_pads = bytes(sum(size % 2 for _, size in heads))
    return tuple(children), table, None if pads == usual_pads else bytes(pads), total
