"""The table of names that BIND, GET_BIND and STT_BIND share: u16 size in bytes, then the names, each ending in NUL."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from struct import Struct

from igtl_gateway.base.errors import MalformedBody, TruncatedMessage
from igtl_gateway.base.quantities import counted

#: Before the types and before the table of names.
COUNT = Struct(">H")

#: The size field of the table has 16 bits.
MAX_NAME_TABLE = 65_535


def need(content: memoryview, size: int, what: str) -> None:
    """Raise TruncatedMessage where ``content`` has fewer than ``size`` bytes."""
    if size > content.nbytes:
        raise TruncatedMessage(
            what, f"{counted(content.nbytes, 'byte')} of content", f"at least {counted(size, 'byte')}"
        )


def read_count(content: memoryview, offset: int, what: str) -> int:
    """Return the u16 at ``offset``.  Raises TruncatedMessage."""
    need(content, offset + COUNT.size, what)
    (count,) = COUNT.unpack_from(content, offset)
    return int(count)


def read_names(content: memoryview, offset: int, count: int, place: str) -> tuple[list[str], bytes | None, int]:
    """Read the table of ``count`` names at ``offset``.

    Returns the names, the table itself where ``pack_names`` would write another one, and the offset of its end.
    Raises TruncatedMessage and MalformedBody.
    """
    size = read_count(content, offset, f"{place} table of names")
    start = offset + COUNT.size
    need(content, start + size, f"{place} table of names")
    table = bytes(content[start : start + size])
    pieces = table.split(b"\x00")
    # the C++ library omits the padding in places; a last name without NUL is unambiguous, too
    if count and (len(pieces) < count or (len(pieces) == count and not pieces[-1])):
        raise MalformedBody(f"{place} table of names", counted(table.count(0), "name"), counted(count, "name"))
    names = [piece.decode("utf-8", "surrogateescape") for piece in pieces[:count]]
    return names, None if pack_names(names) == table else table, start + size


def pack_names(names: Sequence[str]) -> bytes:
    """Return the table of names, padded to an even size.  Raises MalformedBody."""
    table = b"".join(_terminated(names))
    table += bytes(len(table) % 2)
    if len(table) > MAX_NAME_TABLE:
        raise MalformedBody("table of names", counted(len(table), "byte"), f"at most {MAX_NAME_TABLE} bytes")
    return table


def _terminated(names: Iterable[str]) -> Iterable[bytes]:
    for name in names:
        data = name.encode("utf-8", "surrogateescape")
        if b"\x00" in data:
            raise MalformedBody("name of a child", repr(name), "no NUL")
        yield data + b"\x00"
