"""Converts a decoded message to ROS messages: by the rows of the conversion table, or as a RawMessage."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from igtl_gateway.base.buffers import join
from igtl_gateway.base.errors import ConversionError, WireError
from igtl_gateway.base.qos import Qos
from igtl_gateway.convert.assembly import ForeseenVolume
from igtl_gateway.convert.common_msgs import TFMessage
from igtl_gateway.convert.context import ToRosContext
from igtl_gateway.convert.igtl_msgs import Metadata
from igtl_gateway.convert.raw import raw_message
from igtl_gateway.convert.rosmsg import RosMessage
from igtl_gateway.convert.table import ConversionToRos, Role
from igtl_gateway.gateway.log.entry import Entry
from igtl_gateway.gateway.log.fates import CONVERTED, UNSUBSCRIBED
from igtl_gateway.gateway.log.note import Level
from igtl_gateway.gateway.naming import SharedNames
from igtl_gateway.gateway.outcome import Finding, Item, Outcome, conversion_failure, warning_findings
from igtl_gateway.gateway.output import Packed, ros_output
from igtl_gateway.gateway.streams import Streams, ToRosStream
from igtl_gateway.gateway.to_igtl.tf_receive import TfReceiver
from igtl_gateway.gateway.to_ros.beforehand import Beforehand, metadata_message
from igtl_gateway.gateway.to_ros.subscribers import Subscribers, Waiting
from igtl_gateway.wire import Message, Raw, decode, encode
from igtl_gateway.wire.bind import Bind
from igtl_gateway.wire.body import Body
from igtl_gateway.wire.image import Image

RAW_QOS = Qos(depth=100)
METADATA_QOS = Qos(depth=100)


class Converter:
    """Converts decoded messages to ROS.

    Attributes:
        shared: the names that several senders use; None in recordings that do not note them.
    """

    def __init__(
        self,
        streams: Streams,
        subscribers: Subscribers,
        frames: TfReceiver,
        beforehand: Beforehand,
        shared: SharedNames | None = None,
    ) -> None:
        self.shared = shared
        self._streams = streams
        self._subscribers = subscribers
        self._frames = frames
        self._beforehand = beforehand

    def convert(
        self, entry: Entry, message: Message, content: object, stream: ToRosStream, to: ToRosContext
    ) -> Outcome:
        """Return the ROS messages of a content; a RawMessage for a type without a conversion.

        Raises ConversionError if no row can convert it.
        """
        outputs = [pair for pair in stream.outputs if isinstance(content, pair[0].content)]
        if not outputs:
            return self._unconverted(entry, message, stream, to)
        if not any(row.applies(content) for row, _ in outputs):
            return Outcome(fate="not_chosen")
        items = self.publish(entry, content, to, stream, outputs)
        return Outcome(items, CONVERTED if items or self._subscribers.ask is None else UNSUBSCRIBED)

    def publish(
        self,
        entry: Entry,
        content: object,
        to: ToRosContext,
        stream: ToRosStream,
        outputs: Sequence[tuple[ConversionToRos, str]],
    ) -> list[Item]:
        """Convert by every row that applies; an error of one row does not affect others.  Raises if all rows fail."""
        items: list[Item] = []
        frames: list[Item] = []
        problems: list[tuple[ConversionToRos, ConversionError]] = []
        full = False
        for row, topic in outputs:
            if not row.applies(content):
                continue
            try:
                messages = self._built(topic, entry, row, content, to)
            except ConversionError as error:
                problems.append((row, error))
                continue
            full = full or row.role is Role.FULL
            for message in messages:
                if to.reads_status and isinstance(message, TFMessage) and not message.transforms:
                    continue
                items.append(ros_output(topic, message, to.stamp_ns))
                if not isinstance(message, TFMessage):
                    continue
                if self.shared:
                    frames += self.shared.frames(message, f"{to.igtl_type}/{to.device_name}", to.link)
                if self._frames:
                    frames += self._frames.update(entry, message, static=False)
        if problems and not items:
            raise problems[0][1]
        items += [conversion_failure(error, f"not published as {row.message.TYPE}", entry) for row, error in problems]
        if to.metadata and not full and self._subscribers.has(stream.metadata_topic, Metadata.TYPE):
            items.append(self._metadata(content, stream, to))
        return items + warning_findings(to.warnings, entry) + frames

    def build_waiting(self, topic: str) -> list[Item]:
        """Return the last message of a latched topic for its first subscriber."""
        waiting = self._subscribers.waiting.pop(topic, None)
        if waiting is None:
            return []
        entry, row, content, to, _ = waiting
        if content is None:  # from the fast path
            content = decode(entry.payload[0], check_crc=False).content
        try:
            return [ros_output(topic, message, to.stamp_ns) for message in _converted(row, content, to)]
        except ConversionError as error:
            return [conversion_failure(error, f"not published as {row.message.TYPE}", entry)]

    def _built(
        self, topic: str, entry: Entry, row: ConversionToRos, content: object, to: ToRosContext
    ) -> Sequence[RosMessage | Packed]:
        """Return the outputs of a row; none without a subscriber.  Raises ConversionError."""
        if self._subscribers.has(topic, row.message.TYPE):
            messages: Sequence[RosMessage | Packed] | None = self._beforehand.converted(row, content, to)
            if messages is None:
                messages = _converted(row, content, to)
            self._subscribers.waiting.pop(topic, None)
            return messages
        qos = self._streams.qos(topic)
        if qos and qos.latched:
            size = memoryview(content.pixels).nbytes if isinstance(content, Image) else entry.size
            self._subscribers.waiting[topic] = Waiting(replace(entry, payload=()), row, content, to, size)
        return ()

    def _metadata(self, content: object, stream: ToRosStream, to: ToRosContext) -> Item:
        """Return the metadata of the sender as a message of its own, beside a ROS type that cannot contain it."""
        message = self._beforehand.metadata(content, to) or metadata_message(to)
        self._streams.advertise(stream.metadata_topic, METADATA_QOS)
        return ros_output(stream.metadata_topic, message, to.stamp_ns)

    def foreseen(self, image: Image) -> ForeseenVolume | None:
        """Return the volume that a part makes, if it is known."""
        return self._beforehand.volume(image)

    def children(self, bind: Bind) -> Sequence[Body | WireError | None]:
        """Return the contents of the children of a BIND that are known; see ``Beforehand.children``."""
        return self._beforehand.children(bind)

    def _unconverted(self, entry: Entry, message: Message, stream: ToRosStream, to: ToRosContext) -> Outcome:
        """Publish a message without a conversion as a RawMessage; an empty one of a known type is not published."""
        if stream.outputs and isinstance(message.content, Raw):
            text = f"{to.igtl_type} has an empty body and is not published"
            return Outcome([_first(entry, "empty", text, message, to)], "empty")
        if any(not kind.startswith("+") for kind in stream.kinds):
            return Outcome(fate="not_chosen")
        self._streams.advertise(stream.raw_topic, RAW_QOS)
        # a child of a BIND has no bytes of its own, and thousands of copies of the BIND would fill the memory
        raw: RosMessage | Packed | None = self._beforehand.raw(entry, message.content)
        if raw is None:
            data = entry.payload[0] if entry.payload else join(encode(message))
            raw = raw_message(data, entry.stamp_ns, to.link)
        text = f"{to.igtl_type} has no conversion to ROS and is published unchanged"
        found = _first(entry, "no_conversion", text, message, to)
        return Outcome([ros_output(stream.raw_topic, raw, to.stamp_ns), found], CONVERTED)


def _first(entry: Entry, code: str, text: str, message: Message, to: ToRosContext) -> Finding:
    """Return a finding that is reported for the first message of a type from each link."""
    return Finding(Level.INFO, code, text, entry.channel, entry.links, subject=message.type, by=to.link)


def _converted(row: ConversionToRos, content: object, to: ToRosContext) -> Sequence[RosMessage]:
    """Convert a content by a row; other rows can use the result.  Raises ConversionError."""
    converted = row.convert(content, to)
    messages = converted if isinstance(converted, list) else [converted]
    to.made.update((message.TYPE, message) for message in messages)
    return messages
