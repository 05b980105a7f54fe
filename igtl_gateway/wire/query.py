"""Queries: GET_ asks for one message, STT_ starts a stream, STP_ stops it, RTS_ acknowledges (``Protocol/query.md``).

Most have no content.  The type name is the prefix and the name of the data, shortened where the document and
the library do so: GET_TRANS (GET_TRANSFOR in part of the document), GET_CAPABIL, GET_VMETA.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from struct import Struct
from typing import Any, ClassVar

from igtl_gateway.base.buffers import Buffer, join
from igtl_gateway.base.errors import MalformedBody
from igtl_gateway.base.quantities import counted
from igtl_gateway.base.versions import Self
from igtl_gateway.wire.body import Body, Raw
from igtl_gateway.wire.fields import decode_text, encode_text, visible
from igtl_gateway.wire.header import TYPE_SIZE
from igtl_gateway.wire.layout import Field, Layout, compile_struct
from igtl_gateway.wire.name_table import COUNT, need, pack_names, read_count, read_names

_COORDINATE_WIDTH = 32


#: An interval as OpenIGTLink4J sends it, with every STT_.
_LONG_INTERVAL = Struct(">q")


def _lengths(place: str, content: memoryview, *lengths: int) -> None:
    if content.nbytes not in lengths:
        wanted = " or ".join(map(str, lengths))
        raise MalformedBody(f"{place} content", counted(content.nbytes, "byte"), f"{wanted} bytes")


@dataclass(frozen=True, slots=True)
class EmptyQuery:
    """A query without content.

    Accepted: any content; it is kept.  Only 8 bytes of an STT_ mean something: OpenIGTLink4J's interval.

    Attributes:
        data: empty by every document.
    """

    MAY_BE_EMPTY: ClassVar[bool] = True
    LAYOUT: ClassVar[Layout] = ()
    data: Buffer = b""

    @property
    def resolution(self) -> int:
        """Minimum interval between two messages in milliseconds, of an STT_; 0 = every message."""
        return _LONG_INTERVAL.unpack(self.data)[0] if self.is_long else 0

    @property
    def is_long(self) -> bool:
        """Whether the content has the size of an interval as i64."""
        return len(self.data) == _LONG_INTERVAL.size

    @classmethod
    def unpack(cls, content: memoryview) -> Self:
        return cls(bytes(content))

    def pack(self) -> list[Buffer]:
        return [self.data] if len(self.data) else []

    def describe(self) -> dict[str, Any]:
        return Raw(self.data).describe()


@dataclass(frozen=True, slots=True)
class StartTracking:
    """STT_TDATA and STT_QTDATA: start a stream of tracking data.

    In the document STT_QTDATA has a status byte before these fields; no program writes it.

    Accepted: no content, which requests the defaults; 8 bytes, the interval as i64, which OpenIGTLink4J sends.

    Attributes:
        resolution: minimum interval between two messages, milliseconds; 0 = every message.
        coordinate_name: empty = the sender's default.
        has_body: False for a query without content, which requests the defaults.
        is_long: whether the content is the interval only, as i64.
    """

    MAY_BE_EMPTY: ClassVar[bool] = True
    LAYOUT: ClassVar[Layout] = (Field("resolution", "i32"), Field("coordinate_name", "char", _COORDINATE_WIDTH))
    _HEAD: ClassVar[Struct] = compile_struct(LAYOUT)

    resolution: int = 0
    coordinate_name: str = ""
    has_body: bool = True
    is_long: bool = False

    @classmethod
    def unpack(cls, content: memoryview) -> Self:
        _lengths("STT_TDATA", content, 0, _LONG_INTERVAL.size, cls._HEAD.size)
        if not content.nbytes:
            return cls(has_body=False)
        if content.nbytes == _LONG_INTERVAL.size:
            return cls(_LONG_INTERVAL.unpack(content)[0], is_long=True)
        resolution, name = cls._HEAD.unpack(content)
        return cls(resolution, decode_text(name))

    def pack(self) -> list[Buffer]:
        if not self.has_body:
            return []
        if self.is_long:
            return [_LONG_INTERVAL.pack(self.resolution)]
        name = encode_text(self.coordinate_name, _COORDINATE_WIDTH, "STT_TDATA coordinate system")
        return [self._HEAD.pack(self.resolution, name)]

    def describe(self) -> dict[str, Any]:
        return {"resolution": self.resolution, "coordinate_name": visible(self.coordinate_name)}


@dataclass(frozen=True, slots=True)
class StartVideo:
    """STT_VIDEO: start a video.

    Accepted: a ninth byte; the library declares nine for these eight.

    Attributes:
        codec: four letters as in VIDEO.
        resolution: minimum interval between two frames, milliseconds.
        trailing: the ninth byte.
    """

    LAYOUT: ClassVar[Layout] = (Field("codec", "char", 4), Field("resolution", "u32"))
    _HEAD: ClassVar[Struct] = compile_struct(LAYOUT)

    codec: str
    resolution: int = 0
    trailing: bytes = b""

    @classmethod
    def unpack(cls, content: memoryview) -> Self:
        _lengths("STT_VIDEO", content, cls._HEAD.size, cls._HEAD.size + 1)
        codec, resolution = cls._HEAD.unpack_from(content)
        return cls(decode_text(codec), resolution, bytes(content[cls._HEAD.size :]))

    def pack(self) -> list[Buffer]:
        return [self._HEAD.pack(encode_text(self.codec, 4, "STT_VIDEO codec"), self.resolution) + self.trailing]

    def describe(self) -> dict[str, Any]:
        return {"codec": visible(self.codec), "resolution": self.resolution}


@dataclass(frozen=True, slots=True)
class StartPolyData:
    """STT_POLYDATA: start a stream of surfaces; the interval is optional.

    Attributes:
        resolution_ns: minimum interval between two messages, nanoseconds; None = absent.
    """

    MAY_BE_EMPTY: ClassVar[bool] = True
    LAYOUT: ClassVar[Layout] = (Field("resolution_ns", "u64", 1, "minimum interval between two messages, nanoseconds"),)
    _HEAD: ClassVar[Struct] = compile_struct(LAYOUT)

    resolution_ns: int | None = None

    @classmethod
    def unpack(cls, content: memoryview) -> Self:
        _lengths("STT_POLYDATA", content, 0, cls._HEAD.size)
        return cls(cls._HEAD.unpack(content)[0] if content.nbytes else None)

    def pack(self) -> list[Buffer]:
        return [] if self.resolution_ns is None else [self._HEAD.pack(self.resolution_ns)]

    def describe(self) -> dict[str, Any]:
        return {"resolution_ns": self.resolution_ns}


@dataclass(frozen=True, slots=True)
class QueryReply:
    """RTS_…: the result of a query.

    Accepted: a missing byte, as in the document for RTS_BIND.

    Attributes:
        status: 0 success, 1 error; the library's RTS_POLYDATA has the opposite values.
        has_body: False if the byte is missing.
    """

    MAY_BE_EMPTY: ClassVar[bool] = True
    LAYOUT: ClassVar[Layout] = (Field("status", "u8"),)
    _HEAD: ClassVar[Struct] = compile_struct(LAYOUT)

    status: int = 0
    has_body: bool = True

    @classmethod
    def unpack(cls, content: memoryview) -> Self:
        _lengths("RTS_", content, 0, cls._HEAD.size)
        return cls(content[0]) if content.nbytes else cls(has_body=False)

    def pack(self) -> list[Buffer]:
        return [self._HEAD.pack(self.status)] if self.has_body else []

    def describe(self) -> dict[str, Any]:
        return {"status": self.status}


#: Type and device name of what is wanted of a BIND.
Wanted = tuple[str, str]

#: What the C++ library sends for "all": room for the number of children and for the size of the names, never filled.
#: A list with a child has 16 bytes at least, so it cannot be taken for one.
_UNINITIALISED = 4

_CHILDREN = (
    Field("count", "u16", 1, "number of requested contents"),
    Field("type", "char", TYPE_SIZE, "type name", per="content"),
    Field("names_size", "u16", 1, "bytes of the table of names"),
    Field("names", "char", "names_size", "device names, as in BIND"),
)
_TYPE = compile_struct(_CHILDREN, "content")


@dataclass(frozen=True, slots=True)
class GetBind:
    """GET_BIND: the requested contents; without content all of them.

    Accepted: any 4 bytes, which request all: the C++ library reserves them for the two sizes and leaves them
    uninitialised.  A table of names of odd size (the library does not pad it), with or without a pad byte after it.

    Sent: no content to request all; the table of names padded to an even size.

    Attributes:
        children: type and name of each; none = everything, which is a query without content.
        kept: the content as received, where it is not what we should write.
    """

    MAY_BE_EMPTY: ClassVar[bool] = True
    LAYOUT: ClassVar[Layout] = _CHILDREN

    children: tuple[Wanted, ...] = ()
    kept: bytes | None = None

    @classmethod
    def unpack(cls, content: memoryview) -> Self:
        query = cls(_read_children("GET_BIND", content, 0))
        return query if join(query.pack()) == content else replace(query, kept=bytes(content))

    def pack(self) -> list[Buffer]:
        if self.kept is not None:
            return [self.kept] if self.kept else []
        return [_pack_children(self.children)] if self.children else []

    def describe(self) -> dict[str, Any]:
        return _describe_children(self.children)


@dataclass(frozen=True, slots=True)
class StartBind:
    """STT_BIND: start a stream; the interval, then as GET_BIND.

    The library's writer leaves the interval uninitialised; more than an hour is treated as 0.

    Accepted: no content; after the interval, everything that GET_BIND accepts.

    Attributes:
        resolution_ns: minimum interval between two messages, nanoseconds.
        children, kept: as in ``GetBind``.
    """

    MAY_BE_EMPTY: ClassVar[bool] = True
    LAYOUT: ClassVar[Layout] = (Field("resolution_ns", "u64"), *_CHILDREN)
    _INTERVAL: ClassVar[Struct] = compile_struct(LAYOUT[:1])

    resolution_ns: int = 0
    children: tuple[Wanted, ...] = ()
    kept: bytes | None = None

    @classmethod
    def unpack(cls, content: memoryview) -> Self:
        resolution_ns = 0
        if content.nbytes:
            need(content, cls._INTERVAL.size, "STT_BIND interval")
            (resolution_ns,) = cls._INTERVAL.unpack_from(content)
        query = cls(resolution_ns, _read_children("STT_BIND", content, cls._INTERVAL.size))
        return query if join(query.pack()) == content else replace(query, kept=bytes(content))

    def pack(self) -> list[Buffer]:
        if self.kept is not None:
            return [self.kept] if self.kept else []
        return [self._INTERVAL.pack(self.resolution_ns) + (_pack_children(self.children) if self.children else b"")]

    def describe(self) -> dict[str, Any]:
        return {"resolution_ns": self.resolution_ns, **_describe_children(self.children)}


def _read_children(place: str, content: memoryview, offset: int) -> tuple[Wanted, ...]:
    """The list from ``offset`` on; nothing there is an empty list."""
    if content.nbytes in (offset, offset + _UNINITIALISED) or not content.nbytes:
        return ()
    count = read_count(content, offset, f"{place} content")
    names_at = offset + COUNT.size + _TYPE.size * count
    need(content, names_at, f"{place} types")
    types = [decode_text(kind) for (kind,) in _TYPE.iter_unpack(content[offset + COUNT.size : names_at])]
    names, _, end = read_names(content, names_at, count, place)
    if not end <= content.nbytes <= end + 1:  # a pad byte may stand outside the table
        raise MalformedBody(
            f"{place} content", counted(content.nbytes, "byte"), f"{counted(end, 'byte')} by its own sizes"
        )
    return tuple(zip(types, names, strict=True))


def _pack_children(children: Sequence[Wanted]) -> bytes:
    types = b"".join(encode_text(kind, TYPE_SIZE, "child, type name") for kind, _ in children)
    table = pack_names([name for _, name in children])
    return COUNT.pack(len(children)) + types + COUNT.pack(len(table)) + table


def _describe_children(children: Sequence[Wanted]) -> dict[str, Any]:
    return {"children": [{"type": visible(kind), "name": visible(name)} for kind, name in children]}


# -- names ------------------------------------------------------------------------------------------------------------

PREFIXES = ("GET", "STT", "STP", "RTS")

#: Type of the data → what follows the prefix, where that is not the same.
_SHORT = {"TRANSFORM": "TRANS", "CAPABILITY": "CAPABIL", "VIDEOMETA": "VMETA", "COLORTABLE": "COLORT"}
#: The other way round, with what only documents write.
_LONG = {
    "TRANS": "TRANSFORM",
    "TRANSFOR": "TRANSFORM",
    "QTRANS": "POSITION",
    "CAPABIL": "CAPABILITY",
    "VMETA": "VIDEOMETA",
}

_STREAMED = ("TDATA", "QTDATA", "IMAGE", "TRANS", "TRANSFOR", "POSITION", "QTRANS", "SENSOR", "POLYDATA", "NDARRAY",
             "BIND", "VIDEO")  # fmt: skip
_ASKED = ("STATUS", "CAPABIL", "STRING", "POINT", "TRAJ", "IMGMETA", "LBMETA", "COLORT", "VMETA")
_ANSWERED = ("STATUS", "CAPABIL", "POINT", "TRAJ", "IMGMETA", "LBMETA")

#: Type name of every query → its content.
QUERIES: dict[str, type[Body]] = {
    **{f"GET_{name}": EmptyQuery for name in (*_STREAMED, *_ASKED)},
    **{f"STT_{name}": EmptyQuery for name in _STREAMED},
    **{f"STP_{name}": EmptyQuery for name in _STREAMED},
    **{f"RTS_{name}": QueryReply for name in (*_STREAMED, *_ANSWERED)},
    "GET_BIND": GetBind,
    "STT_BIND": StartBind,
    "STT_TDATA": StartTracking,
    "STT_QTDATA": StartTracking,
    "STT_VIDEO": StartVideo,
    "STT_POLYDATA": StartPolyData,
}

#: What only documents write → what we write.
QUERY_ALIASES = {
    f"{prefix}_{name}": f"{prefix}_{sent}"
    for name, sent in (("TRANSFOR", "TRANS"), ("QTRANS", "POSITION"))
    for prefix in PREFIXES
}


@lru_cache(maxsize=256)
def split_query(type_name: str) -> tuple[str, str] | None:
    """Prefix and type of the data of a query, known or not; None for every other type name.

    >>> split_query("GET_TRANS"), split_query("STT_FOO"), split_query("RTS_COMMAND")
    (('GET', 'TRANSFORM'), ('STT', 'FOO'), None)
    """
    prefix, underscore, name = visible(type_name).partition("_")
    if prefix not in PREFIXES or not underscore or not name or (prefix, name) == ("RTS", "COMMAND"):
        return None
    return prefix, _LONG.get(name, name)


@lru_cache(maxsize=256)
def is_dialogue(type_name: str) -> bool:
    """Whether a type is part of a conversation, and not data: queries and their replies, commands, states."""
    return type_name in ("COMMAND", "RTS_COMMAND", "STATUS", "CAPABILITY") or split_query(type_name) is not None


def query_name(prefix: str, base: str) -> str:
    """Type name of a query on the wire.

    >>> query_name("GET", "CAPABILITY"), query_name("STT", "TDATA")
    ('GET_CAPABIL', 'STT_TDATA')
    """
    return f"{prefix}_{_SHORT.get(base, base)}"
