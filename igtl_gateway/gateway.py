"""The gateway: a pure function from each input entry to the entries that it causes.

``Gateway.handle`` reads no clock, no file and no socket.  Its state (links, names, counters) is made by the
inputs alone, so that the same inputs with the same configuration give the same outputs, live, in a replay and
in a verification.  ``Session`` adds the numbering and is the door that all three come through.

What happens to a message on its way:

* OpenIGTLink → ROS: CRC and structure are checked, the content is decoded, every row of the conversion table
  that applies gives one ROS message.
* ROS → OpenIGTLink: the row of its type (or the configured one) gives a content, which is encoded once for
  each header version that the present links have shown, and addressed to all links at once.
* The last message of a latched stream (plans, surfaces) is sent again to every link that comes up.
* A message that fails on its way costs only itself: a note says why, the ledger counts it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

from igtl_gateway.buffers import Buffer
from igtl_gateway.config import Config, ToIgtlRow, ToRosRow, device_of_topic
from igtl_gateway.convert.context import ToIgtl, ToRos
from igtl_gateway.convert.names import frames_of, hashed, short_device_name, topic_token
from igtl_gateway.convert.table import IgtlRow, RosRow, row_to_igtl, rows_to_ros
from igtl_gateway.convert.units import Lengths
from igtl_gateway.errors import ConversionError, WireError
from igtl_gateway.qos import Qos
from igtl_gateway.session.entry import Entry, Kind
from igtl_gateway.session.ledger import Ledger
from igtl_gateway.session.note import Level, Note
from igtl_gateway.stamp import ns_to_ticks, ticks_to_ns
from igtl_gateway.wire import Header, Item, Message, decode, encode
from igtl_gateway.wire.fields import visible

#: Metadata key (header version 2) of a device name that was too long for its 20 bytes.
FULL_NAME_KEY = "DeviceName"

_IN, _OUT = "igtl_in", "igtl_out"
_ROS_IN, _ROS_OUT = "ros_in", "ros_out"

_Reply = tuple[Kind, str, str, Sequence[Buffer], tuple[int, ...], int]


@dataclass(frozen=True, slots=True)
class _ToIgtlStream:
    """A ROS topic that is bridged: everything that the hot path needs, resolved once."""

    row: ToIgtlRow
    conversion: IgtlRow
    device: str
    full_name: str
    channel: str
    lengths: Lengths
    latched: bool


@dataclass(frozen=True, slots=True)
class _ToRosStream:
    """An OpenIGTLink stream that is bridged."""

    row: ToRosRow
    outputs: tuple[tuple[RosRow, str], ...]
    frame_id: str
    child_frame_id: str
    lengths: Lengths


class Gateway:
    """See the module."""

    def __init__(self, config: Config) -> None:
        self.config = config
        self.ledger = Ledger()
        self._versions: dict[int, int] = {}  # link → highest header version it has shown
        self._to_igtl: dict[tuple[str, str], _ToIgtlStream | None] = {}
        self._to_ros: dict[tuple[str, str], _ToRosStream | None] = {}
        self._tokens: dict[str, str] = {}  # topic token → device that owns it
        self._devices: dict[str, str] = {}  # short device name → full name that owns it
        self._latched: dict[str, Entry] = {}  # topic → its last message; as many as there are bridged topics
        self._said: set[tuple[str, str, int]] = set()
        self._news: list[_Reply] = []  # notes of streams that this entry opened
        self._qos: dict[str, Qos] = {}
        self._handlers: dict[Kind, Callable[[Entry], list[_Reply]]] = {
            Kind.IGTL_IN: self._from_igtl,
            Kind.ROS_IN: self._from_ros,
            Kind.LINK: self._on_link,
            Kind.EDGE_NOTE: self._on_edge_note,
        }

    def handle(self, entry: Entry) -> list[Entry]:
        """The entries that ``entry`` causes, numbered and stamped directly behind it.

        Outputs (``*_OUT``, ``NOTE``) are accepted and cause nothing.
        """
        handler = self._handlers.get(entry.kind)
        if handler is None:
            return []
        try:
            self._news = []
            replies = handler(entry) + self._news
        except Exception as error:  # a defect of ours must cost one message, not the session
            self.ledger.drop(entry.kind.value, entry.channel, "internal_error")
            text = f"message lost to a defect of the gateway: {type(error).__name__}: {error}"
            replies = [_note(Level.ERROR, "internal_error", text, entry.channel, entry.links)]
        return [Entry(entry.seq + step, entry.stamp_ns + step, *reply) for step, reply in enumerate(replies, start=1)]

    # -- questions of the edges, answered without changing anything that influences outputs -------------------

    def subscription(self, topic: str, ros_type: str) -> Qos | None:
        """The QoS with which to subscribe to a topic that is to be bridged, None if it is not."""
        row, conversion = self._rows(topic, ros_type)
        return row.qos or conversion.qos if row and conversion else None

    def lacks_conversion(self, topic: str, ros_type: str) -> bool:
        """Whether a topic is to be bridged, but no row of the conversion table can do it."""
        row, conversion = self._rows(topic, ros_type)
        return row is not None and conversion is None

    def _rows(self, topic: str, ros_type: str) -> tuple[ToIgtlRow | None, IgtlRow | None]:
        """The row of the configuration for a topic, and the one of the conversion table that it leads to."""
        row = self.config.row_to_igtl(topic)
        return row, row_to_igtl(ros_type, row.type) if row else None

    def qos(self, topic: str) -> Qos | None:
        """The QoS of a topic that the gateway publishes."""
        return self._qos.get(topic)

    def keep(self, entry: Entry) -> bool:
        """Whether an outgoing OpenIGTLink message must not be dropped at a full send queue."""
        return entry.type in _KEPT_TYPES

    # -- OpenIGTLink → ROS --------------------------------------------------------------------------------------

    def _from_igtl(self, entry: Entry) -> list[_Reply]:
        self.ledger.count(_IN, entry.channel, "received")
        link = entry.links[0]
        try:
            message = decode(entry.payload[0], check_crc=self.config.check_crc)
        except WireError as error:
            self.ledger.drop(_IN, entry.channel, error.code)
            return [_note(Level.ERROR, error.code, f"message refused: {error}", entry.channel, (link,))]
        if message.header_version > self._versions.get(link, 0):
            self._versions[link] = message.header_version
        self.ledger.count(_IN, entry.channel, "decoded")
        device = _full_name(message)
        stream = self._ros_stream(visible(message.type), device)
        if stream is None:
            self.ledger.drop(_IN, entry.channel, "too_many_streams")
            text = f"more than {self.config.max_streams} streams: {entry.channel} is recorded, not published"
            return self._once(entry, Level.WARN, "too_many_streams", text, "", link)
        outputs = [pair for pair in stream.outputs if isinstance(message.content, pair[0].content)]
        if not outputs:
            # Raw content under a type that has rows is an empty body: "nothing to show"
            if stream.outputs:
                reason, level, what = "empty", Level.INFO, "has an empty body: nothing to publish"
            else:
                reason, level, what = "no_conversion", Level.WARN, "is recorded, but has no conversion to ROS"
            self.ledger.drop(_IN, entry.channel, reason)
            return self._once(entry, level, reason, f"{visible(message.type)} {what}", message.type, link)
        return self._publish(entry, message, device, stream, outputs)

    def _publish(
        self,
        entry: Entry,
        message: Message,
        device: str,
        stream: _ToRosStream,
        outputs: list[tuple[RosRow, str]],
    ) -> list[_Reply]:
        stamp_ns = self.config.pick_stamp(stream.row, ticks_to_ns(message.ticks), entry.stamp_ns)
        to = ToRos(device, stamp_ns, stream.frame_id, stream.child_frame_id, stream.lengths)
        replies: list[_Reply] = []
        try:
            for row, topic in outputs:
                if row.applies(message.content):
                    cdr = row.convert(message.content, to).pack()
                    replies.append((Kind.ROS_OUT, topic, row.message.TYPE, (cdr,), (), stamp_ns))
        except ConversionError as error:
            self.ledger.drop(_IN, entry.channel, "conversion")
            return [_note(Level.ERROR, "conversion", f"not published: {error}", entry.channel, entry.links)]
        self.ledger.count(_IN, entry.channel, "converted")
        for reply in replies:
            self.ledger.count(_ROS_OUT, reply[1], "published")
        return replies + self._warnings(to.warnings, entry)

    def _ros_stream(self, igtl_type: str, device: str) -> _ToRosStream | None:
        """The stream of a device, resolved on its first message; None beyond the limit of streams."""
        key = (igtl_type, device)
        if key in self._to_ros:
            return self._to_ros[key]
        if len(self._to_ros) >= self.config.max_streams:
            return None
        row = self.config.row_to_ros(igtl_type, device)
        token = self._token(device)
        parent, child = frames_of(topic_token(device), self.config.base_frame)
        outputs = []
        for conversion in rows_to_ros(igtl_type):
            topic = row.topic.format(device=token, kind=conversion.kind, type=topic_token(igtl_type.lower()))
            outputs.append((conversion, topic))
            self._qos.setdefault(topic, row.qos or conversion.qos)
        poses = any(conversion.kind == "transform" for conversion, _ in outputs)
        frame_id = row.frame_id or (parent if poses else self.config.base_frame)
        lengths = self.config.lengths(row)
        self._to_ros[key] = _ToRosStream(row, tuple(outputs), frame_id, row.child_frame_id or child, lengths)
        if outputs:
            topics = ", ".join(dict.fromkeys(topic for _, topic in outputs))
            self._open_stream(f"{visible(igtl_type)}/{device}", f"to {topics}")
        return self._to_ros[key]

    def _token(self, device: str) -> str:
        """The topic token of a device; a second device that would get the same one gets its hash added."""
        token = topic_token(device)
        while self._tokens.setdefault(token, device) != device:
            token = f"{token}_{hashed(device)}"
        return token

    # -- ROS → OpenIGTLink --------------------------------------------------------------------------------------

    def _from_ros(self, entry: Entry) -> list[_Reply]:
        topic = entry.channel
        self.ledger.count(_ROS_IN, topic, "received")
        stream = self._igtl_stream(topic, entry.type)
        if stream is None:
            self.ledger.count(_ROS_IN, topic, "recorded_only")
            return []
        if stream.latched:
            self._latched[topic] = entry
        if not self._versions:
            self.ledger.drop(_ROS_IN, topic, "no_peer")
            return []
        replies = self._send(entry, stream, self._versions)
        if any(reply[0] is Kind.IGTL_OUT for reply in replies):
            self.ledger.count(_ROS_IN, topic, "converted")
        else:
            self.ledger.drop(_ROS_IN, topic, "conversion")
        return replies

    def _send(self, entry: Entry, stream: _ToIgtlStream, versions: Mapping[int, int]) -> list[_Reply]:
        """A ROS message to some links, each in the header version that it reads; or a note why not."""
        to = ToIgtl(stream.lengths)
        conversion = stream.conversion
        try:
            outgoing = conversion.convert(conversion.message.unpack(entry.payload[0]), to)
            stamp_ns = self.config.pick_stamp(stream.row, outgoing.stamp_ns or entry.source_ns, entry.stamp_ns)
            message = Message(conversion.igtl_type, stream.device, outgoing.content, ns_to_ticks(stamp_ns))
            replies = self._encoded(message, stream, stamp_ns, versions)
        except (ConversionError, WireError) as error:
            return [_note(Level.ERROR, "conversion", f"not sent: {error}", entry.channel, ())]
        for reply in replies:
            self.ledger.count(_OUT, reply[1], "sent", len(reply[4]))
        return replies + self._warnings(to.warnings, entry)

    @staticmethod
    def _encoded(message: Message, stream: _ToIgtlStream, stamp_ns: int, versions: Mapping[int, int]) -> list[_Reply]:
        """One entry for each header version that links have shown, version 1 first."""
        replies: list[_Reply] = []
        for version in sorted(set(versions.values())):
            links = tuple(link for link, shown in versions.items() if shown == version)
            if version > 1:
                metadata = () if stream.device == stream.full_name else (Item.of(FULL_NAME_KEY, stream.full_name),)
                message = replace(message, header_version=version, metadata=metadata)
            replies.append((Kind.IGTL_OUT, stream.channel, message.type, encode(message), links, stamp_ns))
        return replies

    def _igtl_stream(self, topic: str, ros_type: str) -> _ToIgtlStream | None:
        """The stream of a topic, resolved on its first message; None where the topic is not bridged."""
        key = (topic, ros_type)
        if key not in self._to_igtl:
            self._to_igtl[key] = self._resolve_topic(topic, ros_type)
        return self._to_igtl[key]

    def _resolve_topic(self, topic: str, ros_type: str) -> _ToIgtlStream | None:
        row, conversion = self._rows(topic, ros_type)
        if not row or not conversion:
            return None
        kinds = {other.kind for other in rows_to_ros(conversion.igtl_type)}
        last = topic.rpartition("/")[2]
        full_name = row.device or device_of_topic(topic, last if last in kinds else "")
        device = short_device_name(full_name)
        while self._devices.setdefault(device, full_name) != full_name:
            device = short_device_name(f"{full_name[:8]}_{hashed(device + full_name)}_{full_name}")
        channel = f"{conversion.igtl_type}/{device}"
        self._open_stream(topic, f"to {channel}" + (f" (for {full_name})" if device != full_name else ""))
        latched = (row.qos or conversion.qos).latched
        return _ToIgtlStream(row, conversion, device, full_name, channel, self.config.lengths(row), latched)

    # -- links and notes ----------------------------------------------------------------------------------------

    def _on_link(self, entry: Entry) -> list[_Reply]:
        note = Note.unpack(entry.data())
        replies: list[_Reply] = []
        for link in entry.links:
            if note.code == LINK_UP:
                self._versions[link] = 1
                # plans and surfaces are said once: whoever comes later gets the last of each, as a late
                # subscriber of a transient-local topic does
                for topic, last in self._latched.items():
                    if stream := self._igtl_stream(topic, last.type):
                        replies += self._send(last, stream, {link: 1})
            else:
                self._versions.pop(link, None)
                self._said = {said for said in self._said if said[2] != link}
        return replies

    def _on_edge_note(self, entry: Entry) -> list[_Reply]:
        note = Note.unpack(entry.data())
        self.ledger.count("edges", note.stream, note.code)
        return []

    def _open_stream(self, stream: str, text: str) -> None:
        """Say where a new stream goes."""
        self._news.append(_note(Level.INFO, "stream", f"{stream} goes {text}", stream, ()))

    def _once(self, entry: Entry, level: Level, code: str, text: str, about: str, link: int = 0) -> list[_Reply]:
        """A note, but only the first of its kind about this (from this link): the log is for what is new."""
        if (code, about, link) in self._said:
            return []
        self._said.add((code, about, link))
        return [_note(level, code, text, entry.channel, entry.links)]

    def _warnings(self, warnings: list[tuple[str, str]], entry: Entry) -> list[_Reply]:
        """Notes for what a conversion had to bend, once for each stream and cause."""
        return [reply for code, text in warnings for reply in self._once(entry, Level.WARN, code, text, entry.channel)]


LINK_UP, LINK_DOWN = "link_up", "link_down"

#: Types whose messages each count; states and pictures are replaced by the next one anyway.
_KEPT_TYPES = frozenset({"STRING", "STATUS", "COMMAND", "RTS_COMMAND"})


def _note(level: Level, code: str, text: str, stream: str, links: tuple[int, ...]) -> _Reply:
    return (Kind.NOTE, "", "", (Note(level, code, text, stream).pack(),), links, 0)


def _full_name(message: Message) -> str:
    """The device's full name: from the metadata where the sender had to shorten it."""
    for item in message.metadata:
        if item.key == FULL_NAME_KEY and short_device_name(item.text) == message.device_name:
            return item.text
    return visible(message.device_name)


class Session:
    """The gateway with its numbering: raw inputs in, numbered entries out.  Still pure: the time is an argument."""

    def __init__(self, gateway: Gateway) -> None:
        self.gateway = gateway
        self._seq = 0
        self._stamp_ns = 0

    def input(
        self,
        now_ns: int,
        kind: Kind,
        payload: Sequence[Buffer],
        *,
        channel: str = "",
        type_name: str = "",
        links: tuple[int, ...] = (),
        source_ns: int = 0,
    ) -> list[Entry]:
        """The entry of an input that arrived at ``now_ns`` (UTC), followed by what it caused.

        OpenIGTLink input names its own channel, type and stamp: they are read from its header.
        """
        if kind is Kind.IGTL_IN:
            header = Header.unpack(payload[0])
            channel, type_name = stream_name(header), visible(header.type)
            source_ns = ticks_to_ns(header.ticks)
        # log order is time order, even where the host's clock steps back
        entry = Entry(
            self._seq + 1,
            max(now_ns, self._stamp_ns + 1),
            kind,
            channel,
            type_name,
            payload,
            links,
            source_ns,
        )
        entries = [entry, *self.gateway.handle(entry)]
        self._seq, self._stamp_ns = entries[-1].seq, entries[-1].stamp_ns
        return entries


def stream_name(header: Header) -> str:
    """``TYPE/device`` of an OpenIGTLink header, as people read it."""
    return f"{visible(header.type)}/{visible(header.device_name)}"
