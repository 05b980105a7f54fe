"""What the conversion of a message depends on besides its content; before it has its number, too."""

from __future__ import annotations

from dataclasses import replace

from igtl_gateway.config.configuration import Config
from igtl_gateway.convert.context import ToRosContext
from igtl_gateway.convert.names import AS_PLUS, short_device_name
from igtl_gateway.convert.tracking import frame_of_tools
from igtl_gateway.gateway.metadata import RestoredMetadata
from igtl_gateway.gateway.streams import Streams, ToRosStream
from igtl_gateway.wire import Message
from igtl_gateway.wire.bind import BindChild
from igtl_gateway.wire.body import Body
from igtl_gateway.wire.fields import visible
from igtl_gateway.wire.tracking import QuaternionTrackingData, TrackingData


def context_of(
    config: Config,
    streams: Streams,
    stream: ToRosStream,
    message: Message,
    restored: RestoredMetadata,
    frame_id: str,
    link: int,
    stamp_ns: int,
) -> ToRosContext:
    """Return the context of the conversions of a message from a link, with this stamp for the ROS headers.

    Tracking data whose tools have one parent are in its frame, unless the configuration or the sender names another.
    """
    as_plus = config.naming >= AS_PLUS
    to = ToRosContext(
        restored.device_name,
        stamp_ns,
        frame_id,
        stream.row.child_frame_id or restored.child_frame_id or stream.child_frame_id,
        stream.lengths,
        visible(message.type),
        restored.items,
        message.message_id,
        link,
        reads_status=config.knows_peers,
        whole_names=as_plus,
        frames=streams.frames,
    )
    content = message.content
    if as_plus and isinstance(content, TrackingData | QuaternionTrackingData):
        if not (stream.row.frame_id or restored.frame_id) and (frame := frame_of_tools(content, to)):
            return replace(to, frame_id=frame)
    return to


def child_message(
    child: BindChild, content: Body, message: Message, restored: RestoredMetadata
) -> tuple[Message, RestoredMetadata]:
    """Return a child of a BIND as a message of its own, with what its metadata would contain."""
    name = visible(child.name) or restored.device_name
    inner = Message(child.type, short_device_name(name), content, message.ticks)
    return inner, replace(restored, device_name=name, items=())
