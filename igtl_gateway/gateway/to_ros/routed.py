"""What the conversion of a message depends on besides its content; before it has its number, too."""

from __future__ import annotations

from dataclasses import replace

from igtl_gateway.config.configuration import Config
from igtl_gateway.convert.context import ToRosContext
from igtl_gateway.convert.names import short_device_name
from igtl_gateway.gateway.metadata import RestoredMetadata
from igtl_gateway.gateway.streams import Streams, ToRosStream
from igtl_gateway.wire import Message
from igtl_gateway.wire.bind import BindChild
from igtl_gateway.wire.body import Body
from igtl_gateway.wire.fields import visible


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
    """Return the context of the conversions of a message from a link, with this stamp for the ROS headers."""
    return ToRosContext(
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
        frames=streams.frames,
    )


def child_message(
    child: BindChild, content: Body, message: Message, restored: RestoredMetadata
) -> tuple[Message, RestoredMetadata]:
    """Return a child of a BIND as a message of its own, with what its metadata would contain."""
    name = visible(child.name) or restored.device_name
    inner = Message(child.type, short_device_name(name), content, message.ticks)
    return inner, replace(restored, device_name=name, items=())
