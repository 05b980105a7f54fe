"""Answers to queries: GET_ is answered from the latest messages, STT_ and STP_ start and stop streams to the peer.

The reply to a query that cannot be answered is a message of the requested type without content.  ``query.md`` requires
it, and 3D Slicer accepts it; an RTS_ of a known type crashes 3D Slicer.  Other programs that use the C++ library wait
for the missing content of a version 1 message.  They get a STATUS.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from igtl_gateway.base.stamp import NS_PER_MS, ns_to_ticks
from igtl_gateway.gateway.peers import MAX_STREAM_REQUESTS, TRACKING, Peer, interval_ns
from igtl_gateway.gateway.to_igtl.sender import OutboundMessage
from igtl_gateway.gateway.to_igtl.trackdata import NAME_BYTES, Latest, name_field, tracking_moments
from igtl_gateway.wire import Message, Raw
from igtl_gateway.wire.body import Body
from igtl_gateway.wire.capability import Capability
from igtl_gateway.wire.fields import visible
from igtl_gateway.wire.image import Image
from igtl_gateway.wire.metalists import IMAGE_META_DTYPE, ImageMetaList
from igtl_gateway.wire.query import (
    QUERIES,
    EmptyQuery,
    QueryReply,
    StartBind,
    StartPolyData,
    StartTracking,
    StartVideo,
    query_name,
)
from igtl_gateway.wire.registry import ALIASES, BODIES
from igtl_gateway.wire.text import Status

OK, ERROR = 0, 1
#: The frame that programs on the C++ library, such as its examples, ask for if they mean any.
_PATIENT = "patient"
_STATUS_OK, _STATUS_NOT_FOUND, _STATUS_ACCESS_DENIED = 1, 4, 5
_LONG_NAME_BYTES = 63
_TYPE_BYTES = 12  # of the type name in a header

#: Maximum number of device names under which one peer may request tracking data: each costs a message per pose.
MAX_TRACKED = 16

#: Whether a coordinate frame is known.
IsKnownFrame = Callable[[str], bool]

#: Types that the gateway reads, under the names that programs send.
READABLE = tuple(sorted(BODIES.keys() - ALIASES.keys()))


class StartedStream(NamedTuple):
    """The status for the reply to a STT_, and the reason of a refusal or what is different from the request."""

    status: int
    reason: str = ""


def answer(igtl_type: str, device: str, now_ns: int, latest: Latest, *, moments: bool = True) -> list[OutboundMessage]:
    """Return the answers to a GET_; none if there is no message of that type and device.

    Composed tracking data is one message for each moment, the newest first; without ``moments`` one of all poses.
    """
    if igtl_type == "STATUS":
        return [OutboundMessage(igtl_type, device, Status(_STATUS_OK), now_ns)]
    if igtl_type == "CAPABILITY":
        return [OutboundMessage(igtl_type, device, Capability(READABLE), now_ns)]
    found = latest(igtl_type, device)
    if not found and igtl_type == "IMGMETA":
        return _images(device, now_ns, latest)
    if not found and igtl_type in TRACKING:
        return [each.message for each in tracking_moments(igtl_type, device, latest, moments=moments)][::-1]
    return found


def empty_reply(igtl_type: str, device: str, now_ns: int, peer: Peer) -> OutboundMessage:
    """Return the reply for "none": the type without content, or a STATUS for peers that do not accept that."""
    # escaped bytes make a name longer: a message of that type may be impossible
    names_one = len(igtl_type.encode()) <= _TYPE_BYTES
    if names_one and peer.profile.takes_without_content(igtl_type, peer.version):
        return OutboundMessage(igtl_type, device, Raw(b""), now_ns)
    text = f"there is no {igtl_type} {device}".rstrip()
    return OutboundMessage("STATUS", device, Status(_STATUS_NOT_FOUND, 0, "NotFound", text), now_ns)


def denial_reply(prefix: str, igtl_type: str, device: str, now_ns: int, why: str) -> list[OutboundMessage]:
    """Return the reply to a refused query: the RTS_ for a stream, else a STATUS."""
    outs = acknowledgement(igtl_type, device, now_ns, ERROR) if prefix != "GET" else []
    text = f"{query_name(prefix, igtl_type)} is {why}"
    return outs or [OutboundMessage("STATUS", device, Status(_STATUS_ACCESS_DENIED, 0, "AccessDenied", text), now_ns)]


def acknowledgement(igtl_type: str, device: str, now_ns: int, status: int) -> list[OutboundMessage]:
    """Return the RTS_ of a type; none if the protocol does not define one."""
    name = query_name("RTS", igtl_type)
    return [OutboundMessage(name, device, QueryReply(status), now_ns)] if name in QUERIES else []


def start_stream(message: Message, igtl_type: str, peer: Peer, known: IsKnownFrame) -> StartedStream:
    """Start a stream to a peer (STT_)."""
    content = message.content
    frame = visible(content.coordinate_name) if isinstance(content, StartTracking) else ""
    device, note = visible(message.device_name), ""
    if query_name("STT", igtl_type) not in QUERIES:
        return StartedStream(ERROR, f"streams of {igtl_type} cannot be requested")
    if frame and not known(frame):
        if peer.recent and peer.profile.asks_once:
            note = f"the frame {frame!r} is not known yet, and poses are sent as soon as it is"
        elif not (peer.recent and frame.casefold() == _PATIENT):
            return StartedStream(ERROR, f"the frame {frame!r} is not known: no message and no transform names it")
        else:
            note, frame = f"the frame {frame!r} is not known, and the poses are sent in their own frames", ""
    if igtl_type in TRACKING and len({*peer.tracked, (igtl_type, device)}) > MAX_TRACKED:
        return StartedStream(ERROR, f"it has requested {MAX_TRACKED} streams of tracking data, the maximum")
    if not peer.start_stream(igtl_type, device, _interval_ns(content), frame):
        return StartedStream(ERROR, f"it has requested {MAX_STREAM_REQUESTS} streams, the maximum")
    return StartedStream(OK, note)


def _interval_ns(content: Body) -> int:
    match content:
        case StartTracking() | StartVideo():
            return interval_ns(content.resolution)
        case EmptyQuery():  # OpenIGTLink4J's interval, or something else
            found_ns = interval_ns(content.resolution)
            return found_ns if found_ns <= _LONGEST_NS else 0
        case StartPolyData():
            return content.resolution_ns or 0
        case StartBind():
            # the C++ writer leaves this field undefined: ignore values that are too long to be meant
            return content.resolution_ns if content.resolution_ns <= _LONGEST_NS else 0
        case _:
            return 0


_LONGEST_NS = 3_600_000 * NS_PER_MS


def _images(device: str, now_ns: int, latest: Latest) -> list[OutboundMessage]:
    """Return the IMGMETA of the images that go out."""
    rows = [_image_row(one) for one in latest("IMAGE", device)]
    if not rows:
        return []
    elements = np.concatenate(rows)
    return [OutboundMessage("IMGMETA", device, ImageMetaList(elements), now_ns)]


def _image_row(out: OutboundMessage) -> Any:
    row = np.zeros(1, IMAGE_META_DTYPE)
    row["name"] = name_field(out.full_name or out.device, _LONG_NAME_BYTES)
    row["device_name"] = name_field(out.device, NAME_BYTES + 1)
    row["ticks"] = ns_to_ticks(out.stamp_ns)
    if isinstance(out.content, Image):
        row["size"] = out.content.dimensions
        row["scalar_type"] = out.content.scalar_type
    return row
