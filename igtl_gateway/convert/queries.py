"""GET_, STT_, STP_ and RTS_ of every type ⇄ igtl_msgs/Query.

One ROS type represents all of them.  It has the fields of all queries; those that a query does not have are 0 or empty.
"""

from __future__ import annotations

from collections.abc import Callable

from igtl_gateway.base.errors import ConversionError
from igtl_gateway.base.stamp import NS_PER_MS
from igtl_gateway.convert.columns import fit_texts
from igtl_gateway.convert.context import ConvertedMessage, ToIgtlContext, ToRosContext
from igtl_gateway.convert.igtl_msgs import Query
from igtl_gateway.convert.rosmsg import Header
from igtl_gateway.wire.body import Body
from igtl_gateway.wire.fields import visible
from igtl_gateway.wire.query import (
    QUERIES,
    EmptyQuery,
    GetBind,
    QueryReply,
    StartBind,
    StartPolyData,
    StartTracking,
    StartVideo,
    query_name,
    split_query,
)

_KINDS = {"GET": Query.GET, "STT": Query.START, "STP": Query.STOP, "RTS": Query.REPLY}
_PREFIXES = {kind: prefix for prefix, kind in _KINDS.items()}

_COORDINATE_BYTES = 31  # of 32
_CODEC_BYTES = 4
_U32 = 1 << 32


def query_to_ros(content: Body, to: ToRosContext) -> Query:
    """Convert to Query, with intervals rounded up to milliseconds: no peer receives more messages than requested."""
    parts = split_query(to.igtl_type)
    if parts is None:
        raise ConversionError(f"query: found type {visible(to.igtl_type)!r}, expected GET_, STT_, STP_ or RTS_")
    prefix, base = parts
    resolution, coordinate_name, codec, status = 0, "", "", 0
    match content:
        case StartTracking():
            # signed in the library, unsigned in the document: the same 32 bits
            resolution, coordinate_name = min(content.resolution, _U32 - 1) % _U32, visible(content.coordinate_name)
        case EmptyQuery() if prefix == "STT":
            resolution = max(0, min(content.resolution, _U32 - 1))
        case StartVideo():
            resolution, codec = content.resolution, visible(content.codec)
        case StartPolyData() | StartBind():
            resolution = min(-(-(content.resolution_ns or 0) // NS_PER_MS), _U32 - 1)
        case QueryReply():
            status = content.status
    return Query(
        Header(to.stamp_ns, to.frame_id),
        _KINDS[prefix],
        base,
        to.device_name,
        resolution,
        coordinate_name,
        codec,
        status,
        to.link,
        to.metadata,
    )


def query_to_igtl(message: Query, to: ToIgtlContext) -> ConvertedMessage:
    """Convert to a query.  Raises ConversionError for kinds and types without a query.

    Fields that the query does not have are left out, with a warning.
    """
    prefix = _PREFIXES.get(message.kind)
    if prefix is None:
        raise ConversionError(f"{message.TYPE}: found kind {message.kind}, expected one of {sorted(_PREFIXES)}")
    igtl_type = query_name(prefix, message.type)
    codec = QUERIES.get(igtl_type)
    if codec is None:
        known = ", ".join(sorted({base for name in QUERIES for has, base in [_split(name)] if has == prefix}))
        raise ConversionError(f"{message.TYPE}: found type {message.type!r} for {prefix}_, expected one of {known}")
    carried, make = _CONTENTS[codec]
    for field in _FIELDS:
        if field not in carried and getattr(message, field):
            text = f"{field} {getattr(message, field)!r} does not fit into {igtl_type} and is left out"
            to.warnings.append(("field_left_out", text))
    return ConvertedMessage(
        make(message, to),
        message.header.stamp_ns,
        message.header.frame_id,
        metadata=message.metadata,
        igtl_type=igtl_type,
        device_name=message.device_name,
        link=message.link,
    )


def _split(query: str) -> tuple[str, str]:
    parts = split_query(query)
    assert parts is not None, query
    return parts


def _start_tracking(message: Query, to: ToIgtlContext) -> Body:
    (name,) = fit_texts((message.coordinate_name,), _COORDINATE_BYTES, "coordinate name", to)
    signed = (message.resolution + _U32 // 2) % _U32 - _U32 // 2
    return StartTracking(signed, name)


def _start_video(message: Query, _: ToIgtlContext) -> Body:
    codec = visible(message.codec)
    if len(codec.encode()) > _CODEC_BYTES:
        raise ConversionError(f"{message.TYPE}: found codec {message.codec!r}, expected at most {_CODEC_BYTES} bytes")
    return StartVideo(codec, message.resolution)


def _start_polydata(message: Query, _: ToIgtlContext) -> Body:
    # the library reads this query only without content
    return StartPolyData(message.resolution * NS_PER_MS or None)


#: Fields of ``Query`` that only some queries have.
_FIELDS = ("resolution", "coordinate_name", "codec", "status")

#: Content of a query → its fields, and the function that builds it.
_CONTENTS: dict[type[Body], tuple[set[str], Callable[[Query, ToIgtlContext], Body]]] = {
    EmptyQuery: (set(), lambda message, to: EmptyQuery()),
    GetBind: (set(), lambda message, to: GetBind()),
    StartBind: ({"resolution"}, lambda message, to: StartBind(message.resolution * NS_PER_MS)),
    StartTracking: ({"resolution", "coordinate_name"}, _start_tracking),
    StartVideo: ({"resolution", "codec"}, _start_video),
    StartPolyData: ({"resolution"}, _start_polydata),
    QueryReply: ({"status"}, lambda message, to: QueryReply(message.status)),
}
