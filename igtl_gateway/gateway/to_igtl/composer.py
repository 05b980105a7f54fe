"""Composes an :class:`OutboundMessage` from a converted ROS message: adds device name, stamp and metadata."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from igtl_gateway.config.configuration import Config
from igtl_gateway.convert.context import ConvertedMessage, ToIgtlContext
from igtl_gateway.convert.frames import MAX_FRAMES
from igtl_gateway.convert.rosmsg import RosMessage
from igtl_gateway.convert.structs import Size
from igtl_gateway.convert.table import ConversionToIgtl
from igtl_gateway.convert.units import LengthUnits
from igtl_gateway.gateway.log.entry import Entry
from igtl_gateway.gateway.streams import Streams, ToIgtlStream
from igtl_gateway.gateway.to_igtl.sender import OutboundMessage
from igtl_gateway.wire.body import Body
from igtl_gateway.wire.query import split_query
from igtl_gateway.wire.transform import Position, Transform
from igtl_gateway.wire.video import Video

#: Contents of arms that have lengths of the tool.
_POSES = (Transform, Position)


class Composer:
    """Composes outbound messages; keeps the frame ids and the image size of each video stream."""

    def __init__(self, config: Config, streams: Streams) -> None:
        self._config = config
        self._streams = streams
        self._frames: set[str] = set()
        self._video_sizes: dict[str, Size] = {}  # topic → size of its last key frame

    def compose(
        self,
        entry: Entry,
        stream: ToIgtlStream,
        conversion: ConversionToIgtl,
        outgoing: ConvertedMessage,
        message: RosMessage | None = None,
    ) -> OutboundMessage:
        """Return the outbound message for the result of ``conversion``.

        ``message``: of the topic of an arm, which some peers get in their unit.
        """
        device, full_name, content = stream.device, stream.full_name, outgoing.content
        if len(self._frames) < MAX_FRAMES:
            self._frames.add(outgoing.frame_id)
        if isinstance(content, Video):
            content = self._sized(entry.channel, content)
        # a query without a device means any device
        if outgoing.device_name or (outgoing.igtl_type and split_query(outgoing.igtl_type)):
            full_name = outgoing.device_name
            device = self._streams.device(full_name)
        return OutboundMessage(
            outgoing.igtl_type or conversion.igtl_type,
            device,
            content,
            self._config.pick_stamp(stream.row, outgoing.stamp_ns or entry.source_ns, entry.stamp_ns),
            full_name,
            outgoing.stamp_ns,
            outgoing.frame_id,
            outgoing.child_frame_id,
            (*stream.row_metadata, *outgoing.metadata),
            in_unit=self._in_unit(stream, conversion, outgoing, message),
        )

    def _in_unit(
        self,
        stream: ToIgtlStream,
        conversion: ConversionToIgtl,
        outgoing: ConvertedMessage,
        message: RosMessage | None,
    ) -> Callable[[str], Body] | None:
        """Return the function that converts the pose of an arm for peers with a unit of their own."""
        if message is None or not (stream.of_robot and self._config.fitting and isinstance(outgoing.content, _POSES)):
            return None

        def converted(unit: str) -> Body:
            if unit == stream.lengths.igtl:
                return outgoing.content
            return conversion.convert(message, ToIgtlContext(LengthUnits(stream.lengths.ros, unit))).content

        return converted

    def convert(self, entry: Entry, stream: ToIgtlStream, conversion: ConversionToIgtl) -> OutboundMessage:
        """Return the outbound message of a kept ROS message.  Raises ConversionError."""
        message = conversion.message.unpack(entry.payload[0])
        outgoing = conversion.convert(message, ToIgtlContext(stream.lengths))
        return self.compose(entry, stream, conversion, outgoing, message)

    def knows(self, frame: str) -> bool:
        """Return whether a message with this frame has been sent."""
        return frame in self._frames

    def _sized(self, topic: str, frame: Video) -> Video:
        """Return a video frame with the size of its stream, which only key frames contain."""
        if frame.size[0]:
            self._video_sizes[topic] = frame.size
            return frame
        return replace(frame, size=self._video_sizes.get(topic, frame.size), subvol_size=None)
